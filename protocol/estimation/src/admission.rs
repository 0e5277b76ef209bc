//! Canonical order and admission: decides which measurements can be considered at all, before any statistics.
//!
//! Facts come in any order and from anyone. Here they are sorted, repeats are set aside (one measurement counts once,
//! DESIGN §8.10), and whatever names unknown submaps or holds invalid numbers is kept with its reason.

use super::distortion;
use super::drift_model::DriftModel;
use super::graph::{Disjoint, Factor, content_order, is_usable};
use super::joint::{AgreedAlignment, EdgeEstimate, MapProblem, Unused};
use super::node::{Label, Node};
use super::odometry_correlation::Around;
use super::position::{DIMENSION, StatedPoint};
use super::solve::{ComponentError, SolveError};
use super::trajectory::Trajectory;
use crate::geometry::{Covariance, Disagreement, PoseWithCovariance, Relative, So3, chi2};
use crate::ids::{EntryId, FrameId, SubmapId};
use crate::kinds::PairStatus;
use crate::kinds::ScaleKind;
use core::num::NonZero;
use std::collections::{BTreeMap, BTreeSet};

/// Rotation standard deviation from which a measurement says nothing, rad.
pub const SIGMA_ROTATION_MAX: f64 = 3.0;
/// Translation standard deviation from which a measurement says nothing, in units of its frame.
pub const SIGMA_TRANSLATION_MAX: f64 = 1e4;
/// Log-scale standard deviation from which a measurement says nothing.
pub const SIGMA_LOG_SCALE_MAX: f64 = 3.0;

/// What a measurement is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// Of two submaps' clouds.
    Alignment,
    /// Of another robot.
    Sighting,
    /// Of another robot's place alone.
    Position,
}

/// A frame's anchors by odometry alone.
#[derive(Clone, Debug)]
pub(super) struct Chain {
    /// `t_frame_anchor0`.
    pub(super) origin: PoseWithCovariance,
    /// `t_prev_this` of the anchors from the second on.
    pub(super) steps: Vec<PoseWithCovariance>,
    /// Over how many submaps each step leads.
    spans: Vec<f64>,
    /// The same, compounded.
    pub(super) trajectory: Trajectory,
}

/// The admitted problem. An edge counts while its `unused` is `None`.
pub(super) struct Admission {
    pub(super) chains: BTreeMap<FrameId, Chain>,
    /// How many keyframes made each submap, where that is told.
    keyframes: BTreeMap<SubmapId, NonZero<u16>>,
    pub(super) unknown_scale: BTreeSet<FrameId>,
    pub(super) ambiguous: BTreeMap<(FrameId, FrameId), usize>,
    pub(super) edges: Vec<EdgeEstimate>,
}

impl Admission {
    pub(super) fn new(problem: &MapProblem) -> Self {
        let span = |frame: FrameId, place: usize| {
            let id = u32::try_from(place).ok().map(|index| SubmapId { frame, index });
            1.0 + f64::from(id.and_then(|id| problem.gone.get(&id).copied()).unwrap_or(0))
        };
        let chain = |(&f, c): (&FrameId, &super::joint::FrameChain)| {
            Some((f, Chain::new(&c.odometry, |place| span(f, place))?))
        };
        let chains: BTreeMap<_, _> = problem.frames.iter().filter_map(chain).collect();
        let unknown = problem.frames.iter().filter(|(_, c)| c.scale == ScaleKind::Unknown);
        let unknown_scale = unknown.map(|(&f, _)| f).collect();
        let ambiguous = problem.ambiguous.clone();
        let keyframes = problem.keyframes.clone();
        let mut admission = Self { chains, keyframes, unknown_scale, ambiguous, edges: Vec::new() };
        let alignments = sorted(&problem.alignments).into_iter().map(|m| (Kind::Alignment, m));
        let sightings = sorted(&problem.sightings).into_iter().map(|m| (Kind::Sighting, m));
        let tied = alignments.chain(sightings).map(|(kind, measurement)| EdgeEstimate::new(kind, measurement));
        let positions = sorted_points(&problem.positions).into_iter().map(EdgeEstimate::of_point);
        let (mut entries, mut submaps) = (BTreeSet::new(), BTreeMap::new());
        for edge in tied.chain(positions) {
            let EdgeEstimate { kind, measurement, .. } = edge;
            let unused = admission.refusal(kind, &measurement, &mut entries, &mut submaps);
            let stated = if kind == Kind::Alignment { problem.common.get(&measurement.entry) } else { None };
            let common = distortion::bounded(stated.copied().unwrap_or(0.0));
            let second_look = kind == Kind::Alignment && problem.second_looks.contains(&measurement.entry);
            let joins = kind == Kind::Alignment && !second_look;
            admission.edges.push(EdgeEstimate { common, second_look, joins, unused, ..edge });
        }
        distortion::charge(&mut admission.edges);
        for edge in admission.edges.iter_mut().filter(|edge| edge.second_look && edge.is_used()) {
            edge.refuse(Unused::Waiting);
        }
        for edge in &mut admission.edges {
            edge.weight = if edge.is_used() { edge.weight_at(1.0) } else { 0.0 };
        }
        admission
    }

    /// The odometry's walk while a submap was made.
    pub(super) fn walk(&self, id: SubmapId) -> Option<DriftModel> {
        let whole = self.chains.get(&id.frame)?.walk(id.index as usize)?;
        Some(DriftModel { whole, keyframes: self.keyframes.get(&id).copied() })
    }

    /// The odometry around an anchor.
    pub(super) fn around(&self, id: SubmapId) -> Option<Around<'_>> {
        let steps = &self.chains.get(&id.frame).filter(|_| !self.unknown_scale.contains(&id.frame));
        let step = |index: Option<usize>| steps.as_ref()?.steps.get(index?);
        let index = id.index as usize;
        Some(Around { walk: self.walk(id)?, steps: [step(index.checked_sub(1)), step(Some(index))] })
    }

    /// The first and the last anchor of a frame with the drift models of their submaps, as their neighbours' steps
    /// tell. `None` for a frame of a single step, which may lead over a gap.
    pub(super) fn ends(&self, frame: FrameId) -> Option<[(SubmapId, DriftModel); 2]> {
        let last = self.chains.get(&frame)?.len().checked_sub(1).filter(|&last| last > 1)?;
        let last = u32::try_from(last).ok()?;
        let of = |index: u32, neighbour: u32| {
            let [id, neighbour] = [index, neighbour].map(|index| SubmapId { frame, index });
            Some((id, DriftModel { keyframes: self.keyframes.get(&id).copied(), ..self.walk(neighbour)? }))
        };
        Some([of(0, 1)?, of(last, last - 1)?])
    }

    fn refusal(
        &self,
        kind: Kind,
        m: &AgreedAlignment,
        entries: &mut BTreeSet<(Kind, EntryId)>,
        submaps: &mut BTreeMap<(SubmapId, SubmapId), EntryId>,
    ) -> Option<Unused> {
        let same_frame = m.i.frame == m.j.frame;
        let known = |id: SubmapId| self.chains.get(&id.frame).is_some_and(|c| (id.index as usize) < c.len());
        let same_unit = same_frame || ![m.i, m.j].iter().any(|id| self.unknown_scale.contains(&id.frame));
        if !is_usable(&m.t_i_j) {
            return Some(Unused::NotFinite);
        }
        if says_nothing(&m.t_i_j) {
            return Some(Unused::TooUncertain);
        }
        if m.i == m.j {
            return Some(Unused::SelfLoop);
        }
        if !(known(m.i) && known(m.j)) {
            return Some(Unused::UnknownSubmap);
        }
        if same_unit != matches!(m.t_i_j, Relative::Metric(_)) {
            return Some(Unused::Units);
        }
        if kind != Kind::Alignment && same_frame {
            return Some(Unused::SameFrame);
        }
        if !entries.insert((kind, m.entry)) {
            return Some(Unused::RepeatsEntry);
        }
        if kind == Kind::Alignment {
            let key = (m.i.min(m.j), m.i.max(m.j));
            if let Some(&first) = submaps.get(&key) {
                return Some(Unused::RepeatsPair(first));
            }
            submaps.insert(key, m.entry);
        } else {
            // Until the alignments alone have merged its frames.
            return Some(Unused::Unmerged(PairStatus::Provisional));
        }
        None
    }

    /// Sets an edge aside; whether it counted until now.
    pub(super) fn drop_edge(&mut self, label: Label, reason: Unused) -> bool {
        let Some(wanted) = named(label) else { return false };
        let is_it = |e: &&mut EdgeEstimate| e.unused.is_none() && (e.kind, e.measurement.entry) == wanted;
        self.edges.iter_mut().find(is_it).map(|e| e.refuse(reason)).is_some()
    }

    /// A measurement that counts, with its covariance as it counts.
    pub(super) fn stated(&self, label: Label) -> Option<Relative> {
        let wanted = named(label)?;
        let edge = self.edges.iter().find(|e| e.is_used() && (e.kind, e.measurement.entry) == wanted)?;
        Some(edge.measurement.t_i_j.widened((1.0 / edge.weight).sqrt()))
    }

    /// Of a component that cannot be solved, sets aside every edge of the frame that conditions it worst, or, where
    /// there is too little memory, of the one with the most edges; whether any counted until now.
    pub(super) fn isolate_worst(&mut self, frames: &BTreeSet<FrameId>, error: ComponentError<Node>) -> bool {
        let counts =
            |e: &EdgeEstimate, f: FrameId| e.is_used() && [e.measurement.i.frame, e.measurement.j.frame].contains(&f);
        let tied = frames.iter().filter(|&&f| self.edges.iter().any(|e| counts(e, f)));
        let spread = |f: &FrameId| self.chains.get(f).map_or(f64::INFINITY, Chain::spread);
        let ties = |f: &FrameId| self.edges.iter().filter(|e| counts(e, *f)).count();
        let worst = match error {
            ComponentError::Solve(SolveError::TooDense { .. } | SolveError::OutOfMemory) => {
                tied.max_by_key(|f| ties(f))
            }
            _ => tied.max_by(|x, y| spread(x).total_cmp(&spread(y))),
        };
        let Some(&worst) = worst else { return false };
        let mut any = false;
        for edge in self.edges.iter_mut().filter(|e| counts(e, worst)) {
            edge.refuse(Unused::Failed(error));
            any = true;
        }
        any
    }

    /// Groups frames by the alignments that merge them: each frame with a number shared by its group.
    pub(super) fn groups(&self) -> BTreeMap<FrameId, usize> {
        let place: BTreeMap<FrameId, usize> = self.chains.keys().enumerate().map(|(k, &f)| (f, k)).collect();
        let mut sets = Disjoint::new(place.len());
        for edge in self.edges.iter().filter(|e| e.merges()) {
            sets.join(place[&edge.measurement.i.frame], place[&edge.measurement.j.frame]);
        }
        place.into_iter().map(|(f, k)| (f, sets.root(k))).collect()
    }

    /// Sets aside what lies between frames that nothing merges any more: neither sightings nor second looks ever do,
    /// nor alignments of pairs that did not merge by themselves.
    pub(super) fn drop_strays(&mut self) {
        let groups = self.groups();
        let stray = |e: &&mut EdgeEstimate| {
            e.unused.is_none() && groups.get(&e.measurement.i.frame) != groups.get(&e.measurement.j.frame)
        };
        for edge in self.edges.iter_mut().filter(stray) {
            let is_alignment = edge.kind == Kind::Alignment;
            edge.refuse(if is_alignment { Unused::Waiting } else { Unused::Unmerged(PairStatus::Provisional) });
        }
    }

    /// Lets in the sightings and waiting alignments that agree with the map so far, the latter with the standard
    /// deviations their pair was found to need; whether there are any.
    pub(super) fn admit(
        &mut self,
        sigma_scales: &BTreeMap<(FrameId, FrameId), f64>,
        relative: impl Fn(SubmapId, SubmapId) -> Option<Relative>,
    ) -> bool {
        let mut any = false;
        for edge in self.edges.iter_mut().filter(|e| e.is_waiting()) {
            let scale = edge.sigma_scale(sigma_scales);
            edge.complete(&relative);
            if edge.disagreement(scale, &relative).is_some_and(|d| edge.is_consistent(&d)) {
                (edge.weight, edge.unused) = (edge.weight_at(scale), None);
                any = true;
            }
        }
        any
    }

    /// Says of what still waits, though the map holds both its ends, by how much it contradicts.
    pub(super) fn refuse_waiting(
        &mut self,
        sigma_scales: &BTreeMap<(FrameId, FrameId), f64>,
        relative: impl Fn(SubmapId, SubmapId) -> Option<Relative>,
    ) {
        for edge in self.edges.iter_mut().filter(|e| e.is_waiting()) {
            let scale = edge.sigma_scale(sigma_scales);
            if let Some(d) = edge.disagreement(scale, &relative) {
                edge.refuse(Unused::Contradicts(d.distance_squared));
            }
        }
    }
}

/// Which edge a factor stands for, if any.
fn named(label: Label) -> Option<(Kind, EntryId)> {
    match label {
        Label::Odometry | Label::Cloud => None,
        Label::Alignment(entry) => Some((Kind::Alignment, entry)),
        Label::Sighting(entry) => Some((Kind::Sighting, entry)),
        Label::Position(entry) => Some((Kind::Position, entry)),
    }
}

impl EdgeEstimate {
    /// Whether the map is to judge it.
    fn is_waiting(&self) -> bool {
        match self.unused {
            Some(Unused::Unmerged(PairStatus::Provisional)) => true,
            Some(Unused::Waiting) => self.kind == Kind::Alignment,
            _ => false,
        }
    }

    /// A point that was seen, as a pose that the map completes later.
    fn of_point(stated: StatedPoint) -> Self {
        let StatedPoint { entry, i, j, point } = stated;
        let measurement = AgreedAlignment { entry, i, j, t_i_j: point.completed(&So3::identity()) };
        Self { point: Some(point), ..Self::new(Kind::Position, measurement) }
    }

    /// Turns what was seen of a point as the map says.
    fn complete(&mut self, relative: impl Fn(SubmapId, SubmapId) -> Option<Relative>) {
        if let Some((point, predicted)) = self.point.zip(relative(self.measurement.i, self.measurement.j)) {
            self.measurement.t_i_j = point.completed(&predicted.sim().rotation);
        }
    }

    /// Whether an honest measurement would be so far off at most 999 times in 1,000.
    fn is_consistent(&self, d: &Disagreement) -> bool {
        if self.point.is_some() { d.distance_squared <= chi2::P999[DIMENSION - 1] } else { d.is_consistent() }
    }

    /// The factor that its pair found its standard deviations to need.
    fn sigma_scale(&self, of_pairs: &BTreeMap<(FrameId, FrameId), f64>) -> f64 {
        let (i, j) = (self.measurement.i.frame, self.measurement.j.frame);
        of_pairs.get(&(i.min(j), i.max(j))).copied().unwrap_or(1.0)
    }

    /// How far it is from what a map says; `None` if the map does not hold both its ends.
    fn disagreement(
        &self,
        sigma_scale: f64,
        relative: impl Fn(SubmapId, SubmapId) -> Option<Relative>,
    ) -> Option<Disagreement> {
        let predicted = relative(self.measurement.i, self.measurement.j)?;
        Some(predicted.disagreement(&self.measurement.t_i_j.widened(sigma_scale * self.charges.in_all.sqrt())))
    }

    /// Its weight where its pair found its standard deviations to need the factor `sigma_scale`. What it has in common
    /// with others counts against a similarity here; else the graph knows of it ([`distortion::factors`]).
    pub(super) fn weight_at(&self, sigma_scale: f64) -> f64 {
        1.0 / (self.charge() * sigma_scale * sigma_scale)
    }

    /// What its variance is multiplied by for what it has in common with others.
    fn charge(&self) -> f64 {
        if self.measurement.t_i_j.metric().is_some() { 1.0 } else { self.charges.in_all }
    }

    /// Why it counts less than it claims, or not at all; empty where it counts in full.
    pub fn reason(&self) -> String {
        if let Some(unused) = &self.unused {
            return unused.to_string();
        }
        let charge = self.charge();
        // What is left when the charge is taken away; a hair of rounding is no reason.
        let sigma_scale = (1.0 / (self.weight * charge)).sqrt();
        let mut reasons = Vec::new();
        if charge > 1.0 {
            reasons.push(format!(
                "shares errors with other alignments of its submaps, which costs {charge:.2} times the variance"
            ));
        }
        if sigma_scale > 1.0 + 1e-9 {
            reasons.push(format!(
                "the alignments of its pair of frames scatter more than they claim: standard deviations times {sigma_scale:.2}"
            ));
        }
        reasons.join("; ")
    }

    /// Takes the edge out of the estimate.
    pub(super) fn refuse(&mut self, reason: Unused) {
        (self.weight, self.unused) = (0.0, Some(reason));
    }
}

impl Chain {
    /// The chain up to the first step that is not a valid pose or says nothing; `None` if nothing is left.
    fn new(odometry: &[PoseWithCovariance], span: impl Fn(usize) -> f64) -> Option<Self> {
        let holds = |t: &Relative| is_usable(t) && !says_nothing(t);
        let usable = odometry.iter().take_while(|p| holds(&Relative::Metric(**p)));
        let steps: Vec<PoseWithCovariance> = usable.copied().collect();
        let origin = *steps.first()?;
        let trajectory = Trajectory::new(steps.iter().copied());
        let spans = (1..steps.len()).map(span).collect();
        Some(Self { origin, steps: steps[1..].to_vec(), spans, trajectory })
    }

    /// Largest over smallest variance of its steps: how badly it conditions a component.
    pub(super) fn spread(&self) -> f64 {
        let variances = || self.steps.iter().flat_map(|s| s.covariance.matrix().diagonal().data.0[0]);
        variances().fold(0.0, f64::max) / variances().fold(f64::MAX, f64::min)
    }

    /// The odometry's walk while a submap was made: about that of the step to its anchor, or of the one from it; of the
    /// two the smaller, as one may lead over a gap.
    fn walk(&self, index: usize) -> Option<Covariance<6>> {
        let part = |k: usize| Some(self.steps.get(k)?.covariance.scaled(1.0 / self.spans[k]));
        let [to, from] = [index.checked_sub(1), Some(index)].map(|k| part(k?));
        let volume = |covariance: &Covariance<6>| covariance.matrix().determinant();
        [to, from].into_iter().flatten().min_by(|a, b| volume(a).total_cmp(&volume(b)))
    }

    /// Number of anchors.
    pub(super) fn len(&self) -> usize {
        self.trajectory.len()
    }

    pub(super) fn ids(&self, frame: FrameId) -> impl Iterator<Item = SubmapId> + use<> {
        (0..self.len() as u32).map(move |index| SubmapId { frame, index })
    }

    pub(super) fn factors(&self, frame: FrameId) -> impl Iterator<Item = Factor<Node>> + '_ {
        (1u32..).zip(&self.steps).map(move |(index, step)| Factor {
            label: Label::Odometry,
            i: Node::Anchor(SubmapId { frame, index: index - 1 }),
            j: Node::Anchor(SubmapId { frame, index }),
            t_i_j: Relative::Metric(*step),
            weight: 1.0,
        })
    }
}

fn says_nothing(t: &Relative) -> bool {
    let (sigmas, of_scale): ([f64; 6], f64) = match t {
        Relative::Metric(p) => (p.covariance.sigmas().into(), 0.0),
        Relative::Similarity(s) => {
            let all = s.covariance.sigmas();
            (all.fixed_rows::<6>(0).into_owned().into(), all[6])
        }
    };
    let (of_translation, of_rotation) = sigmas.split_at(3);
    of_translation.iter().any(|&s| s > SIGMA_TRANSLATION_MAX)
        || of_rotation.iter().any(|&s| s > SIGMA_ROTATION_MAX)
        || of_scale > SIGMA_LOG_SCALE_MAX
}

fn sorted_points(list: &[StatedPoint]) -> Vec<StatedPoint> {
    let numbers = |a: &StatedPoint, b: &StatedPoint| {
        let by_number = a.point.numbers().zip(b.point.numbers()).map(|(x, y)| x.total_cmp(&y));
        by_number.into_iter().find(|order| order.is_ne()).unwrap_or(core::cmp::Ordering::Equal)
    };
    let mut out = list.to_vec();
    out.sort_by(|a, b| (a.entry, a.i, a.j).cmp(&(b.entry, b.i, b.j)).then_with(|| numbers(a, b)));
    out
}

fn sorted(list: &[AgreedAlignment]) -> Vec<AgreedAlignment> {
    let mut out = list.to_vec();
    out.sort_by(|a, b| (a.entry, a.i, a.j).cmp(&(b.entry, b.i, b.j)).then_with(|| content_order(&a.t_i_j, &b.t_i_j)));
    out
}
