//! Robots whose submaps are tried with one another in vain: told when it has been so often that people ask why. Two robots
//! that have not met yet do so, too, so it is no warning.

use merganser_protocol::ids::FrameId;
use merganser_protocol::snapshot::{FramesView, TriesView};
use std::collections::BTreeMap;

/// After so many refused pairs of submaps, without one that aligned, it is told.
pub const TOLD_AT: [u64; 3] = [24, 240, 2400];
/// Pairs of frames that are counted; of further ones nothing is told.
pub const FRAMES_MAX: usize = 256;

/// Counts tries by pairs of frames.
#[derive(Clone, Debug, Default)]
pub struct Vain(BTreeMap<(FrameId, FrameId), (u64, bool)>);

/// What was told, by the other's frame, ours, and the number of tries: told once.
pub type Told = std::collections::BTreeSet<(String, String, u64)>;

impl Vain {
    /// Counts a try; whether it is to be told now how they went.
    pub fn note(&mut self, i: FrameId, j: FrameId, found: bool) -> bool {
        let pair = (i.min(j), i.max(j));
        if i.robot == j.robot || (self.0.len() == FRAMES_MAX && !self.0.contains_key(&pair)) {
            return false;
        }
        let (refused, any) = self.0.entry(pair).or_default();
        *any |= found;
        *refused += u64::from(!found);
        !found && !*any && TOLD_AT.contains(refused)
    }
}

/// What is told of the frames of which it is due and was not `before`, unless the other side found something.
pub fn told(frames: &FramesView, before: &mut Told) -> Vec<String> {
    let has_pair = |tries: &TriesView| {
        let is = |a: &str, b: &str| frames.pairs.iter().any(|pair| pair.a == a && pair.b == b);
        is(&tries.own, &tries.other) || is(&tries.other, &tries.own)
    };
    let due = frames.tries.iter().filter(|tries| TOLD_AT.contains(&tries.tried()) && !has_pair(tries));
    let due = due.filter(|tries| before.insert((tries.other.clone(), tries.own.clone(), tries.tried())));
    due.filter_map(|tries| Some(format!("no submap aligns with any of {}: {}", tries.other, tries.told()?))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use merganser_protocol::ids::RobotId;
    use merganser_protocol::snapshot::{PairStatus, PairView, RefusalReason};

    fn frame(robot: u8, epoch: u32) -> FrameId {
        FrameId { robot: RobotId([robot; 8]), epoch }
    }

    #[test]
    fn tries_in_vain_are_told_at_each_bound_and_not_before() {
        let mut vain = Vain::default();
        let told: Vec<u64> = (1..=TOLD_AT[2] + 1).filter(|_| vain.note(frame(2, 1), frame(1, 1), false)).collect();
        assert_eq!(told, TOLD_AT);
        // One that is found ends it; loops are not meant.
        let mut vain = Vain::default();
        assert!(!vain.note(frame(1, 1), frame(2, 1), true));
        assert!((0..TOLD_AT[0]).all(|_| !vain.note(frame(1, 1), frame(2, 1), false)));
        assert!((0..TOLD_AT[0]).all(|_| !vain.note(frame(1, 1), frame(1, 2), false)));
    }

    #[test]
    fn as_many_frames_are_counted_as_the_limit_says() {
        let mut vain = Vain::default();
        (0..FRAMES_MAX as u32 + 1).for_each(|epoch| _ = vain.note(frame(1, 1), frame(2, epoch), false));
        let mut tells = |epoch: u32| (1..TOLD_AT[0]).any(|_| vain.note(frame(1, 1), frame(2, epoch), false));
        assert_eq!([tells(FRAMES_MAX as u32 - 1), tells(FRAMES_MAX as u32)], [true, false]);
    }

    #[test]
    fn the_commonest_reason_is_told_with_its_cure_unless_the_other_side_found_something() {
        let refused = [(RefusalReason::TooFew, 5), (RefusalReason::NoConsensus, TOLD_AT[0] - 5)].into();
        let tries = TriesView { own: "alpha/1".into(), other: "beta/2".into(), found: 0, refused };
        let mut frames = FramesView {
            own: "alpha/1".into(),
            frames: Vec::new(),
            pairs: Vec::new(),
            suspects: Vec::new(),
            tries: vec![tries],
        };
        assert_eq!(
            told(&frames, &mut Told::new()),
            [
                "no submap aligns with any of beta/2: 24 pairs of submaps were tried and none aligned, 19 since nothing fits \
                 better than chance: they may have seen no common place yet; if they have, see that all robots state the same \
                 submap.sensor and voxel_m, and that merganser doctor finds nothing odd about either"
            ]
        );
        // Another pair's turn tells it no second time.
        let mut before = Told::new();
        assert_eq!([told(&frames, &mut before).len(), told(&frames, &mut before).len()], [1, 0]);
        frames.pairs.push(PairView {
            a: "alpha/1".into(),
            b: "beta/2".into(),
            status: PairStatus::Provisional,
            proposed: 1,
            agreed: 0,
            used: 0,
            log10_nfa: None,
            t_a_b: None,
            middle: None,
            reason: String::new(),
        });
        assert_eq!(told(&frames, &mut Told::new()), Vec::<String>::new());
    }
}
