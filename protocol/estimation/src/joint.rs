//! The map as a pure function of the set of facts: decides which frames merge, which measurements count, and where
//! every anchor lies (DESIGN §7, MATH §3 and §5).
//!
//! 1. `admission` sorts the facts canonically and lists what cannot be used.
//! 2. `pairs` runs the frame-level consensus on each pair of frames and accepts merges along the strongest spanning
//!    forest; a pair that contradicts a loop of frames (χ², 99.99 %) is left out.
//! 3. Here, the whole graph is solved with the alignments that remain (`distortion` knows what they have in common);
//!    one whose leave-one-out χ² exceeds 99.9 % is dropped, the largest first, and the graph solved again.
//! 4. Sightings between merged frames, and alignments that no consensus weighed, join if they agree with that map.

use super::admission::{Admission, Kind};
use super::distortion::{self, Charges};
use super::drift_model::DriftModel;
use super::graph::{Factor, Graph};
use super::joint_covariance::{JointError, JointPoses};
use super::node::{Label, Node};
use super::optimality::Optimality;
use super::pairs::{self, Pair, PairEstimate};
use super::position::{SeenPoint, StatedPoint};
use super::reweight::{self, Drop};
use super::solve::{ComponentError, Solution, SolveError, solve_within};
use super::verdicts::Verdicts;
use crate::config::EstimateConfig;
use crate::geometry::{PoseWithCovariance, Relative, Se3, Sim3};
use crate::ids::{EntryId, FrameId, SubmapId};
use crate::kinds::PairStatus;
use crate::kinds::ScaleKind;
use core::num::NonZero;
use std::collections::{BTreeMap, BTreeSet};
use thiserror::Error;

/// Rounds in which the map lets in what agrees with it: each makes it surer of the next.
const ADMISSIONS_MAX: usize = 4;

/// Bytes that a component of the map may take while it is solved: half of the gibibyte that the agent's unit file grants
/// it. Whoever sends a map that takes more has his frame left out.
pub const MAP_BYTES_MAX: u64 = 512 << 20;

/// A frame's own trajectory of anchors.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameChain {
    /// Whether its unit is the metre.
    pub scale: ScaleKind,
    /// `t_prev_this` of each anchor in the frame's unit; index 0 is `t_frame_anchor0`.
    pub odometry: Vec<PoseWithCovariance>,
}

/// A measurement between two anchors that both endpoints agree on (or a sighting by its observer).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AgreedAlignment {
    /// The log entry that states it.
    pub entry: EntryId,
    /// Target anchor.
    pub i: SubmapId,
    /// Source anchor.
    pub j: SubmapId,
    /// `t_i_j`.
    pub t_i_j: Relative,
}

/// Everything the map depends on. Order within the vectors does not matter.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MapProblem {
    /// All known frames.
    pub frames: BTreeMap<FrameId, FrameChain>,
    /// Agreed alignments between frames, and loop closures within one.
    pub alignments: Vec<AgreedAlignment>,
    /// Direct measurements of other robots.
    pub sightings: Vec<AgreedAlignment>,
    /// Where other robots were seen, not how they were turned.
    pub positions: Vec<StatedPoint>,
    /// Alignments whose errors are not their own: which share of the variance each other alignment of the one submap
    /// has in common with it, and as much of the other; 0 to 0.45 ([`COMMON_MAX`](super::distortion::COMMON_MAX)), 0
    /// for what is not listed.
    pub common: BTreeMap<EntryId, f64>,
    /// How many keyframes made a submap, by its place in the chain; of what is not listed nobody knows.
    pub keyframes: BTreeMap<SubmapId, NonZero<u16>>,
    /// How many submaps are gone from the chain before one, the steps of which are compounded in that to it; none if it
    /// is not listed.
    pub gone: BTreeMap<SubmapId, u32>,
    /// Between two frames, `a < b`: pairs of submaps of which one end found an alignment, and the other end that there
    /// are several. Within one, `a = b`: pairs of its owner's that fit in several ways. Places that repeat themselves
    /// show by it.
    pub ambiguous: BTreeMap<(FrameId, FrameId), usize>,
    /// Alignments that were looked for because a map had their submaps overlap: they speak for no map, and count once
    /// one without them agrees with them.
    pub second_looks: BTreeSet<EntryId>,
}

/// Why a measurement does not count.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum Unused {
    /// Its mean is NaN, infinite, or of no valid rotation or scale.
    #[error("holds a NaN, infinite or invalid number")]
    NotFinite,
    /// Its standard deviations are so large that it says nothing.
    #[error("too uncertain to say anything")]
    TooUncertain,
    /// One of its anchors is not known (yet), or lies behind a broken step of its frame's odometry.
    #[error("names an unknown submap")]
    UnknownSubmap,
    /// Both ends are one anchor.
    #[error("ties a submap to itself")]
    SelfLoop,
    /// Another measurement with this entry id comes first in canonical order.
    #[error("repeats an entry")]
    RepeatsEntry,
    /// An earlier entry aligns the same two submaps: the same data must not count twice.
    #[error("aligns the same submaps as {0}")]
    RepeatsPair(EntryId),
    /// SE(3) between frames of different units, or SIM(3) between equal ones.
    #[error("SE(3) needs equal units at both ends, SIM(3) different ones")]
    Units,
    /// A sighting within one frame.
    #[error("observer and observed share a frame")]
    SameFrame,
    /// Its two frames are not merged.
    #[error("its frames are not merged ({0:?})")]
    Unmerged(PairStatus),
    /// Its pair has more alignments than its consensus weighs, or a map called for it; it counts once the map agrees
    /// with it.
    #[error("waits for a map that tells where its frames lie")]
    Waiting,
    /// The frame-level consensus of its pair leaves it out.
    #[error("contradicts the other alignments of its pair of frames")]
    Outvoted,
    /// A loop closure that contradicts the odometry between its ends.
    #[error("contradicts the odometry between its ends (chi2 {0:.1})")]
    Odometry(f64),
    /// A loop closure that contradicts other loop closures.
    #[error("contradicts other loop closures of its frame")]
    OtherLoops,
    /// Pairs of frames around a loop contradict one another, and its pair is among those that may be wrong.
    #[error("pairs of frames around a loop contradict one another, and its pair may be the one that is wrong")]
    FrameLoop,
    /// It contradicts the rest of the map.
    #[error("contradicts the rest of the map (leave-one-out chi2 {0:.1})")]
    Contradicts(f64),
    /// Too few alignments of its pair survived the joint estimate.
    #[error("too few alignments of its pair of frames survive the joint estimate")]
    TooFew,
    /// Its component could not be solved; its frame conditions it worst.
    #[error("the component could not be solved: {0}")]
    Failed(ComponentError<Node>),
}

impl Unused {
    /// It is fit to count, and the rest of what is known speaks against it.
    pub fn contradicts(&self) -> bool {
        matches!(self, Self::Outvoted | Self::Odometry(_) | Self::OtherLoops | Self::FrameLoop | Self::Contradicts(_))
    }
}

/// A measurement and what became of it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EdgeEstimate {
    /// Alignment, sighting or position.
    pub kind: Kind,
    /// As it was given, or, of a position, as the map completed it.
    pub measurement: AgreedAlignment,
    /// What its information was multiplied by; 0 if unused.
    pub weight: f64,
    /// Share of its variance that it has in common with the others of either submap.
    pub(super) common: f64,
    /// What that costs where alignments are taken as independent.
    pub(super) charges: Charges,
    /// Of a position, what was seen.
    pub(super) point: Option<SeenPoint>,
    /// A map called for it.
    pub(super) second_look: bool,
    /// It may hold frames together: it is no second look, and one of a pair that merges.
    pub(super) joins: bool,
    /// Why it does not count; `None` if it does.
    pub unused: Option<Unused>,
}

/// Frames that are connected, solved together.
#[derive(Clone, Debug)]
struct Component {
    frames: Vec<FrameId>,
    solution: Result<Solution<Node>, ComponentError<Node>>,
}

/// What a component's estimate falls short of.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
pub enum Shortfall {
    /// It has none.
    #[error("could not be solved, so that nothing is known but each frame's own odometry: {0}")]
    Unsolved(ComponentError<Node>),
    /// It is not at the minimum.
    #[error(
        "no minimum after {iterations} iterations, so that poses and covariances are provisional; raise \
             estimate.iterations_max"
    )]
    NotConverged {
        /// Taken.
        iterations: usize,
    },
}

/// The map.
#[derive(Clone, Debug)]
pub struct JointEstimate {
    components: Vec<Component>,
    component_of: BTreeMap<FrameId, usize>,
    /// `t_frame_anchor0`.
    pub(super) origins: BTreeMap<FrameId, PoseWithCovariance>,
    /// The first and the last anchor of each metric frame and the walks while their submaps were made.
    pub(super) ends: BTreeMap<FrameId, [(SubmapId, DriftModel); 2]>,
    pub(super) unknown_scale: BTreeSet<FrameId>,
    pairs: Vec<PairEstimate>,
    edges: Vec<EdgeEstimate>,
    /// Weighted sum of squared residuals over all components.
    pub chi2: f64,
    /// Degrees of freedom over all components.
    pub dof: usize,
    /// Anchors.
    pub nodes: usize,
    /// Whether every component was solved and converged.
    pub converged: bool,
}

/// Solves the map. Never fails: what cannot be used is listed in [`JointEstimate::edges`] with its reason.
pub fn solve_map(problem: &MapProblem, config: &EstimateConfig) -> JointEstimate {
    solve_map_recalling(problem, config, &mut Verdicts::default())
}

/// [`solve_map`], to the bit, for those who solve a map again that has changed a little: what pairs of frames came to is
/// taken from `verdicts` where it cannot have changed, and left there for the next time.
pub fn solve_map_recalling(problem: &MapProblem, config: &EstimateConfig, verdicts: &mut Verdicts) -> JointEstimate {
    let mut admission = Admission::new(problem);
    let mut pairs = pairs::consensus(&mut admission, config, verdicts);
    let start = pairs::start(&admission, &pairs).into_iter().map(|(id, t)| (Node::Anchor(id), t)).collect();
    let mut map = Map::solve(&mut admission, &mut pairs, start, config);
    let unknown_scale = admission.unknown_scale.clone();
    let scales = pairs::sigma_scales(&pairs);
    for _ in 0..ADMISSIONS_MAX {
        if !admission.admit(&scales, |i, j| map.relative(&unknown_scale, i, j)) {
            break;
        }
        map = Map::solve(&mut admission, &mut pairs, map.start, config);
    }
    admission.refuse_waiting(&scales, |i, j| map.relative(&unknown_scale, i, j));
    JointEstimate::new(admission, pairs, map)
}

/// Solved components while measurements are still being dropped.
struct Map {
    solutions: Vec<Solved>,
    /// Latest `t_world_anchor`, the start of the next solve.
    start: BTreeMap<Node, Sim3>,
}

impl Map {
    /// Solves, drops what contradicts the rest, and solves again until nothing does.
    fn solve(
        admission: &mut Admission,
        pairs: &mut [Pair],
        mut start: BTreeMap<Node, Sim3>,
        config: &EstimateConfig,
    ) -> Self {
        let mut round = 0;
        loop {
            let solved = solve_components(admission, &start, config.iterations_max);
            let mut changed = false;
            let mut solutions = Vec::new();
            for (frames, solution) in solved {
                match solution {
                    Ok(solution) => {
                        start.extend(solution.graph().nodes().iter().copied().zip(solution.values().iter().copied()));
                        for Drop { label, chi2 } in
                            reweight::contradictions(&solution, round, |label| admission.stated(label))
                        {
                            changed |= admission.drop_edge(label, Unused::Contradicts(chi2));
                        }
                        solutions.push((frames, Ok(solution)));
                    }
                    Err(error) => {
                        changed |= admission.isolate_worst(&frames, error);
                        solutions.push((frames, Err(error)));
                    }
                }
            }
            if !changed {
                return Self { solutions, start };
            }
            pairs::demote(admission, pairs, config.alignments_min);
            admission.drop_strays();
            round += 1;
        }
    }

    fn relative(&self, unknown_scale: &BTreeSet<FrameId>, i: SubmapId, j: SubmapId) -> Option<Relative> {
        let holds = |s: &&Solved| s.0.contains(&i.frame) && s.0.contains(&j.frame);
        self.solutions.iter().find(holds)?.1.as_ref().ok()?.relative(i, j, unknown_scale)
    }
}

type Solved = (BTreeSet<FrameId>, Result<Solution<Node>, ComponentError<Node>>);

/// Builds and solves every component from the measurements that count at present.
fn solve_components(admission: &Admission, start: &BTreeMap<Node, Sim3>, iterations_max: usize) -> Vec<Solved> {
    let mut groups: BTreeMap<usize, BTreeSet<FrameId>> = BTreeMap::new();
    for (frame, group) in admission.groups() {
        groups.entry(group).or_default().insert(frame);
    }
    let used = || admission.edges.iter().filter(|e| e.is_used());
    let solve_group = |members: BTreeSet<FrameId>| {
        let mut nodes: BTreeSet<Node> =
            members.iter().flat_map(|f| admission.chains[f].ids(*f)).map(Node::Anchor).collect();
        let mut factors: Vec<Factor<Node>> = members.iter().flat_map(|f| admission.chains[f].factors(*f)).collect();
        let tied: Vec<&EdgeEstimate> = used().filter(|e| members.contains(&e.measurement.i.frame)).collect();
        let (tied, gains) = distortion::factors(&tied, |id| admission.around(id));
        factors.extend(tied);
        nodes.extend(factors.iter().filter(|factor| factor.label == Label::Cloud).map(|factor| factor.j));
        let solution = match Graph::components(&nodes, &admission.unknown_scale, factors) {
            Ok(mut graphs) if graphs.len() == 1 => {
                let mut graph = graphs.remove(0);
                graph.correlate(&gains);
                // A cloud that is new lies where its anchor does.
                let place = |node: &Node| start.get(node).or_else(|| start.get(&Node::Anchor(node.submap()))).copied();
                let start = graph.nodes().iter().map(|node| place(node).unwrap_or_else(Sim3::identity));
                let start = start.collect();
                solve_within(graph, start, iterations_max, MAP_BYTES_MAX)
            }
            // Admission admits only what a graph accepts, and a chain is connected.
            _ => Err(SolveError::NotFinite.into()),
        };
        (members, solution)
    };
    groups.into_values().map(solve_group).collect()
}

impl EdgeEstimate {
    pub(super) fn new(kind: Kind, measurement: AgreedAlignment) -> Self {
        Self {
            kind,
            measurement,
            weight: 0.0,
            common: 0.0,
            charges: Charges::default(),
            point: None,
            second_look: false,
            joins: kind == Kind::Alignment,
            unused: None,
        }
    }

    pub(super) fn factor(&self) -> Factor<Node> {
        let AgreedAlignment { entry, i, j, t_i_j } = self.measurement;
        let label = match self.kind {
            Kind::Alignment => Label::Alignment(entry),
            Kind::Sighting => Label::Sighting(entry),
            Kind::Position => Label::Position(entry),
        };
        Factor { label, i: i.into(), j: j.into(), t_i_j, weight: self.weight }
    }

    /// `t_i_j`, one of several between its two frames that are taken as independent.
    pub(super) fn among_others(&self) -> Relative {
        self.measurement.t_i_j.widened(self.charges.between.sqrt())
    }

    /// Whether it holds its frames together.
    pub(super) fn merges(&self) -> bool {
        self.joins && self.is_used()
    }

    /// Whether it counts in the joint estimate.
    pub fn is_used(&self) -> bool {
        self.unused.is_none()
    }
}

impl JointEstimate {
    fn new(admission: Admission, pairs: Vec<Pair>, map: Map) -> Self {
        let origins = admission.chains.iter().map(|(&f, chain)| (f, chain.origin)).collect();
        let metric = admission.chains.iter().filter(|(f, _)| !admission.unknown_scale.contains(f));
        let ends = metric.filter_map(|(&f, _)| Some((f, admission.ends(f)?))).collect();
        let mut components = Vec::new();
        let mut component_of = BTreeMap::new();
        for (frames, solution) in map.solutions {
            component_of.extend(frames.iter().map(|&f| (f, components.len())));
            components.push(Component { frames: frames.into_iter().collect(), solution });
        }
        let solutions = || components.iter().filter_map(|c| c.solution.as_ref().ok());
        let mut out = Self {
            chi2: solutions().map(|s| s.chi2).sum(),
            dof: solutions().map(|s| s.dof).sum(),
            nodes: admission.chains.values().map(|c| c.len()).sum(),
            converged: components.iter().all(|c| c.solution.as_ref().is_ok_and(|s| s.converged)),
            components,
            component_of,
            origins,
            ends,
            unknown_scale: admission.unknown_scale,
            pairs: Vec::new(),
            edges: admission.edges,
        };
        out.pairs = pairs.into_iter().map(|pair| pair.estimate(&out)).collect();
        out
    }

    /// What can be proved about the whole: the least that can be of any component.
    pub fn optimality(&self) -> Optimality {
        let known = |c: &Component| c.solution.as_ref().map_or(Optimality::NotCertified, Solution::optimality);
        let of_all = self.components.iter().map(known).collect::<BTreeSet<_>>();
        of_all.into_iter().next_back().unwrap_or_default()
    }

    /// The components that could not be solved or did not converge, and what is wrong with them.
    pub fn shortfalls(&self) -> impl Iterator<Item = (&[FrameId], Shortfall)> {
        let why = |c: &Component| match &c.solution {
            Err(error) => Some(Shortfall::Unsolved(*error)),
            Ok(s) => (!s.converged).then_some(Shortfall::NotConverged { iterations: s.iterations }),
        };
        self.components.iter().filter_map(move |c| Some((c.frames.as_slice(), why(c)?)))
    }

    /// The component of a frame; frames with the same number are connected. `None` for a frame without anchors.
    pub fn component_of(&self, frame: FrameId) -> Option<usize> {
        self.component_of.get(&frame).copied()
    }

    /// The frames of each component.
    pub fn components(&self) -> impl ExactSizeIterator<Item = &[FrameId]> {
        self.components.iter().map(|c| c.frames.as_slice())
    }

    /// `t_world_anchor` of a component's anchors, in the component's own arbitrary frame; empty if it was not solved.
    pub fn values(&self, component: usize) -> BTreeMap<SubmapId, Se3> {
        let solution = self.components.get(component).and_then(|c| c.solution.as_ref().ok());
        let places = solution.into_iter().flat_map(|s| s.graph().nodes().iter().copied().zip(s.values()));
        places.filter_map(|(node, value)| Some((node.anchor()?, value.to_se3()))).collect()
    }

    /// `t_i_j` between two anchors of one component, cross-correlations included: rigid between metric frames and
    /// within one frame (in its unit), a similarity otherwise.
    pub fn relative(&self, i: SubmapId, j: SubmapId) -> Option<Relative> {
        self.solution_of(i.frame, j.frame)?.relative(i, j, &self.unknown_scale)
    }

    /// [`JointEstimate::relative`] of many pairs that share few anchors, at one solve for each anchor; `None` for those
    /// that are not connected.
    pub fn relatives(&self, pairs: &[(SubmapId, SubmapId)]) -> Vec<Option<Relative>> {
        let mut places: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        for (place, (i, j)) in pairs.iter().enumerate() {
            let component = self.component_of(i.frame).filter(|c| self.component_of(j.frame) == Some(*c));
            component.into_iter().for_each(|c| places.entry(c).or_default().push(place));
        }
        let mut out = vec![None; pairs.len()];
        for (component, places) in places {
            let Ok(solution) = &self.components[component].solution else { continue };
            let relatives = solution.relatives(places.iter().map(|&place| pairs[place]), &self.unknown_scale);
            places.iter().zip(relatives).for_each(|(&place, t)| out[place] = t);
        }
        out
    }

    /// `t_reference_anchor` of several anchors with their joint covariance ([`JointPoses`] says of what).
    ///
    /// # Errors
    /// [`JointError`]; [`JointError::Apart`] too where the reference's component could not be solved.
    pub fn joint(&self, reference: SubmapId, anchors: &[SubmapId]) -> Result<JointPoses, JointError> {
        let solution = self.solution_of(reference.frame, reference.frame).ok_or(JointError::Apart(reference))?;
        solution.joint(reference, anchors, &self.unknown_scale)
    }

    /// Every pair of frames with an agreed alignment, ascending.
    pub fn pairs(&self) -> &[PairEstimate] {
        &self.pairs
    }

    /// Every alignment and sighting in canonical order, used or not.
    pub fn edges(&self) -> &[EdgeEstimate] {
        &self.edges
    }

    pub(super) fn solution_of(&self, a: FrameId, b: FrameId) -> Option<&Solution<Node>> {
        let component = self.component_of(a).filter(|c| self.component_of(b) == Some(*c))?;
        self.components[component].solution.as_ref().ok()
    }
}
