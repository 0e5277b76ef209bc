//! Sparse normal equations over small blocks: decides how `H x = b` is solved and how entries of `H⁻¹` are had.
//!
//! A multifrontal Cholesky factorisation (Duff and Reid 1983; Liu 1992): [`order`] decides which variables are
//! eliminated together, [`front`] eliminates them in dense fronts with faer's kernels, [`inverse`] draws the blocks of
//! `H⁻¹` that lie in the factor's pattern from the same fronts (Takahashi, Fagan and Chen 1973). Fronts are ours, and
//! not a library's, because their updates are kept: a new measurement then refactorises only the path from its
//! variables to the root.

mod clique;
mod dense;
mod front;
mod inverse;
mod memory;
mod order;
mod revise;
#[cfg(test)]
mod tests;
mod tree;
#[cfg(test)]
mod tree_tests;

use super::solve_error::SolveError;
pub(super) use clique::Sum;
pub(super) use front::{Factor, Workspace};
pub(super) use inverse::SelectedInverse;
pub use memory::FACTOR_BYTES_MAX;
use memory::Needs;
pub(super) use memory::zeroed;
use order::Elimination;
use std::ops::Range;
pub(super) use tree::{Before, CliqueTree, Terms};

/// Where each block of `H` lies, and the symbolic factorisation of that pattern.
///
/// `H` and its factor are stored alike: by front, as a dense column-major panel of all columns it eliminates; of the
/// topmost square only the lower triangle counts.
#[derive(Debug)]
pub(super) struct BlockPattern {
    /// First scalar of each variable in elimination order.
    starts: Vec<usize>,
    /// Variables in elimination order.
    order: Vec<usize>,
    /// The front that eliminates each variable.
    front_of: Vec<usize>,
    fronts: Vec<Front>,
    scalars: usize,
    value_count: usize,
    /// Numbers of updates that wait for their parents, at most at a time.
    update_count: usize,
}

/// Scalars that are eliminated together, and the later ones they are coupled with.
#[derive(Debug)]
struct Front {
    /// Scalars eliminated, in elimination order.
    pivots: Range<usize>,
    /// The later scalars, ascending, as runs of neighbours.
    below: Vec<Range<usize>>,
    /// Rows of the panel: pivots, then all of `below`.
    height: usize,
    /// First value of the panel.
    offset: usize,
    parent: Option<usize>,
    children: Vec<usize>,
    /// Where the rows below lie in the parent's panel.
    into_parent: Vec<Piece>,
}

/// A run of rows of a front's update and its place in the parent's panel.
#[derive(Clone, Copy, Debug)]
struct Piece {
    from: usize,
    to: usize,
    length: usize,
}

/// The place of one block in the value array.
#[derive(Clone, Copy, Debug)]
pub(super) struct Slot {
    at: usize,
    stride: usize,
    /// The block is stored as its transpose: the first variable is eliminated before the second.
    transposed: bool,
    diagonal: bool,
}

impl BlockPattern {
    /// Analyses the pattern of `sizes.len()` variables of which those in each pair are coupled.
    ///
    /// # Errors
    /// [`SolveError::TooDense`] where solving would take more than [`FACTOR_BYTES_MAX`].
    pub(super) fn new(sizes: &[usize], pairs: impl IntoIterator<Item = (usize, usize)>) -> Result<Self, SolveError> {
        Self::of_sizes([sizes], pairs).map(|[only]| only)
    }

    /// The patterns of equally many variables of several sizes, coupled alike. They are analysed once, for the first
    /// sizes: the fill, by variable, is the same for all.
    ///
    /// # Errors
    /// See [`BlockPattern::new`].
    pub(super) fn of_sizes<const N: usize>(
        sizes: [&[usize]; N],
        pairs: impl IntoIterator<Item = (usize, usize)>,
    ) -> Result<[Self; N], SolveError> {
        Self::within(sizes, pairs, FACTOR_BYTES_MAX)
    }

    /// The same, with a limit of one's own.
    pub(super) fn within<const N: usize>(
        sizes: [&[usize]; N],
        pairs: impl IntoIterator<Item = (usize, usize)>,
        bytes_max: u64,
    ) -> Result<[Self; N], SolveError> {
        let first = sizes.first().copied().unwrap_or_default();
        let mut below: Vec<Vec<usize>> = vec![Vec::new(); first.len()];
        for (a, b) in pairs {
            if a != b {
                below[a.max(b)].push(a.min(b));
            }
        }
        for rows in &mut below {
            rows.sort_unstable();
            rows.dedup();
        }
        let elimination = order::analyse(first, &below, bytes_max)?;
        let mut counts = [0; N];
        for (count, sizes) in counts.iter_mut().zip(sizes) {
            let needs = Needs::of(&elimination, sizes, &below);
            memory::within(needs.bytes(), bytes_max)?;
            // What is within the limit of bytes can be counted.
            *count = usize::try_from(needs.updates).map_err(|_| SolveError::OutOfMemory)?;
        }
        let mut counts = counts.into_iter();
        Ok(sizes.map(|sizes| Self::of(sizes, &elimination, counts.next().unwrap_or_default())))
    }

    fn of(sizes: &[usize], Elimination { order, supernodes }: &Elimination, update_count: usize) -> Self {
        let mut scalar_of_place = Vec::with_capacity(order.len() + 1);
        scalar_of_place.push(0);
        let (mut starts, mut front_of, mut scalars) = (vec![0; order.len()], vec![0; order.len()], 0);
        for &variable in order {
            starts[variable] = scalars;
            scalars += sizes[variable];
            scalar_of_place.push(scalars);
        }
        let mut value_count = 0;
        let mut fronts: Vec<Front> = Vec::with_capacity(supernodes.len());
        for (k, node) in supernodes.iter().enumerate() {
            order[node.pivots.clone()].iter().for_each(|&variable| front_of[variable] = k);
            let pivots = scalar_of_place[node.pivots.start]..scalar_of_place[node.pivots.end];
            let below = runs(node.below.iter().map(|&place| scalar_of_place[place]..scalar_of_place[place + 1]));
            let height = pivots.len() + below.iter().map(Range::len).sum::<usize>();
            let offset = value_count;
            value_count += height * pivots.len();
            let (parent, children, into_parent) = (node.parent, Vec::new(), Vec::new());
            fronts.push(Front { pivots, below, height, offset, parent, children, into_parent });
        }
        for k in 0..fronts.len() {
            let Some(parent) = fronts[k].parent else { continue };
            fronts[k].into_parent = fronts[k].pieces_in(0, &fronts[parent]);
            fronts[parent].children.push(k);
        }
        Self { starts, order: order.clone(), front_of, fronts, scalars, value_count, update_count }
    }

    /// Scalars in all.
    pub(super) fn scalars(&self) -> usize {
        self.scalars
    }

    /// First scalar of a variable in right-hand sides and solutions.
    pub(super) fn start(&self, variable: usize) -> usize {
        self.starts[variable]
    }

    /// Length of the value array of `H`.
    pub(super) fn value_count(&self) -> usize {
        self.value_count
    }

    /// The block of two variables that the pattern couples.
    pub(super) fn slot(&self, a: usize, b: usize) -> Slot {
        let transposed = self.starts[a] < self.starts[b];
        let (row, column) = if transposed { (b, a) } else { (a, b) };
        let front = &self.fronts[self.front_of[column]];
        let column_at = front.offset + (self.starts[column] - front.pivots.start) * front.height;
        let at = column_at + front.row_of(self.starts[row]);
        Slot { at, stride: front.height, transposed, diagonal: a == b }
    }

    /// Adds `m`, its rows those of the first variable of `slot`, to the block there.
    pub(super) fn add<R: nalgebra::Dim, C: nalgebra::Dim, S: nalgebra::RawStorage<f64, R, C>>(
        values: &mut [f64],
        slot: Slot,
        m: &nalgebra::Matrix<f64, R, C, S>,
    ) {
        let (rows, columns) = m.shape();
        let (rows, columns) = if slot.transposed { (columns, rows) } else { (rows, columns) };
        for c in 0..columns {
            let column = &mut values[slot.at + c * slot.stride..][..rows];
            let first = if slot.diagonal { c } else { 0 };
            for (r, value) in column.iter_mut().enumerate().skip(first) {
                *value += if slot.transposed { m[(c, r)] } else { m[(r, c)] };
            }
        }
    }

    /// Positions of the diagonal of `H` in its value array, in elimination order.
    pub(super) fn diagonal(&self) -> impl Iterator<Item = usize> + '_ {
        self.fronts.iter().flat_map(|f| (0..f.pivots.len()).map(move |k| f.offset + k * (f.height + 1)))
    }

    /// The variable that owns a scalar.
    fn variable_of(&self, scalar: usize) -> usize {
        let place = self.order.partition_point(|&variable| self.starts[variable] <= scalar);
        self.order.get(place.saturating_sub(1)).copied().unwrap_or_default()
    }
}

impl Front {
    /// The row of the panel that belongs to a scalar of this front.
    fn row_of(&self, scalar: usize) -> usize {
        if scalar < self.pivots.end {
            return scalar - self.pivots.start;
        }
        let mut row = self.pivots.len();
        for run in &self.below {
            if run.end > scalar {
                return row + scalar - run.start;
            }
            row += run.len();
        }
        row
    }

    /// Whether a scalar that is eliminated no earlier than the pivots is among the rows.
    fn holds(&self, scalar: usize) -> bool {
        self.pivots.contains(&scalar) || self.below.iter().any(|run| run.contains(&scalar))
    }

    /// Numbers of the panel.
    fn value_count(&self) -> usize {
        self.height * self.pivots.len()
    }

    /// Rows below the pivots.
    fn depth(&self) -> usize {
        self.height - self.pivots.len()
    }

    /// Where the rows below, without the first `skipped`, lie in the panel of a front that holds them all.
    fn pieces_in(&self, skipped: usize, above: &Self) -> Vec<Piece> {
        let mut held = core::iter::once(&above.pivots).chain(&above.below);
        let (mut holder, mut row) = (held.next().cloned().unwrap_or_default(), 0);
        let (mut pieces, mut from) = (Vec::new(), 0);
        for run in &self.below {
            let mut scalar = run.start + skipped.saturating_sub(from).min(run.len());
            from += scalar - run.start;
            while scalar < run.end {
                while holder.end <= scalar {
                    row += holder.len();
                    let Some(next) = held.next() else { return joined(pieces) };
                    holder = next.clone();
                }
                let length = holder.end.min(run.end) - scalar;
                pieces.push(Piece { from, to: row + scalar - holder.start, length });
                (from, scalar) = (from + length, scalar + length);
            }
        }
        joined(pieces)
    }
}

/// Ranges that touch become one.
fn runs(ranges: impl Iterator<Item = Range<usize>>) -> Vec<Range<usize>> {
    let mut out: Vec<Range<usize>> = Vec::new();
    for range in ranges {
        match out.last_mut() {
            Some(last) if last.end == range.start => last.end = range.end,
            _ => out.push(range),
        }
    }
    out
}

/// Pieces that touch on both sides become one.
fn joined(pieces: Vec<Piece>) -> Vec<Piece> {
    let mut out: Vec<Piece> = Vec::new();
    for piece in pieces {
        match out.last_mut() {
            Some(last) if last.from + last.length == piece.from && last.to + last.length == piece.to => {
                last.length += piece.length;
            }
            _ => out.push(piece),
        }
    }
    out
}
