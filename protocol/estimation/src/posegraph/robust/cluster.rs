//! Parts that no two of them can tell to be one, but several together can: robots with two closures or so to each of
//! their neighbours.
//!
//! A pair merges on at least so many closures because fewer that agree are too easily brought about by places that look
//! alike. What that rule asks of two parts it asks of every cut through a merged map: that so many closures cross it
//! which agree with all the rest. So merges on fewer closures are tried in a copy of the world, where what contradicts
//! them drops out and what agrees is let in; of what becomes one there, the clusters that no cut of fewer closures
//! divides stand. Closures of more than one pair of parts must cross each cut: what a pair says by itself was asked
//! before.

use super::world::World;
use crate::ids::FrameId;
use std::collections::{BTreeMap, BTreeSet};

/// Fewest closures that agree with each other.
const CLOSURES_MIN: usize = 2;
/// Fewest pairs of parts whose closures cross a cut.
const PAIRS_MIN: usize = 2;
/// Parts tied together at most: of more, each of which few closures tie, nobody says in time what belongs together.
const CLUSTER_MAX: usize = 256;
/// log10 of the false alarms of a merge that is only tried: what a cluster rests on are its cuts.
const LOG10_NFA_MAX: f64 = -1.5;

impl World<'_> {
    /// Merges clusters of parts; whether anything was.
    pub(super) fn merge_together(&mut self) -> bool {
        if self.parts.len() < 3 {
            return false;
        }
        let part_of: BTreeMap<FrameId, usize> =
            self.parts.iter().enumerate().flat_map(|(k, p)| p.frames.iter().map(move |&f| (f, k))).collect();
        let mut trial = self.clone();
        let mut merges = 0;
        while merges < self.parts.len() && trial.merge_on(CLOSURES_MIN, LOG10_NFA_MAX) {
            trial.settle();
            merges += 1;
        }
        if merges == 0 {
            return false;
        }
        // Frames that could not be solved are in no part.
        let ends = |k: usize| {
            let c = &trial.closures[k];
            Some((*part_of.get(&c.i.frame)?, *part_of.get(&c.j.frame)?))
        };
        let used = (0..trial.closures.len()).filter(|&k| trial.closures[k].is_used());
        let ties: Vec<(usize, (usize, usize))> =
            used.filter_map(|k| Some((k, ends(k)?))).filter(|(_, (a, b))| a != b).collect();
        let pairs: Vec<(usize, usize)> = ties.iter().map(|&(_, ends)| ends).collect();
        let tied = tied_together(&pairs).into_iter().filter(|parts| parts.len() <= CLUSTER_MAX);
        let clusters = tied.flat_map(|parts| clusters(parts, &pairs, self.config.alignments_min));
        let mut any = false;
        for cluster in clusters.filter(|c| c.len() > 1) {
            for &(k, _) in ties.iter().filter(|(_, (a, b))| cluster.contains(a) && cluster.contains(b)) {
                self.closures[k].unused = None;
                any = true;
            }
            for frame in cluster.iter().flat_map(|&p| &self.parts[p].frames) {
                for id in &self.nodes[frame] {
                    if let Some(pose) = trial.start.get(id) {
                        self.start.insert(*id, *pose);
                    }
                }
            }
        }
        any
    }
}

/// The nodes that ties connect, each with all that it is connected to.
fn tied_together(ties: &[(usize, usize)]) -> Vec<BTreeSet<usize>> {
    let mut neighbours: BTreeMap<usize, BTreeSet<usize>> = BTreeMap::new();
    for &(a, b) in ties {
        neighbours.entry(a).or_default().insert(b);
        neighbours.entry(b).or_default().insert(a);
    }
    let mut components = Vec::new();
    while let Some((&first, _)) = neighbours.first_key_value() {
        let (mut component, mut waiting) = (BTreeSet::new(), vec![first]);
        while let Some(node) = waiting.pop() {
            if let Some(next) = neighbours.remove(&node) {
                component.insert(node);
                waiting.extend(next);
            }
        }
        components.push(component);
    }
    components
}

/// Divides nodes along cuts that fewer than `least` ties cross, or those of fewer than [`PAIRS_MIN`] pairs, until no
/// such cut is left.
fn clusters(nodes: BTreeSet<usize>, ties: &[(usize, usize)], least: usize) -> Vec<BTreeSet<usize>> {
    let inside: Vec<(usize, usize)> =
        ties.iter().copied().filter(|(a, b)| nodes.contains(a) && nodes.contains(b)).collect();
    let pairs: BTreeSet<(usize, usize)> = inside.iter().map(|&(a, b)| (a.min(b), a.max(b))).collect();
    let pairs: Vec<(usize, usize)> = pairs.into_iter().collect();
    let weak = |ties: &[(usize, usize)], least: usize| smallest_cut(&nodes, ties).filter(|(count, _)| *count < least);
    match weak(&inside, least).or_else(|| weak(&pairs, PAIRS_MIN)) {
        Some((_, side)) => {
            let rest = nodes.difference(&side).copied().collect();
            let mut out = clusters(side, &inside, least);
            out.extend(clusters(rest, &inside, least));
            out
        }
        None => vec![nodes],
    }
}

/// The fewest ties that divide the nodes, and the nodes on one side (Stoer and Wagner 1997); `None` of fewer than two.
fn smallest_cut(nodes: &BTreeSet<usize>, ties: &[(usize, usize)]) -> Option<(usize, BTreeSet<usize>)> {
    let mut groups: Vec<BTreeSet<usize>> = nodes.iter().map(|&n| BTreeSet::from([n])).collect();
    let place: BTreeMap<usize, usize> = nodes.iter().enumerate().map(|(k, &n)| (n, k)).collect();
    let mut weight = vec![vec![0_usize; groups.len()]; groups.len()];
    for (a, b) in ties.iter().map(|(a, b)| (place[a], place[b])).filter(|(a, b)| a != b) {
        weight[a][b] += 1;
        weight[b][a] += 1;
    }
    let mut left: Vec<usize> = (0..groups.len()).collect();
    let mut best: Option<(usize, BTreeSet<usize>)> = None;
    while left.len() > 1 {
        // Most tightly tied first; the last is cut off by all its ties.
        let mut order: Vec<usize> = Vec::with_capacity(left.len());
        let (mut tied, mut is_in) = (vec![0_usize; groups.len()], vec![false; groups.len()]);
        while order.len() < left.len() {
            let next = left.iter().copied().filter(|&v| !is_in[v]).max_by_key(|&v| (tied[v], v))?;
            order.push(next);
            is_in[next] = true;
            left.iter().for_each(|&v| tied[v] += weight[next][v]);
        }
        let (last, before) = (order[order.len() - 1], order[order.len() - 2]);
        let count = left.iter().filter(|&&v| v != last).map(|&v| weight[last][v]).sum::<usize>();
        if best.as_ref().is_none_or(|(least, _)| count < *least) {
            best = Some((count, groups[last].clone()));
        }
        let joined = core::mem::take(&mut groups[last]);
        groups[before].extend(joined);
        for &v in &left {
            let more = weight[last][v];
            weight[before][v] += more;
            weight[v][before] += more;
        }
        left.retain(|&v| v != last);
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_smallest_cut_is_that_of_the_fewest_ties() {
        let nodes = |n| (0..n).collect::<BTreeSet<usize>>();
        assert_eq!(smallest_cut(&nodes(1), &[]), None);
        assert_eq!(smallest_cut(&nodes(2), &[]).map(|c| c.0), Some(0));
        // Two triangles of double ties, with two ties between them.
        let mut ties = vec![(0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3)];
        ties.extend(ties.clone());
        ties.extend([(0, 3), (1, 4)]);
        let (count, side) = smallest_cut(&nodes(6), &ties).unwrap();
        assert_eq!(count, 2);
        assert!(side == BTreeSet::from([0, 1, 2]) || side == BTreeSet::from([3, 4, 5]), "{side:?}");
        let mut parts = clusters(nodes(7), &ties, 3);
        parts.sort();
        assert_eq!(parts, [BTreeSet::from([0, 1, 2]), BTreeSet::from([3, 4, 5]), BTreeSet::from([6])]);
        assert_eq!(clusters(nodes(6), &ties, 2), [nodes(6)]);
        assert_eq!(clusters(nodes(2), &[(0, 1); 5], 3).len(), 2, "a pair by itself");
    }

    #[test]
    fn only_what_is_tied_is_looked_at_together() {
        let pairs: Vec<(usize, usize)> = (0..50_000).map(|k| (2 * k, 2 * k + 1)).collect();
        let components = tied_together(&pairs);
        assert!(components.len() == 50_000 && components.iter().all(|c| c.len() == 2));
        let mut ring: Vec<(usize, usize)> = (0..CLUSTER_MAX).map(|k| (k, (k + 1) % CLUSTER_MAX)).collect();
        assert_eq!(tied_together(&ring), [(0..CLUSTER_MAX).collect()]);
        // The largest that is divided: a ring of single ties falls apart, of double ones it holds.
        assert_eq!(clusters((0..CLUSTER_MAX).collect(), &ring, 3).len(), CLUSTER_MAX);
        ring.extend(ring.clone());
        assert_eq!(clusters((0..CLUSTER_MAX).collect(), &ring, 3).len(), 1);
        assert!(tied_together(&[]).is_empty());
    }
}
