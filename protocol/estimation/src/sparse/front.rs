//! The numeric side: decides the factor of `H`, front by front, and solves with it.

use super::dense::{Panel, Scratch};
use super::{BlockPattern, Front, Piece};
use crate::solve_error::SolveError;
use std::collections::BTreeSet;
use std::ops::Range;

/// A Cholesky factor `H = L Lᵀ`, its panels laid out as [`BlockPattern`] says.
#[derive(Clone, Debug, Default)]
pub(crate) struct Factor {
    pub(super) values: Vec<f64>,
}

/// Memory that factorisations share: fresh pages cost more than the arithmetic of small fronts.
#[derive(Default)]
pub(crate) struct Workspace {
    /// Updates that their parents have not taken up yet, the latest last; then what is left of earlier ones. Of each, a
    /// square, the lower triangle counts.
    updates: Vec<f64>,
    scratch: Scratch,
}

#[cfg(test)]
impl Workspace {
    /// Numbers that updates have had room for.
    pub(super) fn capacity(&self) -> usize {
        self.updates.capacity()
    }
}

impl Factor {
    /// Gives the memory back, for the next `H`.
    pub(crate) fn into_values(self) -> Vec<f64> {
        self.values
    }
}

impl BlockPattern {
    /// Factorises `H = L Lᵀ`.
    ///
    /// # Errors
    /// [`SolveError::Underconstrained`] with the variable at which a pivot is not positive;
    /// [`SolveError::OutOfMemory`].
    pub(crate) fn factorise(&self, h: Vec<f64>, space: &mut Workspace) -> Result<Factor, SolveError> {
        let mut values = h;
        let Workspace { updates, scratch } = space;
        let mut top = 0;
        let needed = self.update_count.saturating_sub(updates.len());
        updates.try_reserve_exact(needed).map_err(|_| SolveError::OutOfMemory)?;
        for front in &self.fronts {
            // In postorder the children's updates lie on top, one after the other.
            let depth = front.depth();
            let given: usize = front.children.iter().map(|&child| self.fronts[child].depth().pow(2)).sum();
            let (base, size) = (top - given, depth.pow(2));
            top = base + size;
            if updates.len() < top + given {
                updates.resize(top + given, 0.0);
            }
            let (children, update) = updates[base..top + given].split_at_mut(given);
            (0..depth).for_each(|c| update[c * depth + c..(c + 1) * depth].fill(0.0));
            let panel = &mut values[front.offset..front.offset + front.height * front.pivots.len()];
            let mut rest = &*children;
            for child in front.children.iter().map(|&child| &self.fronts[child]) {
                let (of_child, others) = rest.split_at(child.depth().pow(2));
                assemble(child, of_child, front, panel, update);
                rest = others;
            }
            let mut panel = Panel { values: panel, height: front.height, columns: front.pivots.len() };
            panel.eliminate(scratch).map_err(|index| SolveError::Underconstrained {
                variable: self.variable_of(front.pivots.start + index),
            })?;
            panel.subtract_square(update);
            if given > 0 {
                for c in 0..depth {
                    let column = base + c * depth;
                    updates.copy_within(column + given + c..column + given + depth, column + c);
                }
            }
        }
        // Without a way out at the first, which would hold up the processor's vector units.
        let is_finite = values.iter().fold(true, |so_far, x| so_far & x.is_finite());
        if is_finite { Ok(Factor { values }) } else { Err(SolveError::NotFinite) }
    }

    /// Solves `L Lᵀ x = b` in place for the right-hand sides that follow one another in `b`.
    pub(crate) fn solve(&self, factor: &Factor, b: &mut [f64]) {
        if self.scalars() == 0 {
            return;
        }
        let mut gathered = Vec::new();
        for front in &self.fronts {
            for x in b.chunks_exact_mut(self.scalars()) {
                front.forward(&factor.values, x, &mut gathered);
            }
        }
        for front in self.fronts.iter().rev() {
            for x in b.chunks_exact_mut(self.scalars()) {
                front.backward(&factor.values, x, &mut gathered);
            }
        }
    }
}

impl BlockPattern {
    /// Replaces each of the right-hand sides that follow one another in `b`, zero but at `scalars`, by `L⁻¹ b`: only
    /// the fronts from those scalars up to the root are touched. Returns the scalars that may not be zero now.
    pub(crate) fn solve_upwards(
        &self,
        factor: &Factor,
        scalars: impl IntoIterator<Item = usize>,
        b: &mut [f64],
    ) -> Vec<Range<usize>> {
        let mut path = BTreeSet::new();
        for scalar in scalars {
            let mut at = Some(self.fronts.partition_point(|f| f.pivots.end <= scalar));
            while let Some(front) = at.filter(|&front| front < self.fronts.len() && path.insert(front)) {
                at = self.fronts[front].parent;
            }
        }
        let mut gathered = Vec::new();
        for front in path.iter().map(|&k| &self.fronts[k]) {
            for x in b.chunks_exact_mut(self.scalars()) {
                front.forward(&factor.values, x, &mut gathered);
            }
        }
        path.iter().map(|&k| self.fronts[k].pivots.clone()).collect()
    }
}

impl Front {
    fn panel<'a>(&self, values: &'a [f64]) -> impl DoubleEndedIterator<Item = &'a [f64]> + ExactSizeIterator {
        values[self.offset..self.offset + self.height * self.pivots.len()].chunks_exact(self.height)
    }

    /// `x_J ← L⁻¹ x_J`, then `x_I ← x_I − B x_J`.
    fn forward(&self, values: &[f64], x: &mut [f64], gathered: &mut Vec<f64>) {
        gathered.clear();
        gathered.resize(self.depth(), 0.0);
        let own = &mut x[self.pivots.clone()];
        for (k, column) in self.panel(values).enumerate() {
            let (square, below) = column.split_at(own.len());
            own[k] /= square[k];
            let at = own[k];
            own[k + 1..].iter_mut().zip(&square[k + 1..]).for_each(|(x, l)| *x -= l * at);
            gathered.iter_mut().zip(below).for_each(|(x, l)| *x += l * at);
        }
        let mut rest = &gathered[..];
        for run in &self.below {
            let (now, later) = rest.split_at(run.len());
            x[run.clone()].iter_mut().zip(now).for_each(|(x, y)| *x -= y);
            rest = later;
        }
    }

    /// `x_J ← L⁻ᵀ (x_J − Bᵀ x_I)`.
    fn backward(&self, values: &[f64], x: &mut [f64], gathered: &mut Vec<f64>) {
        gathered.clear();
        self.below.iter().for_each(|run| gathered.extend_from_slice(&x[run.clone()]));
        let own = &mut x[self.pivots.clone()];
        for (k, column) in self.panel(values).enumerate().rev() {
            let (square, below) = column.split_at(own.len());
            let known = dot(&own[k + 1..], &square[k + 1..]) + dot(below, gathered);
            own[k] = (own[k] - known) / square[k];
        }
    }
}

/// The inner product, in eight sums side by side: a single one would wait for itself.
pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; 8];
    let (a, b) = (a.chunks_exact(8), b[..a.len()].chunks_exact(8));
    let rest: f64 = a.remainder().iter().zip(b.remainder()).map(|(x, y)| x * y).sum();
    for (a, b) in a.zip(b) {
        sums.iter_mut().zip(a.iter().zip(b)).for_each(|(sum, (x, y))| *sum += x * y);
    }
    sums.iter().sum::<f64>() + rest
}

/// Adds a child's update to its parent: what falls on the parent's pivots to the panel, the rest to the parent's own
/// update. Lower triangles on both sides.
fn assemble(child: &Front, given: &[f64], parent: &Front, panel: &mut [f64], update: &mut [f64]) {
    let (depth, columns) = (child.depth(), parent.pivots.len());
    for (k, from) in child.into_parent.iter().enumerate() {
        for c in 0..from.length {
            let given = &given[(from.from + c) * depth..(from.from + c + 1) * depth];
            let column = from.to + c;
            let (target, height, above) = if column < columns {
                (&mut panel[column * parent.height..], parent.height, 0)
            } else {
                (&mut update[(column - columns) * parent.depth()..], parent.depth(), columns)
            };
            let target = &mut target[..height];
            let diagonal = Piece { from: from.from + c, to: column, length: from.length - c };
            for piece in core::iter::once(&diagonal).chain(&child.into_parent[k + 1..]) {
                let to = &mut target[piece.to - above..piece.to - above + piece.length];
                to.iter_mut().zip(&given[piece.from..piece.from + piece.length]).for_each(|(t, g)| *t += g);
            }
        }
    }
}
