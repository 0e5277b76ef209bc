//! Points sorted into square columns of a dense table, and by height within each: who is near whom, for many questions
//! about one cloud. Points of one cell (a column's stretch as high as it is wide) share one candidate list, so that the
//! arithmetic on neighbours runs over contiguous lanes.

/// Columns of the table at most; a wider cloud takes wider ones.
const COLUMNS_MAX: f64 = 262_144.0;
/// Numbers worked on together.
pub const LANES: usize = 8;

/// Points sorted into columns.
pub struct Grid {
    edge: f32,
    low: [f32; 3],
    high: [f32; 3],
    dims: [usize; 2],
    /// Where each column begins in `order`.
    starts: Vec<u32>,
    /// Points by column, in each by height.
    order: Vec<u32>,
    /// Their heights.
    heights: Vec<f32>,
}

impl Grid {
    /// Sorts `points` (finite) into columns of `edge` or a power of two times as much.
    pub fn new(points: &[[f32; 3]], edge: f32) -> Self {
        let (low, high) = bounds(points.iter());
        let mut edge = edge;
        let columns = |edge: f32| [0, 1].map(|k| (f64::from(high[k] - low[k]) / f64::from(edge)).floor() + 1.0);
        while columns(edge).iter().product::<f64>() > COLUMNS_MAX {
            edge *= 2.0;
        }
        let dims = columns(edge).map(|n| n as usize);
        let (starts, order) = (vec![0; dims[0] * dims[1] + 1], vec![0; points.len()]);
        let mut grid = Self { edge, low, high, dims, starts, order, heights: Vec::new() };
        let homes: Vec<usize> = points.iter().map(|p| grid.position(grid.column(p))).collect();
        homes.iter().for_each(|&home| grid.starts[home + 1] += 1);
        for k in 1..grid.starts.len() {
            grid.starts[k] += grid.starts[k - 1];
        }
        let mut next = grid.starts.clone();
        for (point, home) in (0..).zip(homes) {
            grid.order[next[home] as usize] = point;
            next[home] += 1;
        }
        let by_height = |a: &u32, b: &u32| points[*a as usize][2].total_cmp(&points[*b as usize][2]).then(a.cmp(b));
        for pair in grid.starts.windows(2).filter(|pair| pair[1] - pair[0] > 1) {
            grid.order[pair[0] as usize..pair[1] as usize].sort_unstable_by(by_height);
        }
        grid.heights = grid.order.iter().map(|&k| points[k as usize][2]).collect();
        grid
    }

    /// The points, cell by cell.
    pub fn cells(&self) -> impl Iterator<Item = &[u32]> {
        let mut begin = 0;
        let mut column = 0;
        core::iter::from_fn(move || {
            let first = *self.heights.get(begin)?;
            while self.starts[column + 1] as usize <= begin {
                column += 1;
            }
            let rest = &self.heights[begin..self.starts[column + 1] as usize];
            let end = begin + rest.iter().take_while(|&&height| height - first < self.edge).count().max(1);
            let cell = &self.order[begin..end];
            begin = end;
            Some(cell)
        })
    }

    /// Fills `found` with all points within `radius` of the box from `low` to `high`, and more.
    pub fn around(&self, low: &[f32; 3], high: &[f32; 3], radius: f32, found: &mut Vec<u32>) {
        found.clear();
        let (low, high) = (low.map(|x| x - radius), high.map(|x| x + radius));
        if self.order.is_empty() || (0..3).any(|k| high[k] < self.low[k] || low[k] > self.high[k]) {
            return;
        }
        let (from, to) = (self.column(&low), self.column(&high));
        for x in from[0]..=to[0] {
            let row = self.position([x, from[1]])..=self.position([x, to[1]]);
            for pair in self.starts[*row.start()..=*row.end() + 1].windows(2) {
                let column = pair[0] as usize..pair[1] as usize;
                let heights = &self.heights[column.clone()];
                let first = column.start + heights.partition_point(|&height| height < low[2]);
                let end = column.start + heights.partition_point(|&height| height <= high[2]);
                found.extend_from_slice(&self.order[first..end]);
            }
        }
    }

    /// The column of a point, or the outermost one towards it.
    fn column(&self, p: &[f32; 3]) -> [usize; 2] {
        [0, 1].map(|k| (((p[k] - self.low[k]) / self.edge).max(0.0) as usize).min(self.dims[k] - 1))
    }

    fn position(&self, [x, y]: [usize; 2]) -> usize {
        x * self.dims[1] + y
    }
}

/// A cell's coordinates (from -2²⁰ to 2²⁰) as one number, which sorts as they do.
pub fn cell_key(cell: [i32; 3]) -> u64 {
    cell.iter().fold(0, |key, &x| key << 21 | (i64::from(x) + (1 << 20)).clamp(0, (1 << 21) - 1) as u64)
}

/// Least and largest coordinates; zeros without points.
pub fn bounds<'a>(mut points: impl Iterator<Item = &'a [f32; 3]>) -> ([f32; 3], [f32; 3]) {
    let Some(&first) = points.next() else { return ([0.0; 3], [0.0; 3]) };
    points.fold((first, first), |(low, high), p| {
        ([0, 1, 2].map(|k| low[k].min(p[k])), [0, 1, 2].map(|k| high[k].max(p[k])))
    })
}

/// Points by column and in groups of [`LANES`]; the last group is padded with points that are near nothing. The first
/// three of the `N` columns are the position.
pub struct Lanes<const N: usize> {
    /// By group, then by column.
    pub groups: Vec<[[f32; LANES]; N]>,
}

impl<const N: usize> Lanes<N> {
    /// Coordinate of a point that pads: out of reach of every real one.
    const FAR: f32 = 1e9;

    /// None.
    pub fn new() -> Self {
        Self { groups: Vec::new() }
    }

    /// Takes in the chosen points.
    pub fn fill(&mut self, points: &[[f32; N]], chosen: &[u32]) {
        self.groups.clear();
        for group in chosen.chunks(LANES) {
            let mut columns = [[Self::FAR; LANES]; N];
            for (lane, &i) in group.iter().enumerate() {
                let point = &points[i as usize];
                (0..N).for_each(|k| columns[k][lane] = point[k]);
            }
            self.groups.push(columns);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// Lattices hold the ties that clouds of walls hold; one far point makes the table coarse.
        #[test]
        fn all_neighbours_are_among_those_found(
            lattice in prop::collection::vec((0..9i32, 0..9i32, 0..3i32), 0..300),
            at in (-2..12i32, -2..12i32, -2..5i32),
            radius in 0.0..4.0f32,
            far in prop::option::of(1e3..1e6f32),
        ) {
            let v = |(x, y, z): (i32, i32, i32)| [x, y, z].map(|c| c as f32 * 0.5);
            let mut points: Vec<[f32; 3]> = lattice.into_iter().map(v).collect();
            points.extend(far.map(|x| [x, -x, x]));
            let grid = Grid::new(&points, 1.0);
            let (at, mut found) = (v(at), Vec::new());
            grid.around(&at, &at, radius, &mut found);
            let squared = |p: &[f32; 3]| (0..3).map(|k| (p[k] - at[k]) * (p[k] - at[k])).sum::<f32>();
            for (i, _) in (0u32..).zip(&points).filter(|(_, p)| squared(p) <= radius * radius) {
                prop_assert!(found.contains(&i));
            }
            let mut all: Vec<u32> = grid.cells().flatten().copied().collect();
            all.sort_unstable();
            prop_assert!(all.into_iter().eq(0..points.len() as u32));
        }
    }

    #[test]
    fn lanes_are_padded_out_of_reach() {
        let mut lanes = Lanes::<4>::new();
        lanes.fill(&[[1.0, 2.0, 3.0, 4.0]; 9], &[0, 1, 2, 3, 4, 5, 6, 7, 8]);
        assert_eq!(lanes.groups.len(), 2);
        assert_eq!(lanes.groups[1][1][..2], [2.0, Lanes::<4>::FAR]);
        lanes.fill(&[], &[]);
        assert!(lanes.groups.is_empty());
    }
}
