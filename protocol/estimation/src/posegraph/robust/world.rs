//! The joint estimate while it is being decided what counts: every connected part solved, every closure judged against
//! the rest of the map with its covariance.
//!
//! A closure that counts is judged by its leave-one-out χ² ([`leave_one_out`]), one that does not by its innovation:
//! the same statistic from either side, so that what is let in is not thrown out again.

use super::Closure;
use super::noise::{Noise, Tally};
use super::scale::{self, Innovation, Scale};
use crate::Unused;
use crate::config::EstimateConfig;
use crate::geometry::{Relative, Se3, Sim3, chi2};
use crate::graph::{Disjoint, Factor, Graph, Source};
use crate::ids::{FrameId, SubmapId};
use crate::reweight::leave_one_out;
use crate::solve::{ComponentError, Solution, SolveError, solve};
use core::f64::consts::PI;
use nalgebra::{Matrix6, Vector3};
use std::collections::{BTreeMap, BTreeSet};

/// χ² exceeds these once in a million times. So seldom, because the noise itself is
/// estimated and its tails are longer than Gaussian, and false closures seldom come so near.
const CHI2_MAX: [f64; 7] = chi2::P999999;

/// ln of how much likelier than by chance a closure must be there to be let in by itself.
const LOG_ODDS_MIN: f64 = 2.3;
/// Closures tried at once in a part whose map is too unsure to tell them.
const TRIALS_MAX: usize = 24;
/// Expected number of false closures, of all that wait, that are let in by themselves.
const FALSE_ALARMS_MAX: f64 = 0.01;
/// Of times [`CHI2_MAX`] beyond which nothing is asked of a closure.
const FAR: f64 = 4.0;
/// Least edge of the box in which a false closure may fall, m.
const SEARCH_EDGE_MIN: f64 = 2.0;
/// A closure dropped so often stays out.
const DROPS_MAX: u8 = 2;
/// Halvings of the interval in which a limit lies.
const LIMIT_STEPS: usize = 30;
/// Rounds of dropping and admitting in one settlement.
const ROUNDS_MAX: usize = 64;

/// Connected frames, solved together.
#[derive(Clone)]
pub(super) struct Part {
    pub(super) frames: BTreeSet<FrameId>,
    /// Closures that it counts.
    used: Vec<usize>,
    pub(super) solution: Solution<SubmapId>,
    /// Covariance of each anchor's perturbation, the first held fixed.
    marginals: Vec<Matrix6<f64>>,
    /// Volume, of places times rotations, over which a false closure may fall.
    pub(super) volume: f64,
}

/// Everything that is known, and what counts of it.
#[derive(Clone)]
pub(super) struct World<'a> {
    pub(super) config: &'a EstimateConfig,
    /// Trusted factors by frame.
    pub(super) trusted: BTreeMap<FrameId, Vec<Factor<SubmapId>>>,
    pub(super) nodes: BTreeMap<FrameId, BTreeSet<SubmapId>>,
    pub(super) closures: Vec<Closure>,
    pub(super) start: BTreeMap<SubmapId, Sim3>,
    pub(super) parts: Vec<Part>,
    /// Volume of places and of rotations over which false closures spread, whatever map they meet.
    pub(super) spread: f64,
    pub(super) rotations: f64,
    /// Factors by which standard deviations may be larger than the noise that is believed.
    pub(super) scales: Vec<f64>,
}

impl World<'_> {
    /// Drops and admits until nothing changes.
    pub(super) fn settle(&mut self) {
        for _ in 0..ROUNDS_MAX {
            self.solve();
            if !self.drop_worst() && !self.admit() {
                return;
            }
        }
        self.solve();
    }

    /// Solves the parts that changed.
    pub(super) fn solve(&mut self) {
        let mut before: Vec<Part> = core::mem::take(&mut self.parts);
        for frames in self.groups() {
            let inside = |c: &Closure| c.is_used() && frames.contains(&c.i.frame);
            let used: Vec<usize> = (0..self.closures.len()).filter(|&k| inside(&self.closures[k])).collect();
            let same = before.iter().position(|p| p.frames == frames && p.used == used);
            let part = match same {
                Some(k) => Ok(before.swap_remove(k)),
                None => self.solved(frames.clone(), used.clone()),
            };
            match part {
                Ok(part) => {
                    let nodes = part.solution.graph().nodes().iter().copied();
                    self.start.extend(nodes.zip(part.solution.values().iter().copied()));
                    self.parts.push(part);
                }
                Err(error) => used.iter().for_each(|&k| self.closures[k].refuse_for_good(Unused::Failed(error.into()))),
            }
        }
    }

    /// Forgets all solutions.
    pub(super) fn forget(&mut self) {
        self.parts.clear();
    }

    fn groups(&self) -> Vec<BTreeSet<FrameId>> {
        let frames: Vec<FrameId> = self.nodes.keys().copied().collect();
        let place: BTreeMap<FrameId, usize> = frames.iter().enumerate().map(|(k, &f)| (f, k)).collect();
        let mut sets = Disjoint::new(frames.len());
        for c in self.closures.iter().filter(|c| c.is_used()) {
            sets.join(place[&c.i.frame], place[&c.j.frame]);
        }
        let mut groups: BTreeMap<usize, BTreeSet<FrameId>> = BTreeMap::new();
        for (k, &frame) in frames.iter().enumerate() {
            groups.entry(sets.root(k)).or_default().insert(frame);
        }
        groups.into_values().collect()
    }

    fn solved(&self, frames: BTreeSet<FrameId>, used: Vec<usize>) -> Result<Part, ComponentError<SubmapId>> {
        let nodes: BTreeSet<SubmapId> = frames.iter().flat_map(|f| self.nodes[f].iter().copied()).collect();
        let trusted = frames.iter().flat_map(|f| self.trusted.get(f).into_iter().flatten().copied());
        let factors = trusted.chain(used.iter().map(|&k| self.closures[k].factor())).collect();
        let mut graphs = Graph::components(&nodes, &BTreeSet::new(), factors).map_err(|_| SolveError::NotFinite)?;
        let (Some(graph), 0) = (graphs.pop(), graphs.len()) else { return Err(SolveError::NotFinite.into()) };
        let start = graph.nodes().iter().map(|id| self.start.get(id).copied().unwrap_or_else(Sim3::identity)).collect();
        let solution = solve(graph, start, self.config.iterations_max)?;
        let inverse = solution.selected_inverse();
        let of_anchor = |k| solution.covariance_along(&inverse, 0, k).map(|m| m.fixed_view::<6, 6>(0, 0).into_owned());
        let marginals = (0..solution.graph().nodes().len()).filter_map(of_anchor).collect();
        let volume = extent(solution.values()).max(self.spread) * self.rotations;
        Ok(Part { frames, used, marginals, volume, solution })
    }

    /// Drops the closures that the rest contradicts, of each pair of frames the worst; whether there are any.
    fn drop_worst(&mut self) -> bool {
        let mut worst: BTreeMap<(FrameId, FrameId), (f64, usize, f64)> = BTreeMap::new();
        for part in &self.parts {
            let inverse = part.solution.selected_inverse();
            let nodes = part.solution.graph().nodes();
            for edge in part.solution.graph().edges() {
                let Source::Measurement(measurement) = edge.label else { continue };
                let Some(out) = leave_one_out(&part.solution, &inverse, edge) else { continue };
                let Some(limit) = out.dof.checked_sub(1).and_then(|k| CHI2_MAX.get(k)) else { continue };
                let (i, j) = (nodes[edge.i].frame, nodes[edge.j].frame);
                // Chance is asked only where all of it can be judged, and of none that a robot found by itself.
                let asked = out.dof == 6 && i != j;
                let excess = out.chi2 / if asked { self.limit(part, out.log_sqrt_det) } else { *limit };
                let place = worst.entry((i.min(j), i.max(j))).or_insert((1.0, usize::MAX, 0.0));
                if excess > place.0 {
                    *place = (excess, measurement, out.chi2);
                }
            }
        }
        let mut any = false;
        for (_, k, chi2) in worst.into_values() {
            if let Ok(at) = self.closures.binary_search_by_key(&k, |c| c.k) {
                self.closures[at].drop(Unused::Contradicts(chi2));
                any = true;
            }
        }
        any
    }

    /// Lets in the closures that agree with the map; whether there are any.
    fn admit(&mut self) -> bool {
        let mut any = false;
        let waiting = self.waiting();
        for k in 0..self.closures.len() {
            let c = &self.closures[k];
            if c.is_used() || c.drops >= DROPS_MAX {
                continue;
            }
            let Some(part) = self.part_of(c.i.frame) else { continue };
            if !part.frames.contains(&c.j.frame) {
                continue;
            }
            if let Some(x) = self.innovation(part, c) {
                let (chi2, _) = x;
                let own = c.i.frame == c.j.frame;
                if chi2 <= CHI2_MAX[5] && (own || self.is_told(part, x, waiting)) {
                    self.closures[k].unused = None;
                    any = true;
                } else {
                    self.closures[k].unused = Some(Unused::Contradicts(chi2));
                }
            }
        }
        any
    }

    /// Lets in closures that agree with the map and with each other, where the map alone is too unsure to tell each
    /// from chance; whether there are any.
    ///
    /// Each is tried in turn: those that then agree are told from chance by it. The trial with the most evidence in all
    /// counts. The first may be further off than the noise that is believed explains: odometry drifts more over long
    /// ways than from step to step, and closures far from all others are the first to show it. It then needs as many
    /// with it as two frames do to merge.
    pub(super) fn admit_together(&mut self) -> bool {
        let mut any = false;
        let widest = self.scales.iter().fold(1.0, |x: f64, s| x.max(s * s)).min(FAR);
        for k in 0..self.parts.len() {
            let part = &self.parts[k];
            let inside = |c: &Closure| part.frames.contains(&c.i.frame) && part.frames.contains(&c.j.frame);
            let mut waiting: Vec<(f64, f64, usize)> = Vec::new();
            for (at, c) in self.closures.iter().enumerate().filter(|(_, c)| c.is_candidate() && inside(c)) {
                if let Some(x) = self.innovation(part, c).filter(|(chi2, _)| *chi2 <= CHI2_MAX[5] * widest) {
                    waiting.push((scale::log_ratio_over(x, part.volume, &self.scales), x.0, at));
                }
            }
            if waiting.len() < 2 {
                continue;
            }
            waiting.sort_by(|x, y| y.0.total_cmp(&x.0).then(x.2.cmp(&y.2)));
            let mut best: (f64, Vec<usize>) = (LOG_ODDS_MIN + libm::log(1e4 * waiting.len() as f64), Vec::new());
            for &(own, chi2, at) in waiting.iter().take(TRIALS_MAX) {
                // Those that one of them brings in would each bring in the others.
                if best.1.contains(&at) {
                    continue;
                }
                let mut used = part.used.clone();
                used.push(at);
                used.sort_unstable();
                let Ok(trial) = self.solved(part.frames.clone(), used) else { continue };
                let (mut evidence, mut together) = (own, vec![at]);
                for &(_, _, other) in waiting.iter().filter(|w| w.2 != at) {
                    let told = self.innovation(&trial, &self.closures[other]).filter(|(chi2, _)| *chi2 <= CHI2_MAX[5]);
                    if let Some(x) = told.filter(|&x| self.is_told(&trial, x, waiting.len())) {
                        evidence += scale::log_ratio_over(x, trial.volume, &self.scales);
                        together.push(other);
                    }
                }
                let least = if chi2 <= CHI2_MAX[5] { 2 } else { self.config.alignments_min.max(2) };
                if together.len() >= least && evidence > best.0 {
                    best = (evidence, together);
                }
            }
            for at in best.1 {
                self.closures[at].unused = None;
                any = true;
            }
        }
        any
    }

    /// Whether a closure is told from chance, of so many that wait: by its odds, and by how few false ones would come
    /// as near.
    fn is_told(&self, part: &Part, x: Innovation, waiting: usize) -> bool {
        let false_alarms = libm::log(waiting.max(1) as f64) + scale::log_chance(x, part.volume);
        scale::log_ratio_over(x, part.volume, &self.scales) > LOG_ODDS_MIN
            && false_alarms <= libm::log(FALSE_ALARMS_MAX)
    }

    /// Closures that count.
    pub(super) fn used(&self) -> Vec<usize> {
        self.closures.iter().filter(|c| c.is_used()).map(|c| c.k).collect()
    }

    /// Closures between frames that do not count.
    fn waiting(&self) -> usize {
        self.closures.iter().filter(|c| !c.is_used() && c.i.frame != c.j.frame).count()
    }

    /// How far a closure that does not count is from what a part says of its ends; `None` if it does not hold both.
    fn innovation(&self, part: &Part, c: &Closure) -> Option<Innovation> {
        let (a, b) = (part.solution.graph().position(c.i)?, part.solution.graph().position(c.j)?);
        let values = part.solution.values();
        let predicted: Se3 = (values[a].inverse() * values[b]).to_se3();
        // var(x − y) ≤ 2 (var x + var y): far-off ones need no more.
        let adjoint = predicted.inverse().adjoint();
        let (of_a, of_b) = (part.marginals.get(a)?, part.marginals.get(b)?);
        let bound = (of_b + adjoint * of_a * adjoint.transpose()) * 2.0 + c.t_i_j.covariance.matrix() * 2.0;
        let off = predicted.local(&c.t_i_j.pose);
        let least = bound.cholesky().map_or(f64::INFINITY, |l| l.solve(&off).dot(&off));
        if least > FAR * CHI2_MAX[5] {
            return Some((least, 0.0));
        }
        let Relative::Metric(predicted) = part.solution.relative(c.i, c.j, &BTreeSet::new())? else { return None };
        let sum = predicted.covariance.matrix() + c.t_i_j.covariance.matrix();
        Some((predicted.distance_squared(&c.t_i_j), log_sqrt_det(&sum)))
    }

    /// The scale of the noise that all closures show whose ends the map holds.
    pub(super) fn scale(&self) -> Scale {
        let mut innovations: Vec<Innovation> = self
            .closures
            .iter()
            .filter(|c| !c.is_used())
            .filter_map(|c| self.innovation(self.part_of(c.i.frame)?, c))
            .collect();
        let mut volume = 0.0;
        for part in &self.parts {
            volume = f64::max(volume, part.volume);
            let inverse = part.solution.selected_inverse();
            for edge in part.solution.graph().edges().iter().filter(|e| e.label != Source::Odometry) {
                let judged = leave_one_out(&part.solution, &inverse, edge).filter(|out| out.dof == 6);
                innovations.extend(judged.map(|out| (out.chi2, out.log_sqrt_det)));
            }
        }
        Scale::of(&innovations, volume)
    }

    /// The χ² beyond which a closure between frames contradicts the map: where chance would bring it there as likely
    /// as noise of one of the scales, but not where true ones are seldom, nor short of where most of them are.
    fn limit(&self, part: &Part, log_sqrt_det: f64) -> f64 {
        let odds = |chi2: f64| scale::log_ratio_over((chi2, log_sqrt_det), part.volume, &self.scales);
        let (mut low, mut high) = (chi2::P9999[5], CHI2_MAX[5]);
        if odds(high) >= 0.0 {
            return high;
        }
        for _ in 0..LIMIT_STEPS {
            let middle = 0.5 * (low + high);
            *(if odds(middle) >= 0.0 { &mut low } else { &mut high }) = middle;
        }
        low
    }

    pub(super) fn part_of(&self, frame: FrameId) -> Option<&Part> {
        self.parts.iter().find(|p| p.frames.contains(&frame))
    }

    /// The noise that all residuals in use show.
    pub(super) fn noise(&self, current: &Noise) -> Noise {
        let mut tally = Tally::default();
        self.parts.iter().for_each(|p| tally.add(&p.solution));
        tally.noise(current)
    }

    /// Moves a part, so that later solves start there.
    pub(super) fn place(&mut self, frames: &BTreeSet<FrameId>, t_new_old: &Se3) {
        let t = Sim3::from_se3(t_new_old);
        for frame in frames {
            for id in &self.nodes[frame] {
                if let Some(pose) = self.start.get_mut(id) {
                    *pose = t * *pose;
                }
            }
        }
    }
}

/// Volume of the box around places.
fn extent(values: &[Sim3]) -> f64 {
    let places = || values.iter().map(|t| t.translation);
    let low = places().fold(Vector3::repeat(f64::INFINITY), |x, y| x.inf(&y));
    let high = places().fold(Vector3::repeat(f64::NEG_INFINITY), |x, y| x.sup(&y));
    (high - low).map(|edge| edge.max(SEARCH_EDGE_MIN)).product()
}

/// Volume of places over which false closures spread, for one of them to fall anywhere in it as likely as in the
/// densest box about the place where its ends would coincide: so few that lie far out make it no larger.
pub(super) fn spread(closures: &[Closure]) -> f64 {
    let places: Vec<Vector3<f64>> =
        closures.iter().filter(|c| c.i.frame != c.j.frame).map(|c| c.t_i_j.pose.translation.abs()).collect();
    let mut sorted: [Vec<f64>; 3] = core::array::from_fn(|k| places.iter().map(|p| p[k]).collect());
    sorted.iter_mut().for_each(|axis| axis.sort_by(f64::total_cmp));
    let mut least = f64::INFINITY;
    for tenth in 1..=10 {
        let Some(at) = (places.len() * tenth).div_ceil(10).checked_sub(1) else { return 0.0 };
        let half = Vector3::from_fn(|k, _| sorted[k][at].max(0.5 * SEARCH_EDGE_MIN));
        let inside = places.iter().filter(|p| (0..3).all(|k| p[k] <= half[k])).count();
        if inside > 0 {
            least = least.min(8.0 * half.product() * places.len() as f64 / inside as f64);
        }
    }
    least
}

/// Volume of rotations over which false closures spread: about the vertical all, and tilts as large as those of the
/// closures given. Never less than tilts within 0.2 rad, those of robots that know the vertical, nor more than all
/// rotations.
pub(super) fn rotations(closures: &[Closure]) -> f64 {
    let between = || closures.iter().filter(|c| c.i.frame != c.j.frame);
    let tilt = |c: &Closure| {
        let up = c.t_i_j.pose.rotation.matrix() * Vector3::z();
        libm::acos(up.z.clamp(-1.0, 1.0))
    };
    let mean = between().map(tilt).sum::<f64>() / between().count().max(1) as f64;
    2.0 * PI * (4.0 * mean * mean).clamp(0.16, 4.0 * PI)
}

fn log_sqrt_det(m: &Matrix6<f64>) -> f64 {
    m.cholesky().map_or(0.0, |c| c.l().diagonal().iter().map(|&x| libm::log(x)).sum())
}

impl Closure {
    pub(super) fn is_used(&self) -> bool {
        self.unused.is_none()
    }

    pub(super) fn is_candidate(&self) -> bool {
        !self.is_used() && self.drops < DROPS_MAX
    }

    fn drop(&mut self, reason: Unused) {
        self.drops += 1;
        self.unused = Some(reason);
    }

    pub(super) fn refuse_for_good(&mut self, reason: Unused) {
        self.drops = DROPS_MAX;
        self.unused = Some(reason);
    }

    fn factor(&self) -> Factor<SubmapId> {
        let label = Source::Measurement(self.k);
        Factor { label, i: self.i, j: self.j, t_i_j: Relative::Metric(self.t_i_j), weight: 1.0 }
    }
}
