//! `merganser-sim run` from outside: seeds of a band are told in order whichever ends first, and how it exits.

#![allow(clippy::unwrap_used, clippy::panic, reason = "the whole file is a test")]

use std::path::{Path, PathBuf};
use std::process::Command;

const SHORT: &str =
    "name = \"short\"\nabout = \"Two robots, for a moment.\"\nrobots = 2\nduration_secs = 4\nsettle_secs = 30\n";

fn scenario(dir: &Path, text: &str) -> PathBuf {
    let path = dir.join("short.toml");
    std::fs::write(&path, text).unwrap();
    path
}

fn run(path: &Path, arguments: &[&str]) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_merganser-sim"));
    let output = command.arg("run").arg(path).args(arguments).output().unwrap();
    (output.status.code(), String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap())
}

/// The lines that tell of a seed, without how long it took.
fn told(text: &str) -> Vec<(String, String)> {
    let seeds = text.lines().filter(|line| line.starts_with("seed "));
    seeds.map(|line| (line.split(':').next().unwrap().into(), line.split("trace ").nth(1).unwrap().into())).collect()
}

#[test]
fn a_band_is_told_in_order_and_is_what_its_seeds_are_alone() {
    let dir = tempfile::tempdir().unwrap();
    let (path, reports) = (scenario(dir.path(), SHORT), dir.path().join("reports"));
    let (code, text, errors) = run(&path, &["--seeds", "3..9", "--jobs", "3", "--report", reports.to_str().unwrap()]);
    assert_eq!((code, errors.as_str()), (Some(0), ""), "{text}");
    let band = told(&text);
    let names: Vec<String> = (3..9).map(|seed| format!("seed {seed} good")).collect();
    assert_eq!(band.iter().map(|(name, _)| name.clone()).collect::<Vec<_>>(), names);
    assert!((3..9).all(|seed| reports.join(format!("{seed}/report.json")).is_file()));
    let (code, alone, _) = run(&path, &["--seed", "5", "--twice"]);
    assert_eq!((code, told(&alone)), (Some(0), vec![band[2].clone()]));
}

#[test]
fn a_broken_expectation_is_told_with_1_and_how_to_see_it_again() {
    let dir = tempfile::tempdir().unwrap();
    let path = scenario(dir.path(), &format!("{SHORT}\n[expect]\nmerged = true\n"));
    let (code, text, _) = run(&path, &["--seeds", "1..3"]);
    assert_eq!(code, Some(1), "{text}");
    for seed in [1, 2] {
        assert!(text.contains(&format!("REPLAY   merganser-sim run {} --seed {seed}", path.display())), "{text}");
    }
}

#[test]
fn what_cannot_be_used_or_written_is_told_with_2() {
    let dir = tempfile::tempdir().unwrap();
    let path = scenario(dir.path(), SHORT);
    for arguments in [
        &["--jobs", "2"][..],
        &["--seed", "1", "--seeds", "1..2"],
        &["--seeds", "5..5"],
        &["--seeds", "1..3", "--jobs", "0"],
    ] {
        let (code, text, errors) = run(&path, arguments);
        assert_eq!((code, text.as_str()), (Some(2), ""), "{arguments:?}: {errors}");
    }
    assert_eq!(run(&dir.path().join("none.toml"), &[]).0, Some(2));
    // A file where the reports' folder should be: the first seed ends the band.
    let (code, text, errors) = run(&path, &["--seeds", "1..100", "--jobs", "1", "--report", path.to_str().unwrap()]);
    assert_eq!((code, told(&text)), (Some(2), vec![]), "{errors}");
    assert_eq!(errors.lines().count(), 1, "{errors}");
}
