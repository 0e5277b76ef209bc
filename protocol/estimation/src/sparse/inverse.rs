//! Entries of `H⁻¹` in the pattern of its factor, front by front from the root down (Takahashi, Fagan and Chen 1973;
//! the supernodal form of Lin et al. 2011, "SelInv").

use super::dense::{self, Panel};
use super::{BlockPattern, Factor, Front};
use core::cmp::Ordering;

/// Blocks of `H⁻¹`. The whole panels would take as much again as the factor; those that ask want the blocks that `H`
/// has, or fewer.
#[derive(Debug)]
pub(crate) struct SelectedInverse<'a> {
    pattern: &'a BlockPattern,
    /// By variable, the first of its blocks: those whose other variable is eliminated later, or is itself. Then where
    /// all end.
    firsts: Vec<usize>,
    blocks: Vec<Block>,
    values: Vec<f64>,
}

/// A block with the rows of `later`, column-major; of one on the diagonal the lower triangle counts.
#[derive(Clone, Copy, Debug)]
struct Block {
    later: usize,
    rows: usize,
    columns: usize,
    /// Its first value.
    at: usize,
}

impl BlockPattern {
    /// The blocks of `H⁻¹` on its diagonal, and those of `pairs` that lie in the pattern of `L`.
    ///
    /// Going down from the root, a front needs the panels of those above it and no others: they alone are held.
    pub(crate) fn selected_inverse(
        &self,
        factor: &Factor,
        pairs: impl IntoIterator<Item = (usize, usize)>,
    ) -> SelectedInverse<'_> {
        let mut out = SelectedInverse::zeros(self, pairs);
        let (places, most) = self.places_on_the_way();
        let mut way = vec![0.0; most];
        let (mut z_below, mut panel) = (Vec::new(), Vec::new());
        let mut left = self.order.len();
        for (front, &place) in self.fronts.iter().zip(&places).rev() {
            let (above, rest) = way.split_at_mut(place);
            let values = &mut rest[..front.value_count()];
            self.gather(front, above, &places, &mut z_below);
            panel.clear();
            panel.extend_from_slice(&factor.values[front.offset..front.offset + front.value_count()]);
            let mut panel = Panel { values: &mut panel, height: front.height, columns: front.pivots.len() };
            dense::invert(&mut panel, &z_below, values);
            while let Some(&variable) = self.order[..left].last().filter(|&&v| self.starts[v] >= front.pivots.start) {
                left -= 1;
                out.take(front, variable, values);
            }
        }
        out
    }

    /// By front, where its panel lies among those on its way to the root; and the length of the longest way.
    fn places_on_the_way(&self) -> (Vec<usize>, usize) {
        let (mut places, mut most) = (vec![0; self.fronts.len()], 0);
        for (k, front) in self.fronts.iter().enumerate().rev() {
            places[k] = front.parent.map_or(0, |parent| places[parent] + self.fronts[parent].value_count());
            most = most.max(places[k] + front.value_count());
        }
        (places, most)
    }

    /// The square of `H⁻¹` at the rows below a front, from the panels of the fronts that eliminate them.
    fn gather(&self, front: &Front, above: &[f64], places: &[usize], square: &mut Vec<f64>) {
        let depth = front.depth();
        square.clear();
        square.resize(depth * depth, 0.0);
        let mut next = front.parent;
        let mut done = 0;
        while let Some((holder, place)) = next.map(|k| (&self.fronts[k], places[k])) {
            next = holder.parent;
            let pieces = front.pieces_in(done, holder);
            for piece in &pieces {
                let columns = piece.length.min(holder.pivots.len().saturating_sub(piece.to));
                done += columns;
                for c in 0..columns {
                    let source = &above[place + (piece.to + c) * holder.height..][..holder.height];
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

impl<'a> SelectedInverse<'a> {
    /// The blocks that are wanted, still zero.
    fn zeros(pattern: &'a BlockPattern, pairs: impl IntoIterator<Item = (usize, usize)>) -> Self {
        let BlockPattern { starts, order, .. } = pattern;
        let ends = order.iter().skip(1).map(|&next| starts[next]).chain([pattern.scalars]);
        let mut sizes = vec![0; order.len()];
        order.iter().zip(ends).for_each(|(&variable, end)| sizes[variable] = end - starts[variable]);
        let is_held = |&(first, later): &(usize, usize)| pattern.fronts[pattern.front_of[first]].holds(starts[later]);
        let in_order = |(a, b): (usize, usize)| if starts[a] <= starts[b] { (a, b) } else { (b, a) };
        let mut wanted: Vec<(usize, usize)> = pairs.into_iter().map(in_order).filter(is_held).collect();
        wanted.extend((0..order.len()).map(|variable| (variable, variable)));
        wanted.sort_unstable();
        wanted.dedup();
        let mut firsts = Vec::with_capacity(order.len() + 1);
        let mut blocks = Vec::with_capacity(wanted.len());
        let mut count = 0;
        for (first, later) in wanted {
            // Every variable has a block, that on the diagonal.
            if firsts.len() == first {
                firsts.push(blocks.len());
            }
            blocks.push(Block { later, rows: sizes[later], columns: sizes[first], at: count });
            count += sizes[later] * sizes[first];
        }
        firsts.push(blocks.len());
        Self { pattern, firsts, blocks, values: vec![0.0; count] }
    }

    /// Takes a variable's blocks from the panel of `H⁻¹` of its front.
    fn take(&mut self, front: &Front, variable: usize, panel: &[f64]) {
        let column = self.pattern.starts[variable] - front.pivots.start;
        for &Block { later, rows, columns, at } in &self.blocks[self.firsts[variable]..self.firsts[variable + 1]] {
            let row = front.row_of(self.pattern.starts[later]);
            for c in 0..columns {
                let from = &panel[(column + c) * front.height + row..][..rows];
                self.values[at + c * rows..][..rows].copy_from_slice(from);
            }
        }
    }

    /// The entry at scalars (`r`, `c`) of variables (`a`, `b`); `None` where that block was not wanted.
    pub(crate) fn get(&self, (a, r): (usize, usize), (b, c): (usize, usize)) -> Option<f64> {
        let starts = &self.pattern.starts;
        let (first, later, r, c) = match starts[a].cmp(&starts[b]) {
            Ordering::Less => (a, b, c, r),
            Ordering::Equal => (a, b, r.max(c), r.min(c)),
            Ordering::Greater => (b, a, r, c),
        };
        let blocks = &self.blocks[self.firsts[first]..self.firsts[first + 1]];
        let block = blocks.get(blocks.binary_search_by_key(&later, |block| block.later).ok()?)?;
        self.values.get(block.at + c * block.rows + r).copied()
    }
}
