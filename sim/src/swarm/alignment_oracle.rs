//! At summary level, what takes the place of heavy work: submaps are described for real (they have few points), but an
//! alignment is the truth about their clouds with noise, if they lie within reach, and the joint estimate may be left
//! out.

use crate::adversary::Adversary;
use crate::dice::Dice;
use crate::scenario::SummaryOptions;
use merganser_protocol::agent::job::{AlignJob, Job, JobResult, Measured, NotAligned, SolveJob};
use merganser_protocol::estimate::joint::MapProblem;
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Relative, Se3};
use merganser_protocol::ids::Hash;
use merganser_protocol::submap::{Described, Submap};
use merganser_protocol::wire::fact::RefusalReason;
use nalgebra::{Matrix6, Vector6};
use std::collections::BTreeMap;

/// Where described submaps truly lie, by what was described.
#[derive(Debug)]
pub struct AlignmentOracle {
    options: SummaryOptions,
    seed: u64,
    /// By the hash of features and of keypoints.
    places: BTreeMap<Hash, Place>,
    /// The last submap that an honest robot described, for mirrors.
    shown: Option<Described>,
    /// How many submaps each shifter described.
    shifted: BTreeMap<String, u32>,
}

/// Where a submap's cloud truly lies, and what all its alignments err by alike, in standard deviations of one.
#[derive(Clone, Copy, Debug)]
struct Place {
    features: Hash,
    t_world_anchor: Se3,
    bent: Vector6<f64>,
    /// Of whom, if its owner colludes.
    colludes: Option<Hash>,
}

impl AlignmentOracle {
    /// Knows nothing yet.
    pub fn new(options: SummaryOptions, seed: u64) -> Self {
        Self { options, seed, places: BTreeMap::new(), shown: None, shifted: BTreeMap::new() }
    }

    /// Does a job of the robot called `name`. `locate` says where a submap's cloud truly lies. Returns whether it lied.
    pub fn run(&mut self, name: &str, job: Job, locate: impl FnOnce(&Submap) -> Option<Se3>) -> (JobResult, bool) {
        match job {
            Job::Describe(job) => {
                let t_world_anchor = locate(&job.submap);
                let mut result = Job::Describe(job).run();
                let lied = self.describe(name, &mut result, t_world_anchor);
                (result, lied)
            }
            Job::Align(job) => {
                let lies = self.options.liars.iter().any(|liar| liar == name);
                (JobResult::Aligned(self.align(name, lies, &job).map(Box::new).map_err(NotAligned::from)), lies)
            }
            Job::Solve(job) if !self.options.solve => {
                let nothing = SolveJob { problem: MapProblem::default(), ..*job };
                (Job::Solve(Box::new(nothing)).run(), false)
            }
            job => (job.run(), false),
        }
    }

    /// Notes where a submap that was described truly lies, as far as its owner does not lie of it. Whether its owner lies.
    fn describe(&mut self, name: &str, result: &mut JobResult, t_world_anchor: Option<Se3>) -> bool {
        let adversary = self.options.adversaries.get(name).copied();
        let JobResult::Described(described) = result else { return false };
        match (adversary, &self.shown) {
            (Some(Adversary::Mirror), Some(shown)) => {
                described.1 = shown.clone();
                return true;
            }
            (None, _) => self.shown = Some(described.1.clone()),
            _ => {}
        }
        let Some(mut t_world_anchor) = t_world_anchor else { return adversary.is_some() };
        if let Some(step) = adversary.map(Adversary::shift_m).filter(|step| *step > 0.0) {
            let count = self.shifted.entry(name.to_owned()).or_default();
            *count += 1;
            t_world_anchor = t_world_anchor * Se3::exp(&(Vector6::x() * step * f64::from(*count)));
        }
        let features = Hash::of(&described.1.features.encode());
        let mut dice = Dice::new(self.seed, &format!("bent {features}"));
        let colludes = (adversary == Some(Adversary::Colluder)).then(|| Hash::of(name.as_bytes()));
        let place = Place { features, t_world_anchor, bent: Vector6::from_fn(|_, _| dice.normal()), colludes };
        self.places.insert(features, place);
        let first = &described.1.keypoints;
        let both = described.1.further.as_ref().and_then(|further| first.with_further(further));
        self.places.insert(Hash::of(&first.encode()), place);
        both.map(|both| self.places.insert(Hash::of(&both.encode()), place));
        adversary.is_some()
    }

    /// By what two that collude say that the world of the other lies beside one's own.
    fn collusion(&self, mine: &Place, theirs: &Place) -> Se3 {
        let Some((me, other)) = mine.colludes.zip(theirs.colludes).filter(|(me, other)| me != other) else {
            return Se3::identity();
        };
        let (first, second) = (me.min(other), me.max(other));
        let mut dice = Dice::new(self.seed, &format!("collusion {first} {second}"));
        let falsehood =
            Se3::exp(&Vector6::from([4.0, 4.0, 0.0, 0.0, 0.0, 1.5].map(|size| size * dice.range(0.5, 1.0))));
        if me == first { falsehood } else { falsehood.inverse() }
    }

    fn align(&self, name: &str, lies: bool, job: &AlignJob) -> Result<Measured, RefusalReason> {
        // Nothing tells one submap without keypoints from another, here or anywhere.
        if job.theirs.is_empty() || job.mine.is_empty() {
            return Err(RefusalReason::NoConsensus);
        }
        let theirs = self.places.get(&Hash::of(&job.theirs.encode())).ok_or(RefusalReason::BadInput)?;
        let mine = self.places.get(&Hash::of(&job.mine.encode())).ok_or(RefusalReason::BadInput)?;
        let truth = mine.t_world_anchor.inverse() * self.collusion(mine, theirs) * theirs.t_world_anchor;
        if truth.translation.norm() > self.options.reach_m {
            return Err(RefusalReason::NoConsensus);
        }
        // Whoever looks, and in whatever order: what both ends find is the same, or their mean would err by less than
        // it says.
        let (first, second) = (mine.features.min(theirs.features), mine.features.max(theirs.features));
        let is_first_look = job.theirs.further().is_some();
        let mut shy = Dice::new(self.seed, &format!("at first {first} {second}"));
        if is_first_look && shy.chance(self.options.refused_at_first) {
            return Err(RefusalReason::NoConsensus);
        }
        let mut dice = Dice::new(self.seed, &format!("align {first} {second}"));
        let side = if mine.features == first { 1.0 } else { -1.0 };
        let [t, r] = self.options.sigma;
        let sigmas = Vector6::from([t, t, t, r, r, r]);
        let variance = Matrix6::from_diagonal(&sigmas.component_mul(&sigmas));
        let common = self.options.common;
        // What two clouds have in common lies between them: noise that is the same from either side. What bends a cloud
        // turns about its anchor, and moves the other by the lever between them.
        let t_theirs_between = truth.inverse().interpolate(&Se3::identity(), 0.5);
        let noise =
            t_theirs_between.adjoint() * sigmas.map(|sigma| side * sigma * dice.normal() * (1.0 - 2.0 * common).sqrt());
        let bent = |place: &Place| Se3::exp(&(place.bent.component_mul(&sigmas) * common.sqrt()));
        let mut pose = bent(mine).inverse() * truth * bent(theirs) * Se3::exp(&noise);
        let seen_from = |lever: &Matrix6<f64>, share: f64| lever * variance * lever.transpose() * share;
        let covariance = seen_from(&t_theirs_between.adjoint(), 1.0 - 2.0 * common)
            + seen_from(&truth.inverse().adjoint(), common)
            + variance * common;
        let covariance = Covariance::new(covariance);
        if lies {
            let mut dice = Dice::new(self.seed, &format!("lie {name}"));
            let falsehood = Vector6::from([4.0, 4.0, 0.0, 0.0, 0.0, 1.5].map(|size| size * dice.range(0.5, 1.0)));
            pose = pose * Se3::exp(&falsehood);
        }
        let covariance = covariance.map_err(|_| RefusalReason::BadInput)?;
        let t_mine_theirs = Relative::Metric(PoseWithCovariance { pose, covariance });
        Ok(Measured { t_mine_theirs, sigma: t, support: 40.0, log10_nfa: -20.0 })
    }
}

/// Where a cloud lies whose keyframes, each alone, would put its anchor there: odometry that drifts bends it, so that
/// it is not where its anchor was. `None` without a keyframe.
pub fn middle(t_world_anchor: &[Se3]) -> Option<Se3> {
    let about = t_world_anchor.first()?;
    let sum: Vector6<f64> = t_world_anchor.iter().map(|t| about.local(t)).sum();
    Some(about.retract(&(sum / t_world_anchor.len() as f64)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use merganser_protocol::agent::job::DescribeJob;
    use merganser_protocol::config::{AlignConfig, Sensor, SubmapConfig};
    use merganser_protocol::submap::{CovarianceOf, Described, Keyframe, SubmapBuilder};
    use merganser_protocol::time::Stamp;
    use merganser_protocol::wire::fact::ScaleKind;
    use std::sync::Arc;

    /// Describes a scan of so many points on a wall, made at `x`.
    fn described(oracle: &mut AlignmentOracle, points: usize, x: f64) -> Described {
        let config = SubmapConfig { keypoints: 16, keypoints_further: 16, ..SubmapConfig::default() };
        let mut builder = SubmapBuilder::new(config.clone());
        let covariance = Covariance::from_sigmas([0.01; 6]).unwrap();
        let pose = PoseWithCovariance { pose: Se3::identity(), covariance };
        let at = |k: usize| [2.0, 0.2 * (k % 20) as f32, 0.2 * (k / 20) as f32 + 0.01 * x as f32];
        let points = (0..points).map(at).collect();
        let keyframe = Keyframe {
            stamp: Stamp(1),
            session: None,
            pose,
            covariance_of: CovarianceOf::Motion,
            points,
            marks: vec![],
            place: None,
            up: None,
        };
        builder.push(keyframe).unwrap();
        let job = Job::Describe(Box::new(DescribeJob { submap: builder.flush().unwrap(), config }));
        let there = Se3::new(Se3::identity().rotation, [x, 0.0, 0.0].into());
        match oracle.run("alpha", job, |_| Some(there)).0 {
            JobResult::Described(described) => described.1,
            other => panic!("{other:?}"),
        }
    }

    fn align(
        oracle: &mut AlignmentOracle,
        mine: &Described,
        theirs: &Described,
        seed: u64,
    ) -> Result<Box<Measured>, RefusalReason> {
        let job = AlignJob {
            theirs: Arc::new(theirs.keypoints.clone()),
            mine: Arc::new(mine.features.clone()),
            back: None,
            config: AlignConfig::default(),
            voxel_m: 0.1,
            sensor: Sensor::Points3d,
            verticals: None,
            scale: ScaleKind::Metric,
            seed,
        };
        match oracle.run("alpha", Job::Align(Box::new(job)), |_| None).0 {
            JobResult::Aligned(answer) => answer.map_err(|why| why.reason),
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn submaps_without_keypoints_align_with_nothing() {
        for (points, aligned) in [(1, false), (400, true)] {
            let mut oracle = AlignmentOracle::new(SummaryOptions::default(), 1);
            let [mine, theirs] = [0.0, 2.0].map(|x| described(&mut oracle, points, x));
            assert_eq!(align(&mut oracle, &mine, &theirs, 1).is_ok(), aligned, "{points} points");
        }
    }

    #[test]
    fn both_ends_find_the_same() {
        let mut oracle = AlignmentOracle::new(SummaryOptions { common: 0.2, ..SummaryOptions::default() }, 1);
        let [one, other] = [0.0, 2.0].map(|x| described(&mut oracle, 100, x));
        let [there, back] = [(&one, &other, 1), (&other, &one, 2)].map(|(mine, theirs, seed)| {
            let found = align(&mut oracle, mine, theirs, seed).unwrap().t_mine_theirs;
            found.metric().unwrap().pose
        });
        let truth = Se3::new(Se3::identity().rotation, [2.0, 0.0, 0.0].into());
        let (apart, off) = ((there * back).log().norm(), truth.local(&there).norm());
        assert!(off > 0.005 && apart < 0.05 * off, "{apart} apart, {off} off");
    }

    /// By both ends, and found by both with further keypoints.
    #[test]
    fn what_is_refused_at_first_is_found_at_a_second_look() {
        let options = SummaryOptions { refused_at_first: 1.0, ..SummaryOptions::default() };
        let mut oracle = AlignmentOracle::new(options, 1);
        let [one, other] = [0.0, 2.0].map(|x| described(&mut oracle, 400, x));
        assert!(matches!(align(&mut oracle, &one, &other, 1), Err(RefusalReason::NoConsensus)));
        assert!(matches!(align(&mut oracle, &other, &one, 1), Err(RefusalReason::NoConsensus)));
        let [one, other] = [one, other].map(|described| {
            let keypoints = described.keypoints.with_further(&described.further.unwrap()).unwrap();
            Described { keypoints, further: None, ..described }
        });
        assert!(align(&mut oracle, &one, &other, 1).is_ok() && align(&mut oracle, &other, &one, 1).is_ok());
    }

    #[test]
    fn a_cloud_lies_amid_its_keyframes() {
        let there = Se3::exp(&Vector6::from([1.0, 2.0, 3.0, 0.3, -0.2, 0.5]));
        let off = |k: f64| there.retract(&(Vector6::from([0.03, -0.01, 0.02, 0.004, 0.002, -0.005]) * k));
        let found = middle(&[off(-1.0), off(3.0), off(1.0), off(-3.0)]).unwrap();
        assert!(there.local(&found).norm() < 1e-6 && middle(&[]).is_none());
        assert_eq!(middle(&[there]), Some(there));
    }

    /// Alignments of one submap err alike, by the stated share, and as much as they say.
    #[test]
    fn errors_are_as_large_and_as_much_alike_as_stated() {
        for common in [0.0, 0.2, 0.5] {
            let (mut nees, mut alike) = (0.0, 0.0);
            let runs = 400;
            for seed in 0..runs {
                let options = SummaryOptions { common, ..SummaryOptions::default() };
                let mut oracle = AlignmentOracle::new(options, seed);
                let [one, two, three] = [0.0, 2.0, 4.0].map(|x| described(&mut oracle, 100, x));
                let mut whitened = |mine: &Described, x: f64, seed| {
                    let t = align(&mut oracle, mine, &two, seed).unwrap().t_mine_theirs;
                    let t = t.metric().unwrap();
                    let truth = Se3::new(Se3::identity().rotation, [x, 0.0, 0.0].into());
                    let off = truth.local(&t.pose);
                    nees += t.covariance.mahalanobis_squared(&off) / 2.0;
                    // Rotations: no lever turns these.
                    off.fixed_rows::<3>(3) / 0.005
                };
                let (a, b) = (whitened(&one, 2.0, 7), whitened(&three, -2.0, 8));
                alike += a.dot(&b) / 3.0;
            }
            let (nees, alike) = (nees / runs as f64, alike / runs as f64);
            assert!((nees - 6.0).abs() < 0.6, "{common}: NEES {nees}");
            assert!((alike - common).abs() < 0.12, "{common}: {alike}");
        }
    }
}
