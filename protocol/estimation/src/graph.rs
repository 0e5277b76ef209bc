//! The factor graph: which nodes are tied by which relative measurements, in one canonical order.
//!
//! Nodes are poses `t_world_node`, such as submaps' anchors; each is a similarity whose scale is shared by all nodes of
//! its unit ([`Key::Unit`], such as a frame) and is 1 where that is the metre. A factor's residual is `r = log(t_i_j⁻¹
//! X_i⁻¹ X_j)`, whose covariance is the measurement's own (MATH §1: local perturbations), with the exact Jacobians of
//! MATH §2: `∂r/∂δ_j = J_r⁻¹(r)`, `∂r/∂δ_i = −J_l⁻¹(r) Ad(t_i_j⁻¹)`. Gauge: the smallest node of a component is held
//! fixed.

mod correlation;
mod edge;
mod key;

use crate::geometry::Relative;
use std::collections::{BTreeMap, BTreeSet};

pub(crate) use correlation::{CorrelatedResidual, Correlation};
pub(crate) use edge::Edge;
pub use key::{GraphError, Key, Source};

/// Room is made for one factor more to so many that a graph has: what it grows by at first needs no copy of them all.
const FACTORS_SPARE: usize = 16;

/// A relative measurement between two nodes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Factor<K: Key> {
    /// Its origin.
    pub label: K::Label,
    /// Target node.
    pub i: K,
    /// Source node.
    pub j: K,
    /// `t_i_j`, lengths in `i`'s unit.
    pub t_i_j: Relative,
    /// Multiplies the information; positive.
    pub weight: f64,
}

/// One connected component, ready to be solved.
#[derive(Clone, Debug)]
pub struct Graph<K: Key> {
    nodes: Vec<K>,
    /// Per node, its scale variable among [`Graph::scale_count`]; `None` where the unit is fixed.
    scales: Vec<Option<usize>>,
    scale_count: usize,
    factors: Vec<Edge<K>>,
    /// Of factors that follow others, by their place.
    pub(super) correlations: BTreeMap<usize, Correlation>,
}

impl<K: Key> Graph<K> {
    /// Splits nodes and factors into connected components, ordered by their smallest node. Any input order of
    /// `factors` gives the same components, to the bit.
    ///
    /// Units in `unknown_scale` get a scale variable, except the first unit of a component without a metric one: it is
    /// the component's.
    ///
    /// # Errors
    /// [`GraphError`] for the first factor, in canonical order, that cannot be used.
    pub fn components(
        nodes: &BTreeSet<K>,
        unknown_scale: &BTreeSet<K::Unit>,
        factors: Vec<Factor<K>>,
    ) -> Result<Vec<Self>, GraphError<K>> {
        // Their numbers are sorted, because they themselves are large.
        let mut order: Vec<usize> = (0..factors.len()).collect();
        order.sort_by(|&a, &b| canonical(&factors[a], &factors[b]));
        let index: BTreeMap<K, usize> = nodes.iter().enumerate().map(|(k, &id)| (id, k)).collect();
        let mut sets = Disjoint::new(nodes.len());
        let mut edges = Vec::with_capacity(factors.len() + factors.len() / FACTORS_SPARE);
        for factor in order.into_iter().map(|k| factors[k]) {
            let edge = Edge::new(factor, |id| index.get(&id).copied(), unknown_scale)?;
            sets.join(edge.i, edge.j);
            edges.push(edge);
        }
        drop(factors);
        let mut members: BTreeMap<usize, Vec<K>> = BTreeMap::new();
        let mut local = Vec::with_capacity(nodes.len());
        for (k, &id) in nodes.iter().enumerate() {
            let list = members.entry(sets.root(k)).or_default();
            local.push(list.len());
            list.push(id);
        }
        let mut edges_of: BTreeMap<usize, Vec<Edge<K>>> = BTreeMap::new();
        if let Some(&root) = members.keys().next().filter(|_| members.len() == 1) {
            edges_of.insert(root, core::mem::take(&mut edges));
        }
        for mut edge in edges {
            let root = sets.root(edge.i);
            (edge.i, edge.j) = (local[edge.i], local[edge.j]);
            edges_of.entry(root).or_default().push(edge);
        }
        let component = |(root, nodes): (usize, Vec<K>)| {
            let (scales, scale_count) = scale_variables(&nodes, unknown_scale);
            let factors = edges_of.remove(&root).unwrap_or_default();
            Self { nodes, scales, scale_count, factors, correlations: BTreeMap::new() }
        };
        Ok(members.into_iter().map(component).collect())
    }

    /// The nodes, ascending. The first is held fixed.
    pub fn nodes(&self) -> &[K] {
        &self.nodes
    }

    /// The factors in canonical order.
    pub fn factors(&self) -> impl ExactSizeIterator<Item = Factor<K>> + '_ {
        let factor = |e: &Edge<K>| {
            let (i, j) = (self.nodes[e.i], self.nodes[e.j]);
            Factor { label: e.label, i, j, t_i_j: e.t_i_j(), weight: e.weight }
        };
        self.factors.iter().map(factor)
    }

    /// Number of scale variables.
    pub fn scale_count(&self) -> usize {
        self.scale_count
    }

    /// The place of a node in [`Graph::nodes`].
    pub fn position(&self, id: K) -> Option<usize> {
        self.nodes.binary_search(&id).ok()
    }

    /// The scale variable of a node.
    pub(super) fn scale_of(&self, node: usize) -> Option<usize> {
        self.scales[node]
    }

    pub(super) fn edges(&self) -> &[Edge<K>] {
        &self.factors
    }

    /// Without what bends them.
    pub(super) fn into_edges(self) -> Vec<Edge<K>> {
        self.factors
    }
}

/// Finite, of unit rotation and positive scale.
pub(super) fn is_usable(t: &Relative) -> bool {
    let s = t.sim();
    let norm = s.rotation.xyzw().iter().map(|x| x * x).sum::<f64>();
    s.translation.iter().all(|x| x.is_finite()) && (norm - 1.0).abs() < 1e-6 && s.scale.is_finite() && s.scale > 0.0
}

/// Total order of factors that depends on nothing but their content.
pub(super) fn canonical<K: Key>(a: &Factor<K>, b: &Factor<K>) -> core::cmp::Ordering {
    (a.i, a.j, a.label).cmp(&(b.i, b.j, b.label)).then_with(|| content_order(&a.t_i_j, &b.t_i_j))
}

/// Total order of measurements by their numbers.
pub(super) fn content_order(a: &Relative, b: &Relative) -> core::cmp::Ordering {
    let (a, b) = (numbers_of(a), numbers_of(b));
    let by_number = a.iter().zip(&b).map(|(x, y)| x.total_cmp(y)).find(|o| o.is_ne());
    by_number.unwrap_or_else(|| a.len().cmp(&b.len()))
}

/// All that a measurement says.
pub(super) fn numbers_of(t: &Relative) -> Vec<f64> {
    let s = t.sim();
    let mut out: Vec<f64> = s.translation.iter().copied().chain(s.rotation.xyzw()).collect();
    out.push(s.scale);
    match t {
        Relative::Metric(p) => out.extend(p.covariance.matrix().iter()),
        Relative::Similarity(q) => out.extend(q.covariance.matrix().iter()),
    }
    out
}

/// Whether a relation between nodes of two units is rigid.
pub(super) fn is_rigid<U: Ord>(a: U, b: U, unknown_scale: &BTreeSet<U>) -> bool {
    a == b || !(unknown_scale.contains(&a) || unknown_scale.contains(&b))
}

/// The scale variable of each node and their number.
fn scale_variables<K: Key>(nodes: &[K], unknown: &BTreeSet<K::Unit>) -> (Vec<Option<usize>>, usize) {
    let units: BTreeSet<K::Unit> = nodes.iter().map(|n| n.unit()).collect();
    let any_metric = units.iter().any(|u| !unknown.contains(u));
    let free = units.iter().filter(|u| unknown.contains(u)).skip(usize::from(!any_metric));
    let variable: BTreeMap<K::Unit, usize> = free.enumerate().map(|(k, &u)| (u, k)).collect();
    (nodes.iter().map(|n| variable.get(&n.unit()).copied()).collect(), variable.len())
}

/// Union-find whose roots are the smallest members.
pub(super) struct Disjoint(Vec<usize>);

impl Disjoint {
    pub(super) fn new(n: usize) -> Self {
        Self((0..n).collect())
    }

    pub(super) fn root(&mut self, mut k: usize) -> usize {
        while self.0[k] != k {
            self.0[k] = self.0[self.0[k]];
            k = self.0[k];
        }
        k
    }

    /// Whether the two were apart.
    pub(super) fn join(&mut self, a: usize, b: usize) -> bool {
        let (a, b) = (self.root(a), self.root(b));
        self.0[a.max(b)] = a.min(b);
        a != b
    }
}
