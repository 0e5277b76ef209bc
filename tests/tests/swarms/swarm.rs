//! A simulated swarm over bad radios converges, and the same seed gives the same run, in this process or another.

use merganser_sim::report::Report;
use merganser_tests::simulate;
use std::process::Command;

const LOSSY: &str = include_str!("../../../sim/scenarios/lossy.toml");
const PARTITION: &str = include_str!("../../../sim/scenarios/partition.toml");
const CALIBRATION: &str = include_str!("../scenarios/calibration.toml");
/// Set for the child process that only prints a trace.
const CHILD: &str = "MERGANSER_TEST_TRACE";

fn converged(scenario: &str, seed: u64) -> Report {
    let report = simulate(scenario, seed).unwrap();
    assert!(report.violation.is_none(), "seed {seed}: {:?}", report.violation);
    let digest = &report.robots[0].digest;
    assert!(report.robots.iter().all(|robot| robot.digest == *digest && robot.entries > 0));
    let robots = report.robots.len();
    assert_eq!(report.frame_errors.len(), robots * (robots - 1), "every robot knows every other's frame");
    report
}

/// A network that loses messages singly and in bursts, doubles them, brings them late, and is cut for a while.
const BAD_NETWORK: &str = "
[network]
loss = 0.2
bursts_per_min = 12.0
burst_ms_mean = 800.0
duplicate = 0.2
reorder = 0.2
reorder_ms_max = 500.0
[[faults]]
kind = \"isolate\"
at = 6
lasts = 6
robot = \"alpha\"
";

#[test]
fn two_robots_converge_over_a_bad_network_that_is_cut_for_a_while() {
    let report = converged(&format!("{CALIBRATION}{BAD_NETWORK}"), 2);
    all_happened(&report);
    assert!(report.faults.blocked > 0, "the partition must really happen: {:?}", report.faults);
}

#[test]
#[ignore = "night: the whole scenario"]
fn a_swarm_converges_under_loss_bursts_doubling_and_reordering() {
    all_happened(&converged(LOSSY, 1));
}

fn all_happened(report: &Report) {
    let faults = &report.faults;
    for (what, count) in [
        ("loss", faults.lost),
        ("loss in bursts", faults.burst_lost),
        ("doubling", faults.duplicated),
        ("reordering", faults.reordered),
    ] {
        assert!(count > 0, "{what} must really happen: {faults:?}");
    }
}

#[test]
fn a_swarm_converges_however_many_messages_are_lost() {
    let run = |loss: f64| converged(&format!("{CALIBRATION}\n[network]\nloss = {loss}\n"), 3).faults.lost;
    let [none, some, many] = [0.0, 0.1, 0.3].map(run);
    assert_eq!(none, 0);
    assert!(some > 0 && many > 2 * some, "{some} and {many} messages lost");
}

#[test]
#[ignore = "night: the whole scenario"]
fn a_swarm_converges_after_partitions_heal() {
    let report = converged(PARTITION, 1);
    assert!(report.faults.blocked > 0, "the partitions must really happen: {:?}", report.faults);
}

#[test]
fn the_same_seed_gives_the_same_run_and_another_seed_another() {
    let once = simulate(CALIBRATION, 5).unwrap().trace;
    assert_eq!(simulate(CALIBRATION, 5).unwrap().trace, once);
    assert_ne!(simulate(CALIBRATION, 6).unwrap().trace, once);
    let child = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "swarm::prints_a_trace_for_another_process", "--nocapture"])
        .env(CHILD, "5")
        .output()
        .unwrap();
    let said = String::from_utf8(child.stdout).unwrap();
    assert!(said.contains(&format!("trace {once}")), "another process ran differently: {said}");
}

#[test]
fn prints_a_trace_for_another_process() {
    if let Ok(seed) = std::env::var(CHILD) {
        println!("trace {}", simulate(CALIBRATION, seed.parse().unwrap()).unwrap().trace);
    }
}
