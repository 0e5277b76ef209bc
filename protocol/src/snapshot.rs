//! The debug view: what an agent believes, as plain serialisable values. Shells publish each view as JSON under
//! `…/view/{status,frames,poses,map,path,graph,stats}`, so that any subscriber in any language can read the swarm's state.
//!
//! Poses are `{translation: [x, y, z], rotation: [x, y, z, w], scale}`; covariances are the row-major upper triangle of
//! the local perturbation's covariance in the order (ρ, φ[, λ]): 21 numbers for a rigid pose, 28 for a similarity.

mod path;

pub use path::{KeyframeView, PathView, bodies};

use crate::geometry::{Covariance, PoseWithCovariance, Relative, Se3, Sim3, SimWithCovariance};
pub use crate::kinds::{Optimality, PairStatus, RefusalReason};
use nalgebra::SMatrix;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// What must be one may differ from it by this: numbers travel as text.
const UNIT_SLACK: f64 = 1e-6;

/// All views at one moment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Snapshot {
    /// Who and how.
    pub status: StatusView,
    /// Frames and the relations between them.
    pub frames: FramesView,
    /// Live robots.
    pub poses: PosesView,
    /// Submap anchors.
    pub map: MapView,
    /// This robot's keyframes.
    pub path: PathView,
    /// The factor graph.
    pub graph: GraphView,
    /// Counters.
    pub stats: StatsView,
}

/// A pose or similarity as plain numbers.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PoseView {
    /// `[x, y, z]`.
    pub translation: [f64; 3],
    /// Unit quaternion `[x, y, z, w]`, w ≥ 0.
    pub rotation: [f64; 4],
    /// 1 for rigid motions.
    pub scale: f64,
}

/// A pose with its uncertainty.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RelationView {
    /// The mean.
    pub pose: PoseView,
    /// Upper triangle of the covariance (21 or 28 numbers).
    pub covariance: Vec<f64>,
    /// Standard deviations in tangent order (6 or 7 numbers).
    pub sigmas: Vec<f64>,
}

/// `view/status`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StatusView {
    /// The swarm.
    pub swarm: String,
    /// This robot.
    pub robot: String,
    /// Its id, hexadecimal.
    pub id: String,
    /// The epoch it writes.
    pub epoch: u32,
    /// Robots that are reachable now, by name.
    pub neighbours: Vec<String>,
    /// Entries held.
    pub entries: u64,
    /// BLAKE3 digest of the set of entries, hexadecimal.
    pub digest: String,
    /// How it makes a map of its facts: version and options ([`crate::agent::estimate_version`]). Robots that differ in
    /// it hold different maps of equal facts. Empty of an older agent.
    #[serde(default)]
    pub estimate: String,
    /// Own submaps finished.
    pub submaps: u64,
    /// Keyframes taken.
    pub keyframes: u64,
    /// Keyframes lost on their way, by cause.
    #[serde(default)]
    pub keyframes_lost: BTreeMap<String, u64>,
    /// Motions across lost keyframes: known to `submap.gap_sigma_per_m` only.
    #[serde(default)]
    pub gaps: u64,
    /// What is odd about what the front end sends, in this epoch, and what to do about it.
    #[serde(default)]
    pub remarks: Vec<String>,
    /// Pairs of submaps still to be tried by this robot, jobs running, records not yet durable.
    pub pending: u64,
    /// Of these, what a restart would lose: submaps not yet stated, records not yet durable.
    pub unsaved: u64,
    /// Nothing is pending and the joint estimate is of the present set.
    pub idle: bool,
    /// Names of robots of which at least one frame is merged with this robot's present frame.
    pub merged_with: Vec<String>,
    /// Nothing new of our own is begun. The store fails, and nothing received counts until it works again; or this
    /// robot began more epochs than the others take. Its log says which.
    pub receive_only: bool,
}

/// `view/frames`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FramesView {
    /// The frame that relations are given in: this robot's present frame, as `name/epoch`.
    pub own: String,
    /// Every known frame.
    pub frames: Vec<FrameView>,
    /// Every pair of frames that has at least one alignment.
    pub pairs: Vec<PairView>,
    /// Robots that may be wrong, and why.
    #[serde(default)]
    pub suspects: Vec<SuspectView>,
    /// What this robot tried with frames of others since it started.
    #[serde(default)]
    pub tries: Vec<TriesView>,
}

/// Pairs of submaps, one of a frame of this robot and one of another robot's, that this robot tried to align.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TriesView {
    /// The frame of this robot, `name/epoch`.
    pub own: String,
    /// The other robot's.
    pub other: String,
    /// Pairs that aligned.
    pub found: u64,
    /// Pairs that did not, by reason.
    pub refused: BTreeMap<RefusalReason, u64>,
}

impl TriesView {
    /// Pairs tried.
    pub fn tried(&self) -> u64 {
        self.found + self.refused.values().sum::<u64>()
    }

    /// The tries of both sides.
    #[must_use]
    pub fn and(mut self, other: &Self) -> Self {
        self.found += other.found;
        for (reason, count) in &other.refused {
            *self.refused.entry(*reason).or_default() += count;
        }
        self
    }

    /// What became of pairs of which none aligned: how many there were, the commonest reason, and what may help. `None` if
    /// some did, or there were none.
    pub fn told(&self) -> Option<String> {
        let (reason, count) =
            self.refused.iter().max_by_key(|(reason, count)| (**count, std::cmp::Reverse(**reason)))?;
        let [why, cure] = reason.explained();
        let tried = self.tried();
        let pairs = if tried == 1 { "pair of submaps was" } else { "pairs of submaps were" };
        (self.found == 0).then(|| format!("{tried} {pairs} tried and none aligned, {count} since {why}: {cure}"))
    }
}

/// A robot that may be wrong.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SuspectView {
    /// Its name.
    pub robot: String,
    /// What speaks against it, and what is done.
    pub reason: String,
    /// Nothing else explains that as well.
    pub certain: bool,
}

/// One frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameView {
    /// `name/epoch`.
    pub frame: String,
    /// The robot's name.
    pub robot: String,
    /// Submaps known.
    pub submaps: u64,
    /// Frames with the same number are connected by agreed alignments.
    pub component: u64,
    /// `t_own_frame`, if connected to our own frame.
    pub t_own_frame: Option<RelationView>,
}

/// One pair of frames, `a < b`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PairView {
    /// First frame, `name/epoch`.
    pub a: String,
    /// Second frame.
    pub b: String,
    /// Merged or why not.
    pub status: PairStatus,
    /// Alignments stated, by either side.
    pub proposed: u64,
    /// Alignments both endpoints agree on.
    pub agreed: u64,
    /// Alignments that the frame-level consensus keeps.
    pub used: u64,
    /// log₁₀ of the number of false alarms of the kept set.
    pub log10_nfa: Option<f64>,
    /// `t_a_b` of the joint estimate if merged, of the frame-level consensus otherwise.
    pub t_a_b: Option<RelationView>,
    /// Of a merged pair, how two anchors in the middle of what both saw lie: what a merge is worth shows there. The
    /// origins of the frames may be far away, and `t_a_b` as uncertain as the way to them.
    #[serde(default)]
    pub middle: Option<MiddleView>,
    /// Of a pair that contradicts others: that it does, and who may be wrong. Empty else.
    #[serde(default)]
    pub reason: String,
}

/// How two anchors lie by the joint estimate.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MiddleView {
    /// Anchor of the first frame, `name/epoch#index`.
    pub i: String,
    /// Anchor of the second frame.
    pub j: String,
    /// `t_i_j`.
    pub t_i_j: RelationView,
}

/// `view/poses`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PosesView {
    /// One per robot whose pose is known, this robot included.
    pub robots: Vec<RobotView>,
    /// How robots lie by one another, where the joint estimate says so: every two of up to
    /// [`ROBOTS_ALL_PAIRS_MAX`](crate::agent::ROBOTS_ALL_PAIRS_MAX), of more those with this robot.
    #[serde(default)]
    pub pairs: Vec<RobotPairView>,
}

/// Two live robots.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RobotPairView {
    /// Name of the first.
    pub a: String,
    /// Name of the second.
    pub b: String,
    /// `t_a_b` of their bodies at their [`RobotView::stamp_secs`]. The covariance knows what the two have in common, so
    /// it is smaller than that of two [`RobotView::t_own_body`] taken as independent.
    pub t_a_b: RelationView,
}

/// A robot whose beacons were heard.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RobotView {
    /// Its name.
    pub robot: String,
    /// Whether it is known to be there: it answered since we listen, and its beacons go on. If not, the rest tells where
    /// it was last known to be: what is heard of it may have been recorded.
    #[serde(default)]
    pub live: bool,
    /// Seconds since its last beacon (or keyframe); if it is not live, since it last was, or since we listen.
    pub age_secs: f64,
    /// Its stamp, s, on its own clock.
    pub stamp_secs: f64,
    /// The submap the beacon is relative to, `name/epoch#index`.
    pub anchor: String,
    /// `t_own_body`, if its frame is connected to ours.
    pub t_own_body: Option<RelationView>,
    /// Of this robot alone: t_own_body ∘ t_odom_body⁻¹ of its last keyframe, where *odom* is the frame of the poses
    /// that its SLAM sends; REP 105's `map` → `odom`, with our own frame as map. Composed with a pose in odom it has
    /// again the covariance of [`Self::t_own_body`]; at the origin of odom it is as uncertain as the way there.
    #[serde(default)]
    pub t_map_odom: Option<RelationView>,
}

/// `view/map`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MapView {
    /// Every submap known.
    pub submaps: Vec<SubmapView>,
}

/// A submap anchor.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SubmapView {
    /// `name/epoch`.
    pub frame: String,
    /// The robot's name.
    pub robot: String,
    /// Index in the frame.
    pub index: u32,
    /// Stamps of its first and last keyframe, s.
    pub stamps_secs: [f64; 2],
    /// The anchor's pose in its own frame by odometry alone.
    pub t_frame_anchor: PoseView,
    /// The anchor's pose in our own frame by the joint estimate, if connected.
    pub t_own_anchor: Option<RelationView>,
}

/// `view/graph`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct GraphView {
    /// Nodes of the joint estimate.
    pub nodes: u64,
    /// χ² at the optimum and its degrees of freedom.
    pub chi2: f64,
    /// Degrees of freedom.
    pub dof: u64,
    /// Whether the optimum is proved to be the global one; applies where every measurement's weight is isotropic.
    pub optimality: Optimality,
    /// Whether every component was solved and converged; false before the first estimate.
    #[serde(default)]
    pub converged: bool,
    /// The components that were not.
    #[serde(default)]
    pub failed: Vec<FailedView>,
    /// Alignments, sightings and positions, used or not (odometry edges are implied by the submaps).
    pub edges: Vec<EdgeView>,
}

/// A component of which there is no estimate, or none at its minimum.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FailedView {
    /// Its frames, `name/epoch`.
    pub frames: Vec<String>,
    /// What is wrong, and what helps.
    pub reason: String,
}

/// One alignment, sighting or position.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EdgeView {
    /// `alignment`, `sighting`, or `position`: a sighting that does not tell how the other robot is turned. Its
    /// `t_i_j` is turned as the map says, and as uncertain in that as if nothing were known.
    pub kind: String,
    /// Target submap, `name/epoch#index`.
    pub i: String,
    /// Source submap.
    pub j: String,
    /// Its measurement `t_i_j`.
    pub t_i_j: RelationView,
    /// Both endpoints agree.
    pub agreed: bool,
    /// Weight in the joint estimate, 0 if unused.
    pub weight: f64,
    /// Why it is not used, or counts less than it claims; empty where it counts in full.
    pub reason: String,
    /// It is not used because the rest of what is known speaks against it.
    #[serde(default)]
    pub contradicts: bool,
}

/// `view/stats`: counters since start.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StatsView {
    /// Bytes of payload sent, by message kind.
    pub sent_bytes: BTreeMap<String, u64>,
    /// Messages sent, by kind.
    pub sent_messages: BTreeMap<String, u64>,
    /// Bytes of payload received, by kind.
    pub received_bytes: BTreeMap<String, u64>,
    /// Messages received, by kind.
    pub received_messages: BTreeMap<String, u64>,
    /// Refused input, by reason.
    pub rejected: BTreeMap<String, u64>,
    /// Refused input, by peer (name or id).
    pub rejected_by_peer: BTreeMap<String, u64>,
    /// Alignments tried here, found, refused, agreed, disputed; solves.
    pub work: BTreeMap<String, u64>,
    /// What `gossip.link_bytes_per_sec` held back, by class: new entries that waited, answers put off, turns to
    /// announce or ask that waited.
    #[serde(default)]
    pub held_back: BTreeMap<String, u64>,
    /// Bytes of this robot's logs that were condensed, before and after, summed over every time.
    #[serde(default)]
    pub condensed_bytes: CondensedView,
}

/// Bytes of entries, headers and signatures included.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct CondensedView {
    /// Of those that were replaced.
    pub before: u64,
    /// Of those in their place.
    pub after: u64,
}

impl From<&Sim3> for PoseView {
    fn from(t: &Sim3) -> Self {
        Self { translation: t.translation.into(), rotation: t.rotation.xyzw(), scale: t.scale }
    }
}

impl From<&Se3> for PoseView {
    fn from(t: &Se3) -> Self {
        Self::from(&Sim3::from_se3(t))
    }
}

impl From<&Relative> for RelationView {
    fn from(r: &Relative) -> Self {
        match r {
            Relative::Metric(p) => Self::of(PoseView::from(&p.pose), p.covariance.matrix()),
            Relative::Similarity(s) => Self::of(PoseView::from(&s.sim), s.covariance.matrix()),
        }
    }
}

impl RelationView {
    fn of<const N: usize>(pose: PoseView, p: &SMatrix<f64, N, N>) -> Self {
        let covariance = (0..N).flat_map(|r| (r..N).map(move |c| p[(r, c)])).collect();
        Self { pose, covariance, sigmas: (0..N).map(|i| p[(i, i)].sqrt()).collect() }
    }
}

/// A pose without its scale; `None` if a number is not finite or the quaternion is not of length one.
pub fn pose(view: &PoseView) -> Option<Se3> {
    let length = view.rotation.iter().map(|x| x * x).sum::<f64>().sqrt();
    Se3::from_xyzw(view.rotation, view.translation).filter(|_| (length - 1.0).abs() <= UNIT_SLACK)
}

/// A rigid pose with its covariance; `None` for a similarity.
pub fn relation(view: &RelationView) -> Option<PoseWithCovariance> {
    match relative(view)? {
        Relative::Metric(t) => Some(t),
        Relative::Similarity(_) => None,
    }
}

/// A relation with its covariance: a similarity where the covariance is one of seven values. `None` if it is neither: a
/// pose that is none, a scale that is none or, of a rigid one, not 1, or a covariance that is not positive definite.
pub fn relative(view: &RelationView) -> Option<Relative> {
    let (pose, scale) = (pose(&view.pose)?, view.pose.scale);
    match view.covariance.len() {
        21 if (scale - 1.0).abs() <= UNIT_SLACK => {
            let covariance = Covariance::new(square::<6>(&view.covariance)).ok()?;
            Some(Relative::Metric(PoseWithCovariance { pose, covariance }))
        }
        28 if scale.is_finite() && scale > 0.0 => {
            let covariance = Covariance::new(square::<7>(&view.covariance)).ok()?;
            let sim = Sim3::new(pose.rotation, pose.translation, scale);
            Some(Relative::Similarity(SimWithCovariance { sim, covariance }))
        }
        _ => None,
    }
}

/// The symmetric matrix of a row-major upper triangle.
fn square<const N: usize>(triangle: &[f64]) -> SMatrix<f64, N, N> {
    let mut m = SMatrix::zeros();
    for ((row, column), value) in (0..N).flat_map(|r| (r..N).map(move |c| (r, c))).zip(triangle) {
        m[(row, column)] = *value;
        m[(column, row)] = *value;
    }
    m
}
