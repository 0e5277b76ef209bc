//! Sparse normal equations over small blocks: decides the elimination order and how `H x = b` is solved.
//!
//! The order comes from approximate minimum degree (Amestoy, Davis and Duff 1996) on the *block* pattern, the
//! factorisation from faer's simplicial Cholesky. Simplicial, not supernodal, on purpose: it is plain scalar
//! arithmetic in a fixed order, so that two robots with different vector units get the same bits. The blocks of `H⁻¹`
//! that lie in the factor's pattern come from the recursion of Takahashi, Fagan and Chen (1973).

use super::solve::SolveError;
use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt::factor::LltError;
use faer::sparse::linalg::cholesky::{
    CholeskySymbolicParams, LltRef, SymbolicCholesky, SymbolicCholeskyRaw, SymmetricOrdering,
    factorize_symbolic_cholesky,
};
use faer::sparse::linalg::{SupernodalThreshold, amd};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMat, SymbolicSparseColMatRef};
use faer::{Conj, MatMut, Par, Side};
use std::collections::BTreeMap;

/// Where each block of `H` lies, and the symbolic factorisation of that pattern.
#[derive(Debug)]
pub(super) struct BlockPattern {
    /// Scalars of each variable.
    sizes: Vec<usize>,
    /// First scalar of each variable in elimination order.
    starts: Vec<usize>,
    /// The upper triangle of `H` in elimination order.
    upper: SymbolicSparseColMat<usize>,
    /// Of each block (row variable, column variable), the offset of its first row within its columns.
    offsets: BTreeMap<(usize, usize), usize>,
    symbolic: SymbolicCholesky<usize>,
}

/// The place of one block in the value array.
#[derive(Clone, Copy, Debug)]
pub(super) struct Slot {
    first_column: usize,
    offset: usize,
    /// The block is stored as its transpose: the first variable is eliminated after the second.
    pub(super) transposed: bool,
    diagonal: bool,
}

impl BlockPattern {
    /// Analyses the pattern of `sizes.len()` variables of which those in each pair are coupled.
    pub(super) fn new(sizes: Vec<usize>, pairs: impl IntoIterator<Item = (usize, usize)>) -> Result<Self, SolveError> {
        let n = sizes.len();
        let mut below: Vec<Vec<usize>> = vec![Vec::new(); n];
        for (a, b) in pairs {
            if a != b {
                below[a.max(b)].push(a.min(b));
            }
        }
        for rows in &mut below {
            rows.sort_unstable();
            rows.dedup();
        }
        let (order, rank) = minimum_degree(&below)?;
        let mut starts = vec![0; n];
        let mut scalars = 0;
        for &variable in &order {
            starts[variable] = scalars;
            scalars += sizes[variable];
        }
        let mut above: Vec<Vec<usize>> = vec![Vec::new(); n];
        for (a, rows) in below.iter().enumerate() {
            for &b in rows {
                let (first, last) = if rank[a] < rank[b] { (a, b) } else { (b, a) };
                above[last].push(first);
            }
        }
        let mut offsets = BTreeMap::new();
        let (mut col_ptr, mut row_idx) = (Vec::with_capacity(scalars + 1), Vec::new());
        col_ptr.push(0);
        for &column in &order {
            above[column].sort_unstable_by_key(|&row| rank[row]);
            let mut offset = 0;
            for &row in &above[column] {
                offsets.insert((row, column), offset);
                offset += sizes[row];
            }
            offsets.insert((column, column), offset);
            for c in 0..sizes[column] {
                for &row in &above[column] {
                    row_idx.extend(starts[row]..starts[row] + sizes[row]);
                }
                row_idx.extend(starts[column]..=starts[column] + c);
                col_ptr.push(row_idx.len());
            }
        }
        let upper = SymbolicSparseColMat::new_checked(scalars, scalars, col_ptr, None, row_idx);
        let params = CholeskySymbolicParams {
            supernodal_flop_ratio_threshold: SupernodalThreshold::FORCE_SIMPLICIAL,
            ..Default::default()
        };
        let symbolic = factorize_symbolic_cholesky(upper.as_ref(), Side::Upper, SymmetricOrdering::Identity, params)
            .map_err(|_| SolveError::OutOfMemory)?;
        Ok(Self { sizes, starts, upper, offsets, symbolic })
    }

    /// Scalars in all.
    pub(super) fn scalars(&self) -> usize {
        self.upper.ncols()
    }

    /// First scalar of a variable in right-hand sides and solutions.
    pub(super) fn start(&self, variable: usize) -> usize {
        self.starts[variable]
    }

    /// The block of two coupled variables; `None` if they are not.
    pub(super) fn slot(&self, a: usize, b: usize) -> Option<Slot> {
        let transposed = self.starts[a] > self.starts[b];
        let (row, column) = if transposed { (b, a) } else { (a, b) };
        let offset = *self.offsets.get(&(row, column))?;
        Some(Slot { first_column: self.starts[column], offset, transposed, diagonal: a == b })
    }

    /// The variable that owns a scalar.
    fn variable_of(&self, scalar: usize) -> usize {
        (0..self.sizes.len())
            .find(|&v| (self.starts[v]..self.starts[v] + self.sizes[v]).contains(&scalar))
            .unwrap_or_default()
    }

    /// Adds `m` (row-major access through `at(row, column)`) to the block at `slot`.
    pub(super) fn add(
        &self,
        values: &mut [f64],
        slot: Slot,
        (rows, columns): (usize, usize),
        at: impl Fn(usize, usize) -> f64,
    ) {
        let col_ptr = self.upper.col_ptr();
        let (rows, columns) = if slot.transposed { (columns, rows) } else { (rows, columns) };
        for c in 0..columns {
            let base = col_ptr[slot.first_column + c] + slot.offset;
            let last = if slot.diagonal { c + 1 } else { rows };
            for r in 0..last {
                values[base + r] += if slot.transposed { at(c, r) } else { at(r, c) };
            }
        }
    }

    /// Length of the value array of `H`.
    pub(super) fn value_count(&self) -> usize {
        self.upper.row_idx().len()
    }

    /// Positions of the diagonal of `H` in its value array, in elimination order.
    pub(super) fn diagonal(&self) -> impl Iterator<Item = usize> + '_ {
        self.upper.col_ptr()[1..].iter().map(|&end| end - 1)
    }

    /// Factorises `H = L Lᵀ` into `factor`.
    ///
    /// # Errors
    /// [`SolveError::Underconstrained`] with the variable at which a pivot is not positive.
    pub(super) fn factorise(&self, values: &[f64], factor: &mut Vec<f64>) -> Result<(), SolveError> {
        factor.clear();
        factor.resize(self.symbolic.len_val(), 0.0);
        let scratch = self.symbolic.factorize_numeric_llt_scratch::<f64>(Par::Seq, Default::default());
        let mut memory = MemBuffer::try_new(scratch).map_err(|_| SolveError::OutOfMemory)?;
        let h = SparseColMatRef::new(self.upper.as_ref(), values);
        let outcome = self.symbolic.factorize_numeric_llt::<f64>(
            factor,
            h,
            Side::Upper,
            Default::default(),
            Par::Seq,
            MemStack::new(&mut memory),
            Default::default(),
        );
        match outcome.map(|_| ()) {
            Ok(()) if factor.iter().all(|x| x.is_finite()) => Ok(()),
            Ok(()) => Err(SolveError::NotFinite),
            Err(LltError::NonPositivePivot { index }) => {
                Err(SolveError::Underconstrained { variable: self.variable_of(index.saturating_sub(1)) })
            }
        }
    }

    /// Solves `L Lᵀ x = b` in place for `columns` right-hand sides, one after the other in `b`.
    pub(super) fn solve(&self, factor: &[f64], b: &mut [f64], columns: usize) -> Result<(), SolveError> {
        if self.scalars() == 0 {
            return Ok(());
        }
        let scratch = self.symbolic.solve_in_place_scratch::<f64>(columns, Par::Seq);
        let mut memory = MemBuffer::try_new(scratch).map_err(|_| SolveError::OutOfMemory)?;
        LltRef::new(&self.symbolic, factor).solve_in_place_with_conj(
            Conj::No,
            MatMut::from_column_major_slice_mut(b, self.scalars(), columns),
            Par::Seq,
            MemStack::new(&mut memory),
        );
        Ok(())
    }

    /// The entries of `H⁻¹` in the pattern of `L`.
    pub(super) fn selected_inverse(&self, factor: &[f64]) -> SelectedInverse<'_> {
        let SymbolicCholeskyRaw::Simplicial(l) = self.symbolic.raw() else {
            return SelectedInverse { pattern: self, values: Vec::new() };
        };
        let (col_ptr, row_idx) = (l.col_ptr(), l.row_idx());
        let mut z = vec![0.0; factor.len()];
        let mut column = vec![0.0; self.scalars()];
        for j in (0..self.scalars()).rev() {
            let (head, tail) = (col_ptr[j], col_ptr[j] + 1..col_ptr[j + 1]);
            let pivot = factor[head];
            for p in tail.clone() {
                let (k, l_k) = (row_idx[p], factor[p] / pivot);
                column[k] -= l_k * z[col_ptr[k]];
                // Rows of column j below k are a subset of those of column k: walk both, sorted.
                let mut q = col_ptr[k] + 1;
                for m in p + 1..tail.end {
                    while row_idx[q] != row_idx[m] {
                        q += 1;
                    }
                    column[row_idx[m]] -= l_k * z[q];
                    column[k] -= factor[m] / pivot * z[q];
                }
            }
            let mut corner = 1.0 / (pivot * pivot);
            for p in tail {
                z[p] = core::mem::take(&mut column[row_idx[p]]);
                corner -= factor[p] / pivot * z[p];
            }
            z[head] = corner;
        }
        SelectedInverse { pattern: self, values: z }
    }
}

/// Entries of `H⁻¹` in the pattern of its Cholesky factor.
#[derive(Debug)]
pub(super) struct SelectedInverse<'a> {
    pattern: &'a BlockPattern,
    values: Vec<f64>,
}

impl SelectedInverse<'_> {
    /// The entry at scalars (`r`, `c`) of variables (`a`, `b`); `None` outside the pattern.
    pub(super) fn get(&self, (a, r): (usize, usize), (b, c): (usize, usize)) -> Option<f64> {
        let SymbolicCholeskyRaw::Simplicial(l) = self.pattern.symbolic.raw() else { return None };
        let (r, c) = (self.pattern.starts[a] + r, self.pattern.starts[b] + c);
        let (row, column) = (r.max(c), r.min(c));
        let range = l.col_ptr()[column]..l.col_ptr()[column + 1];
        let at = l.row_idx()[range.clone()].binary_search(&row).ok()?;
        self.values.get(range.start + at).copied()
    }
}

/// A fill-reducing elimination order, as (order, rank), of a pattern given as neighbours of smaller index.
fn minimum_degree(below: &[Vec<usize>]) -> Result<(Vec<usize>, Vec<usize>), SolveError> {
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
    Ok((order, rank))
}
