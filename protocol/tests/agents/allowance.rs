//! What an allowance in bytes changes for those who merge: nothing before they have, less after.

use super::common::{Wires, World, agent_of, drive};
use merganser_protocol::agent::io::{Event, Input};
use merganser_protocol::time::Instant;
use std::time::Duration;

/// Two robots that drive and then wait: when both know that they have merged, the bytes of keypoints fetched by then
/// and in all, and the pairs aligned.
fn merge_at(further_bytes_per_sec: f64) -> (Option<Instant>, [usize; 2], usize) {
    let world = World::new(1);
    let mut config = super::common::config();
    config.align.further_bytes_per_sec = further_bytes_per_sec;
    let mut wires = Wires::new((0..2).map(|k| agent_of(k, &config)).collect());
    let runs: Vec<_> = (0..2).map(|k| drive(&world, k, 40).0).collect();
    let fetched =
        |wires: &Wires| wires.pieces.iter().map(|(.., answer)| answer.as_ref().map_or(0, Vec::len)).sum::<usize>();
    let mut merged = None;
    for n in 0..60 {
        for (k, keyframe) in runs.iter().enumerate().filter_map(|(k, keyframes)| Some((k, keyframes.get(n)?))) {
            wires.input(k, Input::Keyframe(keyframe.clone()));
        }
        wires.run(Duration::from_secs(1));
        if merged.is_none() && wires.agents.iter().all(|agent| !agent.status().merged_with.is_empty()) {
            merged = Some((wires.now, fetched(&wires)));
        }
    }
    let proposed = wires.events.iter().filter(|(_, event)| matches!(event, Event::AlignmentProposed { .. })).count();
    (merged.map(|(when, _)| when), [merged.map_or(0, |(_, bytes)| bytes), fetched(&wires)], proposed)
}

#[test]
fn little_allowance_delays_no_merge_and_buys_less_of_what_only_makes_the_map_surer() {
    let (poor, rich) = (merge_at(10.0), merge_at(1e9));
    assert!(poor.0.is_some() && (poor.0, poor.1[0]) == (rich.0, rich.1[0]), "merging waits for nothing");
    assert!(poor.1[1] < rich.1[1] && poor.2 < rich.2, "{poor:?} {rich:?}");
}
