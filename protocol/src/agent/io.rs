//! What goes into an agent and what comes out: the whole contract between the core and its shells.

use super::job::{Job, JobResult};
use crate::ids::{EntryId, FrameId, Hash, Name, RobotId, SubmapId};
use crate::kinds::PairStatus;
use crate::submap::stated::Oddity;
use crate::submap::{Keyframe, Loss};
use crate::time::Stamp;
use serde::{Deserialize, Serialize};

/// The three broadcast channels (DESIGN §5).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Channel {
    /// Live pose beacons: best effort, latest wins.
    Pose,
    /// New entries, once.
    Facts,
    /// Root hashes.
    Have,
}

/// The questions one robot asks another.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum QueryKind {
    /// "Here is my have-vector; what am I missing?"
    Sync,
    /// "Give me the blob with this hash."
    Blob,
    /// "I think these two submaps overlap; please look."
    Align,
    /// "Are you there now?"
    Life,
}

/// A question of ours, chosen by the core; unique within one run of an agent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct QueryId(pub u64);

/// A question of a peer's, chosen by the shell; the core hands it back with the answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct AskToken(pub u64);

/// A piece of heavy work; unique within one run of an agent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct JobId(pub u64);

/// Everything that can happen to an agent.
#[expect(clippy::large_enum_variant, reason = "one input is handed over at a time, and none is kept")]
#[derive(Clone, Debug)]
pub enum Input {
    /// The robot's own SLAM finished a keyframe.
    Keyframe(Keyframe),
    /// Keyframes that the SLAM sent came to nothing in the shell, between the last [`Input::Keyframe`] and the next:
    /// the motion to that one crosses a gap.
    KeyframesLost {
        /// By what.
        why: Loss,
        /// How many.
        count: u64,
    },
    /// The robot's own sensors measured another robot directly.
    Sighting(Sighting),
    /// Another robot was seen, but not how it is turned.
    Position(PositionSighting),
    /// A broadcast arrived. `from` is the robot the key names (a hint for statistics, not proof).
    Received {
        /// Whose key it came on.
        from: RobotId,
        /// On which channel.
        channel: Channel,
        /// The framed message.
        bytes: Vec<u8>,
    },
    /// A peer asks. Every `Asked` is answered by exactly one [`Output::Answer`].
    Asked {
        /// To be handed back.
        token: AskToken,
        /// What kind of question.
        kind: QueryKind,
        /// The framed message.
        bytes: Vec<u8>,
    },
    /// Our question was answered, or will have no more answers (`None`): exactly once, at the end, whether or not there
    /// were any. Where anyone may answer in another's name there may be several; the core takes what proves itself.
    Answered {
        /// Which question.
        query: QueryId,
        /// A framed answer.
        bytes: Option<Vec<u8>>,
    },
    /// A peer appeared or vanished (liveliness).
    Neighbour {
        /// Which robot.
        robot: RobotId,
        /// Whether it is reachable now.
        up: bool,
    },
    /// All [`Output::Persist`] batches up to and including this number are durable.
    Persisted {
        /// The batch number.
        up_to: u64,
    },
    /// The store cannot write (disk full, I/O error) and goes on trying: until the next [`Input::Persisted`] the agent
    /// begins nothing that would have to be written, and says so.
    PersistFailed {
        /// The first batch that is not durable.
        batch: u64,
        /// What the store said.
        reason: String,
    },
    /// A job finished.
    JobDone {
        /// Which.
        job: JobId,
        /// With what.
        result: JobResult,
    },
    /// The moment that `poll_timeout` named has come (harmless at any other time).
    Timeout,
    /// The operator or the shell wants something.
    Command(Command),
}

/// A direct relative measurement of another robot's body.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sighting {
    /// When.
    pub stamp: Stamp,
    /// Who was seen.
    pub robot: Name,
    /// `t_body_other`: translation `[x, y, z]` m, quaternion `[x, y, z, w]`.
    pub t_body_other: [f64; 7],
    /// Row-major upper triangle of the 6×6 covariance of the local perturbation (ρ, φ).
    pub covariance: [f64; 21],
}

/// A direct measurement of where another robot's body is: a range and a bearing. How it is turned was not seen.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PositionSighting {
    /// When.
    pub stamp: Stamp,
    /// Who was seen.
    pub robot: Name,
    /// `p_body_other`: its body's origin in ours, m.
    pub position: [f64; 3],
    /// Row-major upper triangle of the 3×3 covariance along our body's axes, m².
    pub covariance: [f64; 6],
}

/// What an operator or a shell can ask for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Command {
    /// The recording ended or the robot parks: close the open submap now.
    Flush,
    /// The robot's SLAM restarted in a new local frame: begin a new epoch.
    NewEpoch,
}

/// Everything an agent can want.
#[derive(Clone, Debug)]
pub enum Output {
    /// Make these records durable, then say [`Input::Persisted`]. Batches are numbered from 1 without holes.
    Persist {
        /// Number of this batch.
        batch: u64,
        /// What to store.
        records: Vec<Record>,
    },
    /// Broadcast.
    Publish {
        /// On which channel.
        channel: Channel,
        /// The framed message.
        bytes: Vec<u8>,
    },
    /// Ask one peer, and whoever else answers for it; end with an [`Input::Answered`] without bytes in any case.
    Ask {
        /// To be handed back.
        query: QueryId,
        /// Whom.
        peer: RobotId,
        /// What kind of question.
        kind: QueryKind,
        /// The framed message.
        bytes: Vec<u8>,
    },
    /// Answer a peer's question.
    Answer {
        /// Which.
        token: AskToken,
        /// The framed message.
        bytes: Vec<u8>,
    },
    /// Run heavy work ([`Job::run`]) off the core's thread; answer with [`Input::JobDone`].
    Run {
        /// To be handed back.
        id: JobId,
        /// The work: a pure function of its data.
        job: Job,
    },
    /// Something people may want to know.
    Event(Event),
}

/// A durable record. Writing the same record twice is harmless.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Record {
    /// A signed log entry.
    Entry {
        /// Its place.
        id: EntryId,
        /// Its canonical bytes.
        bytes: Vec<u8>,
    },
    /// A content-addressed keypoint blob.
    Blob {
        /// Its address.
        hash: Hash,
        /// Its bytes.
        bytes: Vec<u8>,
    },
    /// Something of this robot's own that is never sent (all features and the thinned cloud of one own submap).
    Private {
        /// Which submap.
        submap: SubmapId,
        /// Encoded features and cloud.
        bytes: Vec<u8>,
    },
    /// Proof that a log has two histories: two entries that contradict each other. Without it a restart would take the
    /// log out of quarantine.
    Fork {
        /// The log.
        frame: FrameId,
        /// The canonical bytes of the two entries.
        proof: [Vec<u8>; 2],
    },
    /// This robot's own epochs up to this one must not be continued, in no later run: a new one was begun, or entries
    /// that others may hold were lost. The largest counts.
    EpochClosed {
        /// The last one closed.
        epoch: u32,
    },
    /// What our front end calls the run that made the keyframes of this epoch: after a restart, one of another run is
    /// of another frame. One is kept, of the largest epoch.
    Session {
        /// Our epoch.
        epoch: u32,
        /// Its run.
        session: u64,
        /// The last ones that are over, at most [`SESSIONS_OVER_MAX`](crate::submap::runs::SESSIONS_OVER_MAX).
        over: Vec<u64>,
    },
    /// We tried a pair of submaps and could not align it: not to be tried again on the same evidence. Nothing waits for
    /// it to be durable, since a lost one costs no more than the try.
    Refused {
        /// Target.
        i: SubmapId,
        /// Source.
        j: SubmapId,
        /// A digest of what was looked at, and how. `None` if the refusal counts no more: to be taken off the disk.
        evidence: Option<u64>,
    },
    /// What a log's writer has replaced, to be taken off the disk in the same commit.
    Replaced {
        /// The entries of its log below this one.
        below: EntryId,
        /// Own submaps that are gone: what is private to them.
        submaps: Vec<SubmapId>,
        /// Keypoint blobs that no submap of ours names any more.
        blobs: Vec<Hash>,
    },
    /// A log that its writer gave up, or that is older than as many as are held: entries and proof are to be taken off the disk.
    Retired {
        /// The log.
        frame: FrameId,
        /// Own submaps that are gone: what is private to them.
        submaps: Vec<SubmapId>,
        /// Keypoint blobs that no submap of ours names any more.
        blobs: Vec<Hash>,
    },
}

/// Something people may want to know. Shells log it; tests assert on it.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// One of our submaps was finished and described.
    SubmapFinished {
        /// Which.
        submap: SubmapId,
        /// Keypoints offered.
        keypoints: usize,
    },
    /// We tried to align two submaps that, as far as one could tell, might overlap.
    AlignmentTried {
        /// Target.
        i: SubmapId,
        /// Source.
        j: SubmapId,
        /// How probable success seemed.
        expected: f64,
        /// Whether there was any.
        found: bool,
    },
    /// We looked with further keypoints at a pair that was refused and that the map has overlap.
    LookedAgain {
        /// Target.
        i: SubmapId,
        /// Source.
        j: SubmapId,
        /// Whether there was an alignment that agrees with the map.
        found: bool,
    },
    /// We computed an alignment and stated it.
    AlignmentProposed {
        /// Target.
        i: SubmapId,
        /// Source.
        j: SubmapId,
        /// Σ of inlier probabilities.
        support: f64,
    },
    /// Both endpoints agree on an alignment.
    AlignmentAgreed {
        /// Target.
        i: SubmapId,
        /// Source.
        j: SubmapId,
    },
    /// The two endpoints do not agree.
    AlignmentDisputed {
        /// Target.
        i: SubmapId,
        /// Source.
        j: SubmapId,
    },
    /// A frame joined ours.
    Merged {
        /// The frame.
        frame: FrameId,
    },
    /// A frame left ours: its alignments no longer hold.
    Unmerged {
        /// The frame.
        frame: FrameId,
    },
    /// Two merged frames lie elsewhere than was claimed, by more than the claim allowed in 99.9 of 100 cases.
    PairMoved {
        /// The first, `name/epoch`.
        a: String,
        /// The second.
        b: String,
        /// How far their origins moved, m (units of the first frame).
        by: f64,
    },
    /// Two frames that were merged no longer are.
    PairUnmerged {
        /// The first, `name/epoch`.
        a: String,
        /// The second.
        b: String,
        /// What they are now; `None` if nothing between them counts any more.
        status: Option<PairStatus>,
    },
    /// Merged pairs of frames contradict one another around a loop. Told once for each set of robots.
    PairsContradict {
        /// Names of the robots of which at least one is wrong.
        robots: Vec<String>,
        /// Nothing else explains it as well: all of these are wrong.
        certain: bool,
    },
    /// Alignments of a robot with several others, who agree among themselves, contradict one another: its odometry is
    /// wrong, or far less certain than it says. Told once, until it fits again.
    RobotDoesNotFit {
        /// Its name.
        robot: String,
        /// How many others.
        others: usize,
    },
    /// Bad input was refused. Rate-limited: `suppressed` counts the like since the last report.
    Rejected {
        /// From whom, as far as known.
        peer: Option<RobotId>,
        /// The peer's name in the roster, else its id in hexadecimal; `unknown` where nobody is known.
        name: String,
        /// What was wrong.
        reason: String,
        /// Refusals of the same peer not reported one by one.
        suppressed: u64,
    },
    /// Nothing of our own can be written: storage failed, and until it works again the agent hears, solves and serves
    /// what is durable, and no more; or we began more epochs than others take, and only a new key helps.
    ReceiveOnly {
        /// Why.
        reason: String,
    },
    /// Storage works again; nothing was lost.
    StoreHealed,
    /// Our log was replaced by what still counts of it.
    Condensed {
        /// Which.
        frame: FrameId,
        /// Entries that hold it now.
        parts: usize,
        /// Submaps that are gone: nothing was tied to them.
        submaps_gone: usize,
        /// Bytes of the entries before and after.
        bytes: [usize; 2],
    },
    /// Our odometry has a gap: keyframes were lost, and the motion across it counts as known to `gap_sigma_per_m` only.
    /// Told once for each cause; `view/status` counts them all.
    OdometryGap {
        /// Our frame.
        frame: FrameId,
        /// What lost them.
        why: Loss,
    },
    /// What our front end sends is odd. Each kind is told once in an epoch.
    InputOdd {
        /// Our frame.
        frame: FrameId,
        /// In what way.
        oddity: Oddity,
    },
    /// A robot's oldest epochs made room for a new one. Their maps are gone.
    EpochsRetired {
        /// The robot's name.
        robot: String,
        /// Its first epoch that stays.
        first: u32,
        /// How many logs went here.
        count: usize,
    },
    /// A new epoch, hence a new frame, began.
    EpochBegan {
        /// Its frame.
        frame: FrameId,
        /// Why.
        reason: EpochReason,
    },
    /// The views within our submaps do not fit together where our SLAM put them, the median over several submaps: its
    /// intrinsics, unit, extrinsics or odometry are wrong. Told once a frame.
    ViewsDisagree {
        /// Our frame.
        frame: FrameId,
        /// How far points of one view lie off the surfaces of another, voxels.
        misfit_voxels: f64,
    },
}

/// Why a new epoch begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum EpochReason {
    /// The operator or the shell said so.
    Told,
    /// Keyframes are of another session of the front end.
    Session,
    /// Keyframes go on from another place: the front end restarted or relocalised.
    Jumped,
    /// The stamps of keyframes went back, and stay there.
    ClockBack,
    /// The log must not be written on: it is damaged, or others hold more of it than we do, or has two histories.
    Log,
}

impl EpochReason {
    /// For people.
    pub fn text(self) -> &'static str {
        match self {
            Self::Told => "it was told to",
            Self::Session => "the front end's session is another one",
            Self::Jumped => "the front end's poses jumped and go on elsewhere",
            Self::ClockBack => "the clock of the keyframes went back",
            Self::Log => "the log before is damaged, or others hold more of it",
        }
    }
}
