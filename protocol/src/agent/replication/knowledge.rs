//! What the facts say, independent of the order they came in: the submaps, which alignments both endpoints agree on
//! (the two-sided rule, DESIGN §3), and the estimation problem that follows from them.

use super::copies::{CopiedFrom, Copies, FirstHeard};
use crate::agent::two_sided;
use crate::estimate::distortion::{COMMON_BENT, COMMON_LIDAR};
use crate::estimate::joint::{AgreedAlignment, FrameChain, MapProblem};
use crate::estimate::position::{SeenPoint, StatedPoint};
use crate::geometry::{PoseWithCovariance, Relative, Se3};
use crate::ids::{EntryId, FrameId, Hash, RobotId, SubmapId};
use crate::submap::Summary;
use crate::time::Stamp;
use crate::wire::fact::{
    AlignmentFact, CarriedFact, Fact, LookalikeFact, PositionFact, RefusalReason, ScaleKind, SightingFact, SubmapFact,
    VerdictFact, VerdictOutcome,
};
use core::num::NonZero;
use nalgebra::Vector3;
use std::collections::{BTreeMap, BTreeSet};

/// A pair of submaps, the smaller first.
pub type Pair = (SubmapId, SubmapId);

/// The pair of `a` and `b`, in canonical order.
pub fn pair_of(a: SubmapId, b: SubmapId) -> Pair {
    if a < b { (a, b) } else { (b, a) }
}

/// How far the two endpoints of an alignment are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Agreement {
    /// The other endpoint has not answered.
    Waiting,
    /// Both measured it and the measurements agree (or one robot owns both ends).
    Agreed,
    /// The other endpoint refused, or measured something else.
    Disputed,
}

/// What is kept of a submap's fact at hand. Of 36,000 submaps there is no room for more; the odometry's covariance is
/// read again from the entry when it is needed.
#[derive(Clone, Debug)]
pub struct Known {
    /// The entry that states it.
    pub entry: EntryId,
    /// Place of the entry that holds the fact now: another, if it is carried on.
    pub held_at: u32,
    /// Index of the submap that `t_prev_this` begins at; `None` for the origin of the frame.
    pub after: Option<u32>,
    /// Stamps of the first and last keyframe.
    pub stamps: [Stamp; 2],
    /// `t_prev_this`.
    pub t_prev_this: Se3,
    /// Half extents of the cloud about the anchor, in frame units.
    pub extent: [f32; 3],
    /// Address of the keypoint blob.
    pub blob: Hash,
    /// How many keypoints that holds, by its owner's word.
    pub keypoints: u16,
    /// Unit of the frame.
    pub scale: ScaleKind,
    /// How many keyframes made it, if that is told.
    pub keyframes: Option<NonZero<u16>>,
    /// What it looks like, if that can be read.
    pub summary: Option<Summary>,
}

/// What the joint estimate is to be a function of.
#[derive(Clone, Debug)]
pub struct EstimationInput {
    /// The frames that are tied to others or within themselves, our own, and what ties them.
    pub problem: MapProblem,
    /// Frames that nothing ties to anything, and how many anchors each has: their odometry is all there is to say.
    pub alone: BTreeMap<FrameId, usize>,
    /// The problem counts the anchors of a frame from 0. These are the indices of those frames of it whose submaps are
    /// no longer all there.
    pub gaps: Gaps,
}

/// Indices of the submaps of frames that have lost some, by their places in the chain.
pub type Gaps = BTreeMap<FrameId, Vec<u32>>;

/// All facts held, parsed and indexed.
#[derive(Clone, Debug, Default)]
pub struct Knowledge {
    /// Boxed: a tree's nodes are half empty.
    submaps: BTreeMap<SubmapId, Box<Known>>,
    alignments: BTreeMap<EntryId, AlignmentFact>,
    by_pair: BTreeMap<Pair, BTreeSet<EntryId>>,
    verdicts: BTreeMap<EntryId, BTreeMap<EntryId, VerdictFact>>,
    sightings: BTreeMap<EntryId, SightingFact>,
    positions: BTreeMap<EntryId, PositionFact>,
    lookalikes: BTreeMap<EntryId, LookalikeFact>,
    first_heard: FirstHeard,
    /// Derived, kept because it is asked often: what [`Knowledge::judge`] says of each alignment.
    agreements: BTreeMap<EntryId, Agreement>,
}

impl Knowledge {
    /// Takes one fact. Facts that contradict the rules (an alignment by a third party, of a submap with itself) are
    /// ignored: they are signed, so they stay in the log as evidence, but they move nothing.
    pub fn absorb(&mut self, id: EntryId, fact: Fact) {
        match fact {
            Fact::Submap(submap) => self.absorb_submap(id, id.seq, submap.index.checked_sub(1), &submap),
            Fact::Condensed(condensed) => {
                for CarriedFact { seq, after, fact } in condensed.carried {
                    let stated = EntryId { seq, ..id };
                    match fact {
                        _ if seq >= id.seq => {}
                        Fact::Submap(submap) => self.absorb_submap(stated, id.seq, after, &submap),
                        fact => self.absorb(stated, fact),
                    }
                }
            }
            Fact::Alignment(alignment) => self.absorb_alignment(id, alignment),
            Fact::Verdict(verdict) => {
                let alignment = verdict.alignment;
                self.verdicts.entry(alignment).or_default().insert(id, verdict);
                self.agreements.insert(alignment, self.judge(alignment));
            }
            Fact::Sighting(sighting) => {
                if is_of_another(id, sighting.i, sighting.j) {
                    self.sightings.insert(id, sighting);
                }
            }
            Fact::Position(position) => {
                if is_of_another(id, position.i, position.j) {
                    self.positions.insert(id, position);
                }
            }
            Fact::Lookalike(pair) => {
                self.lookalikes.insert(id, pair);
            }
            // The replica acts on it.
            Fact::Retired(_) => {}
        }
    }

    /// Forgets what a writer's entries below its floor said: what still counts of it is carried on above.
    pub fn forget_below(&mut self, frame: FrameId, floor: u32) {
        let gone = |id: &EntryId| id.frame == frame && id.seq < floor;
        self.submaps.retain(|_, known| !gone(&known.entry));
        self.sightings.retain(|id, _| !gone(id));
        self.positions.retain(|id, _| !gone(id));
        self.lookalikes.retain(|id, _| !gone(id));
        self.first_heard.prune(self.submaps.len(), self.submaps.values().map(|known| &**known));
        let entries = EntryId { frame, seq: 0 }..EntryId { frame, seq: floor };
        let alignments: Vec<EntryId> = self.alignments.range(entries).map(|(id, _)| *id).collect();
        for id in alignments {
            let Some(fact) = self.alignments.remove(&id) else { continue };
            self.agreements.remove(&id);
            if let Some(ids) = self.by_pair.get_mut(&(fact.i, fact.j)) {
                ids.remove(&id);
            }
        }
        self.by_pair.retain(|_, ids| !ids.is_empty());
        let mut answered = Vec::new();
        for (alignment, verdicts) in &mut self.verdicts {
            let before = verdicts.len();
            verdicts.retain(|id, _| !gone(id));
            answered.extend((verdicts.len() < before).then_some(*alignment));
        }
        self.verdicts.retain(|_, verdicts| !verdicts.is_empty());
        for alignment in answered {
            self.agreements.insert(alignment, self.judge(alignment));
        }
    }

    /// Of two submaps that claim one index, the one written first counts, in whatever order they arrive.
    fn absorb_submap(&mut self, entry: EntryId, held_at: u32, after: Option<u32>, fact: &SubmapFact) {
        let submap = SubmapId { frame: entry.frame, index: fact.index };
        if self.submaps.get(&submap).is_none_or(|first| entry < first.entry) {
            let known = Known {
                entry,
                held_at,
                after,
                stamps: fact.stamps,
                t_prev_this: fact.odometry.pose,
                extent: fact.extent,
                blob: fact.blob,
                keypoints: fact.keypoint_count,
                scale: fact.scale,
                keyframes: fact.keyframes,
                summary: Summary::decode(&fact.summary).ok(),
            };
            self.first_heard.hear(submap.frame.robot, &known);
            self.submaps.insert(submap, Box::new(known));
        }
    }

    /// All facts came from the disk at once, and those of `me` count as heard before all.
    pub fn order_by_stamp(&mut self, me: RobotId) {
        self.first_heard = FirstHeard::by_stamp(me, self.submaps());
    }

    /// Another robot that stated before what this submap shows: the submap is a copy.
    pub fn copied_from(&self, id: SubmapId) -> Option<RobotId> {
        self.first_heard.before(id.frame.robot, self.submap(id)?)
    }

    /// Who states others' clouds as its own, whose, and of how many submaps.
    pub fn copied(&self) -> impl Iterator<Item = (CopiedFrom, u64)> {
        self.first_heard.copied()
    }

    /// What several robots state as their own, by all facts held.
    pub fn copies(&self) -> Copies {
        Copies::among(self.submaps())
    }

    /// Whether an alignment of two submaps says nothing, for one is a copy.
    pub fn is_of_copy(&self, copies: &Copies, (i, j): Pair) -> bool {
        let known = |id| self.submap(id).map(|known| (id, known));
        known(i).zip(known(j)).is_some_and(|(i, j)| copies.void([i, j]))
    }

    fn absorb_alignment(&mut self, id: EntryId, fact: AlignmentFact) {
        let writer = id.frame.robot;
        let endpoint = fact.i.frame.robot == writer || fact.j.frame.robot == writer;
        if endpoint && fact.i < fact.j {
            self.by_pair.entry((fact.i, fact.j)).or_default().insert(id);
            self.alignments.insert(id, fact);
            self.agreements.insert(id, self.judge(id));
        }
    }

    /// Every submap known.
    pub fn submaps(&self) -> impl Iterator<Item = (SubmapId, &Known)> {
        self.submaps.iter().map(|(id, known)| (*id, &**known))
    }

    /// The submaps of one robot, of all its frames.
    pub fn submaps_of(&self, robot: RobotId) -> impl Iterator<Item = (SubmapId, &Known)> {
        let end = |epoch, index| SubmapId { frame: FrameId { robot, epoch }, index };
        self.submaps.range(end(0, 0)..=end(u32::MAX, u32::MAX)).map(|(id, known)| (*id, &**known))
    }

    /// The keypoint blobs of a robot's submaps.
    pub fn blobs_of(&self, robot: RobotId) -> BTreeSet<Hash> {
        self.submaps_of(robot).map(|(_, known)| known.blob).collect()
    }

    /// One submap.
    pub fn submap(&self, id: SubmapId) -> Option<&Known> {
        self.submaps.get(&id).map(|known| &**known)
    }

    /// Every alignment stated.
    pub fn alignments(&self) -> impl Iterator<Item = (EntryId, &AlignmentFact)> {
        self.alignments.iter().map(|(id, fact)| (*id, fact))
    }

    /// One alignment.
    pub fn alignment(&self, id: EntryId) -> Option<&AlignmentFact> {
        self.alignments.get(&id)
    }

    /// Whether anyone stated an alignment of this pair.
    pub fn is_stated(&self, pair: Pair) -> bool {
        self.by_pair.contains_key(&pair)
    }

    /// Whether `robot` has answered this alignment.
    pub fn has_verdict(&self, alignment: EntryId, robot: RobotId) -> bool {
        self.verdicts.get(&alignment).is_some_and(|all| all.keys().any(|id| id.frame.robot == robot))
    }

    /// Whether an alignment names other blobs than its submaps' own facts do: it was computed from further keypoints.
    pub fn is_second_look(&self, fact: &AlignmentFact) -> bool {
        let stated = |id: SubmapId| self.submap(id).map(|known| known.blob);
        [stated(fact.i), stated(fact.j)] != fact.blobs.map(Some)
    }

    /// What the two endpoints make of an alignment.
    pub fn agreement(&self, id: EntryId) -> Agreement {
        self.agreements.get(&id).copied().unwrap_or(Agreement::Waiting)
    }

    fn judge(&self, id: EntryId) -> Agreement {
        let Some(fact) = self.alignments.get(&id) else { return Agreement::Waiting };
        if fact.i.frame.robot == fact.j.frame.robot {
            return Agreement::Agreed;
        }
        match self.verdict(id, fact).map(|verdict| &verdict.outcome) {
            None => Agreement::Waiting,
            Some(VerdictOutcome::Refused(_)) => Agreement::Disputed,
            Some(VerdictOutcome::Measured { t_i_j, .. }) if two_sided::agree(&fact.t_i_j, t_i_j) => Agreement::Agreed,
            Some(VerdictOutcome::Measured { .. }) => Agreement::Disputed,
        }
    }

    /// The first verdict that the endpoint other than the writer wrote.
    fn verdict(&self, id: EntryId, fact: &AlignmentFact) -> Option<&VerdictFact> {
        let writer = id.frame.robot;
        let other = if fact.i.frame.robot == writer { fact.j.frame.robot } else { fact.i.frame.robot };
        let all = self.verdicts.get(&id)?;
        all.iter().find(|(verdict, _)| verdict.frame.robot == other).map(|(_, fact)| fact)
    }

    /// The measurement that enters the estimate for an agreed alignment: midway between what the two endpoints
    /// measured.
    fn measurement(&self, id: EntryId, fact: &AlignmentFact) -> Relative {
        let Some(VerdictOutcome::Measured { t_i_j, .. }) = self.verdict(id, fact).map(|v| &v.outcome) else {
            return fact.t_i_j;
        };
        two_sided::midway(&fact.t_i_j, t_i_j).unwrap_or(fact.t_i_j)
    }

    /// The estimation problem: one agreed alignment per pair, all sightings, and the unbroken chain of submaps of every
    /// frame they tie, and of `own`. `odometry` reads `t_prev_this` from where a submap's fact is held.
    pub fn question(
        &self,
        own: FrameId,
        mut odometry: impl FnMut(&Known) -> Option<PoseWithCovariance>,
    ) -> EstimationInput {
        let chains = self.chains();
        let place = |id: SubmapId| {
            let index = chains.get(&id.frame)?.binary_search(&id.index).ok()?;
            Some(SubmapId { index: index as u32, ..id })
        };
        let bends = |fact: &AlignmentFact| !(self.is_of_ranges(fact.i) && self.is_of_ranges(fact.j));
        let tie = |entry: EntryId, i: SubmapId, j: SubmapId, t_i_j: Relative| {
            Some(AgreedAlignment { entry, i: place(i)?, j: place(j)?, t_i_j })
        };
        let point = |(entry, fact): (&EntryId, &PositionFact)| {
            let [p_i, p_j] = [fact.p_i, fact.p_j].map(|p| Vector3::from(p.map(f64::from)));
            let point = SeenPoint { p_i, p_j, covariance: fact.covariance };
            Some(StatedPoint { entry: *entry, i: place(fact.i)?, j: place(fact.j)?, point })
        };
        let copies = self.copies();
        let counts = |pair: &Pair| {
            let known = place(pair.0).is_some() && place(pair.1).is_some();
            if known && !self.is_of_copy(&copies, *pair) { self.counted(*pair) } else { None }
        };
        let agreed: Vec<(AgreedAlignment, f64)> = self
            .by_pair
            .keys()
            .filter_map(counts)
            .filter_map(|id| self.alignments.get(&id).map(|fact| (id, fact)))
            .filter_map(|(entry, fact)| {
                let tie = tie(entry, fact.i, fact.j, self.measurement(entry, fact))?;
                Some((tie, if bends(fact) { COMMON_BENT } else { COMMON_LIDAR }))
            })
            .collect();
        let common = agreed.iter().map(|(tie, common)| (tie.entry, *common)).collect();
        let is_second = |entry: &EntryId| self.alignments.get(entry).is_some_and(|fact| self.is_second_look(fact));
        let second_looks = agreed.iter().map(|(tie, _)| tie.entry).filter(is_second).collect();
        let alignments: Vec<AgreedAlignment> = agreed.into_iter().map(|(tie, _)| tie).collect();
        let sightings = self.sightings.iter();
        let sightings: Vec<AgreedAlignment> =
            sightings.filter_map(|(entry, fact)| tie(*entry, fact.i, fact.j, Relative::Metric(fact.t_i_j))).collect();
        let positions: Vec<StatedPoint> = self.positions.iter().filter_map(point).collect();
        let ties = alignments.iter().chain(&sightings).flat_map(|tie| [tie.i.frame, tie.j.frame]);
        let seen = positions.iter().flat_map(|stated| [stated.i.frame, stated.j.frame]);
        let tied: BTreeSet<FrameId> = ties.chain(seen).chain([own]).collect();
        let mut chain = |frame: &FrameId| {
            let known = |index: &u32| self.submap(SubmapId { frame: *frame, index: *index });
            let mut anchors = chains.get(frame)?.iter().filter_map(known).peekable();
            let scale = anchors.peek()?.scale;
            Some((*frame, FrameChain { scale, odometry: anchors.map_while(&mut odometry).collect() }))
        };
        let frames: BTreeMap<_, _> = tied.iter().filter_map(&mut chain).collect();
        let within = self.submaps.iter().filter(|(id, _)| frames.contains_key(&id.frame));
        let keyframes = within.filter_map(|(id, known)| Some((place(*id)?, known.keyframes?))).collect();
        let gone = chains.iter().filter(|(frame, _)| frames.contains_key(frame)).flat_map(gone_before).collect();
        let (posed, alone): (BTreeMap<_, _>, BTreeMap<_, _>) =
            chains.into_iter().partition(|(frame, _)| tied.contains(frame));
        let gaps =
            posed.into_iter().filter(|(_, chain)| chain.last().is_some_and(|last| *last as usize >= chain.len()));
        EstimationInput {
            problem: MapProblem {
                gone,
                keyframes,
                frames,
                alignments,
                sightings,
                positions,
                common,
                ambiguous: self.ambiguous(),
                second_looks,
            },
            alone: alone.into_iter().map(|(frame, chain)| (frame, chain.len())).collect(),
            gaps: gaps.collect(),
        }
    }

    /// Between which frames there are pairs of submaps of which one end found an alignment, and the other that there
    /// are several; how many. Of a frame and itself, pairs that fit in several ways by their owner's word.
    fn ambiguous(&self) -> BTreeMap<(FrameId, FrameId), usize> {
        let is_ambiguous = |id: &EntryId| {
            let first_look = self.alignments.get(id).filter(|fact| !self.is_second_look(fact));
            let verdict = first_look.and_then(|fact| self.verdict(*id, fact));
            verdict.is_some_and(|v| v.outcome == VerdictOutcome::Refused(RefusalReason::Ambiguous))
        };
        let mut counts = BTreeMap::new();
        for ((i, j), ids) in &self.by_pair {
            let (a, b) = (i.frame.min(j.frame), i.frame.max(j.frame));
            let agreed = ids.iter().any(|id| self.agreement(*id) == Agreement::Agreed);
            if a != b && !agreed && ids.iter().any(is_ambiguous) {
                *counts.entry((a, b)).or_default() += 1;
            }
        }
        let frames: BTreeSet<FrameId> = self.lookalikes.keys().map(|id| id.frame).collect();
        counts.extend(frames.into_iter().map(|frame| ((frame, frame), self.lookalikes_of(frame).len())));
        counts
    }

    /// Pairs within a frame of which its owner tells that one fits at another place as well.
    pub fn lookalikes_of(&self, frame: FrameId) -> BTreeSet<(u32, u32)> {
        let told = self.lookalikes.range(EntryId { frame, seq: 0 }..=EntryId { frame, seq: u32::MAX });
        told.map(|(_, pair)| (pair.i, pair.j)).collect()
    }

    /// Of all alignments of two submaps the one that counts: the first that both endpoints agree on, of first looks if
    /// there is one.
    pub fn counted(&self, pair: Pair) -> Option<EntryId> {
        let agreed =
            || self.by_pair.get(&pair).into_iter().flatten().filter(|id| self.agreement(**id) == Agreement::Agreed);
        let is_first = |id: &&EntryId| self.alignments.get(id).is_some_and(|fact| !self.is_second_look(fact));
        agreed().find(is_first).or_else(|| agreed().next()).copied()
    }

    /// Whether a LiDAR saw the submap, by its owner's word.
    pub fn is_of_ranges(&self, id: SubmapId) -> bool {
        self.submap(id).and_then(|known| known.summary.as_ref()).is_some_and(Summary::is_of_ranges)
    }

    /// Submaps that an alignment, a sighting or a position names.
    pub fn tied_submaps(&self) -> BTreeSet<SubmapId> {
        let aligned = self.alignments.values().flat_map(|fact| [fact.i, fact.j]);
        let sighted = self.sightings.values().flat_map(|fact| [fact.i, fact.j]);
        aligned.chain(sighted).chain(self.positions.values().flat_map(|fact| [fact.i, fact.j])).collect()
    }

    /// The indices of every frame's submaps from the origin on, as far as each step between them is known.
    pub fn chains(&self) -> BTreeMap<FrameId, Vec<u32>> {
        let mut chains: BTreeMap<FrameId, (Vec<u32>, bool)> = BTreeMap::new();
        for (id, known) in &self.submaps {
            let (chain, whole) = chains.entry(id.frame).or_insert_with(|| (Vec::new(), true));
            *whole &= known.after == chain.last().copied();
            if *whole {
                chain.push(id.index);
            }
        }
        chains.into_iter().filter(|(_, (chain, _))| !chain.is_empty()).map(|(f, (chain, _))| (f, chain)).collect()
    }
}

/// Whether a sighting is of another robot and signed by its observer.
fn is_of_another(id: EntryId, i: SubmapId, j: SubmapId) -> bool {
    i.frame.robot == id.frame.robot && j.frame.robot != id.frame.robot
}

/// Of the submaps of a chain that others are gone before: their place, and how many.
fn gone_before((frame, chain): (&FrameId, &Vec<u32>)) -> Vec<(SubmapId, u32)> {
    let one = |(place, two): (u32, &[u32])| {
        let gone = two[1].saturating_sub(two[0]).saturating_sub(1);
        (gone > 0).then_some((SubmapId { frame: *frame, index: place }, gone))
    };
    (1..).zip(chain.windows(2)).filter_map(one).collect()
}

#[cfg(test)]
#[path = "knowledge_tests.rs"]
mod tests;
