//! The robot's own side: keyframes in, submaps cut and described one at a time, so that they are stated in order; and
//! what its sensors tell of other robots. It has no timers: all that it does is called for by an input.

mod losses;
mod path;
mod sighting;

pub use crate::submap::stated::TURN_SIGMA_MAX;
pub use path::PATH_KEYFRAMES_MAX;
pub use sighting::SIGHTING_AGE_SECS_MAX;

use super::context::Context;
use super::io::{EpochReason, Event, JobId, Record};
use super::job::{DescribeJob, Job};
use super::motion::Twist;
use super::replication::knowledge::Knowledge;
use crate::config::SubmapConfig;
use crate::geometry::{PoseWithCovariance, Se3};
use crate::ids::{Hash, SubmapId};
use crate::kinds::ScaleKind;
use crate::snapshot::PathView;
use crate::submap::continuity::FrameSign;
use crate::submap::habits::Habits;
use crate::submap::runs::Runs;
use crate::submap::stated::Oddity;
use crate::submap::{Described, Keyframe, KeyframeError, Loss, Submap, SubmapBuilder};
use crate::time::{Instant, Stamp};
use crate::wire::fact::{Fact, SubmapFact};
use core::num::NonZero;
use core::time::Duration;
use losses::Losses;
use path::Path;
use sighting::Positions;
use std::collections::VecDeque;

/// Finished submaps waiting to be described. Beyond it keyframes are refused: the computer is too slow for its sensor.
pub const DESCRIBE_QUEUE_MAX: usize = 64;

/// A clock that went back and stays there is one whose stamps are refused, and rise, for so many keyframes in a row and
/// for so long. Keyframes that are only late come all at once, or between others.
pub const CLOCK_BACK_KEYFRAMES: u32 = 8;
const CLOCK_BACK: Duration = Duration::from_secs(10);

/// Keyframes on their way to becoming submaps.
pub(super) struct Mapping {
    builder: SubmapBuilder,
    behind: Option<Behind>,
    last: Option<(Se3, Stamp)>,
    twist: Option<Twist>,
    queue: VecDeque<(SubmapId, Submap)>,
    describing: Option<(JobId, SubmapId)>,
    keyframes: u64,
    losses: Losses,
    habits: Habits,
    path: Path,
    positions: Positions,
}

/// A submap that was described.
pub(super) struct Finished {
    pub(super) id: SubmapId,
    /// What is stated of it.
    pub(super) fact: Fact,
    /// Its keypoints as they are sent, and their address.
    pub(super) blob: (Hash, Vec<u8>),
    pub(super) described: Described,
}

/// What a robot states of a submap, and its keypoints as they are sent, with their address.
pub fn stated(submap: &Submap, described: &Described, scale: ScaleKind) -> (Fact, (Hash, Vec<u8>)) {
    let blob = described.keypoints.encode();
    let hash = Hash::of(&blob);
    let fact = Fact::Submap(SubmapFact {
        index: submap.index,
        stamps: submap.stamps,
        odometry: submap.odometry,
        extent: described.extent,
        summary: described.summary.encode(),
        keypoint_count: u16::try_from(described.keypoints.len()).unwrap_or(u16::MAX),
        blob: hash,
        scale,
        keyframes: u16::try_from(submap.keyframes.len()).ok().and_then(NonZero::new),
    });
    (fact, (hash, blob))
}

/// Keyframes in a row that were refused because their stamps, which rise, are behind the last one taken.
#[derive(Clone, Copy, Debug)]
struct Behind {
    since: Instant,
    last: Stamp,
    count: u32,
}

impl Mapping {
    pub(super) fn new(config: &SubmapConfig) -> Self {
        let builder = SubmapBuilder::new(config.clone());
        Self {
            builder,
            behind: None,
            last: None,
            twist: None,
            queue: VecDeque::new(),
            describing: None,
            keyframes: 0,
            losses: Losses::default(),
            habits: Habits::default(),
            path: Path::default(),
            positions: Positions::default(),
        }
    }

    /// A new frame: what follows has nothing to do with what came before.
    pub(super) fn restart(&mut self, session_is_over: bool) {
        self.builder = self.builder.begun_anew(session_is_over);
        self.behind = None;
        (self.last, self.twist) = (None, None);
        self.path = Path::default();
        self.habits = Habits::default();
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

    /// The first submap that is not described yet. Lookalikes name submaps of the log that they are stated in, and only
    /// described ones: none waits that came before.
    pub(super) fn first_undescribed(&self) -> Option<SubmapId> {
        let describing = self.describing.map(|(_, id)| id);
        describing.or_else(|| self.queue.front().map(|(id, _)| *id))
    }

    /// Keyframes taken.
    pub(super) fn keyframes(&self) -> u64 {
        self.keyframes
    }

    /// Keyframes lost, and the gaps that they left.
    pub(super) fn losses(&self) -> &Losses {
        &self.losses
    }

    /// Keyframes were lost before they came here.
    pub(super) fn lose(&mut self, why: Loss, count: u64) {
        self.builder.lose(why);
        self.losses.lose(why, count);
    }

    /// The last finished submap and the body's pose in its anchor.
    pub(super) fn body(&self) -> Option<(u32, PoseWithCovariance, Stamp)> {
        self.builder.body_since_anchor()
    }

    /// `t_odom_body` of the last keyframe of this frame, as the SLAM sent it.
    pub(super) fn t_odom_body(&self) -> Option<Se3> {
        self.last.map(|(t_odom_body, _)| t_odom_body)
    }

    /// The keyframes of the present frame.
    pub(super) fn path_view(&self, frame: String) -> PathView {
        PathView { frame, keyframes: self.path.keyframes(), forgotten: self.path.forgotten() }
    }

    /// Whether there is room for a keyframe; if not, it is refused.
    pub(super) fn has_room(&mut self, context: &mut Context, keyframe: &Keyframe) -> bool {
        let has_room = self.queue.len() < DESCRIBE_QUEUE_MAX;
        if !has_room {
            let detail = format!("{DESCRIBE_QUEUE_MAX} submaps wait to be described; raise submap.distance_m");
            self.builder.pass(keyframe);
            self.losses.lose(Loss::Overload, 1);
            context.reject(Some(context.robot()), "keyframe: overload", &detail);
        }
        has_room
    }

    /// Why a keyframe is of another frame than those before it, if it is.
    pub(super) fn another_frame(&mut self, keyframe: &Keyframe) -> Option<EpochReason> {
        self.builder.another_frame(keyframe).map(|sign| match sign {
            FrameSign::Session => EpochReason::Session,
            FrameSign::Jump => EpochReason::Jumped,
        })
    }

    /// Takes a keyframe of the present frame, or refuses it. Why a new epoch is to begin, if one is.
    pub(super) fn on_keyframe(&mut self, context: &mut Context, keyframe: Keyframe) -> Option<EpochReason> {
        let (stamp, pose) = (keyframe.stamp, keyframe.pose.pose);
        let session = self.builder.runs().now();
        let pushed = self.builder.push(keyframe);
        let paced = pushed.as_ref().ok().and_then(|_| self.habits.take(context.now(), stamp));
        for oddity in self.builder.take_oddities().into_iter().chain(paced) {
            self.tell(context, oddity);
        }
        match pushed {
            Ok(closed) => {
                self.behind = None;
                let gap = self.builder.take_gap();
                gap.into_iter().for_each(|why| self.losses.cross(context, why));
                if !self.builder.has_stood() {
                    self.path.take(stamp, pose);
                }
                self.taken(&pose, stamp);
                self.keyframes += 1;
                self.keep_session(context, session);
                self.enqueue(context, closed);
                None
            }
            Err(error) => {
                context.reject(Some(context.robot()), "keyframe", &error.to_string());
                self.builder.loss(stamp, &error).into_iter().for_each(|why| self.losses.lose(why, 1));
                let is_behind = matches!(error, KeyframeError::StampNotRising { .. });
                (is_behind && self.is_clock_back(context.now(), stamp)).then_some(EpochReason::ClockBack)
            }
        }
    }

    /// Something is odd about what the front end sends: people are told, now and in `view/status`.
    fn tell(&mut self, context: &mut Context, oddity: Oddity) {
        self.habits.keep(oddity);
        context.event(Event::InputOdd { frame: context.frame(), oddity });
    }

    /// What is odd about what the front end sends, in this epoch.
    pub(super) fn remarks(&self) -> Vec<String> {
        self.habits.found().map(ToString::to_string).collect()
    }

    /// Once it is known what the front end calls its run, that is kept for the next start: together with the first
    /// submap of the epoch, or before.
    fn keep_session(&mut self, context: &mut Context, before: Option<u64>) {
        let runs = self.builder.runs();
        if let Some(session) = runs.now().filter(|now| Some(*now) != before) {
            let over = runs.over().collect();
            context.keep(Record::Session { epoch: context.frame().epoch, session, over });
        }
    }

    /// The open submap ends here.
    pub(super) fn close_submap(&mut self, context: &mut Context) {
        let closed = self.builder.flush();
        self.enqueue(context, closed);
    }

    fn enqueue(&mut self, context: &mut Context, closed: Option<Submap>) {
        if let Some(misfit_voxels) = self.builder.take_misfit() {
            context.event(Event::ViewsDisagree { frame: context.frame(), misfit_voxels });
        }
        if let Some(submap) = closed {
            self.path.close(&submap);
            let id = SubmapId { frame: context.frame(), index: submap.index };
            self.queue.push_back((id, submap));
        }
    }

    /// One submap is described at a time, so that facts are written in order.
    pub(super) fn start_describing(&mut self, context: &mut Context) {
        // Beyond the epoch limit no keyframe is taken: what waits here is of epochs that can still be written.
        if self.describing.is_some() {
            return;
        }
        if let Some((id, submap)) = self.queue.pop_front() {
            let config = context.config().submap.clone();
            let job = context.run_job(Job::Describe(Box::new(DescribeJob { submap, config })));
            self.describing = Some((job, id));
        }
    }

    /// A submap was described: what is to be stated of it, and kept.
    pub(super) fn on_described(
        &mut self,
        context: &mut Context,
        job: JobId,
        (submap, described): (Submap, Described),
    ) -> Option<Finished> {
        let (_, id) = self.describing.take_if(|(running, _)| *running == job)?;
        if id.frame == context.frame()
            && !context.config().submap.sensor.sees_landmarks()
            && let Some(bare) = self.habits.described(described.keypoints.len())
        {
            self.tell(context, bare);
        }
        // The epoch may have ended meanwhile: the submap still belongs to the frame it was driven in.
        let (fact, blob) = stated(&submap, &described, context.config().submap.scale);
        Some(Finished { id, fact, blob, described })
    }

    /// After a restart: the trajectory goes on from the last submap that is durable, if the front end's run does.
    pub(super) fn resume(&mut self, context: &Context, knowledge: &Knowledge, runs: Runs) {
        let mut t_frame_anchor = None;
        let mut next_index = 0;
        let chain = knowledge.chains().remove(&context.frame()).unwrap_or_default();
        for index in chain {
            let Some(known) = knowledge.submap(SubmapId { frame: context.frame(), index }) else { break };
            next_index = index + 1;
            t_frame_anchor = Some(t_frame_anchor.unwrap_or_else(Se3::identity) * known.t_prev_this);
        }
        self.builder = SubmapBuilder::resume(context.config().submap.clone(), next_index, t_frame_anchor, runs);
    }
}
