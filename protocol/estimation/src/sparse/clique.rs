//! One front that outlives its factorisation: decides what is kept of it, and how its children's updates are taken up.

use super::dense::{Panel, Scratch};
use super::front::dot;
use nalgebra::{Dim, Matrix, RawStorage};

/// Variables eliminated together, with what their elimination left behind.
#[derive(Clone, Debug, Default)]
pub(super) struct Clique {
    /// Variables eliminated, in that order.
    pub(super) pivots: Vec<usize>,
    /// The later variables they are coupled with.
    pub(super) below: Vec<usize>,
    pub(super) parent: Option<usize>,
    pub(super) children: Vec<usize>,
    /// The terms whose first eliminated variable is among the pivots.
    pub(super) terms: Vec<usize>,
    /// Scalars of the pivots.
    pub(super) columns: usize,
    /// Scalars of the pivots and of all below.
    pub(super) height: usize,
    /// The factor's columns, column-major.
    panel: Vec<f64>,
    /// What the elimination adds to `H` at the variables below: the lower triangle, column after column. Empty if it
    /// adds nothing.
    update: Vec<f64>,
    /// `L⁻¹ b` of the pivots, then what the elimination adds to `b` below.
    rhs: Vec<f64>,
    /// Not solved for since it was eliminated.
    pub(super) is_fresh: bool,
    /// How many cliques lie below it on the longest way down.
    pub(super) level: usize,
    /// What it adds below was not kept: who needs it must eliminate this clique again.
    pub(super) is_forgetful: bool,
    /// May yet be taken back.
    pub(super) is_tentative: bool,
}

/// A run of scalars and where the parent holds them.
struct Run {
    from: usize,
    to: usize,
    length: usize,
}

impl Clique {
    /// A front of zeros.
    pub(super) fn new(pivots: Vec<usize>, below: Vec<usize>, sizes: &[usize]) -> Self {
        let scalars = |of: &[usize]| of.iter().map(|&v| sizes[v]).sum::<usize>();
        let (columns, depth) = (scalars(&pivots), scalars(&below));
        let height = columns + depth;
        let panel = vec![0.0; height * columns];
        let (update, rhs) = (vec![0.0; depth * (depth + 1) / 2], vec![0.0; height]);
        Self { pivots, below, columns, height, panel, update, rhs, is_fresh: true, ..Self::default() }
    }

    /// Its variables, pivots first.
    pub(super) fn variables(&self) -> impl Iterator<Item = usize> + '_ {
        self.pivots.iter().chain(&self.below).copied()
    }

    /// Numbers of its factor.
    pub(super) fn value_count(&self) -> usize {
        self.panel.len()
    }

    /// Numbers it keeps.
    pub(super) fn kept_count(&self) -> usize {
        self.panel.len() + self.update.len() + self.rhs.len()
    }

    /// `|L⁻¹ b|²` of its pivots.
    pub(super) fn whitened_square(&self) -> f64 {
        self.rhs[..self.columns].iter().map(|y| y * y).sum()
    }

    /// Adds what a child's elimination left; `row_of` says by variable where this front holds it.
    pub(super) fn take_up(&mut self, child: &Self, sizes: &[usize], row_of: &[usize]) {
        if child.update.is_empty() {
            return;
        }
        let mut runs: Vec<Run> = Vec::new();
        let mut from = 0;
        for &variable in &child.below {
            let (to, length) = (row_of[variable], sizes[variable]);
            match runs.last_mut() {
                Some(run) if run.to + run.length == to => run.length += length,
                _ => runs.push(Run { from, to, length }),
            }
            from += length;
        }
        let depth = child.height - child.columns;
        for (k, a) in runs.iter().enumerate() {
            for c in 0..a.length {
                let at = a.from + c;
                let source = &child.update[triangle(depth, at)..][..depth - at];
                let (target, above) = self.column(a.to + c);
                add(&mut target[a.to + c - above..], &source[..a.length - c]);
                for b in &runs[k + 1..] {
                    let given = &source[b.from - at..][..b.length];
                    if b.to > a.to {
                        let (target, above) = self.column(a.to + c);
                        add(&mut target[b.to - above..], given);
                    } else {
                        // The two are eliminated the other way round now.
                        for (r, x) in given.iter().enumerate() {
                            let (target, above) = self.column(b.to + r);
                            target[a.to + c - above] += x;
                        }
                    }
                }
            }
            add(&mut self.rhs[a.to..], &child.rhs[child.columns + a.from..][..a.length]);
        }
    }

    /// Eliminates the pivots.
    ///
    /// # Errors
    /// The pivot that is not positive.
    pub(super) fn eliminate(&mut self, scratch: &mut Scratch, square: &mut Vec<f64>) -> Result<(), usize> {
        let depth = self.height - self.columns;
        let mut panel = Panel { values: &mut self.panel, height: self.height, columns: self.columns };
        panel.eliminate(scratch)?;
        square.clear();
        square.resize(depth * depth, 0.0);
        panel.subtract_square(square);
        let mut rest = &mut self.update[..];
        for (c, column) in square.chunks_exact(depth.max(1)).enumerate() {
            let (now, later) = rest.split_at_mut(depth - c);
            add(now, &column[c..]);
            rest = later;
        }
        let mut rhs = core::mem::take(&mut self.rhs);
        self.whiten(&mut rhs);
        self.rhs = rhs;
        Ok(())
    }

    /// Declares that the elimination adds nothing below, which rounding may have blurred.
    pub(super) fn pass_nothing(&mut self) {
        self.update = Vec::new();
        self.rhs[self.columns..].fill(0.0);
    }

    /// Forgets what the elimination adds below, where that is cheap to have again.
    pub(super) fn forget(&mut self) {
        if self.level.is_multiple_of(2) && !self.update.is_empty() {
            self.update = Vec::new();
            self.is_forgetful = true;
        }
    }

    /// Whether all numbers are.
    pub(super) fn is_finite(&self) -> bool {
        self.rhs.iter().chain(&self.panel).chain(&self.update).all(|x| x.is_finite())
    }

    /// `x_J ← L⁻¹ x_J`, then `x_I ← x_I − B x_J`.
    pub(super) fn whiten(&self, x: &mut [f64]) {
        for (k, column) in self.panel.chunks_exact(self.height.max(1)).enumerate() {
            x[k] /= column[k];
            let at = x[k];
            x[k + 1..].iter_mut().zip(&column[k + 1..]).for_each(|(x, l)| *x -= l * at);
        }
    }

    /// `x_J = L⁻ᵀ (y − Bᵀ x_I)`.
    pub(super) fn solution(&self, below: &[f64], own: &mut Vec<f64>) {
        own.clear();
        own.extend_from_slice(&self.rhs[..self.columns]);
        for (k, column) in self.panel.chunks_exact(self.height.max(1)).enumerate().rev() {
            let (square, rows) = column.split_at(self.columns);
            let known = dot(&own[k + 1..], &square[k + 1..]) + dot(below, rows);
            own[k] = (own[k] - known) / square[k];
        }
    }

    /// By scalar of the pivots: the inverse of its standard deviation if all later ones were known.
    pub(super) fn certainty(&self, k: usize) -> f64 {
        self.panel[k * (self.height + 1)]
    }

    /// A column of the whole front, and its first row.
    fn column(&mut self, column: usize) -> (&mut [f64], usize) {
        if column < self.columns {
            (&mut self.panel[column * self.height..][..self.height], 0)
        } else {
            let (depth, at) = (self.height - self.columns, column - self.columns);
            (&mut self.update[triangle(depth, at)..][..depth - at], column)
        }
    }
}

/// A front that terms add to.
pub(crate) struct Sum<'a> {
    pub(super) clique: &'a mut Clique,
    pub(super) row_of: &'a [usize],
}

impl Sum<'_> {
    /// Adds `m` to the block of `H` with the rows of variable `a` and the columns of `b`; stands for its mirror too.
    pub(crate) fn block<R: Dim, C: Dim, S: RawStorage<f64, R, C>>(
        &mut self,
        a: usize,
        b: usize,
        m: &Matrix<f64, R, C, S>,
    ) {
        let (row, column) = (self.row_of[a], self.row_of[b]);
        let is_transposed = row < column;
        let (rows, columns) = if is_transposed { (m.ncols(), m.nrows()) } else { m.shape() };
        let at = (row.max(column), row.min(column));
        for c in 0..columns {
            let (target, above) = self.clique.column(at.1 + c);
            let first = if a == b { c } else { 0 };
            for r in first..rows {
                target[at.0 + r - above] += if is_transposed { m[(c, r)] } else { m[(r, c)] };
            }
        }
    }

    /// Adds to the right-hand side of a variable.
    pub(crate) fn rhs<'v>(&mut self, variable: usize, values: impl Iterator<Item = &'v f64>) {
        self.clique.rhs[self.row_of[variable]..].iter_mut().zip(values).for_each(|(x, v)| *x += v);
    }
}

/// Where a column of a packed lower triangle begins.
fn triangle(depth: usize, column: usize) -> usize {
    // The first `column` columns hold depth, depth − 1, … values.
    column * depth - column * column.saturating_sub(1) / 2
}

fn add(to: &mut [f64], from: &[f64]) {
    to.iter_mut().zip(from).for_each(|(t, f)| *t += f);
}
