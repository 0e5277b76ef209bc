//! The steps of odometry of the last problem posed, kept for the next: between two solutions a swarm learns a few
//! facts, and to read all the others from their entries again is most of what posing a problem costs.

use crate::agent::replication::knowledge::Known;
use crate::geometry::PoseWithCovariance;
use crate::ids::EntryId;
use std::collections::BTreeMap;

/// Steps kept; those beyond are read from their entries every time. 360 bytes each.
pub const STEPS_KEPT_MAX: usize = 4_096;

/// See the module.
#[derive(Default)]
pub struct Steps {
    before: BTreeMap<EntryId, Step>,
    now: BTreeMap<EntryId, Step>,
}

/// `t_prev_this` of a submap and the place of the entry that it was read from.
#[derive(Clone, Copy)]
struct Step {
    held_at: u32,
    t_prev_this: PoseWithCovariance,
}

impl Steps {
    /// For the next problem: what the last did not ask for is forgotten.
    pub fn renewed(self) -> Self {
        Self { before: self.now, now: BTreeMap::new() }
    }

    /// `t_prev_this` of a submap. `read` reads it from the entry that holds it now, if it was not read there before.
    pub fn of(
        &mut self,
        known: &Known,
        read: impl FnOnce() -> Option<PoseWithCovariance>,
    ) -> Option<PoseWithCovariance> {
        let kept = self.before.get(&known.entry).filter(|step| step.held_at == known.held_at);
        let t_prev_this = kept.map(|step| step.t_prev_this).or_else(read)?;
        if self.now.len() < STEPS_KEPT_MAX {
            self.now.insert(known.entry, Step { held_at: known.held_at, t_prev_this });
        }
        Some(t_prev_this)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Covariance, Se3, So3};
    use crate::ids::{FrameId, Hash, RobotId};
    use crate::time::Stamp;
    use crate::wire::fact::ScaleKind;
    use nalgebra::Vector3;

    fn known(seq: u32, held_at: u32) -> Known {
        Known {
            entry: EntryId { frame: FrameId { robot: RobotId([1; 8]), epoch: 1 }, seq },
            held_at,
            after: None,
            stamps: [Stamp(0); 2],
            t_prev_this: Se3::identity(),
            keyframes: None,
            extent: [1.0; 3],
            blob: Hash::default(),
            keypoints: 0,
            scale: ScaleKind::Metric,
            summary: None,
        }
    }

    fn step(x: f64) -> PoseWithCovariance {
        let covariance = Covariance::from_sigmas([0.1; 6]).unwrap();
        PoseWithCovariance { pose: Se3::new(So3::identity(), Vector3::new(x, 0.0, 0.0)), covariance }
    }

    /// Asks for steps `0..count`, held where they were written; how many were read.
    fn ask(steps: &mut Steps, count: usize) -> usize {
        let mut read = 0;
        for seq in 0..count as u32 {
            let from_entry = || {
                read += 1;
                Some(step(f64::from(seq)))
            };
            assert_eq!(steps.of(&known(seq, seq), from_entry), Some(step(f64::from(seq))));
        }
        read
    }

    #[test]
    fn a_step_is_read_once_up_to_the_limit() {
        for (count, again) in [(STEPS_KEPT_MAX, 0), (STEPS_KEPT_MAX + 3, 3)] {
            let mut steps = Steps::default();
            assert_eq!(ask(&mut steps, count), count);
            let mut steps = steps.renewed();
            assert_eq!(ask(&mut steps, count), again);
        }
    }

    #[test]
    fn a_step_that_is_carried_on_elsewhere_is_read_there() {
        let mut steps = Steps::default();
        steps.of(&known(3, 3), || Some(step(1.0)));
        let mut steps = steps.renewed();
        assert_eq!(steps.of(&known(3, 9), || Some(step(2.0))), Some(step(2.0)));
        assert_eq!(steps.of(&known(4, 4), || None), None, "an entry that does not say so");
    }

    #[test]
    fn what_a_problem_does_not_ask_for_is_forgotten() {
        let mut steps = Steps::default();
        ask(&mut steps, 2);
        let mut steps = steps.renewed().renewed();
        assert_eq!(ask(&mut steps, 2), 2);
    }
}
