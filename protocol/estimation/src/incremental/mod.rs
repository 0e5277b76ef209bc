//! The joint estimate as it grows: decides what a new fact touches, and solves for no more than that.
//!
//! A component's factorisation is kept as a tree of fronts (the `sparse` module). A new factor dissolves the fronts on
//! the ways from its anchors to the root, and only they are eliminated anew; the solution moves only where it changes
//! by a share of its standard deviation; factors are linearised anew only where the linear model has aged (`model`).
//! This is iSAM2 (Kaess et al. 2012) with limits in standard deviations, so that they hold for any unit, and with new
//! anchors hung below known ones at no further cost while a single rigid factor ties them, as odometry does.
//!
//! The tests hold every estimate within 0.05 standard deviations of [`super::solve::solve`]'s, and within 1e-5 after
//! [`Incremental::settle`]. The anchor held fixed is that of the solution it grew from. The same additions in the same
//! order give the same bits.

mod model;
mod plan;
#[cfg(test)]
mod tests;

use super::graph::{Factor, GraphError, Key, is_rigid};
use super::marginals::{certain, relation};
use super::solve::{Solution, SolveError};
use super::sparse::{Before, CliqueTree};
use crate::geometry::sim3::Matrix7;
use crate::geometry::{Relative, Sim3};
use model::{Model, Owner};
use plan::Plan;
use std::collections::BTreeSet;
use thiserror::Error;

/// A variable that would move by less than this share of its standard deviation, the later ones given, stays.
const MOVE_MIN: f64 = 3e-3;
/// Linearisations that an addition may take.
const PASSES_MAX: usize = 8;
/// The elimination order is made afresh when the factor holds this many times more numbers a variable than when it was
/// last made.
const FILL_GROWTH_MAX: f64 = 1.5;
/// [`Incremental::settle`] stops when a step promises to lower χ² by less than this share of (1 + χ²).
const DECREASE_MIN: f64 = 1e-12;
/// Gauss–Newton steps that [`Incremental::settle`] may take.
const STEPS_MAX: usize = 30;

/// Why a component was left as it was.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
pub enum IncrementalError<K: Key> {
    /// A factor cannot be used.
    #[error(transparent)]
    Graph(#[from] GraphError<K>),
    /// An anchor is there already.
    #[error("anchor {0:?} is already in the component; leave it out of the addition")]
    Known(K),
    /// No factor ties an anchor to the component, by way of others or at all.
    #[error("anchor {0:?} is tied to nothing known; add it with a factor that leads there")]
    Loose(K),
    /// A frame's unit would change what the units of the others are.
    #[error("the unit of frame {0:?} contradicts the component's; solve it anew with the frame")]
    Unit(K::Unit),
    /// The measurements leave an anchor free, or are too ill-conditioned to tell.
    #[error("anchor {0:?} is not determined by its measurements")]
    Underconstrained(K),
    /// The measurements leave a frame's scale free, or are too ill-conditioned to tell.
    #[error("the scale of frame {0:?} is not determined by its measurements")]
    UnderconstrainedScale(K::Unit),
    /// An intermediate number overflowed, or memory could not be had.
    #[error(transparent)]
    Solve(SolveError),
    /// Full steps do not lower χ²: the estimate lies too far from the minimum.
    #[error("the estimate is too far from the minimum; solve the component anew")]
    Diverged,
}

/// What a component shall grow by.
#[derive(Clone, Debug)]
pub struct Addition<K: Key> {
    /// New anchors; each must be tied to the component by `factors`.
    pub nodes: BTreeSet<K>,
    /// New frames whose scale is not known.
    pub unknown_scale: BTreeSet<K::Unit>,
    /// New factors, among new and known anchors.
    pub factors: Vec<Factor<K>>,
}

impl<K: Key> Default for Addition<K> {
    fn default() -> Self {
        Self { nodes: BTreeSet::new(), unknown_scale: BTreeSet::new(), factors: Vec::new() }
    }
}

/// What an addition cost.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Update {
    /// Fronts eliminated anew, repeated ones counted again.
    pub eliminated: usize,
    /// Fronts in all, afterwards.
    pub fronts: usize,
    /// Factors linearised at a new place.
    pub relinearised: usize,
    /// Anchors whose estimate moved, new ones left out.
    pub moved: usize,
    /// Whether the elimination order was made afresh.
    pub reordered: bool,
    /// Whether every factor's linear model is good enough; otherwise call [`Incremental::settle`].
    pub settled: bool,
}

/// A component that grows.
#[derive(Debug)]
pub struct Incremental<K: Key> {
    model: Model<K>,
    tree: CliqueTree,
    /// Numbers a scalar that the factor held when its order was last made.
    fill: f64,
    /// What known anchors were before the change under way, once it moves them.
    saved: Option<Saved>,
}

#[derive(Debug)]
struct Saved {
    points: Vec<Sim3>,
    estimates: Vec<Sim3>,
    solution: Vec<f64>,
}

impl<K: Key> Incremental<K> {
    /// Takes over a solved component; `unknown_scale` as it was for [`super::graph::Graph::components`].
    ///
    /// # Errors
    /// [`IncrementalError::Underconstrained`] if the component's factorisation fails here.
    pub fn new(solution: Solution<K>, unknown_scale: &BTreeSet<K::Unit>) -> Result<Self, IncrementalError<K>> {
        let Solution { graph, values, pattern, factor, .. } = solution;
        drop((pattern, factor));
        let (mut model, mut tree) = (Model::default(), CliqueTree::default());
        let anchors = graph.nodes().len().saturating_sub(1);
        for (k, (&id, value)) in graph.nodes().iter().zip(values).enumerate() {
            model.push_node(id, value, k.checked_sub(1), graph.scale_of(k).map(|s| anchors + s));
        }
        for k in 0..anchors {
            model.owners.push(Owner::Anchor(k + 1));
            tree.add_variable(6);
        }
        let scales: BTreeSet<(usize, K::Unit)> =
            model.frames.iter().filter_map(|(&id, frame)| Some((frame.scale?, id))).collect();
        for (_, frame) in scales {
            model.owners.push(Owner::Scale(frame));
            tree.add_variable(1);
        }
        let frames = &model.frames;
        model.unknown_scale = unknown_scale.iter().filter(|frame| frames.contains_key(frame)).copied().collect();
        model.take_edges(graph.into_edges());
        model.edges.iter().for_each(|_| tree.add_term());
        let (variables, terms): (Vec<usize>, Vec<usize>) =
            ((0..model.owners.len()).collect(), (0..model.edges.len()).collect());
        let result = tree.revise(&model, (&[], &[]), (&variables, &terms));
        result.map_err(|error| named(&model, error))?;
        tree.accept();
        let mut out = Self { model, tree, fill: 0.0, saved: None };
        out.fill = out.fill_now();
        let moved = out.tree.substitute(MOVE_MIN);
        out.model.refresh(&out.tree, &moved);
        Ok(out)
    }

    /// The anchors with their estimates `t_world_anchor`: first the solution's, then in the order of addition.
    pub fn values(&self) -> impl ExactSizeIterator<Item = (K, &Sim3)> {
        self.model.nodes.iter().map(|node| node.id).zip(&self.model.estimates)
    }

    /// The estimate `t_world_anchor` of an anchor.
    pub fn value(&self, id: K) -> Option<&Sim3> {
        self.model.estimates.get(*self.model.index.get(&id)?)
    }

    /// Weighted sum of squared residuals.
    pub fn chi2(&self) -> f64 {
        self.model.chi2()
    }

    /// Bytes that the factorisation keeps.
    pub fn kept_bytes(&self) -> usize {
        self.tree.kept_count() * size_of::<f64>()
    }

    /// Adds anchors and factors and moves the estimate to where they are most probable.
    ///
    /// # Errors
    /// [`IncrementalError`]; the component is as it was then.
    pub fn add(&mut self, addition: Addition<K>) -> Result<Update, IncrementalError<K>> {
        let plan = self.model.plan(addition)?;
        self.reversibly(|this| this.grow(plan))
    }

    /// Linearises everything where it stands until no step lowers χ²: the minimum, as a batch solve has it. Returns the
    /// number of steps.
    ///
    /// # Errors
    /// [`IncrementalError`]; the component is as it was then.
    pub fn settle(&mut self) -> Result<usize, IncrementalError<K>> {
        self.reversibly(|this| {
            this.save();
            let mut chi2 = this.chi2();
            for step in 1..=STEPS_MAX {
                let all: Vec<usize> = (0..this.model.nodes.len()).collect();
                this.model.relinearise(&mut this.tree, &all);
                let variables = this.tree.eliminated();
                this.tree.revise(&this.model, (&variables, &[]), (&[], &[]))?;
                let threshold = DECREASE_MIN * (1.0 + chi2);
                let promised = this.tree.decrease();
                let moved = this.tree.substitute(0.0);
                this.model.refresh(&this.tree, &moved);
                let next = this.chi2();
                if next.is_nan() || next > chi2 + threshold {
                    return Err(Failure::Diverged);
                }
                chi2 = next;
                if promised <= threshold {
                    this.fill = this.fill_now();
                    return Ok(step);
                }
            }
            Err(Failure::Diverged)
        })
    }

    /// `t_i_j` between two anchors with the covariance of its local perturbation, as [`Solution::relative`] has it,
    /// drawn at the linearisation points. `None` for anchors that are not here.
    pub fn relative(&self, i: K, j: K, unknown_scale: &BTreeSet<K::Unit>) -> Option<Relative> {
        let model = &self.model;
        let (a, b) = (*model.index.get(&i)?, *model.index.get(&j)?);
        if a == b {
            return Some(Relative::Metric(certain()));
        }
        let t_i_j = model.estimates[a].inverse() * model.estimates[b];
        let mut rows = Vec::with_capacity(14);
        for (node, by_local) in [(a, -t_i_j.inverse().adjoint()), (b, Matrix7::identity())] {
            let by_delta = by_local * model.local_by_delta(&self.tree, node);
            let node = &model.nodes[node];
            rows.extend(node.anchor.iter().flat_map(|&v| (0..6).map(move |k| (v, k, by_delta.column(k).into_owned()))));
            rows.extend(node.scale.map(|v| (v, 0, by_delta.column(6).into_owned())));
        }
        relation(t_i_j, self.tree.covariance(&rows), is_rigid(i.unit(), j.unit(), unknown_scale))
    }

    /// Does something, or leaves everything as it was.
    fn reversibly<T>(
        &mut self,
        change: impl FnOnce(&mut Self) -> Result<T, Failure>,
    ) -> Result<T, IncrementalError<K>> {
        let model = &self.model;
        let sizes = (model.nodes.len(), model.edges.len(), model.owners.len());
        let (before, fill): (Before, f64) = (self.tree.before(), self.fill);
        let result = change(self);
        let saved = self.saved.take();
        let failure = match result {
            Ok(out) => {
                self.tree.accept();
                return Ok(out);
            }
            Err(failure) => failure,
        };
        let error = match failure {
            Failure::Solve(error) => named(&self.model, error),
            Failure::Diverged => IncrementalError::Diverged,
        };
        let solution = saved.map(|Saved { points, estimates, solution }| {
            (self.model.points, self.model.estimates) = (points, estimates);
            solution
        });
        self.tree.reject(before, solution);
        self.model.truncate(sizes.0, sizes.1, sizes.2);
        self.fill = fill;
        Err(error)
    }

    /// To be called before known anchors move.
    fn save(&mut self) {
        let Self { model, tree, .. } = self;
        self.saved.get_or_insert_with(|| Saved {
            points: model.points.clone(),
            estimates: model.estimates.clone(),
            solution: tree.solutions().to_vec(),
        });
    }

    fn grow(&mut self, plan: Plan<K>) -> Result<Update, Failure> {
        let (known, known_edges) = (self.model.nodes.len(), self.model.edges.len());
        let hung: Vec<(usize, usize)> = plan.hung.iter().map(|(n, e)| (known + n, known_edges + e)).collect();
        let mut is_hung = vec![false; plan.nodes.len() + plan.edges.len()];
        for (node, edge) in &plan.hung {
            (is_hung[*node], is_hung[plan.nodes.len() + edge]) = (true, true);
        }
        let (mut variables, terms) = self.push(plan);
        variables.retain(|&v| !matches!(self.model.owners[v], Owner::Anchor(node) if is_hung[node - known]));
        let nodes = self.model.nodes.len() - known;
        let terms: Vec<usize> = terms.filter(|term| !is_hung[nodes + term - known_edges]).collect();
        let mut update = Update::default();
        let mut moved = Vec::new();
        if !terms.is_empty() {
            moved = self.revise(&mut update, &[], &variables, &terms)?;
        }
        for (node, edge) in hung {
            let Some(variable) = self.model.nodes[node].anchor else { continue };
            if self.tree.hang(&self.model, variable, edge)? {
                update.eliminated += 1;
                moved.extend(self.model.refresh(&self.tree, &[variable]));
            } else {
                moved.extend(self.revise(&mut update, &[], &[variable], &[edge])?);
            }
        }
        self.follow(&mut update, moved)?;
        update.moved = update.moved.min(known);
        if update.eliminated > nodes && self.fill_now() > FILL_GROWTH_MAX * self.fill {
            self.save();
            let all = self.tree.eliminated();
            update.eliminated += self.tree.revise(&self.model, (&all, &[]), (&[], &[]))?;
            let moved = self.tree.substitute(MOVE_MIN);
            self.model.refresh(&self.tree, &moved);
            self.fill = self.fill_now();
            update.reordered = true;
        }
        update.fronts = self.tree.cliques();
        Ok(update)
    }

    /// Appends anchors, scales and factors; returns the new variables and terms.
    fn push(&mut self, plan: Plan<K>) -> (Vec<usize>, core::ops::Range<usize>) {
        let Self { model, tree, .. } = self;
        let (first_variable, first_term) = (model.owners.len(), model.edges.len());
        model.unknown_scale.extend(&plan.scales);
        for (id, point) in plan.nodes {
            let is_new_scale = plan.scales.contains(&id.unit()) && !model.frames.contains_key(&id.unit());
            let scale = is_new_scale.then(|| {
                model.owners.push(Owner::Scale(id.unit()));
                tree.add_variable(1)
            });
            model.owners.push(Owner::Anchor(model.nodes.len()));
            let anchor = tree.add_variable(6);
            model.push_node(id, point, Some(anchor), scale);
        }
        for edge in plan.edges {
            model.push_edge(edge);
            tree.add_term();
        }
        ((first_variable..model.owners.len()).collect(), first_term..model.edges.len())
    }

    /// Eliminates what factors touch and moves the estimate; returns the anchors that moved.
    fn revise(
        &mut self,
        update: &mut Update,
        dirty: &[usize],
        new_variables: &[usize],
        new_terms: &[usize],
    ) -> Result<Vec<usize>, Failure> {
        self.save();
        let touched: Vec<usize> = new_terms
            .iter()
            .flat_map(|&term| super::sparse::Terms::variables(&self.model, term).collect::<Vec<_>>())
            .collect();
        update.eliminated += self.tree.revise(&self.model, (&touched, dirty), (new_variables, new_terms))?;
        let mut moved = self.tree.substitute(MOVE_MIN);
        moved.extend_from_slice(new_variables);
        Ok(self.model.refresh(&self.tree, &moved))
    }

    /// Linearises anew what has aged by the anchors that moved, until nothing has.
    fn follow(&mut self, update: &mut Update, mut moved: Vec<usize>) -> Result<(), Failure> {
        for _ in 0..PASSES_MAX {
            update.moved = update.moved.max(moved.len());
            let aged = self.model.aged(&self.tree, &moved);
            if aged.is_empty() {
                update.settled = true;
                return Ok(());
            }
            self.save();
            let dirty = self.model.relinearise_around(&mut self.tree, aged);
            update.relinearised += dirty.len();
            moved = self.revise(update, &dirty, &[], &[])?;
        }
        Ok(())
    }

    /// Numbers a scalar that the factor holds.
    fn fill_now(&self) -> f64 {
        self.tree.value_count() as f64 / self.tree.scalars().max(1) as f64
    }
}

/// Why a change is to be undone.
enum Failure {
    Solve(SolveError),
    Diverged,
}

impl From<SolveError> for Failure {
    fn from(error: SolveError) -> Self {
        Self::Solve(error)
    }
}

/// An error in terms of anchors and frames.
fn named<K: Key>(model: &Model<K>, error: SolveError) -> IncrementalError<K> {
    let owner = match error {
        SolveError::Underconstrained { variable } => model.owners.get(variable),
        _ => None,
    };
    match owner {
        Some(&Owner::Anchor(node)) => IncrementalError::Underconstrained(model.nodes[node].id),
        Some(&Owner::Scale(frame)) => IncrementalError::UnderconstrainedScale(frame),
        None => IncrementalError::Solve(error),
    }
}
