//! The robot's own side: keyframes in, submaps cut, described one at a time, and stated as facts in order.

use super::Agent;
use super::io::{Event, JobId, Record, Sighting};
use super::job::{DescribeJob, Job};
use super::ledger::BATCHES_WAITING_MAX;
use crate::config::SubmapConfig;
use crate::geometry::{Covariance, PoseWithCovariance, Se3, So3};
use crate::ids::{Hash, SubmapId};
use crate::submap::{Described, Features, Keyframe, KeyframeError, Keypoints, Submap, SubmapBuilder};
use crate::time::{Instant, Stamp};
use crate::wire::fact::{Fact, SightingFact, SubmapFact};
use core::time::Duration;
use nalgebra::{Matrix6, Vector3};
use std::collections::VecDeque;
use std::sync::Arc;

/// Finished submaps waiting to be described. Beyond it keyframes are refused: the computer is too slow for its sensor.
pub const DESCRIBE_QUEUE_MAX: usize = 64;

/// A clock that went back and stays there is one whose stamps are refused, and rise, for so many keyframes in a row and
/// for so long. Keyframes that are only late come all at once, or between others.
pub const CLOCK_BACK_KEYFRAMES: u32 = 8;
const CLOCK_BACK: Duration = Duration::from_secs(10);

/// Keyframes on their way to becoming submaps.
pub(super) struct Mapper {
    builder: SubmapBuilder,
    behind: Option<Behind>,
    queue: VecDeque<(SubmapId, Submap)>,
    describing: Option<(JobId, SubmapId)>,
    pub(super) keyframes: u64,
}

/// Keyframes in a row that were refused because their stamps, which rise, are behind the last one taken.
#[derive(Clone, Copy, Debug)]
struct Behind {
    since: Instant,
    last: Stamp,
    count: u32,
}

impl Mapper {
    pub(super) fn new(config: &SubmapConfig) -> Self {
        let builder = SubmapBuilder::new(config.clone());
        Self { builder, behind: None, queue: VecDeque::new(), describing: None, keyframes: 0 }
    }

    /// A new frame: what follows has nothing to do with what came before.
    pub(super) fn restart(&mut self, config: &SubmapConfig) {
        self.builder = SubmapBuilder::new(config.clone());
        self.behind = None;
    }

    /// A keyframe with this stamp was refused as one behind. Whether the clock has gone back for good.
    fn is_clock_back(&mut self, now: Instant, stamp: Stamp) -> bool {
        let behind = match self.behind {
            Some(behind) if stamp > behind.last => Behind { last: stamp, count: behind.count + 1, ..behind },
            _ => Behind { since: now, last: stamp, count: 1 },
        };
        self.behind = Some(behind);
        behind.count >= CLOCK_BACK_KEYFRAMES && now.since(behind.since) >= CLOCK_BACK
    }

    /// Submaps not yet described.
    pub(super) fn pending(&self) -> usize {
        self.queue.len() + usize::from(self.describing.is_some())
    }

    /// The last finished submap and the body's pose in its anchor.
    pub(super) fn body(&self) -> Option<(u32, PoseWithCovariance, Stamp)> {
        self.builder.body_since_anchor()
    }
}

impl Agent {
    pub(super) fn on_keyframe(&mut self, keyframe: Keyframe) {
        if let Some(error) = self.epoch_limit() {
            return self.reject(Some(self.me.robot), "keyframe: receive-only", &error.to_string());
        }
        if self.mapper.queue.len() >= DESCRIBE_QUEUE_MAX {
            let detail = format!("{DESCRIBE_QUEUE_MAX} submaps wait to be described; raise submap.distance_m");
            self.reject(Some(self.me.robot), "keyframe: overload", &detail);
            return;
        }
        let stamp = keyframe.stamp;
        match self.mapper.builder.push(keyframe) {
            Ok(closed) => {
                self.mapper.behind = None;
                self.mapper.keyframes += 1;
                self.enqueue(closed);
            }
            Err(error) => {
                self.reject(Some(self.me.robot), "keyframe", &error.to_string());
                let is_behind = matches!(error, KeyframeError::StampNotRising { .. });
                if is_behind && self.mapper.is_clock_back(self.now, stamp) {
                    self.begin_epoch(self.me.frame.epoch.saturating_add(1));
                }
            }
        }
    }

    pub(super) fn close_submap(&mut self) {
        let closed = self.mapper.builder.flush();
        self.enqueue(closed);
    }

    fn enqueue(&mut self, closed: Option<Submap>) {
        if let Some(submap) = closed {
            let id = SubmapId { frame: self.me.frame, index: submap.index };
            self.mapper.queue.push_back((id, submap));
        }
    }

    /// One submap is described at a time, so that facts are written in order.
    pub(super) fn start_describing(&mut self) {
        // Beyond the epoch limit no keyframe is taken: what waits here is of epochs that can still be written.
        if self.mapper.describing.is_some() || self.ledger.fails {
            return;
        }
        if let Some((id, submap)) = self.mapper.queue.pop_front() {
            let config = self.config.submap.clone();
            let job = self.run_job(Job::Describe(Box::new(DescribeJob { submap, config })));
            self.mapper.describing = Some((job, id));
        }
    }

    pub(super) fn on_described(&mut self, job: JobId, (submap, described): (Submap, Described)) {
        let Some((_, id)) = self.mapper.describing.take_if(|(running, _)| *running == job) else { return };
        let blob = described.keypoints.encode();
        let hash = Hash::of(&blob);
        // The epoch may have ended meanwhile: the submap still belongs to the frame it was driven in.
        let fact = Fact::Submap(SubmapFact {
            index: submap.index,
            stamps: submap.stamps,
            odometry: submap.odometry,
            extent: described.extent,
            summary: described.summary.encode(),
            keypoint_count: u16::try_from(described.keypoints.len()).unwrap_or(u16::MAX),
            blob: hash,
            scale: self.config.submap.scale,
        });
        if !self.write(id.frame.epoch, &fact) {
            return;
        }
        self.ledger.open.push(Record::Private { submap: id, bytes: described.features.encode() });
        self.keep_keypoints(hash, &blob);
        self.ledger.open.push(Record::Blob { hash, bytes: blob });
        self.event(Event::SubmapFinished { submap: id, keypoints: described.keypoints.len() });
        self.negotiation.add_features(id, Arc::new(described.features));
    }

    /// After a restart: the trajectory goes on from the last submap that is durable.
    pub(super) fn resume_mapping(&mut self) {
        let mut t_frame_anchor = None;
        let mut next_index = 0;
        let chain = self.knowledge.chains().remove(&self.me.frame).unwrap_or_default();
        for index in chain {
            let Some(known) = self.knowledge.submap(SubmapId { frame: self.me.frame, index }) else { break };
            next_index = index + 1;
            t_frame_anchor = Some(t_frame_anchor.unwrap_or_else(Se3::identity) * known.t_prev_this);
        }
        self.mapper.builder = SubmapBuilder::resume(self.config.submap.clone(), next_index, t_frame_anchor);
    }

    pub(super) fn restore_features(&mut self, submap: SubmapId, bytes: &[u8]) {
        match Features::decode(bytes) {
            Ok(features) => self.negotiation.add_features(submap, Arc::new(features)),
            Err(error) => self.reject(Some(self.me.robot), "store: features", &format!("{submap}: {error}")),
        }
    }

    /// Keeps a keypoint blob, for whoever asks, and its decoded form.
    pub(super) fn keep_blob(&mut self, bytes: Vec<u8>) {
        let hash = Hash::of(&bytes);
        if self.keep_keypoints(hash, &bytes) {
            self.gossip.add_blob(hash, bytes, || self.knowledge.blobs_of(self.me.robot));
        }
    }

    /// Keeps what a keypoint blob says. False if it says nothing.
    fn keep_keypoints(&mut self, hash: Hash, blob: &[u8]) -> bool {
        match Keypoints::decode(blob) {
            Ok(keypoints) => {
                self.negotiation.out_of_reach.remove(&hash);
                self.negotiation.add_keypoints(hash, Arc::new(keypoints));
                true
            }
            Err(error) => {
                self.reject(None, "blob", &error.to_string());
                false
            }
        }
    }

    /// A direct measurement of another robot, carried from the two bodies to the anchors they are known by.
    pub(super) fn on_sighting(&mut self, sighting: &Sighting) {
        if self.is_receive_only() {
            return self.reject(Some(self.me.robot), "sighting: receive-only", "it cannot be kept now");
        }
        if self.is_overloaded() {
            let detail = format!("{BATCHES_WAITING_MAX} batches wait for the disk; the store is too slow");
            return self.reject(Some(self.me.robot), "sighting: overload", &detail);
        }
        match self.sighting_fact(sighting) {
            Ok(fact) => _ = self.write(self.me.frame.epoch, &Fact::Sighting(fact)),
            Err(detail) => self.reject(Some(self.me.robot), "sighting", detail),
        }
    }

    fn sighting_fact(&self, sighting: &Sighting) -> Result<SightingFact, &'static str> {
        let t_body_other = parse_sighting(sighting)?;
        let seen = self.replica.members().find(|(_, name)| **name == sighting.robot).map(|(id, _)| id);
        let seen = seen.filter(|id| *id != self.me.robot).ok_or("names no other robot of the roster")?;
        let (index, t_i_body, _) = self.mapper.body().ok_or("came before the first submap was finished")?;
        let beacon = self
            .gossip
            .beacon(seen)
            .map(|seen| &seen.content)
            .ok_or("names a robot of which no pose beacon was heard yet")?;
        let t_i_j = t_i_body.compose(&t_body_other).compose(&beacon.t_anchor_body.inverse());
        let i = SubmapId { frame: self.me.frame, index };
        Ok(SightingFact { stamp: sighting.stamp, i, j: beacon.anchor, t_i_j })
    }
}

fn parse_sighting(sighting: &Sighting) -> Result<PoseWithCovariance, &'static str> {
    let [x, y, z, qx, qy, qz, qw] = sighting.t_body_other;
    let translation = Vector3::new(x, y, z);
    if translation.iter().any(|v| !v.is_finite()) {
        return Err("has a translation that is not finite");
    }
    let rotation = So3::from_xyzw([qx, qy, qz, qw]).ok_or("has a quaternion of zero length or not finite")?;
    let mut p = Matrix6::zeros();
    let mut upper = sighting.covariance.iter();
    for r in 0..6 {
        for c in r..6 {
            let v = upper.next().copied().unwrap_or(f64::NAN);
            (p[(r, c)], p[(c, r)]) = (v, v);
        }
    }
    let covariance = Covariance::new(p).map_err(|_| "has a covariance that is not positive definite")?;
    Ok(PoseWithCovariance { pose: Se3::new(rotation, translation), covariance })
}
