//! The real program on real Zenoh over bad networks: three agents, each in a network namespace of its own, on a bridge
//! whose faults are real ones of the kernel (DESIGN §9). Whatever happens on the way, all robots must end with the same
//! facts, byte for byte; nothing is asked about how long it takes, except that it ends.
//!
//! Needs root, `ip`, `tc` and `nft`, and a few minutes, so it is not part of a plain `cargo test`:
//!
//! ```sh
//! cargo test --release -p merganser --test namespaces -- --ignored --test-threads=1
//! ```
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]
#![allow(clippy::print_stdout, clippy::print_stderr, reason = "what a test saw is worth a line")]

mod air;
#[path = "../common/mod.rs"]
mod common;
mod cost;
mod robot;
mod spectator;

use air::Air;
use robot::{Fleet, Robot, name_list};
use std::collections::BTreeSet;
use std::os::unix::process::ExitStatusExt;
use std::thread::sleep;
use std::time::Duration;

/// One second. Waits are not assertions: they say how long a fault lasts.
const SECOND: Duration = Duration::from_secs(1);

#[test]
#[ignore = "smoke: root only, in network namespaces of its own"]
fn a_killed_robot_resumes_and_all_hold_the_same() {
    let Some(air) = Air::open(&["alpha", "beta", "gamma"]) else { return };
    let mut fleet = Fleet::drive_guarded(&air, 8.0); // by TLS, as is recommended; the others by plain TCP
    let before = fleet.beta().until("beta writes", |seen| seen.own_submaps("beta") >= 2 && seen.status.entries >= 4);
    let killed = fleet.beta().kill();
    assert_eq!(killed.signal(), Some(9), "{killed}");
    fleet.alpha().until("alpha misses beta", |seen| !seen.neighbours().contains("beta"));

    fleet.beta().start(None); // its SLAM stays away: what it had said must be enough
    let after = fleet.beta().until("beta is back", |_| true);
    assert_eq!(after.status.epoch, before.status.epoch, "a restart goes on with the log");
    assert!(after.own_submaps("beta") >= before.own_submaps("beta"), "{after:?}\n{before:?}");
    assert!(after.status.entries >= before.status.entries, "{after:?}\n{before:?}");
    fleet.end_alike();
}

#[test]
#[ignore = "night: root only, in network namespaces of its own"]
fn a_partition_of_twenty_seconds_heals() {
    let Some(air) = Air::open(&["alpha", "beta", "gamma"]) else { return };
    let mut fleet = Fleet::drive(&air, 1.5);
    fleet.until_all("everybody hears everybody", |seen| seen.neighbours().len() == 2);
    fleet.until_all("everybody writes", |seen| seen.own_submaps(&seen.status.robot) >= 1);

    air.block("alpha", "beta");
    air.block("beta", "alpha");
    air.block("alpha", "gamma");
    air.block("gamma", "alpha");
    sleep(2 * SECOND); // what had arrived is on the disk
    let (alpha, beta) = (fleet.alpha().now(), fleet.beta().now());
    sleep(18 * SECOND);
    let (alpha_later, beta_later) = (fleet.alpha().now(), fleet.beta().now());
    assert!(air.dropped() > 0, "nothing was dropped");
    for other in ["beta", "gamma"] {
        assert_eq!(alpha_later.own_submaps(other), alpha.own_submaps(other), "alpha learned of {other}");
    }
    assert_eq!(beta_later.own_submaps("alpha"), beta.own_submaps("alpha"), "beta learned of alpha");
    assert!(alpha_later.own_submaps("alpha") > alpha.own_submaps("alpha"), "alpha drives on");
    assert!(beta_later.own_submaps("gamma") > beta.own_submaps("gamma"), "beta and gamma hear each other");
    assert_ne!(alpha_later.status.digest, beta_later.status.digest);

    air.heal();
    fleet.end_alike();
}

#[test]
#[ignore = "night: root only, in network namespaces of its own"]
fn a_robot_without_a_radio_for_a_while_catches_up() {
    let Some(air) = Air::open(&["alpha", "beta", "gamma"]) else { return };
    let mut fleet = Fleet::drive(&air, 3.0);
    fleet.until_all("everybody hears everybody", |seen| seen.neighbours().len() == 2);
    fleet.gamma().until("gamma writes", |seen| seen.own_submaps("gamma") >= 1);

    air.unplug("gamma");
    assert_eq!(air.carrier("gamma"), None, "the radio is gone");
    let before = fleet.gamma().now();
    fleet.gamma().until("gamma is alone", |seen| seen.neighbours().is_empty());
    fleet.gamma().until("gamma drives on", |seen| seen.own_submaps("gamma") > before.own_submaps("gamma"));
    let (alpha, gamma) = (fleet.alpha().now(), fleet.gamma().now());
    assert!(gamma.own_submaps("gamma") > alpha.own_submaps("gamma"), "{gamma:?}\n{alpha:?}");
    assert!(alpha.own_submaps("alpha") > gamma.own_submaps("alpha"), "{gamma:?}\n{alpha:?}");

    air.plug("gamma");
    fleet.end_alike();
}

#[test]
#[ignore = "night: root only, in network namespaces of its own"]
fn facts_pass_through_a_robot_in_the_middle() {
    let Some(air) = Air::open(&["alpha", "beta", "gamma"]) else { return };
    air.block("alpha", "gamma");
    air.block("gamma", "alpha");
    let mut fleet = Fleet::drive(&air, 8.0);
    fleet.hold_alike();
    assert!(air.dropped() > 0, "nothing was dropped");
    assert_eq!(fleet.alpha().now().neighbours(), BTreeSet::from(["beta"]));
    assert_eq!(fleet.gamma().now().neighbours(), BTreeSet::from(["beta"]));
    assert!(fleet.gamma().now().own_submaps("alpha") > 0);
}

#[test]
#[ignore = "night: root only, in network namespaces of its own"]
fn a_link_that_carries_one_way_only_is_got_around() {
    let Some(air) = Air::open(&["alpha", "beta", "gamma"]) else { return };
    let mut fleet = Fleet::drive(&air, 4.0);
    fleet.until_all("everybody hears everybody", |seen| seen.neighbours().len() == 2);
    air.block("alpha", "beta");
    fleet.hold_alike();
    assert!(air.dropped() > 0, "nothing was dropped");
    fleet.beta().until("beta misses alpha", |seen| seen.neighbours() == BTreeSet::from(["gamma"]));
    fleet.hold_alike();
}

#[test]
#[ignore = "night: root only, in network namespaces of its own"]
fn a_robot_that_gets_another_address_is_linked_again() {
    let Some(air) = Air::open(&["alpha", "beta", "gamma"]) else { return };
    let mut fleet = Fleet::drive(&air, 3.0);
    fleet.until_all("everybody hears everybody", |seen| seen.neighbours().len() == 2);
    fleet.gamma().until("gamma writes", |seen| seen.own_submaps("gamma") >= 1);
    let [old, new] = [air.address("gamma"), air.readdress("gamma")];
    let links = |gamma: &Robot, address| gamma.links().into_iter().filter(|link| *link == address).count();
    assert_ne!(old, new);
    fleet.gamma().until_itself("gamma has links from its new address alone", |gamma| {
        links(gamma, new) >= 2 && links(gamma, old) == 0
    });
    fleet.end_alike();
}

#[test]
#[ignore = "night: root only, in network namespaces of its own"]
fn a_robot_that_only_scouts_ends_where_its_address_is_new_and_is_found_when_started_again() {
    let Some(air) = Air::open(&["alpha", "beta", "gamma"]) else { return };
    let mut fleet = Fleet::scout(&air, 3.0);
    fleet.until_all("everybody hears everybody", |seen| seen.neighbours().len() == 2);
    fleet.gamma().until("gamma writes", |seen| seen.own_submaps("gamma") >= 1);
    let new = air.readdress("gamma");
    let (ended, told) = fleet.gamma().end();
    assert_eq!(ended.code(), Some(1), "{told}");
    assert!(told.contains(&format!("{new} on radio")) && told.contains("zenoh.connect"), "{told}");

    fleet.gamma().start(None); // as its service manager does; its SLAM stays away
    fleet.gamma().until("gamma hears the others from its new address", |seen| seen.neighbours().len() == 2);
    fleet.end_alike();
}

#[test]
#[ignore = "night: root only, in network namespaces of its own"]
fn robots_that_only_scout_find_one_another_by_tls() {
    let Some(air) = Air::open(&["alpha", "beta", "gamma"]) else { return };
    let mut fleet = Fleet::scout_guarded(&air, 8.0);
    fleet.until_all("everybody hears everybody", |seen| seen.neighbours().len() == 2);
    fleet.end_alike();
}

#[test]
#[ignore = "night: root only, in network namespaces of its own"]
fn a_loss_of_5_percent_changes_nothing() {
    lossy(5);
}

#[test]
#[ignore = "night: root only, in network namespaces of its own"]
fn a_loss_of_20_percent_changes_nothing() {
    lossy(20);
}

fn lossy(percent: u32) {
    let Some(air) = Air::open(&["alpha", "beta", "gamma"]) else { return };
    air.lose(percent);
    let mut fleet = Fleet::drive(&air, 8.0);
    fleet.end_alike();
    let (dropped, carried) = (air.dropped() as f64, air.carried() as f64);
    let (all, share) = (dropped + carried, f64::from(percent) / 100.0);
    let sigma = (all * share * (1.0 - share)).sqrt();
    assert!(dropped > 0.0 && (dropped - share * all).abs() < 6.0 * sigma, "{dropped} of {all} frames were dropped");
}

#[test]
#[ignore = "night: root only, in network namespaces of its own"]
fn a_slow_link_is_enough() {
    let Some(air) = Air::open(&["alpha", "beta", "gamma"]) else { return };
    name_list().iter().for_each(|name| air.slow(name, "384kbit"));
    let mut fleet = Fleet::drive(&air, 4.0);
    fleet.end_alike();
    for name in name_list() {
        assert!(air.slowed(name) > 0, "{name} was never held back");
    }
}

/// What links by TLS cost beside plain TCP. Prints figures; asks only that all arrives.
#[test]
#[ignore = "night: root only, in network namespaces of its own"]
fn what_tls_costs() {
    let Some(air) = Air::open(&["alpha", "beta"]) else { return };
    cost::measure(&air);
}

/// Not a test: the ends of the link that `what_tls_costs` measures.
#[test]
#[ignore = "night: no test; another starts it"]
fn end_of_a_link() {
    cost::main();
}

/// Not a test: what the tests start in each robot's namespace (see the module).
#[test]
#[ignore = "night: no test; the others start it"]
fn spectator() {
    spectator::main();
}
