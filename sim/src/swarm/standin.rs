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
