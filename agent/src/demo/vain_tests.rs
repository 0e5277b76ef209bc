//! What is told of robots that did not merge.

use super::evaluate::evaluate;
use super::report;
use super::tests::{all_views, frame, tracks};
use super::views::Views;
use merganser_protocol::snapshot::{RefusalReason, TriesView};
use nalgebra::Vector6;

/// Of two robots with nothing in common it is told what was tried, and why that came to nothing.
#[test]
fn robots_with_nothing_in_common_are_told_what_was_tried() {
    let tracks = tracks();
    let mut seen = all_views(&tracks, &Vector6::zeros());
    seen[0].frames.pairs.retain(|pair| pair.b != frame(1));
    let tries = |own: usize, other: usize, count: u64| TriesView {
        own: frame(own),
        other: frame(other),
        found: 0,
        refused: [(RefusalReason::NoConsensus, count), (RefusalReason::TooFew, 2)].into(),
    };
    let told = |seen: &[Views]| report::evaluation(&evaluate(&tracks, seen, None), &tracks);
    assert!(told(&seen).contains("no pair of submaps was tried: no two looked alike, or they have no keypoints"));
    seen[0].frames.tries = vec![tries(0, 1, 7), tries(0, 2, 90)];
    seen[1].frames.tries = vec![tries(1, 0, 4)];
    let text = told(&seen);
    assert!(
        text.contains("nothing in common was found")
            && text
                .contains("15 pairs of submaps were tried and none aligned, 11 since nothing fits better than chance"),
        "{text}"
    );
    assert_eq!(text.matches("were tried").count(), 1, "{text}");
    seen[1].frames.tries[0].found = 2;
    assert!(told(&seen).contains("17 pairs of submaps were tried and 2 aligned, none of which counts"));
}
