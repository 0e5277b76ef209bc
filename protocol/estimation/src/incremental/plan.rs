//! What an addition means for a component: decides whether it fits, where its anchors start, and which of them merely
//! hang below what is known.

use super::super::graph::{Edge, Factor, Key, canonical};
use super::model::Model;
use super::{Addition, IncrementalError};
use crate::geometry::Sim3;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// An addition that fits.
pub(super) struct Plan<K: Key> {
    /// New anchors, ascending, with their linearisation points.
    pub(super) nodes: Vec<(K, Sim3)>,
    /// New frames whose scale is a variable.
    pub(super) scales: BTreeSet<K::Unit>,
    /// New factors, their ends numbered after the known anchors.
    pub(super) edges: Vec<Edge<K>>,
    /// New anchors that one rigid factor alone ties to those before: (place in `nodes`, place in `edges`), in the order
    /// in which they can be hung.
    pub(super) hung: Vec<(usize, usize)>,
}

impl<K: Key> Model<K> {
    /// Checks an addition against what is known.
    pub(super) fn plan(&self, addition: Addition<K>) -> Result<Plan<K>, IncrementalError<K>> {
        let Addition { nodes: ids, unknown_scale, mut factors } = addition;
        if let Some(&id) = ids.iter().find(|id| self.index.contains_key(id)) {
            return Err(IncrementalError::Known(id));
        }
        let scales = self.new_scales(&ids, &unknown_scale)?;
        let unknown: BTreeSet<K::Unit> = self.unknown_scale.union(&unknown_scale).copied().collect();
        let known = self.nodes.len();
        let ids: Vec<K> = ids.into_iter().collect();
        let number = |id: K| {
            let new = || ids.binary_search(&id).ok().map(|k| known + k);
            self.index.get(&id).copied().or_else(new)
        };
        factors.sort_by(canonical);
        let edge = |factor: Factor<K>| Edge::new(factor, number, &unknown);
        let edges = factors.into_iter().map(edge).collect::<Result<Vec<Edge<K>>, _>>()?;
        let starts = self.starts(&ids, &edges)?;
        let hung = hung(known, ids.len(), &edges);
        Ok(Plan { nodes: ids.into_iter().zip(starts).collect(), scales, edges, hung })
    }

    /// The new frames of unknown scale.
    fn new_scales(
        &self,
        ids: &BTreeSet<K>,
        unknown_scale: &BTreeSet<K::Unit>,
    ) -> Result<BTreeSet<K::Unit>, IncrementalError<K>> {
        let turned = |frame: &&K::Unit| self.frames.contains_key(frame) && !self.unknown_scale.contains(frame);
        if let Some(&frame) = unknown_scale.iter().find(turned) {
            return Err(IncrementalError::Unit(frame));
        }
        let new: BTreeSet<K::Unit> = ids.iter().map(|id| id.unit()).filter(|f| !self.frames.contains_key(f)).collect();
        // Where no frame is metric, one of unknown scale gives the unit; a metric one would contradict it.
        let is_unit = |(frame, known): (&K::Unit, &super::model::Frame)| {
            known.scale.is_none() && self.unknown_scale.contains(frame)
        };
        let metric = new.iter().find(|frame| !unknown_scale.contains(frame));
        if let (true, Some(&frame)) = (self.frames.iter().any(is_unit), metric) {
            return Err(IncrementalError::Unit(frame));
        }
        Ok(new.intersection(unknown_scale).copied().collect())
    }

    /// Each new anchor by way of the first factor that ties it to a known one, or to one reached before.
    fn starts(&self, ids: &[K], edges: &[Edge<K>]) -> Result<Vec<Sim3>, IncrementalError<K>> {
        let known = self.nodes.len();
        let mut edges_of = vec![Vec::new(); ids.len()];
        let mut queue = VecDeque::new();
        for (k, edge) in edges.iter().enumerate() {
            for node in [edge.i, edge.j] {
                match node.checked_sub(known) {
                    Some(new) => edges_of[new].push(k),
                    None => queue.push_back(k),
                }
            }
        }
        let mut estimates: Vec<Option<Sim3>> = vec![None; ids.len()];
        let mut frame_scales: BTreeMap<K::Unit, f64> = BTreeMap::new();
        while let Some(k) = queue.pop_front() {
            let edge = &edges[k];
            let value = |node: usize| match node.checked_sub(known) {
                Some(new) => estimates[new],
                None => Some(self.estimates[node]),
            };
            let t_i_j = edge.mean();
            let (new, mut reached) = match (value(edge.i), value(edge.j)) {
                (Some(i), None) => (edge.j - known, i * t_i_j),
                (None, Some(j)) => (edge.i - known, j * t_i_j.inverse()),
                _ => continue,
            };
            // A rigid factor between frames of one unit says nothing of that unit: the other end's holds.
            let frame = ids[new].unit();
            let of_known = || self.frames.get(&frame).and_then(|f| f.nodes.first()).map(|&n| self.estimates[n].scale);
            let scale = frame_scales.get(&frame).copied().or_else(of_known).unwrap_or(reached.scale);
            frame_scales.insert(frame, scale);
            reached.scale = scale;
            estimates[new] = Some(reached);
            queue.extend(&edges_of[new]);
        }
        let point = |(&id, value): (&K, Option<Sim3>)| {
            let mut value = value.ok_or(IncrementalError::Loose(id))?;
            // A known frame's anchors are linearised at one scale.
            if let Some(&first) = self.frames.get(&id.unit()).and_then(|frame| frame.nodes.first()) {
                value.scale = self.points[first].scale;
            }
            Ok(value)
        };
        ids.iter().zip(estimates).map(point).collect()
    }
}

/// Peels off new anchors that a single rigid factor ties to the rest.
fn hung<K: Key>(known: usize, count: usize, edges: &[Edge<K>]) -> Vec<(usize, usize)> {
    let mut edges_of = vec![Vec::new(); count];
    for (k, edge) in edges.iter().enumerate() {
        for new in [edge.i, edge.j].into_iter().filter_map(|node| node.checked_sub(known)) {
            edges_of[new].push(k);
        }
    }
    let mut is_peeled = vec![false; edges.len()];
    let mut degree: Vec<usize> = edges_of.iter().map(Vec::len).collect();
    let mut queue: VecDeque<usize> = (0..count).filter(|&new| degree[new] == 1).collect();
    let mut out = Vec::new();
    while let Some(new) = queue.pop_front() {
        let Some(&k) = edges_of[new].iter().find(|&&k| !is_peeled[k]) else { continue };
        let edge = &edges[k];
        if !edge.is_rigid() {
            continue;
        }
        is_peeled[k] = true;
        out.push((new, k));
        let other = if edge.i == known + new { edge.j } else { edge.i };
        if let Some(other) = other.checked_sub(known) {
            degree[other] -= 1;
            if degree[other] == 1 {
                queue.push_back(other);
            }
        }
    }
    out.reverse();
    out
}
