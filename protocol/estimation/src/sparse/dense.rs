//! The dense kernels of one front: faer's, on column-major panels. They follow the processor's vector units, so that
//! two kinds of processor agree to rounding and not to the bit (DESIGN §7 asks 1e-9); on one kind they do, to the bit.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt::factor::{LltError, LltRegularization, cholesky_in_place, cholesky_in_place_scratch};
use faer::linalg::matmul::matmul;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::linalg::triangular_solve::{solve_lower_triangular_in_place, solve_upper_triangular_in_place};
use faer::{Accum, MatMut, MatRef, Par};

/// A panel of `columns` columns with all its rows; or a square without rows below.
pub(super) struct Panel<'a> {
    pub(super) values: &'a mut [f64],
    pub(super) height: usize,
    pub(super) columns: usize,
}

impl Panel<'_> {
    /// Replaces the square `A` by its Cholesky factor `L` and the rows below, `B`, by `B L⁻ᵀ`.
    ///
    /// # Errors
    /// The pivot that is not positive.
    pub(super) fn eliminate(&mut self, scratch: &mut Scratch) -> Result<(), usize> {
        let panel = MatMut::from_column_major_slice_mut(self.values, self.height, self.columns);
        let (mut square, below) = panel.split_at_row_mut(self.columns);
        let stack = MemStack::new(scratch.memory(self.columns));
        cholesky_in_place(square.as_mut(), LltRegularization::default(), Par::Seq, stack, Default::default())
            .map_err(|LltError::NonPositivePivot { index }| index)?;
        solve_lower_triangular_in_place(square.as_ref(), below.transpose_mut(), Par::Seq);
        Ok(())
    }

    /// Subtracts `B Bᵀ` of the rows below from the lower triangle of `update`.
    pub(super) fn subtract_square(&self, update: &mut [f64]) {
        let depth = self.height - self.columns;
        let below = self.below();
        triangular::matmul(
            MatMut::from_column_major_slice_mut(update, depth, depth),
            BlockStructure::TriangularLower,
            Accum::Add,
            below,
            BlockStructure::Rectangular,
            below.transpose(),
            BlockStructure::Rectangular,
            -1.0,
            Par::Seq,
        );
    }

    fn below(&self) -> MatRef<'_, f64> {
        MatRef::from_column_major_slice(self.values, self.height, self.columns).split_at_row(self.columns).1
    }
}

/// From the panel of a factor, `L` and `B`, and `z_below`, the dense square of `H⁻¹` at the rows below: the panel of
/// `H⁻¹`, whose rows below are `−Z_below W` with `W = B L⁻¹` and whose square is `L⁻ᵀ L⁻¹ − Wᵀ (−Z_below W)`. Leaves
/// `W` and `L⁻¹` in `panel`.
pub(super) fn invert(panel: &mut Panel<'_>, z_below: &[f64], out: &mut [f64]) {
    let (height, columns) = (panel.height, panel.columns);
    let depth = height - columns;
    let factor = MatMut::from_column_major_slice_mut(panel.values, height, columns);
    let (mut square, mut w) = factor.split_at_row_mut(columns);
    let out = MatMut::from_column_major_slice_mut(out, height, columns);
    let (mut z_square, mut z_rows) = out.split_at_row_mut(columns);
    // W = B L⁻¹ solves Lᵀ Wᵀ = Bᵀ.
    solve_upper_triangular_in_place(square.as_ref().transpose(), w.as_mut().transpose_mut(), Par::Seq);
    let z_below = MatRef::from_column_major_slice(z_below, depth, depth);
    matmul(z_rows.as_mut(), Accum::Replace, z_below, w.as_ref(), -1.0, Par::Seq);
    // L⁻¹ by way of the output, then L⁻ᵀ L⁻¹.
    z_square.fill(0.0);
    z_square.as_mut().diagonal_mut().fill(1.0);
    solve_lower_triangular_in_place(square.as_ref(), z_square.as_mut(), Par::Seq);
    square.copy_from(&z_square);
    let inverse = square.as_ref();
    matmul(z_square.as_mut(), Accum::Replace, inverse.transpose(), inverse, 1.0, Par::Seq);
    matmul(z_square, Accum::Add, w.as_ref().transpose(), z_rows.as_ref(), -1.0, Par::Seq);
}

/// Working memory that grows to what the largest front needs.
#[derive(Default)]
pub(super) struct Scratch {
    memory: Option<MemBuffer>,
    size: usize,
}

impl Scratch {
    fn memory(&mut self, size: usize) -> &mut MemBuffer {
        if size > self.size {
            self.memory = None;
            self.size = size;
        }
        let size = self.size;
        let fresh = || MemBuffer::new(cholesky_in_place_scratch::<f64>(size, Par::Seq, Default::default()));
        self.memory.get_or_insert_with(fresh)
    }
}
