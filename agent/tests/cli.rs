//! The program from outside: its help and its exit codes.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Command, Output};

fn merganser(arguments: &[&str], folder: &Path) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_merganser"));
    command.args(arguments).current_dir(folder).env_remove("COLUMNS").output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

#[test]
fn the_help_is_the_one_we_reviewed() {
    let here = std::path::absolute("tests").unwrap();
    let told = merganser(&["--help"], &here);
    assert_eq!(told.status.code(), Some(0));
    let kept = here.join("help.txt");
    if std::env::var_os("UPDATE_HELP").is_some() {
        std::fs::write(&kept, &told.stdout).unwrap();
    }
    let kept = std::fs::read_to_string(kept).unwrap();
    assert_eq!(text(&told.stdout), kept, "if the change is meant, run again with UPDATE_HELP=1");
}

#[test]
fn every_subcommand_has_help_and_every_option_a_text() {
    let dir = tempfile::tempdir().unwrap();
    for subcommand in ["demo", "run", "align", "watch", "check", "keys", "store", "graph", "replay"] {
        let told = merganser(&[subcommand, "--help"], dir.path());
        assert_eq!(told.status.code(), Some(0), "{subcommand}");
        assert!(text(&told.stdout).contains("Usage: merganser"), "{subcommand}");
    }
}

#[test]
fn exit_codes_tell_usage_from_failure() {
    let dir = tempfile::tempdir().unwrap();
    let code = |arguments: &[&str]| merganser(arguments, dir.path()).status.code();
    assert_eq!(code(&["--version"]), Some(0));
    assert_eq!(code(&[]), Some(2));
    assert_eq!(code(&["fly"]), Some(2));
    assert_eq!(code(&["run"]), Some(2), "without a configuration");
    assert_eq!(code(&["run", "-c", "none.toml"]), Some(2), "the file is not there");
    assert_eq!(code(&["run", "-c", "a.toml", "--recording", "r", "--speed", "0"]), Some(2));
    assert_eq!(code(&["keys", "generate", "--name", "UPPER"]), Some(2));
    assert_eq!(code(&["keys", "generate", "--name", "alpha"]), Some(0));
    assert_eq!(code(&["keys", "generate", "--name", "alpha"]), Some(1), "a key is never overwritten");
}

#[test]
fn a_generated_key_makes_a_good_configuration() {
    let dir = tempfile::tempdir().unwrap();
    let line = text(&merganser(&["keys", "generate", "--name", "alpha"], dir.path()).stdout);
    let shown = text(&merganser(&["keys", "show", "--name", "alpha", "--key", "alpha.key"], dir.path()).stdout);
    assert_eq!(line, shown);
    let default = include_str!("../dist/default.toml");
    let filled = default.replace("# alpha = \"…\"", line.trim());
    std::fs::write(dir.path().join("a.toml"), &filled).unwrap();
    let without = merganser(&["check", "-c", "a.toml"], dir.path());
    assert_eq!(without.status.code(), Some(2));
    assert!(text(&without.stderr).contains("demo.authority.crt: No such file"), "{}", text(&without.stderr));
    let good = |arguments: &[&str]| {
        let done = merganser(arguments, dir.path());
        assert_eq!(done.status.code(), Some(0), "{}", text(&done.stderr));
    };
    for days in ["0", "36501"] {
        assert_eq!(
            merganser(&["keys", "authority", "--swarm", "demo", "--days", days], dir.path()).status.code(),
            Some(2)
        );
    }
    good(&["keys", "authority", "--swarm", "demo", "--days", "36500"]);
    let again = merganser(&["keys", "authority", "--swarm", "demo"], dir.path());
    assert_eq!(again.status.code(), Some(1), "an authority is never overwritten");
    let mode = std::fs::metadata(dir.path().join("demo.authority.key")).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o600);
    good(&["keys", "certificate", "--authority", "demo.authority.key", "-c", "a.toml"]);
    let checked = merganser(&["check", "-c", "a.toml"], dir.path());
    assert_eq!(checked.status.code(), Some(0), "{}", text(&checked.stderr));
    assert!(text(&checked.stdout).contains("Links by TLS; certificate until 20"), "{}", text(&checked.stdout));
    assert!(text(&checked.stdout).starts_with("# a.toml: good. Robot alpha of swarm demo"));
    let router = ["keys", "router", "--authority", "demo.authority.key", "-c", "a.toml", "--name", "hub"];
    let unnamed = merganser(&router, dir.path());
    assert_eq!(unnamed.status.code(), Some(2));
    assert!(text(&unnamed.stderr).contains("zenoh.routers: hub is not in it"), "{}", text(&unnamed.stderr));
    std::fs::write(dir.path().join("a.toml"), filled.replace("# routers", "routers")).unwrap();
    good(&router);
    let mode = std::fs::metadata(dir.path().join("hub.json5")).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o600, "it holds a key");

    let line = text(&merganser(&["keys", "generate", "--name", "laptop"], dir.path()).stdout);
    let laptop = filled.replace("# [observers]", &format!("[observers]\n{line}\n#")).replacen("\"alpha", "\"laptop", 2);
    let laptop = laptop.replace("alpha.crt", "laptop.crt");
    std::fs::write(dir.path().join("laptop.toml"), laptop).unwrap();
    let without = merganser(&["check", "-c", "laptop.toml"], dir.path());
    assert_eq!(without.status.code(), Some(2));
    assert!(text(&without.stderr).contains("laptop.crt: No such file"), "{}", text(&without.stderr));
    good(&["keys", "certificate", "--authority", "demo.authority.key", "-c", "laptop.toml"]);
    let checked = merganser(&["check", "-c", "laptop.toml"], dir.path());
    assert_eq!(checked.status.code(), Some(0), "{}", text(&checked.stderr));
    assert!(text(&checked.stdout).starts_with("# laptop.toml: good. Observer laptop of swarm demo, of 1 robots"));

    good(&["keys", "authority", "--swarm", "other"]);
    let mixed = ["keys", "certificate", "--authority", "other.authority.key", "-c", "a.toml"];
    let mixed = merganser(&mixed, dir.path());
    assert_eq!(mixed.status.code(), Some(2));
    assert!(text(&mixed.stderr).contains("swarm:other; here belongs the one of swarm:demo"), "{}", text(&mixed.stderr));

    std::fs::write(dir.path().join("a.toml"), filled.replace("queue = 1024", "queues = 1024")).unwrap();
    let refused = merganser(&["check", "-c", "a.toml"], dir.path());
    assert_eq!(refused.status.code(), Some(2));
    let said = text(&refused.stderr);
    assert!(said.contains("a.toml:") && said.contains("unknown field `queues`"), "{said}");
    assert_eq!(said.lines().count(), 1, "{said}");
}

/// The private half never lies on the disk in the clear; whoever has the file alone has nothing.
#[test]
fn an_encrypted_key_starts_by_its_passphrase_and_else_tells_why_not() {
    let dir = tempfile::tempdir().unwrap();
    for (file, words) in [("good", "correct horse\n"), ("wrong", "correct house\n")] {
        std::fs::write(dir.path().join(file), words).unwrap();
        std::fs::set_permissions(dir.path().join(file), std::fs::Permissions::from_mode(0o600)).unwrap();
    }
    let out = merganser(&["keys", "generate", "--name", "alpha", "--passphrase-file", "good"], dir.path());
    assert_eq!(out.status.code(), Some(0), "{}", text(&out.stderr));
    assert!(std::fs::read_to_string(dir.path().join("alpha.key")).unwrap().contains("ENCRYPTED PRIVATE KEY"));
    let config = |more: &str| {
        let roster =
            format!("[roster]\n{}[zenoh]\nmulticast = false\nlisten = [\"tcp/127.0.0.1:7999\"]\n", text(&out.stdout));
        let text = format!("swarm = \"demo\"\nrobot = \"alpha\"\nkey_file = \"alpha.key\"\n{more}\n{roster}");
        std::fs::write(dir.path().join("alpha.toml"), text).unwrap();
        let told = merganser(&["check", "-c", "alpha.toml"], dir.path());
        (told.status.code(), String::from_utf8(told.stderr).unwrap())
    };
    assert_eq!(config("key_passphrase_file = \"good\"").0, Some(0));
    for (more, wanted) in [
        ("key_passphrase_file = \"wrong\"", "the passphrase is wrong"),
        ("key_passphrase_file = \"none\"", "none"),
        ("key_passphrase_env = \"MERGANSER_NO_SUCH_VARIABLE\"", "MERGANSER_NO_SUCH_VARIABLE is not set"),
        ("", "key_passphrase_file"),
        ("key_passphrase_env = \"A\"\nkey_passphrase_file = \"good\"", "keep one of the two"),
    ] {
        let (code, told) = config(more);
        assert!(code == Some(2) && told.contains(wanted) && told.lines().count() == 1, "{more}: {code:?} {told}");
    }
    let show = |options: &[&str]| {
        merganser(&[&["keys", "show", "--name", "alpha", "--key", "alpha.key"], options].concat(), dir.path())
    };
    assert_eq!(show(&["--passphrase-file", "good"]).stdout, out.stdout);
    assert_eq!(show(&["--passphrase-file", "wrong"]).status.code(), Some(2));
}

/// `dist/default.toml` claims to show the defaults: take every line away that has one, and nothing may change.
#[test]
fn the_commented_defaults_are_the_defaults() {
    use merganser::config::FileConfig;
    let key = format!("alpha = \"{}\"", merganser::trust::SecretKey::from_bytes([7; 32]).public());
    let full = include_str!("../dist/default.toml").replace("# alpha = \"…\"", &key);
    let head: String = full.lines().take_while(|line| !line.starts_with("[store]")).map(|l| format!("{l}\n")).collect();
    let parse = |text: &str| FileConfig::parse(text, Path::new("default.toml")).unwrap();
    let head = head + "[zenoh]\ncertificate = \"alpha.crt\"\nauthority = \"demo.authority.crt\"\n";
    assert_eq!(parse(&full), parse(&head));
    let written = toml::to_string(&parse(&full)).unwrap();
    for line in written.lines().filter(|line| line.contains(" = ") && !line.starts_with("alpha")) {
        let name = line.split(" = ").next().unwrap();
        assert!(full.lines().any(|l| l.starts_with(&format!("{name} = "))), "default.toml does not show {name}");
    }
}

#[test]
#[cfg(target_os = "linux")]
fn a_graph_of_ten_million_edges_is_refused_before_it_fills_memory() {
    use std::io::{BufWriter, Write};
    use std::process::Stdio;
    // 2 GiB of address space; ten million edges would take more than 4.
    let limited = "ulimit -v 2097152; exec \"$0\" graph solve /dev/stdin";
    let mut child = Command::new("sh")
        .args(["-c", limited, env!("CARGO_BIN_EXE_merganser")])
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut pipe = BufWriter::new(child.stdin.take().unwrap());
    let edge = |k: u32| {
        let (i, step) = (k % 100_000, 1 + k / 100_000);
        format!("EDGE_SE3:QUAT {i} {} 1 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1", i + step)
    };
    // It stops reading long before the end.
    let taken = (0..10_000_000).take_while(|&k| writeln!(pipe, "{}", edge(k)).is_ok()).count();
    drop(pipe);
    let told = child.wait_with_output().unwrap();
    assert_eq!(told.status.code(), Some(2), "{}", text(&told.stderr));
    assert!(text(&told.stderr).contains("more than 500000 measurements; split the graph"), "{}", text(&told.stderr));
    assert!((500_000..600_000).contains(&taken), "{taken}");
}
