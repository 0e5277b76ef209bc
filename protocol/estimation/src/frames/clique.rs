//! Exact maximum clique of a small graph, by branch and bound with greedy colouring (Tomita & Seki 2003): the largest
//! set of alignments that all agree pairwise. Vertices are visited in a fixed order, so equal graphs give equal
//! cliques.

/// Vertices at most: one bit each.
pub(super) const VERTICES_MAX: usize = 128;

/// Search nodes at most; graphs of a few dozen alignments need hundreds. A graph made to exhaust them gets the best
/// clique found so far.
const NODES_MAX: u32 = 200_000;

/// Set of vertices.
pub(crate) type Set = u128;

/// The vertices of `set`, ascending.
pub(crate) fn vertices(mut set: Set) -> impl Iterator<Item = usize> {
    core::iter::from_fn(move || {
        (set != 0).then(|| {
            let v = set.trailing_zeros() as usize;
            set &= set - 1;
            v
        })
    })
}

/// The set of one vertex.
pub(crate) fn bit(v: usize) -> Set {
    1 << v
}

/// A maximum clique within `candidates`; `adjacency[v]` are v's neighbours (symmetric, without v).
pub(crate) fn maximum_clique(adjacency: &[Set], candidates: Set) -> Set {
    let mut search = Search { adjacency, best: 0, nodes_left: NODES_MAX };
    search.expand(0, candidates);
    search.best
}

/// A largest clique with vertex `v`, searched with a share of the nodes only: one is asked of every vertex.
pub(crate) fn largest_with(adjacency: &[Set], v: usize) -> Set {
    let mut search = Search { adjacency, best: 0, nodes_left: NODES_MAX / VERTICES_MAX as u32 };
    search.expand(bit(v), adjacency[v]);
    search.best
}

struct Search<'a> {
    adjacency: &'a [Set],
    best: Set,
    nodes_left: u32,
}

impl Search<'_> {
    fn expand(&mut self, clique: Set, mut candidates: Set) {
        if clique.count_ones() > self.best.count_ones() {
            self.best = clique;
        }
        if candidates == 0 || self.nodes_left == 0 {
            return;
        }
        self.nodes_left -= 1;
        let mut order = [(0_u8, 0_u8); VERTICES_MAX];
        let count = self.colour(candidates, &mut order);
        // A clique has at most one vertex of each colour: the last vertices promise most.
        for &(v, colours) in order[..count].iter().rev() {
            if clique.count_ones() + u32::from(colours) <= self.best.count_ones() {
                return;
            }
            let v = usize::from(v);
            self.expand(clique | bit(v), candidates & self.adjacency[v]);
            candidates &= !bit(v);
        }
    }

    /// Colours greedily; fills (vertex, colours used up to it) by rising colour and returns how many.
    fn colour(&self, candidates: Set, order: &mut [(u8, u8); VERTICES_MAX]) -> usize {
        let (mut left, mut count, mut colour) = (candidates, 0, 0_u8);
        while left != 0 {
            colour += 1;
            let mut independent = left;
            while independent != 0 {
                let v = independent.trailing_zeros() as usize;
                independent &= !(bit(v) | self.adjacency[v]);
                left &= !bit(v);
                order[count] = (v as u8, colour);
                count += 1;
            }
        }
        count
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::sampling::{rng, uniform};
    use rand::Rng;

    fn graph(rng: &mut impl Rng, n: usize, density: f64) -> Vec<Set> {
        let mut adjacency = vec![0; n];
        for a in 0..n {
            for b in 0..a {
                if uniform(rng, 0.0, 1.0) < density {
                    adjacency[a] |= bit(b);
                    adjacency[b] |= bit(a);
                }
            }
        }
        adjacency
    }

    fn is_clique(adjacency: &[Set], set: Set) -> bool {
        vertices(set).all(|v| set & !bit(v) & !adjacency[v] == 0)
    }

    #[test]
    fn it_is_the_largest_of_all_subsets() {
        let mut rng = rng(51);
        for density in [0.2, 0.5, 0.8, 1.0] {
            for n in [1, 2, 7, 13] {
                let g = graph(&mut rng, n, density);
                let found = maximum_clique(&g, (1 << n) - 1);
                let largest = (0..1_u128 << n).filter(|&s| is_clique(&g, s)).map(Set::count_ones).max().unwrap();
                assert!(is_clique(&g, found) && found.count_ones() == largest, "{n} {density}");
                let with_last = largest_with(&g, n - 1);
                let last = |s: &Set| s & bit(n - 1) != 0 && is_clique(&g, *s);
                let largest = (0..1_u128 << n).filter(last).map(Set::count_ones).max().unwrap();
                assert!(last(&with_last) && with_last.count_ones() == largest, "{n} {density}");
            }
        }
    }

    /// Bron and Kerbosch without any bound: slow, and nothing in common with the search above.
    fn largest_by_enumeration(g: &[Set], size: u32, mut open: Set, mut closed: Set) -> u32 {
        if open == 0 {
            return if closed == 0 { size } else { 0 };
        }
        let pivot = vertices(open | closed).max_by_key(|&v| (g[v] & open).count_ones()).unwrap();
        let mut largest = 0;
        for v in vertices(open & !g[pivot]) {
            largest = largest.max(largest_by_enumeration(g, size + 1, open & g[v], closed & g[v]));
            open &= !bit(v);
            closed |= bit(v);
        }
        largest
    }

    #[test]
    fn it_is_exact_on_a_hundred_vertices() {
        let mut rng = rng(54);
        for density in [0.05, 0.3, 0.5] {
            for _ in 0..4 {
                let g = graph(&mut rng, 100, density);
                let all = (1 << 100) - 1;
                let found = maximum_clique(&g, all);
                assert!(is_clique(&g, found));
                assert_eq!(found.count_ones(), largest_by_enumeration(&g, 0, all, 0), "density {density}");
            }
        }
    }

    #[test]
    fn a_planted_clique_is_found_among_all_vertices() {
        let mut rng = rng(52);
        let mut g = graph(&mut rng, VERTICES_MAX, 0.1);
        let planted: Set = (0..VERTICES_MAX).step_by(9).map(bit).sum();
        for v in vertices(planted) {
            g[v] |= planted & !bit(v);
        }
        assert_eq!(maximum_clique(&g, Set::MAX), planted);
    }

    #[test]
    fn a_hostile_graph_ends_with_a_clique() {
        // Dense complements of sparse random graphs are the hard ones.
        let mut rng = rng(53);
        let g = graph(&mut rng, VERTICES_MAX, 0.9);
        let found = maximum_clique(&g, Set::MAX);
        assert!(is_clique(&g, found) && found.count_ones() >= 20);
        assert_eq!(maximum_clique(&g, 0), 0);
    }
}
