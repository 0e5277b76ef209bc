//! At summary level, what takes the place of heavy work: submaps are described for real (they have few points), but an
//! alignment is the truth with noise, if the two lie within reach, and the joint estimate may be left out.

use crate::dice::Dice;
use crate::scenario::SummaryOptions;
use merganser_protocol::agent::job::{AlignJob, Job, JobResult, Measured, SolveJob};
use merganser_protocol::estimate::joint::MapProblem;
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Relative, Se3};
use merganser_protocol::ids::Hash;
use merganser_protocol::submap::Submap;
use merganser_protocol::wire::fact::RefusalReason;
use nalgebra::Vector6;
use std::collections::BTreeMap;

/// Where described submaps truly lie, by what was described.
#[derive(Debug)]
pub struct StandIn {
    options: SummaryOptions,
    seed: u64,
    /// `t_world_anchor` by the hash of features and of keypoints.
    anchors: BTreeMap<Hash, Se3>,
}

impl StandIn {
    /// Knows nothing yet.
    pub fn new(options: SummaryOptions, seed: u64) -> Self {
        Self { options, seed, anchors: BTreeMap::new() }
    }

    /// Does a job of the robot called `name`. `locate` says where the keyframe truly was that a submap's anchor names.
    /// Returns whether it lied.
    pub fn run(&mut self, name: &str, job: Job, locate: impl FnOnce(&Submap) -> Option<Se3>) -> (JobResult, bool) {
        match job {
            Job::Describe(job) => {
                let t_world_anchor = locate(&job.submap);
                let result = Job::Describe(job).run();
                if let (JobResult::Described(described), Some(t_world_anchor)) = (&result, t_world_anchor) {
                    self.anchors.insert(Hash::of(&described.1.features.encode()), t_world_anchor);
                    self.anchors.insert(Hash::of(&described.1.keypoints.encode()), t_world_anchor);
                }
                (result, false)
            }
            Job::Align(job) => {
                let lies = self.options.liars.iter().any(|liar| liar == name);
                (JobResult::Aligned(self.align(name, lies, &job).map(Box::new)), lies)
            }
            Job::Solve(job) if !self.options.solve => {
                let nothing = SolveJob { problem: MapProblem::default(), ..*job };
                (Job::Solve(Box::new(nothing)).run(), false)
            }
            job => (job.run(), false),
        }
    }

    fn align(&self, name: &str, lies: bool, job: &AlignJob) -> Result<Measured, RefusalReason> {
        // Nothing tells one submap without keypoints from another, here or anywhere.
        if job.theirs.is_empty() || job.mine.is_empty() {
            return Err(RefusalReason::NoConsensus);
        }
        let theirs = self.anchors.get(&Hash::of(&job.theirs.encode())).ok_or(RefusalReason::BadInput)?;
        let mine = self.anchors.get(&Hash::of(&job.mine.encode())).ok_or(RefusalReason::BadInput)?;
        let truth = mine.inverse() * *theirs;
        if truth.translation.norm() > self.options.reach_m {
            return Err(RefusalReason::NoConsensus);
        }
        let mut dice = Dice::new(self.seed, &format!("align {}", job.seed));
        let [t, r] = self.options.sigma;
        let sigmas = [t, t, t, r, r, r];
        let noise = Vector6::from(sigmas.map(|sigma| sigma * dice.normal()));
        let mut pose = truth.retract(&noise);
        if lies {
            let mut dice = Dice::new(self.seed, &format!("lie {name}"));
            let falsehood = Vector6::from([4.0, 4.0, 0.0, 0.0, 0.0, 1.5].map(|size| size * dice.range(0.5, 1.0)));
            pose = pose * Se3::exp(&falsehood);
        }
        let covariance = Covariance::from_sigmas(sigmas).map_err(|_| RefusalReason::BadInput)?;
        let t_mine_theirs = Relative::Metric(PoseWithCovariance { pose, covariance });
        Ok(Measured { t_mine_theirs, sigma: t, support: 40.0, log10_nfa: -20.0 })
    }
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
    fn described(standin: &mut StandIn, points: usize, x: f64) -> Described {
        let config = SubmapConfig::default();
        let mut builder = SubmapBuilder::new(config.clone());
        let covariance = Covariance::from_sigmas([0.01; 6]).unwrap();
        let pose = PoseWithCovariance { pose: Se3::identity(), covariance };
        let at = |k: usize| [2.0, 0.2 * (k % 20) as f32, 0.2 * (k / 20) as f32 + 0.01 * x as f32];
        let points = (0..points).map(at).collect();
        let keyframe = Keyframe { stamp: Stamp(1), pose, covariance_of: CovarianceOf::Motion, points, marks: vec![] };
        builder.push(keyframe).unwrap();
        let job = Job::Describe(Box::new(DescribeJob { submap: builder.flush().unwrap(), config }));
        let there = Se3::new(Se3::identity().rotation, [x, 0.0, 0.0].into());
        match standin.run("alpha", job, |_| Some(there)).0 {
            JobResult::Described(described) => described.1,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn submaps_without_keypoints_align_with_nothing() {
        for (points, aligned) in [(1, false), (400, true)] {
            let mut standin = StandIn::new(SummaryOptions::default(), 1);
            let [mine, theirs] = [0.0, 2.0].map(|x| described(&mut standin, points, x));
            let job = AlignJob {
                theirs: Arc::new(theirs.keypoints),
                mine: Arc::new(mine.features),
                back: None,
                config: AlignConfig::default(),
                voxel_m: 0.1,
                sensor: Sensor::Points3d,
                scale: ScaleKind::Metric,
                seed: 1,
            };
            let JobResult::Aligned(answer) = standin.run("alpha", Job::Align(Box::new(job)), |_| None).0 else {
                panic!("not aligned")
            };
            assert_eq!(answer.is_ok(), aligned, "{points} points");
        }
    }
}
