//! The simulator is tested on fakes: it must be deterministic, every fault must fire, and planted bugs must be found.

use super::fake::{Bug, Fake, with_bug};
use super::*;

const SMALL: &str = "
name = \"small\"
robots = 4
duration_secs = 20
settle_secs = 10
[sensor]
rows = 2
columns = 8
";

fn run(extra: &str, seed: u64) -> Outcome<Fake> {
    let scenario = Scenario::parse(&format!("{SMALL}{extra}")).unwrap();
    Swarm::<Fake>::new(scenario, seed).unwrap().run(|_| {}).unwrap()
}

const HOSTILE: &str = "
[network]
loss = 0.3
bursts_per_min = 10
duplicate = 0.5
reorder = 0.5
bytes_per_sec = 4000.0
queue_ms_max = 100.0
[[faults]]
kind = \"partition\"
at = 2
lasts = 8
groups = [[\"alpha\", \"beta\"], [\"gamma\", \"delta\"]]
[[faults]]
kind = \"one_way\"
at = 11
lasts = 3
from = \"alpha\"
to = \"gamma\"
[[faults]]
kind = \"isolate\"
at = 15
lasts = 3
robot = \"delta\"
[[faults]]
kind = \"kill\"
at = 5.005
lasts = 3
robot = \"alpha\"
[[faults]]
kind = \"wipe\"
at = 6
lasts = 3
robot = \"beta\"
[[faults]]
kind = \"pause\"
at = 4
lasts = 6
robot = \"gamma\"
[[faults]]
kind = \"new_frame\"
at = 9
robot = \"gamma\"
[[faults]]
kind = \"disk_full\"
at = 12
lasts = 4
robot = \"delta\"
";

#[test]
fn the_same_seed_gives_the_same_trace() {
    for extra in ["", HOSTILE] {
        let (one, two, other) = (run(extra, 1), run(extra, 1), run(extra, 2));
        assert!(one.trace_lines > 500, "{}", one.trace_lines);
        assert_eq!((one.trace, one.trace_lines, one.counts.clone()), (two.trace, two.trace_lines, two.counts));
        assert_ne!(one.trace, other.trace);
    }
}

#[test]
fn an_outside_influence_shows_in_the_trace() {
    let traces = with_bug(Bug::Unseeded, || [run("", 1).trace, run("", 1).trace]);
    assert_ne!(traces[0], traces[1]);
}

#[test]
fn honest_fakes_survive_every_fault_and_every_fault_fires() {
    for seed in 0..8 {
        let outcome = run(HOSTILE, seed);
        assert_eq!(outcome.violation, None, "seed {seed}");
        let c = outcome.counts;
        let fired = [
            c.lost,
            c.duplicated,
            c.reordered,
            c.blocked,
            c.over_capacity,
            c.to_the_dead,
            c.unanswered,
            c.killed,
            c.restarted,
            c.wiped,
            c.paused,
            c.delayed_by_pause,
            c.new_frames,
            c.disk_refused,
            c.keyframes_missed,
        ];
        assert!(fired.iter().all(|&n| n > 0), "seed {seed}: {fired:?}");
        assert_eq!(outcome.robots.len(), 4);
    }
    let leave = "[[faults]]\nkind = \"leave\"\nat = 5\nrobot = \"delta\"";
    let outcome = run(leave, 1);
    assert_eq!((outcome.counts.left, outcome.robots.len(), outcome.violation), (1, 3, None));
}

#[test]
fn a_new_epoch_has_its_own_true_frame() {
    let outcome = run(HOSTILE, 1);
    let frames: Vec<&str> = outcome.truth.keys().map(String::as_str).collect();
    assert!(frames.contains(&"beta/1") && frames.contains(&"beta/2"), "{frames:?}");
}

#[test]
fn planted_bugs_are_found() {
    let find = |bug, extra: &str| {
        with_bug(bug, || (0..4).find_map(|seed| run(extra, seed).violation)).map(|violation| violation.invariant)
    };
    assert_eq!(find(Bug::EarlyPublish, "").as_deref(), Some("durable first"));
    assert_eq!(find(Bug::NoRepair, "[network]\nloss = 0.3").as_deref(), Some("converged"));
    let kill = "[[faults]]\nkind = \"kill\"\nat = 5\nlasts = 2\nrobot = \"alpha\"";
    assert_eq!(find(Bug::ReusesNumbers, kill).as_deref(), Some("unique entries"));
    assert_eq!(find(Bug::NeverRests, "").as_deref(), Some("no endless loop"));
    assert_eq!(find(Bug::None, kill), None);
}
