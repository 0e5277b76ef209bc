//! The robot's own side: keyframes in, submaps cut, described one at a time, and stated as facts in order.

use super::Agent;
use super::io::{EpochReason, Event, JobId, Record};
use super::job::{DescribeJob, Job};
use super::sighting::Twist;
use crate::config::SubmapConfig;
use crate::geometry::{PoseWithCovariance, Se3};
use crate::ids::{Hash, SubmapId};
use crate::submap::continuity::FrameSign;
use crate::submap::runs::Runs;
use crate::submap::{Described, Features, Keyframe, KeyframeError, Keypoints, Submap, SubmapBuilder};
use crate::time::{Instant, Stamp};
use crate::wire::fact::{Fact, SubmapFact};
use core::num::NonZero;
use core::time::Duration;
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
    last: Option<(Se3, Stamp)>,
    twist: Option<Twist>,
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
        Self { builder, behind: None, last: None, twist: None, queue: VecDeque::new(), describing: None, keyframes: 0 }
    }

    /// A new frame: what follows has nothing to do with what came before.
    pub(super) fn restart(&mut self, session_is_over: bool) {
        self.builder = self.builder.begun_anew(session_is_over);
        self.behind = None;
        (self.last, self.twist) = (None, None);
    }

    fn taken(&mut self, pose: &Se3, stamp: Stamp) {
        let last = self.last.replace((*pose, stamp));
        self.twist = last.and_then(|(last, at)| Twist::between(&last, pose, stamp.secs_since(at)));
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

    /// How the body moved between its last two keyframes.
    pub(super) fn twist(&self) -> Option<Twist> {
        self.twist
    }

    /// The last finished submap and the body's pose in its anchor.
    pub(super) fn body(&self) -> Option<(u32, PoseWithCovariance, Stamp)> {
        self.builder.body_since_anchor()
    }
}

impl Agent {
    pub(super) fn on_keyframe(&mut self, keyframe: Keyframe) {
        if let Some(error) = self.epoch_limit() {
            return self.context.reject(Some(self.context.robot()), "keyframe: receive-only", &error.to_string());
        }
        if self.mapper.queue.len() >= DESCRIBE_QUEUE_MAX {
            let detail = format!("{DESCRIBE_QUEUE_MAX} submaps wait to be described; raise submap.distance_m");
            self.mapper.builder.pass(&keyframe);
            self.context.reject(Some(self.context.robot()), "keyframe: overload", &detail);
            return;
        }
        if let Some(sign) = self.mapper.builder.another_frame(&keyframe) {
            let reason = match sign {
                FrameSign::Session => EpochReason::Session,
                FrameSign::Jump => EpochReason::Jumped,
            };
            self.begin_epoch(self.context.frame().epoch.saturating_add(1), reason);
            if let Some(error) = self.epoch_limit() {
                return self.context.reject(Some(self.context.robot()), "keyframe: receive-only", &error.to_string());
            }
        }
        let (stamp, pose) = (keyframe.stamp, keyframe.pose.pose);
        let session = self.mapper.builder.runs().now();
        match self.mapper.builder.push(keyframe) {
            Ok(closed) => {
                self.mapper.behind = None;
                self.mapper.taken(&pose, stamp);
                self.mapper.keyframes += 1;
                self.keep_session(session);
                self.enqueue(closed);
            }
            Err(error) => {
                self.context.reject(Some(self.context.robot()), "keyframe", &error.to_string());
                let is_behind = matches!(error, KeyframeError::StampNotRising { .. });
                if is_behind && self.mapper.is_clock_back(self.context.now(), stamp) {
                    self.begin_epoch(self.context.frame().epoch.saturating_add(1), EpochReason::ClockBack);
                }
            }
        }
    }

    /// Once it is known what the front end calls its run, that is kept for the next start: together with the first
    /// submap of the epoch, or before.
    fn keep_session(&mut self, before: Option<u64>) {
        let runs = self.mapper.builder.runs();
        if let Some(session) = runs.now().filter(|now| Some(*now) != before) {
            let over = runs.over().collect();
            self.context.keep(Record::Session { epoch: self.context.frame().epoch, session, over });
        }
    }

    pub(super) fn close_submap(&mut self) {
        let closed = self.mapper.builder.flush();
        self.enqueue(closed);
    }

    fn enqueue(&mut self, closed: Option<Submap>) {
        if let Some(misfit_voxels) = self.mapper.builder.take_misfit() {
            self.context.event(Event::ViewsDisagree { frame: self.context.frame(), misfit_voxels });
        }
        if let Some(submap) = closed {
            let id = SubmapId { frame: self.context.frame(), index: submap.index };
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
            let config = self.context.config().submap.clone();
            let job = self.context.run_job(Job::Describe(Box::new(DescribeJob { submap, config })));
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
            scale: self.context.config().submap.scale,
            keyframes: u16::try_from(submap.keyframes.len()).ok().and_then(NonZero::new),
        });
        if !self.write(id.frame.epoch, &fact) {
            return;
        }
        self.context.keep(Record::Private { submap: id, bytes: described.features.encode() });
        self.keep_keypoints(hash, &blob);
        self.context.keep(Record::Blob { hash, bytes: blob });
        if let Some(bytes) = described.further.map(|further| further.encode()) {
            self.context.keep(Record::Blob { hash: Hash::of(&bytes), bytes });
        }
        self.context.event(Event::SubmapFinished { submap: id, keypoints: described.keypoints.len() });
        self.negotiation.add_features(id, Arc::new(described.features));
    }

    /// After a restart: the trajectory goes on from the last submap that is durable, if the front end's run does.
    pub(super) fn resume_mapping(&mut self, runs: Runs) {
        let mut t_frame_anchor = None;
        let mut next_index = 0;
        let chain = self.knowledge.chains().remove(&self.context.frame()).unwrap_or_default();
        for index in chain {
            let Some(known) = self.knowledge.submap(SubmapId { frame: self.context.frame(), index }) else { break };
            next_index = index + 1;
            t_frame_anchor = Some(t_frame_anchor.unwrap_or_else(Se3::identity) * known.t_prev_this);
        }
        self.mapper.builder =
            SubmapBuilder::resume(self.context.config().submap.clone(), next_index, t_frame_anchor, runs);
    }

    pub(super) fn restore_features(&mut self, submap: SubmapId, bytes: &[u8]) {
        match Features::decode(bytes) {
            Ok(features) => self.negotiation.add_features(submap, Arc::new(features)),
            Err(error) => {
                self.context.reject(Some(self.context.robot()), "store: features", &format!("{submap}: {error}"))
            }
        }
    }

    /// Keeps a keypoint blob, for whoever asks, and its decoded form.
    pub(super) fn keep_blob(&mut self, bytes: Vec<u8>) {
        let hash = Hash::of(&bytes);
        if self.keep_keypoints(hash, &bytes) {
            let ours = self.gossip.is_full().then(|| self.own_blobs());
            self.gossip.add_blob(hash, bytes, ours);
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
                self.context.reject(None, "blob", &error.to_string());
                false
            }
        }
    }
}
