//! Epochs that are gone: the oldest, once a robot has begun more than are held, so that the sixty-fifth start of a SLAM
//! is like the second; and those that their writer gave up in the first entry of a new one, because its share of the
//! bytes was full.

use super::Replication;
use crate::agent::context::Context;
use crate::agent::io::{Event, Record};
use crate::ids::{FrameId, Hash, RobotId, SubmapId};
use crate::wire::fact::{Fact, RetiredFact};
use core::num::NonZero;
use std::collections::{BTreeMap, BTreeSet};

impl Replication {
    /// What must be said first in a new epoch of ours, for others to take it.
    pub(super) fn to_retire(&self, context: &Context, epoch: u32) -> Option<Fact> {
        let first = self.replica.to_retire(FrameId { robot: context.robot(), epoch })?;
        NonZero::new(first).map(|below| Fact::Retired(RetiredFact { below }))
    }

    /// What must be said again when our log is replaced.
    pub(super) fn retired(&self, robot: RobotId) -> Option<Fact> {
        let first = NonZero::new(self.replica.stated_first_epoch(robot)?)?;
        Some(Fact::Retired(RetiredFact { below: first }))
    }

    /// Takes logs off the disk that were given up or too many, and tells of it. Our own submaps that are gone; `None` if no log is.
    /// `private` are own submaps that the disk holds something of, beside those that are known.
    pub(in crate::agent) fn drop_retired(
        &mut self,
        context: &mut Context,
        private: &[SubmapId],
    ) -> Option<BTreeSet<SubmapId>> {
        let frames = self.replica.take_gone();
        if frames.is_empty() {
            return None;
        }
        let is_gone = |submap: &SubmapId| frames.contains(&submap.frame);
        let (gone, stay): (Vec<_>, Vec<_>) = self.knowledge.submaps().partition(|(id, _)| is_gone(id));
        let is_ours = |id: &SubmapId| id.frame.robot == context.robot();
        let ours = gone.iter().filter(|(id, _)| is_ours(id));
        let kept = self.blobs.with_further(stay.iter().map(|(_, known)| known.blob));
        let of_gone = self.blobs.with_further(ours.clone().map(|(_, known)| known.blob));
        let mut blobs: Vec<Hash> = of_gone.difference(&kept).copied().collect();
        let mut submaps: BTreeSet<SubmapId> = ours.map(|(id, _)| *id).collect();
        submaps.extend(private.iter().copied().filter(is_gone));
        let mut counts = BTreeMap::<RobotId, usize>::new();
        for frame in frames {
            *counts.entry(frame.robot).or_default() += 1;
            let of_frame = submaps.iter().copied().filter(|submap| submap.frame == frame).collect();
            let blobs = if frame.robot == context.robot() { core::mem::take(&mut blobs) } else { Vec::new() };
            context.keep(Record::Retired { frame, submaps: of_frame, blobs });
        }
        for (robot, count) in counts {
            let first = self.replica.first_epoch(robot).unwrap_or_default();
            context.event(Event::EpochsRetired { robot: context.robot_name(robot), first, count });
        }
        Some(submaps)
    }
}
