//! The nonlinear side: where each factor is linearised, and when that is no longer good enough.
//!
//! An anchor's estimate is its linearisation point moved by δ: `R exp(φ)`, `p + s R ρ`. Moved so, a whole robot's
//! translation is linear exactly, and only rotations age a linearisation.

use super::super::graph::{Edge, Key};
use super::super::solve::{Part, RigidTerm, columns, parts_of};
use super::super::sparse::{CliqueTree, Sum, Terms};
use crate::geometry::sim3::{Matrix7, Vector7};
use crate::geometry::{Sim3, So3, so3};
use nalgebra::{SMatrix, Vector3};
use std::collections::{BTreeMap, BTreeSet};

/// An anchor is linearised anew when it has turned further than this (rad): its Jacobians are off by half that share.
pub(super) const ROTATION_MAX: f64 = 0.02;
/// Both ends of a factor are, when the linear residual is off by more than so many standard deviations.
pub(super) const DEFECT_MAX: f64 = 0.01;

/// Anchors, factors and linearisation points of one component.
#[derive(Debug)]
pub(super) struct Model<K: Key> {
    pub(super) nodes: Vec<Node<K>>,
    pub(super) index: BTreeMap<K, usize>,
    pub(super) unknown_scale: BTreeSet<K::Unit>,
    pub(super) frames: BTreeMap<K::Unit, Frame>,
    pub(super) edges: Vec<Edge<K>>,
    /// By node: where its factors are linearised.
    pub(super) points: Vec<Sim3>,
    pub(super) estimates: Vec<Sim3>,
    /// By variable.
    pub(super) owners: Vec<Owner<K::Unit>>,
}

#[derive(Debug)]
pub(super) struct Node<K> {
    pub(super) id: K,
    /// Its variable; `None` for the anchor held fixed.
    pub(super) anchor: Option<usize>,
    /// The scale variable of its frame.
    pub(super) scale: Option<usize>,
    pub(super) edges: Vec<usize>,
}

#[derive(Debug)]
pub(super) struct Frame {
    /// Its scale variable; `None` where the unit is fixed.
    pub(super) scale: Option<usize>,
    pub(super) nodes: Vec<usize>,
}

/// Whose variable it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Owner<U> {
    Anchor(usize),
    Scale(U),
}

impl<K: Key> Default for Model<K> {
    fn default() -> Self {
        Self {
            nodes: Vec::new(),
            index: BTreeMap::new(),
            unknown_scale: BTreeSet::new(),
            frames: BTreeMap::new(),
            edges: Vec::new(),
            points: Vec::new(),
            estimates: Vec::new(),
            owners: Vec::new(),
        }
    }
}

impl<K: Key> Model<K> {
    /// An anchor with its estimate as linearisation point; a new frame in `unknown_scale` has `scale` as its variable.
    pub(super) fn push_node(&mut self, id: K, point: Sim3, anchor: Option<usize>, scale: Option<usize>) {
        let node = self.nodes.len();
        let frame = self.frames.entry(id.unit()).or_insert_with(|| Frame { scale, nodes: Vec::new() });
        frame.nodes.push(node);
        self.index.insert(id, node);
        self.nodes.push(Node { id, anchor, scale: frame.scale, edges: Vec::new() });
        self.points.push(point);
        self.estimates.push(point);
    }

    /// The factors that there are at first, which are too many to be moved.
    pub(super) fn take_edges(&mut self, edges: Vec<Edge<K>>) {
        for (k, edge) in edges.iter().enumerate() {
            [edge.i, edge.j].into_iter().for_each(|node| self.nodes[node].edges.push(k));
        }
        self.edges = edges;
    }

    pub(super) fn push_edge(&mut self, edge: Edge<K>) {
        for node in [edge.i, edge.j] {
            self.nodes[node].edges.push(self.edges.len());
        }
        self.edges.push(edge);
    }

    /// Forgets all but the first anchors, factors and variables.
    pub(super) fn truncate(&mut self, nodes: usize, edges: usize, variables: usize) {
        for node in self.nodes.drain(nodes..) {
            self.index.remove(&node.id);
            if let Some(frame) = self.frames.get_mut(&node.id.unit()) {
                frame.nodes.retain(|&k| k < nodes);
            }
        }
        let frames = &mut self.frames;
        frames.retain(|_, frame| !frame.nodes.is_empty());
        self.unknown_scale.retain(|frame| frames.contains_key(frame));
        for edge in self.edges.drain(edges..) {
            for node in [edge.i, edge.j].into_iter().filter(|&node| node < nodes) {
                self.nodes[node].edges.retain(|&k| k < edges);
            }
        }
        self.points.truncate(nodes);
        self.estimates.truncate(nodes);
        self.owners.truncate(variables);
    }

    /// Weighted sum of squared residuals at the estimates.
    pub(super) fn chi2(&self) -> f64 {
        self.edges.iter().map(|edge| edge.chi2(&self.estimates)).sum()
    }

    /// Moves the estimates of what the variables belong to; returns those anchors, ascending.
    pub(super) fn refresh(&mut self, tree: &CliqueTree, variables: &[usize]) -> Vec<usize> {
        let mut nodes = Vec::with_capacity(variables.len());
        for &variable in variables {
            match self.owners[variable] {
                Owner::Anchor(node) => nodes.push(node),
                Owner::Scale(frame) => nodes.extend(self.frames.get(&frame).into_iter().flat_map(|f| &f.nodes)),
            }
        }
        nodes.sort_unstable();
        nodes.dedup();
        for &node in &nodes {
            let (point, (rho, phi, lambda)) = (self.points[node], self.delta(tree, node));
            let translation = point.translation + point.rotation * rho * point.scale;
            let scale = if lambda == 0.0 { point.scale } else { point.scale * libm::exp(lambda) };
            self.estimates[node] = Sim3::new(point.rotation * So3::exp(&phi), translation, scale);
        }
        nodes
    }

    /// δ of an anchor: ρ, φ and that of its scale.
    pub(super) fn delta(&self, tree: &CliqueTree, node: usize) -> (Vector3<f64>, Vector3<f64>, f64) {
        let Node { anchor, scale, .. } = self.nodes[node];
        let lambda = scale.and_then(|v| tree.solution(v).first()).copied().unwrap_or(0.0);
        match anchor.map(|v| tree.solution(v)) {
            Some(&[a, b, c, d, e, f]) => (Vector3::new(a, b, c), Vector3::new(d, e, f), lambda),
            _ => (Vector3::zeros(), Vector3::zeros(), lambda),
        }
    }

    /// Those of `nodes`, and of the ends of factors at them, whose linearisation has aged.
    pub(super) fn aged(&self, tree: &CliqueTree, nodes: &[usize]) -> Vec<usize> {
        let mut edges: Vec<usize> = nodes.iter().flat_map(|&node| &self.nodes[node].edges).copied().collect();
        edges.sort_unstable();
        edges.dedup();
        let turned = |&&node: &&usize| self.delta(tree, node).1.norm() > ROTATION_MAX;
        let mut aged: Vec<usize> = nodes.iter().filter(turned).copied().collect();
        for edge in edges.into_iter().map(|k| &self.edges[k]) {
            if self.defect_bound(tree, edge).is_some_and(|bound| bound <= DEFECT_MAX) {
                continue;
            }
            let defect = self.defect(tree, edge);
            if defect > DEFECT_MAX || defect.is_nan() {
                aged.extend([edge.i, edge.j]);
            }
        }
        aged
    }

    /// Moves the linearisation points of aged anchors to their estimates, and of their neighbours as far as they would
    /// age by that: two that moved as one are linear only together. Returns the factors that are linearised anew,
    /// ascending.
    pub(super) fn relinearise_around(&mut self, tree: &mut CliqueTree, mut aged: Vec<usize>) -> Vec<usize> {
        let mut edges = BTreeSet::new();
        while !aged.is_empty() {
            let moved = self.relinearise(tree, &aged);
            edges.extend(moved.iter().flat_map(|&node| &self.nodes[node].edges));
            aged = self.aged(tree, &moved);
        }
        edges.into_iter().collect()
    }

    /// Moves the linearisation points of `nodes` to their estimates, and those of their frames where the scale has
    /// moved. Returns all whose point moved, ascending.
    pub(super) fn relinearise(&mut self, tree: &mut CliqueTree, nodes: &[usize]) -> Vec<usize> {
        let mut all: BTreeSet<usize> = nodes.iter().copied().collect();
        let frames: BTreeSet<K::Unit> = nodes.iter().map(|&node| self.nodes[node].id.unit()).collect();
        for frame in frames.iter().filter_map(|frame| self.frames.get(frame)) {
            if let Some(scale) = frame.scale.filter(|&v| tree.solution(v) != [0.0]) {
                all.extend(&frame.nodes);
                tree.clear_solution(scale);
            }
        }
        for &node in &all {
            self.points[node] = self.estimates[node];
            self.nodes[node].anchor.into_iter().for_each(|v| tree.clear_solution(v));
        }
        all.into_iter().collect()
    }

    /// What [`Model::defect`] cannot much exceed, at a tenth of its cost: the terms of second order, each as large as
    /// it can be. `None` where scales moved.
    pub(super) fn defect_bound(&self, tree: &CliqueTree, edge: &Edge<K>) -> Option<f64> {
        let ((rho_i, phi_i, scale_i), (rho_j, phi_j, scale_j)) = (self.delta(tree, edge.i), self.delta(tree, edge.j));
        if scale_i != 0.0 || scale_j != 0.0 {
            return None;
        }
        let (turn, shift) = (phi_i.norm() + phi_j.norm(), rho_i.norm() + rho_j.norm());
        let length = 1.0 + edge.mean().translation.norm();
        Some(edge.information_trace().sqrt() * turn * (shift + turn * length))
    }

    /// By how many standard deviations the linear residual is off.
    pub(super) fn defect(&self, tree: &CliqueTree, edge: &Edge<K>) -> f64 {
        let at = edge.linearise(&self.points);
        let tangent = |node: usize| {
            let (rho, phi, lambda) = self.delta(tree, node);
            Vector7::from([rho.x, rho.y, rho.z, phi.x, phi.y, phi.z, lambda])
        };
        let linear = at.residual + at.by_i * tangent(edge.i) + at.by_j * tangent(edge.j);
        let off = edge.residual(&self.estimates) - linear;
        off.dot(&(edge.information() * off)).max(0.0).sqrt()
    }

    /// How the local perturbation of an anchor's estimate follows from that of its δ.
    pub(super) fn local_by_delta(&self, tree: &CliqueTree, node: usize) -> Matrix7 {
        let (_, phi, lambda) = self.delta(tree, node);
        let mut out = Matrix7::identity();
        let turned_back = So3::exp(&-phi).matrix() * libm::exp(-lambda);
        out.fixed_view_mut::<3, 3>(0, 0).copy_from(&turned_back);
        out.fixed_view_mut::<3, 3>(3, 3).copy_from(&so3::left_jacobian(&-phi));
        out
    }

    fn parts(&self, edge: &Edge<K>) -> [Option<(usize, Part)>; 4] {
        let end = |node: usize| (self.nodes[node].anchor, self.nodes[node].scale);
        parts_of(end(edge.i), end(edge.j))
    }
}

impl<K: Key> Terms for Model<K> {
    fn variables(&self, term: usize) -> impl Iterator<Item = usize> {
        self.parts(&self.edges[term]).into_iter().flatten().map(|(variable, _)| variable)
    }

    fn add(&self, term: usize, sum: &mut Sum<'_>) {
        let edge = &self.edges[term];
        let parts = self.parts(edge);
        if let [i, j, None, None] = parts {
            let (i, j) = (i.map(|(v, _)| v), j.map(|(v, _)| v));
            let term = RigidTerm::new(edge, &self.points);
            if let Some(j) = j {
                sum.block(j, j, &term.jj);
                sum.rhs(j, (-term.gradient_j).iter());
            }
            if let Some(i) = i {
                sum.block(i, i, &term.ii);
                sum.rhs(i, (-term.gradient_i).iter());
            }
            if let Some((i, j)) = i.zip(j) {
                sum.block(j, i, &term.ji);
            }
            return;
        }
        let at = edge.linearise(&self.points);
        let information = edge.information();
        let weighted = information * at.residual;
        let of = |(variable, part): (usize, Part)| (variable, part.size(), columns(part, &at.by_i, &at.by_j));
        let parts: Vec<(usize, usize, SMatrix<f64, 7, 6>)> = parts.into_iter().flatten().map(of).collect();
        for (k, (p, size, jacobian)) in parts.iter().enumerate() {
            let gradient = -(jacobian.transpose() * weighted);
            sum.rhs(*p, gradient.iter().take(*size));
            let left = jacobian.transpose() * information;
            for (q, other, by_other) in &parts[k..] {
                sum.block(*p, *q, &(left * by_other).view((0, 0), (*size, *other)));
            }
        }
    }
}
