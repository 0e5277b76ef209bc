//! The nearest surface of a cloud, for hundreds of thousands of questions about it: pieces of surface sorted into the
//! cells of a dense table, in the order in which they are looked through. Lengths are in voxels.

use super::grid::bounds;
use core::ops::ControlFlow;

/// Edge of a cell: of a thinned wall each holds a handful of points.
const EDGE: f32 = 2.0;
/// Cells of the table at most (4 MiB); a wider cloud takes wider ones.
const CELLS_MAX: f64 = 1_048_576.0;

/// A point on a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Piece {
    /// Where.
    pub point: [f32; 3],
    /// Unit normal.
    pub normal: [f32; 3],
}

impl Piece {
    /// The squared distance from a place.
    fn squared(&self, at: &[f32; 3]) -> f32 {
        (0..3).map(|k| (self.point[k] - at[k]) * (self.point[k] - at[k])).sum()
    }
}

/// Pieces of surface sorted into cells.
pub struct Near {
    edge: f32,
    low: [f32; 3],
    dims: [usize; 3],
    /// Where each cell begins in `pieces`; the last coordinate runs fastest.
    starts: Vec<u32>,
    pieces: Vec<Piece>,
}

impl Near {
    /// Sorts pieces at finite points.
    pub fn new(pieces: &[Piece]) -> Self {
        let (low, high) = bounds(pieces.iter().map(|piece| &piece.point));
        let mut edge = EDGE;
        let cells = |edge: f32| [0, 1, 2].map(|k| (f64::from(high[k] - low[k]) / f64::from(edge)).floor() + 1.0);
        while cells(edge).iter().product::<f64>() > CELLS_MAX {
            edge *= 2.0;
        }
        let dims = cells(edge).map(|n| n as usize);
        let mut near =
            Self { edge, low, dims, starts: vec![0; dims.iter().product::<usize>() + 1], pieces: pieces.to_vec() };
        let home = |piece: &Piece| {
            let [x, y, z] = [0, 1, 2].map(|k| near.cell(piece.point[k], k).min(dims[k] as i64 - 1) as usize);
            near.position(x, y, z)
        };
        let homes: Vec<usize> = pieces.iter().map(home).collect();
        homes.iter().for_each(|&home| near.starts[home + 1] += 1);
        for k in 1..near.starts.len() {
            near.starts[k] += near.starts[k - 1];
        }
        let mut next = near.starts.clone();
        for (piece, home) in pieces.iter().zip(homes) {
            near.pieces[next[home] as usize] = *piece;
            next[home] += 1;
        }
        near
    }

    /// The piece nearest to `at` within `radius` of those that `fit`; of several, the first sorted in.
    pub fn nearest(&self, at: &[f32; 3], radius: f32, fits: impl Fn(&Piece) -> bool) -> Option<&Piece> {
        let mut best = (radius * radius, None);
        let _ = self.rows(at, radius, |row| {
            for piece in row {
                let squared = piece.squared(at);
                let nearer = squared < best.0 || (squared == best.0 && best.1.is_none());
                if nearer && fits(piece) {
                    best = (squared, Some(piece));
                }
            }
            ControlFlow::Continue(())
        });
        best.1
    }

    /// Whether a piece that `fits` lies within `radius` of `at`: what [`nearest`](Self::nearest) finds, but the first is
    /// enough.
    pub fn any(&self, at: &[f32; 3], radius: f32, fits: impl Fn(&Piece) -> bool) -> bool {
        let here = |piece: &Piece| piece.squared(at) <= radius * radius && fits(piece);
        let found =
            |row: &[Piece]| if row.iter().any(here) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
        self.rows(at, radius, found).is_break()
    }

    /// Shows every piece within `radius` of `at`.
    pub fn within(&self, at: &[f32; 3], radius: f32, mut each: impl FnMut(&Piece)) {
        let _ = self.rows(at, radius, |row| {
            row.iter().filter(|piece| piece.squared(at) <= radius * radius).for_each(&mut each);
            ControlFlow::Continue(())
        });
    }

    /// Shows the pieces of every cell within `radius` of `at`, row by row of cells, until it is enough.
    #[inline]
    fn rows<'a>(
        &'a self,
        at: &[f32; 3],
        radius: f32,
        mut each: impl FnMut(&'a [Piece]) -> ControlFlow<()>,
    ) -> ControlFlow<()> {
        let mut run = [(0, 0); 3];
        for k in 0..3 {
            let (from, to) = (self.cell(at[k] - radius, k).max(0), self.cell(at[k] + radius, k));
            let to = to.min(self.dims[k] as i64 - 1);
            if from > to {
                return ControlFlow::Continue(());
            }
            run[k] = (from as usize, to as usize);
        }
        for x in run[0].0..=run[0].1 {
            for y in run[1].0..=run[1].1 {
                let (first, last) = (self.position(x, y, run[2].0), self.position(x, y, run[2].1));
                each(&self.pieces[self.starts[first] as usize..self.starts[last + 1] as usize])?;
            }
        }
        ControlFlow::Continue(())
    }

    /// The cell of a coordinate, which may lie outside of the table: just before it counts as the first. Saturates.
    fn cell(&self, x: f32, axis: usize) -> i64 {
        ((x - self.low[axis]) / self.edge) as i64
    }

    fn position(&self, x: usize, y: usize, z: usize) -> usize {
        (x * self.dims[1] + y) * self.dims[2] + z
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Lattices hold the ties that clouds of walls hold; one far point makes the table coarse.
        #[test]
        fn the_nearest_is_that_of_a_full_search(
            lattice in prop::collection::vec((0..9i32, 0..9i32, 0..3i32, any::<bool>()), 0..300),
            at in (-9..27i32, -9..27i32, -9..15i32),
            radius in 0.0..4.0f32,
            far in prop::option::of(1e3..1e6f32),
        ) {
            let piece = |(x, y, z, up): (i32, i32, i32, bool)| Piece {
                point: [x, y, z].map(|c| c as f32 * 0.5),
                normal: if up { [0.0, 0.0, 1.0] } else { [1.0, 0.0, 0.0] },
            };
            let mut pieces: Vec<Piece> = lattice.into_iter().map(piece).collect();
            pieces.extend(far.map(|x| Piece { point: [x, -x, x], normal: [0.0, 0.0, 1.0] }));
            let at = [at.0, at.1, at.2].map(|c| c as f32 * 0.25);
            let up = |piece: &Piece| piece.normal[2] > 0.5;
            let near = Near::new(&pieces);
            let found = near.nearest(&at, radius, up).map(|piece| piece.squared(&at));
            let all = pieces.iter().filter(|piece| up(piece)).map(|piece| piece.squared(&at));
            let expected = all.filter(|d| *d <= radius * radius).min_by(f32::total_cmp);
            prop_assert_eq!(found, expected);
            prop_assert_eq!(near.any(&at, radius, up), expected.is_some());
        }
    }

    #[test]
    fn nothing_is_near_nothing_and_no_number_panics() {
        assert!(Near::new(&[]).nearest(&[0.0; 3], 1.0, |_| true).is_none());
        let one = Near::new(&[Piece { point: [0.0; 3], normal: [0.0, 0.0, 1.0] }]);
        for x in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e38] {
            assert!(one.nearest(&[x, 0.0, 0.0], 1.0, |_| true).is_none());
        }
        assert!(one.nearest(&[1.0, 0.0, 0.0], 1.0, |_| true).is_some());
    }
}
