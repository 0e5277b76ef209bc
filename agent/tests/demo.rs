//! The demonstration as a program: it ends by itself, leaves nothing running, and says what is wrong with bad data.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use std::{fs, thread};

fn demo(out: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_merganser"));
    command.arg("demo").arg("--out").arg(out).stdin(Stdio::null());
    command
}

/// Processes whose command line holds `text`, this one aside.
fn processes(text: &str) -> usize {
    let own = std::process::id().to_string();
    let entries = fs::read_dir("/proc").unwrap().flatten().filter(|entry| entry.file_name().to_string_lossy() != own);
    let lines = entries.filter_map(|entry| fs::read(entry.path().join("cmdline")).ok());
    lines.filter(|line| String::from_utf8_lossy(line).contains(text)).count()
}

#[test]
fn bad_data_is_told_in_one_line() {
    let dir = tempfile::tempdir().unwrap();
    let nothing = dir.path().join("nothing");
    fs::create_dir(&nothing).unwrap();
    fs::write(nothing.join("notes.txt"), "").unwrap();
    let absent = dir.path().join("absent");
    for (data, what) in [(&nothing, "nothing here can be fed to robots"), (&absent, "No such file")] {
        let told = demo(&dir.path().join("out")).arg("--data").arg(data).output().unwrap();
        assert_eq!(told.status.code(), Some(2));
        let text = String::from_utf8(told.stderr).unwrap();
        assert!(text.contains(what) && text.contains(data.to_str().unwrap()), "{text}");
        assert_eq!(text.lines().count(), 1, "{text}");
    }
}

#[test]
fn agents_end_with_an_interrupted_demonstration() {
    if !Path::new("/proc/self/cmdline").exists() {
        println!("skipped: there is no /proc to look for processes in");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let mark = dir.path().to_str().unwrap().to_owned();
    // Slow enough that it cannot be over before it is interrupted.
    let mut demo =
        demo(dir.path()).args(["--speed", "0.5"]).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    wait_for(|| processes(&mark) == 4, "the demonstration and three agents");
    let told = Command::new("kill").arg(demo.id().to_string()).status().unwrap();
    assert!(told.success());
    assert_eq!(demo.wait().unwrap().code(), Some(1));
    assert_eq!(processes(&mark), 0);
}

fn wait_for(good: impl Fn() -> bool, what: &str) {
    let start = Instant::now();
    while !good() {
        assert!(start.elapsed() < Duration::from_secs(30), "waited in vain for {what}");
        thread::sleep(Duration::from_millis(50));
    }
}
