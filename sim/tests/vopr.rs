//! `merganser-sim vopr` from outside: what it prints, what it returns, and that a band of seeds breaks nothing.

#![allow(clippy::unwrap_used, clippy::panic, reason = "the whole file is a test")]

use merganser_sim::scenario::Scenario;
use std::process::Command;

fn vopr(arguments: &[&str]) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_merganser-sim"));
    let output = command.arg("vopr").args(arguments).output().unwrap();
    (output.status.code(), String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap())
}

#[test]
fn a_seed_tells_what_it_drew_and_replays_bit_for_bit() {
    let (code, told, errors) = vopr(&["--seed", "7", "--twice"]);
    assert_eq!((code, errors.as_str()), (Some(0), ""), "{told}");
    let (options, rest) = told.split_once("\nfault ").unwrap();
    let scenario = Scenario::parse(options).unwrap();
    assert_eq!(scenario.name, "vopr-7");
    assert!(rest.contains("seed 7 good") && rest.contains("1 seeds, 0 broken"), "{rest}");
    let trace = |told: &str| told.split("trace ").nth(1).unwrap()[..64].to_owned();
    assert_eq!(trace(&told), trace(&vopr(&["--seed", "7"]).1));
    assert_ne!(trace(&told), trace(&vopr(&["--seed", "8"]).1));
}

#[test]
fn a_band_of_seeds_breaks_nothing_and_its_faults_fire() {
    let dir = tempfile::tempdir().unwrap();
    let report = dir.path().join("report.json");
    let (code, told, _) = vopr(&["--seeds", "1000..1024", "--report", report.to_str().unwrap()]);
    assert_eq!(code, Some(0), "{told}");
    let report: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(report).unwrap()).unwrap();
    assert_eq!(report["seeds"], 24);
    let fired = report["fired"].as_object().unwrap();
    let silent: Vec<&String> = fired.iter().filter(|(_, row)| row[0] == 0).map(|(name, _)| name).collect();
    assert_eq!(silent, ["out_of_reach"], "only crowds are out of one another's reach: {told}");
}

#[test]
fn wrong_usage_is_told_with_2() {
    for arguments in [
        &[][..],
        &["--seed", "1", "--seeds", "1..2"],
        &["--seeds", "5..5"],
        &["--seeds", "5"],
        &["--seed", "-1"],
        &["--seed", "1", "--jobs", "0"],
        &["--seed", "1", "--fly"],
    ] {
        let (code, told, errors) = vopr(arguments);
        assert_eq!((code, told.as_str()), (Some(2), ""), "{arguments:?}");
        assert!(errors.contains("Usage") || errors.contains("error:"), "{arguments:?}: {errors}");
    }
    let (code, _, errors) = vopr(&["--seed", "1", "--report", "/none/report.json"]);
    assert_eq!(code, Some(2), "{errors}");
}
