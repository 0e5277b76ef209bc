//! Entries of `H⁻¹` in the pattern of its factor, front by front from the root down (Takahashi, Fagan and Chen 1973;
//! the supernodal form of Lin et al. 2011, "SelInv").

use super::dense::{self, Panel};
use super::{BlockPattern, Factor, Front};

/// The panels of `H⁻¹`, laid out as [`BlockPattern`] says; of a front's square both triangles.
#[derive(Debug)]
pub(in crate::estimate) struct SelectedInverse<'a> {
    pattern: &'a BlockPattern,
    values: Vec<f64>,
}

impl BlockPattern {
    /// The entries of `H⁻¹` in the pattern of `L`.
    pub(in crate::estimate) fn selected_inverse(&self, factor: &Factor) -> SelectedInverse<'_> {
        let mut values = factor.values.clone();
        let mut z_below = Vec::new();
        let mut out = Vec::new();
        for front in self.fronts.iter().rev() {
            let range = front.offset..front.offset + front.height * front.pivots.len();
            self.gather(front, &values, &mut z_below);
            out.clear();
            out.resize(range.len(), 0.0);
            let mut panel =
                Panel { values: &mut values[range.clone()], height: front.height, columns: front.pivots.len() };
            dense::invert(&mut panel, &z_below, &mut out);
            values[range].copy_from_slice(&out);
        }
        SelectedInverse { pattern: self, values }
    }

    /// The square of `H⁻¹` at the rows below a front, from the panels of the fronts that eliminate them.
    fn gather(&self, front: &Front, values: &[f64], square: &mut Vec<f64>) {
        let depth = front.depth();
        square.clear();
        square.resize(depth * depth, 0.0);
        let mut above = front.parent;
        let mut done = 0;
        while let Some(holder) = above.map(|k| &self.fronts[k]) {
            above = holder.parent;
            let pieces = front.pieces_in(done, holder);
            for piece in &pieces {
                let columns = piece.length.min(holder.pivots.len().saturating_sub(piece.to));
                done += columns;
                for c in 0..columns {
                    let source = &values[holder.offset + (piece.to + c) * holder.height..][..holder.height];
                    let column = piece.from + c;
                    for rows in &pieces {
                        for r in 0..rows.length {
                            let value = source[rows.to + r];
                            square[column * depth + rows.from + r] = value;
                            square[(rows.from + r) * depth + column] = value;
                        }
                    }
                }
            }
            if done == depth {
                return;
            }
        }
    }
}

impl SelectedInverse<'_> {
    /// The entry at scalars (`r`, `c`) of variables (`a`, `b`); `None` outside the pattern.
    pub(in crate::estimate) fn get(&self, (a, r): (usize, usize), (b, c): (usize, usize)) -> Option<f64> {
        let pattern = self.pattern;
        let (r, c) = (pattern.starts[a] + r, pattern.starts[b] + c);
        let (row, column) = (r.max(c), r.min(c));
        let variable = if pattern.starts[a] < pattern.starts[b] { a } else { b };
        let front = &pattern.fronts[pattern.front_of[variable]];
        if !(front.pivots.contains(&row) || front.below.iter().any(|run| run.contains(&row))) {
            return None;
        }
        self.values.get(front.offset + (column - front.pivots.start) * front.height + front.row_of(row)).copied()
    }
}
