//! Which pairs of submaps to align next, and which of them may wait: first what joins frames that nothing connects yet,
//! then where the joint estimate knows least for the bytes it costs to know more.

use super::Prospects;
use super::allowance::FACT_BYTES;
use super::negotiation::{ALIGNMENTS_PER_SUBMAP, LOOPS_PER_SUBMAP, TRIES_PER_SUBMAP_FREE, TRIES_PER_SUBMAP_TIED};
use super::overlap_model::{OverlapFeatures, Prediction};
use super::prospects::is_loop;
use super::second_look;
use super::shortlist::Candidate;
use super::stated::Stated;
use crate::agent::replication::knowledge::{Agreement, Pair, pair_of};
use crate::geometry::Relative;
use crate::ids::SubmapId;

/// Two frames that are tied well enough as such are aligned further where a submap has drifted from the other by this
/// many standard deviations of an alignment.
const NEWS_MIN: f64 = 1.0;
/// The same where no keypoints have to be sent and many alignments of one submap say more than one.
const NEWS_MIN_FREE: f64 = 0.25;
/// Two submaps that the joint estimate connects are tried from this probability of success on. Those of frames that
/// nothing connects yet always are: a robot that met nobody for long has learned to expect nothing.
const PROMISE_MIN: f64 = 0.2;
/// A submap may have drifted from another by so many standard deviations.
pub(super) const DRIFT_SIGMAS: f64 = 2.0;
/// Two LiDAR submaps whose anchors are so far apart, in units of what both reach, tell half of what two at one place
/// do. *Measured* in a hall: errors' variances are 1.2 times at a fifth, 2.4 at three tenths, 4.2 at four tenths.
const TOLD_HALF: f64 = 0.23;
/// What the other endpoint asked for counts by so much more.
const WISHED: f64 = 1.5;
/// Alignments, in units of what it takes to merge, after which two frames that still have not merged may wait with
/// more.
const MERGE_ATTEMPTS: usize = 2;

/// A pair worth trying.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Proposal {
    pub mine: SubmapId,
    pub theirs: SubmapId,
    /// It moves keypoints, and only makes surer what is known: not before more may be spent.
    pub may_wait: bool,
    /// About what it makes both ends send.
    pub bytes: usize,
    /// How probable it is that it can be aligned.
    pub prediction: Prediction,
    /// A second look, with further keypoints.
    pub further: bool,
}

impl Prospects<'_> {
    /// Candidates worth their cost, best first.
    pub(super) fn active_candidates(&self) -> Vec<Proposal> {
        let stated = self.stated();
        let enough = MERGE_ATTEMPTS * self.context.config().estimate.alignments_min;
        let proposal = |candidate: Candidate| {
            let Candidate { mine, theirs, .. } = candidate;
            let joins = !self.are_connected(mine, theirs) && stated.between(pair_of(mine, theirs)) < enough;
            let lacking = self.blobs_lacking(&candidate, &stated);
            // Theirs is about as long as ours.
            let bytes = lacking * self.blob_of(mine, candidate.further).map_or(0, <[u8]>::len) + 2 * FACT_BYTES;
            let prediction = self.predict(&candidate);
            Proposal { mine, theirs, may_wait: !joins && lacking > 0, bytes, prediction, further: candidate.further }
        };
        self.negotiation.ranked(|candidate| self.gain(candidate, &stated)).into_iter().map(proposal).collect()
    }

    /// Active candidates without those that are put off until more may be spent: they are no work left to do.
    pub(super) fn proposals(&self) -> usize {
        let may_spend = self.allowance.has_some(self.context.now());
        let is_begun = |p: &Proposal| self.negotiation.begun.contains(&pair_of(p.mine, p.theirs));
        self.active_candidates().iter().filter(|p| may_spend || !p.may_wait || is_begun(p)).count()
    }

    /// Whether the joint estimate knows how the two submaps lie.
    pub(super) fn are_connected(&self, a: SubmapId, b: SubmapId) -> bool {
        self.estimation.are_connected(a, b)
    }

    fn stated(&self) -> Stated {
        let mut stated = Stated::default();
        for (id, fact) in self.knowledge.alignments() {
            // Second looks say nothing where no map holds their submaps.
            let says = !self.knowledge.is_second_look(fact) || self.are_connected(fact.i, fact.j);
            if says && self.knowledge.agreement(id) != Agreement::Disputed {
                stated.count((fact.i, fact.j), &fact.t_i_j);
            }
        }
        stated
    }

    /// Expected gain of a pair: unmerged frames first, then where the two submaps are alike and least is known of how
    /// they lie, for as few keypoints as possible; nothing where the joint estimate says that they cannot touch, or
    /// where another alignment of theirs would say too little.
    fn gain(&self, candidate: &Candidate, stated: &Stated) -> Option<f64> {
        let pair = pair_of(candidate.mine, candidate.theirs);
        let is_loop = is_loop(candidate.mine, candidate.theirs);
        if self.is_out_of_reach(candidate.theirs) || (is_loop && self.is_out_of_reach(candidate.mine)) {
            return None;
        }
        // What bends a camera's submap is common to all its alignments: of LiDARs' alone many say more than a few.
        let averages = [pair.0, pair.1].into_iter().all(|id| self.knowledge.is_of_ranges(id));
        let Prediction { probability, features } = self.predict(candidate);
        if candidate.further && !self.calls_for_second_look(candidate) {
            return None;
        }
        let told = if averages { told(features.apart) } else { 1.0 };
        let limit = if is_loop && averages { part(LOOPS_PER_SUBMAP, told) } else { ALIGNMENTS_PER_SUBMAP };
        if stated.most_of_either(pair) >= limit.max(self.context.config().estimate.alignments_min) {
            return None;
        }
        let lacking = self.blobs_lacking(candidate, stated);
        let is_tied = stated.is_tied(pair);
        let favour = match (candidate.further, candidate.wished) {
            (true, _) => second_look::WORTH,
            (false, true) => WISHED,
            (false, false) => 1.0,
        };
        let worth = told * probability * favour;
        let Some((at_a, at_b)) = self.anchor(pair.0).zip(self.anchor(pair.1)) else {
            return (!is_tied).then_some(1.5 + worth / (1 + lacking) as f64);
        };
        if features.apart.is_some_and(|apart| apart > 1.0) || (probability < PROMISE_MIN && !candidate.further) {
            return None;
        }
        let news = stated.sigma(pair).map(|sigma| drift_between(at_a, at_b) / (sigma * at_b.sim().scale));
        let (tries, least) = match lacking == 0 && averages {
            true => (TRIES_PER_SUBMAP_FREE, NEWS_MIN_FREE),
            false => (TRIES_PER_SUBMAP_TIED, NEWS_MIN),
        };
        if is_tied && (self.negotiation.tries(candidate) >= part(tries, told) || news < Some(least)) {
            return None;
        }
        // Loops of our own come first: they take no keypoints.
        let share = news.filter(|_| !is_loop).map_or(1.0, |news| news / (1.0 + news));
        Some(0.5 * worth * share / (1 + lacking) as f64)
    }

    fn predict(&self, candidate: &Candidate) -> Prediction {
        let apart = self.apart(pair_of(candidate.mine, candidate.theirs));
        self.negotiation.overlap_model.predict(OverlapFeatures { similarity: candidate.similarity, apart })
    }

    /// How far two submaps are from one another by the joint estimate; see [`apart`].
    fn apart(&self, (a, b): Pair) -> Option<f64> {
        apart((self.anchor(a)?, self.reach(a)), (self.anchor(b)?, self.reach(b)))
    }

    /// How far from its anchor a submap may still overlap another, in its frame's unit: half its extent.
    pub(super) fn reach(&self, id: SubmapId) -> f64 {
        let [x, y, z] = self.knowledge.submap(id).map_or([0.0; 3], |fact| fact.extent).map(f64::from);
        0.5 * (x * x + y * y + z * z).sqrt()
    }

    /// Keypoint blobs that must be sent, as far as we know, for both ends to look at a pair.
    fn blobs_lacking(&self, Candidate { mine, theirs, further, .. }: &Candidate, stated: &Stated) -> usize {
        if is_loop(*mine, *theirs) {
            return 0;
        }
        let blob =
            if *further { self.address_of(*theirs) } else { self.knowledge.submap(*theirs).map(|known| known.blob) };
        let is_here =
            blob.is_some_and(|blob| self.negotiation.keypoints(blob).is_some() || self.blobs.get(blob).is_some());
        usize::from(!is_here) + usize::from(*further || stated.of_submap(*mine, theirs.frame) == 0)
    }

    /// The keypoints of a submap as they are sent, or the further ones, if they are here.
    fn blob_of(&self, id: SubmapId, further: bool) -> Option<&[u8]> {
        let hash = if further { self.address_of(id)? } else { self.knowledge.submap(id)?.blob };
        self.blobs.get(hash)
    }

    /// `t_own_anchor` by the joint estimate, if the submap is connected to us.
    pub(super) fn anchor(&self, id: SubmapId) -> Option<&Relative> {
        self.estimation.anchor(id)
    }
}

/// Share of what an alignment of two LiDAR submaps at one place tells that is told by one of two that are so far apart,
/// in units of what both reach.
fn told(apart: Option<f64>) -> f64 {
    apart.map_or(1.0, |apart| 1.0 / (1.0 + (apart / TOLD_HALF) * (apart / TOLD_HALF)))
}

/// Of so many, the share that is left to pairs that tell only so much: one at least.
fn part(of: usize, told: f64) -> usize {
    (of as f64 * told).ceil() as usize
}

/// How far two anchors are from one another, at the least that is likely: 0 where they may be at one place, 1 where, as
/// far as one can tell from their reaches, the submaps just touch. `None` where nothing is known of that, for one has
/// drifted from the other by more than both reach: such a pair must not be passed over, nor count as near.
fn apart((at_a, reach_a): (&Relative, f64), (at_b, reach_b): (&Relative, f64)) -> Option<f64> {
    let apart = (at_a.sim().translation - at_b.sim().translation).norm();
    let reach = at_a.sim().scale * reach_a + at_b.sim().scale * reach_b;
    let drift = DRIFT_SIGMAS * drift_between(at_a, at_b);
    let least = (apart - drift).max(0.0);
    (drift <= reach).then_some(if least == 0.0 { 0.0 } else { least / reach })
}

/// The least that the standard deviation of two anchors' distance vector can be, over all axes, in the unit of the
/// frame that both are given in: the difference of those of their positions (triangle inequality in L²), whatever they
/// share.
fn drift_between(a: &Relative, b: &Relative) -> f64 {
    let sigma = |t: &Relative| t.sim().scale * t.translation_variance().sqrt();
    (sigma(a) - sigma(b)).abs()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Covariance, PoseWithCovariance, Se3, Sim3, SimWithCovariance, So3};
    use nalgebra::Vector3;

    fn pose() -> Se3 {
        Se3::new(So3::identity(), Vector3::new(1.0, 2.0, 3.0))
    }

    fn metric(sigma: f64) -> Relative {
        let covariance = Covariance::from_sigmas([sigma; 6]).unwrap();
        Relative::Metric(PoseWithCovariance { pose: pose(), covariance })
    }

    /// A loop is looked for where the odometry may be wrong, not only where it says that one is.
    #[test]
    fn what_has_drifted_is_nearer_than_it_seems_or_anywhere() {
        let at = |x: f64, sigma: f64| {
            let covariance = Covariance::from_sigmas([sigma, sigma, sigma, 0.01, 0.01, 0.01]).unwrap();
            let pose = Se3::new(So3::identity(), Vector3::new(x, 0.0, 0.0));
            Relative::Metric(PoseWithCovariance { pose, covariance })
        };
        let of = |x: f64, drift: f64| apart((&at(0.0, 0.1), 3.0), (&at(x, 0.1 + drift / 3.0f64.sqrt()), 2.0));
        let is = |found: Option<f64>, expected: f64| found.is_some_and(|found| (found - expected).abs() < 1e-9);
        assert!(is(of(4.0, 0.0), 0.8) && is(of(10.0, 0.0), 2.0) && is(of(0.0, 0.0), 0.0));
        assert!(is(of(4.0, 0.5), 0.6) && is(of(10.0, 2.4), 1.04) && is(of(4.0, 2.4), 0.0));
        // Twice 2.6 m is more than the 5 m that both reach.
        assert_eq!((of(10.0, 2.6), of(0.0, 2.6), of(1000.0, 300.0)), (None, None, None));
    }

    #[test]
    fn the_farther_apart_two_submaps_are_the_fewer_tries_they_take_from_nearer_ones() {
        assert_eq!((told(Some(0.0)), told(None), told(Some(TOLD_HALF))), (1.0, 1.0, 0.5));
        let tries: Vec<usize> = (0..10).map(|k| part(TRIES_PER_SUBMAP_FREE, told(Some(0.1 * f64::from(k))))).collect();
        assert!(tries.is_sorted_by(|a, b| a >= b), "{tries:?}");
        assert_eq!((tries[0], tries[4], tries[9]), (TRIES_PER_SUBMAP_FREE, 2, 1), "never none");
    }

    /// A frame whose unit is half of ours: what it takes for a metre is half of one.
    #[test]
    fn drift_is_told_in_the_unit_of_the_frame_that_both_are_given_in() {
        let small = {
            let covariance = Covariance::from_sigmas([0.4; 7]).unwrap();
            let sim = Sim3::new(pose().rotation, pose().translation, 0.5);
            Relative::Similarity(SimWithCovariance { sim, covariance })
        };
        let off = |a: &Relative, b: &Relative, sigma: f64| (drift_between(a, b) - 3.0f64.sqrt() * sigma).abs();
        assert!(off(&metric(0.5), &metric(0.2), 0.3) < 1e-12);
        assert!(off(&metric(0.2), &metric(0.5), 0.3) < 1e-12);
        assert!(off(&metric(0.5), &small, 0.3) < 1e-12, "{}", drift_between(&metric(0.5), &small));
    }
}
