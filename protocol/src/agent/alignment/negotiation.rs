//! Which pairs of submaps are worth aligning, in what order, and who begins (DESIGN §6).
//!
//! A hash of the pair decides the responsible endpoint, so exactly one begins. Candidates are ranked by what they
//! promise for the bytes they cost ([`ranking`](super::ranking)). Pairs that the joint estimate places out of reach of
//! one another, and submaps that have [`ALIGNMENTS_PER_SUBMAP`] with the other frame, stay dormant. Two frames with
//! [`ALIGNMENTS_PER_FRAME_PAIR`] alignments are tied well enough as such; after that only submaps are aligned that have
//! drifted from one another by the joint estimate: without these the map of a long drive would become that of its
//! odometry. Every pair is tried once, and once more with [further keypoints](super::second_look) if it was refused and
//! should not have been; every foreign alignment that names us is verified once.

use super::overlap_model::{OverlapModel, Prediction};
use super::second_look::SECOND_LOOKS_MAX;
use super::shortlist::{Candidate, Shortlist};
use crate::agent::io::JobId;
use crate::agent::recent::Recent;
use crate::agent::replication::knowledge::{Knowledge, Pair, pair_of};
use crate::config::Sensor;
use crate::ids::{EntryId, FrameId, Hash, RobotId, SubmapId};
use crate::submap::{Features, Keypoints};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Undisputed alignments between two frames beyond which a further pair must tell something new.
pub const ALIGNMENTS_PER_FRAME_PAIR: usize = 12;
/// Undisputed alignments of one submap with one other frame beyond which it is tried with no more of that frame's: they
/// share the submap's errors, so that others tell more.
pub const ALIGNMENTS_PER_SUBMAP: usize = 3;
/// The same of its own frame, for LiDARs: these take no keypoints, and their errors average out. *Measured* (four
/// robots in a hall, two minutes): with 3 the map errs 2.3 times as much as given every true loop, with 4 1.75 times, 5
/// 1.5, 8 1.3.
pub const LOOPS_PER_SUBMAP: usize = 8;
/// Pairs tried for one own submap against one foreign frame.
pub const TRIES_PER_SUBMAP: usize = 12;
/// Of these, once the two frames are tied well enough as such: what drifts is seen from the next submap as well.
pub const TRIES_PER_SUBMAP_TIED: usize = 3;
/// The same for LiDARs where no keypoints have to be sent, as between submaps of our own.
pub const TRIES_PER_SUBMAP_FREE: usize = 8;
/// Index distance from which two submaps of one frame may close a loop.
pub const LOOP_GAP: u32 = 5;
/// Pairs of own submaps of one frame that are told to fit at another place as well: facts of 124 bytes that stay as
/// long as the frame. If so many do not outweigh the loops that hold, the place does not repeat itself.
pub const LOOKALIKES_MAX: usize = 32;
/// Decoded keypoint blobs kept in memory.
pub const KEYPOINTS_MAX: usize = 512;
/// Own submaps whose features are kept in memory; older ones can no longer be aligned.
pub const FEATURES_MAX: usize = 2_000;
/// Foreign alignments waiting to be verified.
pub const VERIFICATIONS_MAX: usize = 1_024;
/// Pairs remembered as tried.
pub const TRIED_MAX: usize = 1_000_000;
/// What a running alignment is for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Purpose {
    /// To state it, if there is any.
    Propose(Prediction),
    /// To answer an alignment that another robot stated.
    Verify(EntryId),
}

/// A running alignment job.
#[derive(Clone, Copy, Debug)]
pub struct Work {
    /// Our submap.
    pub mine: SubmapId,
    /// The other one.
    pub theirs: SubmapId,
    /// What for.
    pub purpose: Purpose,
    /// The blob of further keypoints that is looked at as well, at a pair that the map calls for.
    pub further: Option<Hash>,
}

/// Everything the negotiation remembers.
#[derive(Debug)]
pub struct Negotiation {
    features: BTreeMap<SubmapId, Arc<Features>>,
    keypoints: Recent<Arc<Keypoints>>,
    candidates: Shortlist,
    tried: BTreeSet<Pair>,
    tries: BTreeMap<(SubmapId, FrameId), usize>,
    /// How likely a candidate is to overlap.
    pub overlap_model: OverlapModel,
    /// Foreign alignments to answer.
    pub verify: BTreeSet<EntryId>,
    /// Jobs under way.
    pub running: BTreeMap<JobId, Work>,
    /// Pairs that were let through and paid for, and not tried yet.
    pub begun: BTreeSet<Pair>,
    /// Something changed that may make work startable.
    stirred: bool,
    /// Pairs we are not responsible for and would like to see tried.
    pub peer_requests: Shortlist,
    /// Pairs that were refused and may be looked at again.
    second_looks: Shortlist,
}

impl Negotiation {
    /// Nothing is known yet of what this sensor sees.
    pub fn new(sensor: Sensor) -> Self {
        Self {
            features: BTreeMap::new(),
            keypoints: Recent::default(),
            candidates: Shortlist::default(),
            tried: BTreeSet::new(),
            tries: BTreeMap::new(),
            overlap_model: OverlapModel::new(sensor),
            verify: BTreeSet::new(),
            running: BTreeMap::new(),
            begun: BTreeSet::new(),
            stirred: false,
            peer_requests: Shortlist::default(),
            second_looks: Shortlist::default(),
        }
    }

    /// Which of the two robots begins with this pair. Both compute the same answer.
    pub fn responsible(pair: Pair) -> RobotId {
        let mut bytes = Vec::with_capacity(32);
        for id in [pair.0, pair.1] {
            bytes.extend_from_slice(&id.frame.robot.0);
            bytes.extend_from_slice(&id.frame.epoch.to_le_bytes());
            bytes.extend_from_slice(&id.index.to_le_bytes());
        }
        let even = Hash::of(&bytes).0[0].is_multiple_of(2);
        if even { pair.0.frame.robot } else { pair.1.frame.robot }
    }

    /// Something changed: look for work again.
    pub fn mark_dirty(&mut self) {
        self.stirred = true;
    }

    /// Whether anything changed since the last call.
    pub fn take_stirred(&mut self) -> bool {
        core::mem::take(&mut self.stirred)
    }

    /// Keeps the features of an own submap; the oldest beyond [`FEATURES_MAX`] go.
    pub fn add_features(&mut self, submap: SubmapId, features: Arc<Features>) {
        self.stirred = true;
        self.features.insert(submap, features);
        while self.features.len() > FEATURES_MAX {
            self.features.pop_first();
        }
    }

    /// An own submap is gone.
    pub fn forget(&mut self, submap: SubmapId) {
        self.features.remove(&submap);
    }

    /// Candidates and wishes that name a submap which is gone go as well.
    pub fn drop_unknown(&mut self, knowledge: &Knowledge) {
        let known = |candidate: &Candidate| knowledge.submap(candidate.theirs).is_some();
        for list in [&mut self.candidates, &mut self.peer_requests, &mut self.second_looks] {
            list.retain(known);
        }
    }

    /// The features of an own submap.
    pub fn features(&self, submap: SubmapId) -> Option<&Arc<Features>> {
        self.features.get(&submap)
    }

    /// Own submaps that can be aligned.
    pub fn own(&self) -> impl Iterator<Item = SubmapId> + '_ {
        self.features.keys().copied()
    }

    /// Keeps a decoded blob; a full cache drops the one that came first.
    pub fn add_keypoints(&mut self, hash: Hash, keypoints: Arc<Keypoints>) {
        if self.keypoints.len() >= KEYPOINTS_MAX {
            self.keypoints.drop_oldest(|_| true);
        }
        self.stirred = true;
        self.keypoints.insert(hash, keypoints);
    }

    /// A decoded blob.
    pub fn keypoints(&self, hash: Hash) -> Option<&Arc<Keypoints>> {
        self.keypoints.get(hash)
    }

    /// Notes a pair that may overlap; the least similar beyond `limit` goes.
    pub fn add_candidate(&mut self, candidate: Candidate, limit: usize) {
        if !self.tried.contains(&pair_of(candidate.mine, candidate.theirs)) {
            self.candidates.offer(candidate, limit);
        }
    }

    /// Notes an alignment to answer. Beyond [`VERIFICATIONS_MAX`] those of the robot with most that `waits` go, half of
    /// them, the latest: a robot that states what cannot be answered must not keep others from their answers, nor us
    /// busy with making room.
    pub fn add_verification(&mut self, id: EntryId, waits: impl Fn(&EntryId) -> bool) {
        if self.verify.len() >= VERIFICATIONS_MAX {
            let mut waiting: BTreeMap<RobotId, Vec<EntryId>> = BTreeMap::new();
            for id in self.verify.iter().filter(|id| waits(id)) {
                waiting.entry(id.frame.robot).or_default().push(*id);
            }
            let most = waiting.into_values().max_by_key(Vec::len).unwrap_or_default();
            for id in &most[most.len() / 2..] {
                self.verify.remove(id);
            }
        }
        if self.verify.len() < VERIFICATIONS_MAX {
            self.verify.insert(id);
        }
    }

    /// Notes a pair that was refused and may be looked at again; the least similar beyond [`SECOND_LOOKS_MAX`] goes.
    pub fn add_second_look(&mut self, candidate: Candidate) {
        self.second_looks.offer(candidate, SECOND_LOOKS_MAX);
    }

    /// Neither among candidates nor among wishes would a pair less similar than this be kept.
    pub fn least_similarity(&self, limit: usize) -> f64 {
        self.candidates.least(limit).min(self.peer_requests.least(limit))
    }

    /// The other endpoint wishes this pair tried. False if it is unknown here.
    pub fn wish(&mut self, pair: Pair) -> bool {
        self.candidates.wish(pair)
    }

    /// Whether a pair has been tried.
    pub fn is_tried(&self, pair: Pair) -> bool {
        self.tried.contains(&pair)
    }

    /// Takes a pair off the list for good.
    pub fn mark_tried(&mut self, pair: Pair) {
        self.begun.remove(&pair);
        self.second_looks.remove(pair);
        if let Some(candidate) = self.candidates.remove(pair) {
            *self.tries.entry((candidate.mine, candidate.theirs.frame)).or_default() += 1;
        }
        if self.tried.len() < TRIED_MAX {
            self.tried.insert(pair);
        }
    }

    /// A pair that was tried in an earlier run counts as in this one.
    pub fn restore_tried(&mut self, mine: SubmapId, theirs: SubmapId) {
        if self.tried.len() < TRIED_MAX && self.tried.insert(pair_of(mine, theirs)) {
            *self.tries.entry((mine, theirs.frame)).or_default() += 1;
        }
    }

    /// What a pair's try rested on is no more: it may be tried again.
    pub fn retry(&mut self, pair: Pair) {
        self.tried.remove(&pair);
        self.second_looks.remove(pair);
    }

    /// Pairs tried so far of this one's own submap with this one's other frame.
    pub fn tries(&self, candidate: &Candidate) -> usize {
        self.tries.get(&(candidate.mine, candidate.theirs.frame)).copied().unwrap_or(0)
    }

    /// Candidates with an expected gain, best first. `gain` answers `None` for a pair that is dormant now.
    pub fn ranked(&self, gain: impl Fn(&Candidate) -> Option<f64>) -> Vec<Candidate> {
        let mut ranked: Vec<(f64, Pair, Candidate)> = self
            .candidates
            .iter()
            .chain(self.second_looks.iter())
            .filter(|(_, c)| self.tries(c) < TRIES_PER_SUBMAP)
            .filter_map(|(pair, c)| gain(c).map(|g| (g, pair, *c)))
            .collect();
        ranked.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        ranked.into_iter().map(|(_, _, candidate)| candidate).collect()
    }

    /// Forgets all candidates (the set of facts was rebuilt). What was refused stays tried, and may be looked at again.
    pub fn clear_candidates(&mut self) {
        self.candidates.clear();
        self.peer_requests.clear();
        self.begun.clear();
        self.verify.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::submap::{Looks, Similarity};

    fn submap(robot: u8, index: u32) -> SubmapId {
        SubmapId { frame: FrameId { robot: RobotId([robot; 8]), epoch: 1 }, index }
    }

    fn candidate(index: u32, similarity: f64) -> Candidate {
        let similarity = Similarity { value: similarity, by: Looks::Summary };
        Candidate { mine: submap(1, 0), theirs: submap(2, index), similarity, wished: false, further: false }
    }

    #[test]
    fn exactly_one_endpoint_is_responsible_and_the_load_is_shared() {
        let mut first = 0;
        for n in 0..1000 {
            let pair = pair_of(submap(2, n), submap(1, n));
            let who = Negotiation::responsible(pair);
            assert!(who == pair.0.frame.robot || who == pair.1.frame.robot);
            assert_eq!(pair, pair_of(submap(1, n), submap(2, n)));
            first += usize::from(who == pair.0.frame.robot);
        }
        assert!((400..600).contains(&first), "{first}");
    }

    #[test]
    fn the_candidate_list_keeps_the_most_similar_up_to_its_limit() {
        let mut n = Negotiation::new(Sensor::Points3d);
        for k in 0..10 {
            n.add_candidate(candidate(k, f64::from(k)), 5);
        }
        let kept: Vec<u32> = n.ranked(|c| Some(c.similarity.value)).iter().map(|c| c.theirs.index).collect();
        assert_eq!(kept, [9, 8, 7, 6, 5]);
    }

    #[test]
    fn as_many_refused_pairs_wait_for_a_second_look_as_the_limit_says_and_each_has_one() {
        let mut n = Negotiation::new(Sensor::Points3d);
        let of = |k: usize| Candidate { further: true, ..candidate(k as u32, k as f64) };
        let waiting = |n: &Negotiation| n.ranked(|c| c.further.then_some(c.similarity.value));
        for (count, kept) in [(SECOND_LOOKS_MAX, SECOND_LOOKS_MAX), (1, SECOND_LOOKS_MAX)] {
            let begin = n.second_looks.iter().count();
            (begin..begin + count).for_each(|k| n.add_second_look(of(k)));
            assert_eq!(waiting(&n).len(), kept);
        }
        assert!(waiting(&n).iter().all(|c| c.theirs.index > 0), "the least alike went");
        let best = waiting(&n)[0];
        n.mark_tried(pair_of(best.mine, best.theirs));
        assert_eq!(
            (waiting(&n).len(), n.tries(&best)),
            (SECOND_LOOKS_MAX - 1, 0),
            "it takes no first look from others"
        );
    }

    #[test]
    fn who_states_what_cannot_be_answered_keeps_nobody_from_an_answer() {
        let mut n = Negotiation::new(Sensor::Points3d);
        let of = |robot: u8, seq: u32| EntryId { frame: FrameId { robot: RobotId([robot; 8]), epoch: 1 }, seq };
        let held = |n: &Negotiation, robot: u8| n.verify.iter().filter(|id| id.frame.robot.0[0] == robot).count();
        let waits = |id: &EntryId| id.frame.robot.0[0] != 3;
        (0..4).for_each(|seq| n.add_verification(of(1, seq), waits));
        (0..VERIFICATIONS_MAX as u32).for_each(|seq| n.add_verification(of(2, seq), waits));
        assert_eq!((held(&n, 1), held(&n, 2)), (4, VERIFICATIONS_MAX / 2 - 2 + 4), "who has most gives way to itself");
        (0..VERIFICATIONS_MAX as u32 - 4).for_each(|seq| n.add_verification(of(3, seq), waits));
        assert_eq!(held(&n, 3), VERIFICATIONS_MAX - 4);
        assert!(held(&n, 1) > 0 && held(&n, 1) + held(&n, 2) <= 4);
        (0..5).for_each(|seq| n.add_verification(of(3, 5_000 + seq), waits));
        assert_eq!(
            (n.verify.len(), held(&n, 3)),
            (VERIFICATIONS_MAX, VERIFICATIONS_MAX),
            "none goes that can be answered"
        );
    }

    #[test]
    fn a_tried_pair_never_returns_and_tries_are_bounded_per_frame() {
        let mut n = Negotiation::new(Sensor::Points3d);
        for k in 0..2 * TRIES_PER_SUBMAP as u32 {
            n.add_candidate(candidate(k, 1.0), 1000);
        }
        let mut tried = 0;
        while let Some(best) = n.ranked(|_| Some(1.0)).first().copied() {
            n.mark_tried(pair_of(best.mine, best.theirs));
            n.add_candidate(best, 1000);
            tried += 1;
        }
        assert_eq!(tried, TRIES_PER_SUBMAP);
    }
}
