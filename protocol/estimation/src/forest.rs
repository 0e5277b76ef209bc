//! The spanning forest of merged pairs of frames: by which pairs one gets from one frame to another.

use super::geometry::Relative;
use super::ids::FrameId;
use std::collections::BTreeMap;

/// A pair of frames whose alignments say how the two lie.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tie {
    pub(super) a: FrameId,
    pub(super) b: FrameId,
    pub(super) t_a_b: Relative,
}

/// Frames and the ties between them, without loops. Each tie has the number that its owner gave it.
#[derive(Default)]
pub(super) struct Forest(BTreeMap<FrameId, Vec<Branch>>);

#[derive(Clone, Copy)]
struct Branch {
    to: FrameId,
    t_from_to: Relative,
    tie: usize,
}

/// A way from one frame to another.
pub(super) struct Way {
    /// Compounded along the ties: its covariance takes them as independent, which overstates it where they share a
    /// trajectory.
    pub(super) t_from_to: Relative,
    /// The ties, in their order.
    pub(super) ties: Vec<usize>,
}

impl Forest {
    /// Adds a tie between frames that none connects.
    pub(super) fn add(&mut self, number: usize, Tie { a, b, t_a_b }: &Tie) {
        self.0.entry(*a).or_default().push(Branch { to: *b, t_from_to: *t_a_b, tie: number });
        self.0.entry(*b).or_default().push(Branch { to: *a, t_from_to: t_a_b.inverse(), tie: number });
    }

    /// Every frame connected to `root`, with `t_root_frame` (`None` for the root itself).
    pub(super) fn reach(&self, root: FrameId) -> BTreeMap<FrameId, Option<Relative>> {
        let mut reached = BTreeMap::from([(root, None)]);
        let mut next = vec![root];
        while let Some(frame) = next.pop() {
            let so_far: Option<Relative> = reached[&frame];
            for Branch { to, t_from_to, .. } in self.0.get(&frame).into_iter().flatten() {
                if !reached.contains_key(to) {
                    reached.insert(*to, Some(so_far.map_or(*t_from_to, |t| t.compose(t_from_to))));
                    next.push(*to);
                }
            }
        }
        reached
    }

    /// The way from one frame to another, if there is any.
    pub(super) fn way(&self, from: FrameId, to: FrameId) -> Option<Way> {
        // Where each frame was reached from, by which branch of that.
        let mut reached: BTreeMap<FrameId, (FrameId, Branch)> = BTreeMap::new();
        let mut next = vec![from];
        while let Some(frame) = next.pop() {
            for branch in self.0.get(&frame).into_iter().flatten() {
                if branch.to != from && !reached.contains_key(&branch.to) {
                    reached.insert(branch.to, (frame, *branch));
                    next.push(branch.to);
                }
            }
        }
        let mut branches = Vec::new();
        let mut at = to;
        while at != from {
            let (before, branch) = reached.get(&at)?;
            branches.push(*branch);
            at = *before;
        }
        branches.reverse();
        let t_from_to = branches.iter().map(|branch| branch.t_from_to).reduce(|t, next| t.compose(&next))?;
        Some(Way { t_from_to, ties: branches.iter().map(|branch| branch.tie).collect() })
    }
}
