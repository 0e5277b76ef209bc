//! The symbolic side of the factorisation: decides in which order variables are eliminated, and which together.
//!
//! Approximate minimum degree (Amestoy, Davis and Duff 1996, from faer) on the *block* pattern, then a postorder of the
//! elimination tree (Liu 1990). Columns of equal structure form a supernode; small supernodes are merged with their
//! parent where that stores few zeros, because one dense product is cheaper than two (Ashcraft and Grimes 1989).

use super::super::solve_error::SolveError;
use super::memory::Count;
use faer::dyn_stack::{MemBuffer, MemStack};
use faer::sparse::SymbolicSparseColMatRef;
use faer::sparse::linalg::amd;
use std::ops::Range;

/// Supernodes of up to so many scalars are merged if at most this share of the result is zeros; the last entry bounds
/// all larger ones.
const ZEROS_MAX: [(usize, f64); 3] = [(18, 0.4), (36, 0.1), (usize::MAX, 0.01)];

/// Variables that are eliminated together.
#[derive(Debug)]
pub(super) struct Supernode {
    /// Places in the elimination order.
    pub(super) pivots: Range<usize>,
    /// Places of the later variables they are coupled with once all earlier ones are eliminated, ascending.
    pub(super) below: Vec<usize>,
    /// The supernode that holds the first of `below`.
    pub(super) parent: Option<usize>,
}

/// An elimination order with its supernodes in postorder (children before parents).
#[derive(Debug)]
pub(super) struct Elimination {
    /// Variables in elimination order.
    pub(super) order: Vec<usize>,
    pub(super) supernodes: Vec<Supernode>,
}

/// Analyses the pattern of `sizes.len()` variables, given as each one's neighbours of smaller index (ascending, no
/// repeats), unless its factor takes more than `bytes_max`.
///
/// # Errors
/// [`SolveError::TooDense`], [`SolveError::OutOfMemory`].
pub(super) fn analyse(sizes: &[usize], below: &[Vec<usize>], bytes_max: u64) -> Result<Elimination, SolveError> {
    let order = minimum_degree(below)?;
    let later = later_neighbours(&order, below);
    let parents = elimination_tree(&later);
    let post = postorder(&parents);
    let order: Vec<usize> = post.iter().map(|&place| order[place]).collect();
    let later = later_neighbours(&order, below);
    let parents = elimination_tree(&later);
    let size_at: Vec<usize> = order.iter().map(|&variable| sizes[variable]).collect();
    let structures = structures(later, &parents, &size_at, Count::new(bytes_max))?;
    let supernodes = supernodes(&order, sizes, structures, &parents);
    Ok(Elimination { order, supernodes })
}

/// A fill-reducing elimination order.
fn minimum_degree(below: &[Vec<usize>]) -> Result<Vec<usize>, SolveError> {
    let n = below.len();
    let (mut col_ptr, mut row_idx) = (Vec::with_capacity(n + 1), Vec::new());
    col_ptr.push(0);
    for (column, rows) in below.iter().enumerate() {
        row_idx.extend_from_slice(rows);
        row_idx.push(column);
        col_ptr.push(row_idx.len());
    }
    let (mut order, mut rank) = (vec![0; n], vec![0; n]);
    let pattern = SymbolicSparseColMatRef::new_checked(n, n, &col_ptr, None, &row_idx);
    let scratch = amd::order_scratch::<usize>(n, row_idx.len());
    let mut memory = MemBuffer::try_new(scratch).map_err(|_| SolveError::OutOfMemory)?;
    amd::order(&mut order, &mut rank, pattern, amd::Control::default(), MemStack::new(&mut memory))
        .map_err(|_| SolveError::OutOfMemory)?;
    Ok(order)
}

/// By place in the order: the places of later neighbours, ascending.
fn later_neighbours(order: &[usize], below: &[Vec<usize>]) -> Vec<Vec<usize>> {
    let mut rank = vec![0; order.len()];
    for (place, &variable) in order.iter().enumerate() {
        rank[variable] = place;
    }
    let mut later = vec![Vec::new(); order.len()];
    for (a, rows) in below.iter().enumerate() {
        for &b in rows {
            let (first, last) = (rank[a].min(rank[b]), rank[a].max(rank[b]));
            later[first].push(last);
        }
    }
    later.iter_mut().for_each(|list| list.sort_unstable());
    later
}

/// The parent of each place: the first later place it is coupled with after elimination (Liu 1990, with path
/// compression).
fn elimination_tree(later: &[Vec<usize>]) -> Vec<Option<usize>> {
    let n = later.len();
    let mut earlier = vec![Vec::new(); n];
    for (first, list) in later.iter().enumerate() {
        list.iter().for_each(|&last| earlier[last].push(first));
    }
    let (mut parent, mut ancestor) = (vec![None; n], vec![None; n]);
    for (j, list) in earlier.iter().enumerate() {
        for &start in list {
            let mut k = start;
            while let Some(next) = ancestor[k].replace(j) {
                if next == j {
                    break;
                }
                k = next;
            }
            if parent[k].is_none() && k != j {
                parent[k] = Some(j);
            }
        }
    }
    parent
}

/// Places such that children directly precede their parents.
fn postorder(parents: &[Option<usize>]) -> Vec<usize> {
    let n = parents.len();
    let mut children = vec![Vec::new(); n];
    let mut stack = Vec::new();
    for (k, parent) in parents.iter().enumerate().rev() {
        match parent {
            Some(p) => children[*p].push(k),
            None => stack.push(k),
        }
    }
    // Parents before children, last child first; reversed, that is a postorder.
    let mut out = Vec::with_capacity(n);
    stack.reverse();
    while let Some(k) = stack.pop() {
        out.push(k);
        stack.extend(children[k].iter().rev());
    }
    out.reverse();
    out
}

/// By place: all later places it is coupled with when it is eliminated, ascending.
fn structures(
    mut later: Vec<Vec<usize>>,
    parents: &[Option<usize>],
    size_at: &[usize],
    mut count: Count,
) -> Result<Vec<Vec<usize>>, SolveError> {
    for k in 0..later.len() {
        count.add(size_at[k], later[k].iter().map(|&place| size_at[place]).sum())?;
        let Some(parent) = parents[k] else { continue };
        let inherited = merged(&later[parent], &later[k], parent);
        later[parent] = inherited;
    }
    Ok(later)
}

/// The union of two ascending lists without `left_out`.
fn merged(a: &[usize], b: &[usize], left_out: usize) -> Vec<usize> {
    let mut out = Vec::with_capacity(a.len() + b.len());
    let (mut i, mut j) = (0, 0);
    while i < a.len() || j < b.len() {
        let (x, y) = (a.get(i).copied().unwrap_or(usize::MAX), b.get(j).copied().unwrap_or(usize::MAX));
        let least = x.min(y);
        i += usize::from(x == least);
        j += usize::from(y == least);
        if least != left_out {
            out.push(least);
        }
    }
    out
}

/// A supernode while its children are still being merged into it.
struct Open {
    pivots: Range<usize>,
    below: Vec<usize>,
    /// Scalars eliminated and zeros stored among them.
    columns: usize,
    zeros: usize,
}

fn supernodes(
    order: &[usize],
    sizes: &[usize],
    mut structures: Vec<Vec<usize>>,
    parents: &[Option<usize>],
) -> Vec<Supernode> {
    let scalars = |places: &[usize]| places.iter().map(|&p| sizes[order[p]]).sum::<usize>();
    let is_child = |c: &Open, of: &Open| parents[c.pivots.end - 1].is_some_and(|p| of.pivots.contains(&p));
    let mut open: Vec<Open> = Vec::new();
    for k in 0..order.len() {
        let below = core::mem::take(&mut structures[k]);
        let mut node = Open { pivots: k..k + 1, columns: sizes[order[k]], zeros: 0, below };
        // In postorder the supernode that ends just before this one is its last child, if it is a child at all.
        while let Some(child) = open.last().filter(|c| is_child(c, &node)) {
            let heights = (scalars(&child.below), node.columns + scalars(&node.below));
            let zeros = child.zeros + node.zeros + child.columns * (heights.1 - heights.0);
            let columns = child.columns + node.columns;
            let stored = columns * (columns + 1) / 2 + columns * (heights.1 - node.columns);
            let limit = ZEROS_MAX.iter().find(|(most, _)| columns <= *most).map_or(0.0, |(_, share)| *share);
            if zeros as f64 > limit * stored as f64 {
                break;
            }
            node = Open { pivots: child.pivots.start..node.pivots.end, columns, zeros, below: node.below };
            open.pop();
        }
        open.push(node);
    }
    let mut of_place = vec![0; order.len()];
    for (k, node) in open.iter().enumerate() {
        of_place[node.pivots.clone()].fill(k);
    }
    let closed = |node: Open| {
        let parent = node.below.first().map(|&place| of_place[place]);
        Supernode { pivots: node.pivots, below: node.below, parent }
    };
    open.into_iter().map(closed).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Structures by eliminating one variable after the other.
    fn eliminated(order: &[usize], below: &[Vec<usize>]) -> Vec<Vec<usize>> {
        let n = order.len();
        let mut coupled = vec![vec![false; n]; n];
        for (first, list) in later_neighbours(order, below).iter().enumerate() {
            list.iter().for_each(|&last| coupled[first][last] = true);
        }
        for k in 0..n {
            for a in k + 1..n {
                for b in a + 1..n {
                    coupled[a][b] |= coupled[k][a] && coupled[k][b];
                }
            }
        }
        coupled.iter().map(|row| (0..n).filter(|&k| row[k]).collect()).collect()
    }

    proptest! {
        #[test]
        fn supernodes_hold_the_fill_of_elimination(
            pairs in prop::collection::vec((0usize..24, 0usize..24), 0..60),
            sizes in prop::collection::vec(1usize..7, 24),
        ) {
            let mut below = vec![Vec::new(); 24];
            for (a, b) in pairs {
                if a != b {
                    below[a.max(b)].push(a.min(b));
                }
            }
            for list in &mut below {
                list.sort_unstable();
                list.dedup();
            }
            let out = analyse(&sizes, &below, u64::MAX).unwrap();
            let mut sorted = out.order.clone();
            sorted.sort_unstable();
            prop_assert!(sorted.into_iter().eq(0..24));
            let structures = eliminated(&out.order, &below);
            let mut next = 0;
            for (k, node) in out.supernodes.iter().enumerate() {
                prop_assert_eq!(node.pivots.start, next);
                next = node.pivots.end;
                prop_assert!(node.below.is_sorted() && node.below.iter().all(|&p| p >= next));
                for place in node.pivots.clone() {
                    let held = |p: &usize| node.pivots.contains(p) || node.below.contains(p);
                    prop_assert!(structures[place].iter().all(held));
                }
                if let Some(parent) = node.parent {
                    let above = &out.supernodes[parent];
                    prop_assert!(parent > k);
                    prop_assert!(node.below.iter().all(|p| above.pivots.contains(p) || above.below.contains(p)));
                }
            }
            prop_assert_eq!(next, 24);
        }
    }
}
