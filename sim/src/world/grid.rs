//! A uniform grid over the ground that tells a ray which solids it may meet, cell by cell (Amanatides and Woo, "A fast
//! voxel traversal algorithm for ray tracing", 1987). Cells of 1 m suit solids of about that size.

use super::shape::{Ray, Shape};

/// Edge of a cell, m.
const CELL_M: f64 = 1.0;

/// Which solids stand over each cell.
#[derive(Clone, Debug)]
pub struct Grid {
    origin: [f64; 2],
    size: [usize; 2],
    cells: Vec<Vec<u32>>,
}

impl Grid {
    /// The grid that covers all these solids.
    pub fn new(shapes: &[Shape]) -> Self {
        let mut bounds = [0.0f64, 0.0, 0.0, 0.0];
        for b in shapes.iter().map(Shape::bounds) {
            bounds = [bounds[0].min(b[0]), bounds[1].min(b[1]), bounds[2].max(b[2]), bounds[3].max(b[3])];
        }
        let cells_along = |low: f64, high: f64| ((high - low) / CELL_M).floor() as usize + 1;
        let size = [cells_along(bounds[0], bounds[2]), cells_along(bounds[1], bounds[3])];
        let mut grid = Self { origin: [bounds[0], bounds[1]], size, cells: vec![Vec::new(); size[0] * size[1]] };
        for (index, shape) in (0u32..).zip(shapes) {
            let b = shape.bounds();
            for y in grid.cell(1, b[1])..=grid.cell(1, b[3]) {
                for x in grid.cell(0, b[0])..=grid.cell(0, b[2]) {
                    grid.cells[y * size[0] + x].push(index);
                }
            }
        }
        grid
    }

    /// Distance to the nearest solid within `range`.
    pub fn cast(&self, shapes: &[Shape], ray: &Ray, range: f64) -> Option<f64> {
        let start = self.enter(ray)?;
        if start > range {
            return None;
        }
        // `cell` clamps, so rounding cannot put the first cell outside.
        let at = ray.origin + ray.direction * start;
        let mut cell = [self.cell(0, at.x), self.cell(1, at.y)];
        let direction = [ray.direction.x, ray.direction.y];
        let origin = [ray.origin.x, ray.origin.y];
        let border = |axis: usize, cell: usize| {
            let edge = self.origin[axis] + (cell + usize::from(direction[axis] > 0.0)) as f64 * CELL_M;
            if direction[axis] == 0.0 { f64::INFINITY } else { (edge - origin[axis]) / direction[axis] }
        };
        let mut next = [border(0, cell[0]), border(1, cell[1])];
        let mut nearest = range;
        let mut found = false;
        loop {
            for &index in &self.cells[cell[1] * self.size[0] + cell[0]] {
                if let Some(t) = shapes[index as usize].hit(ray)
                    && t <= nearest
                {
                    (nearest, found) = (t, true);
                }
            }
            let axis = usize::from(next[1] < next[0]);
            // A solid found beyond this cell's border may hide behind one of the next cell.
            if nearest <= next[axis] {
                break;
            }
            let step = if direction[axis] > 0.0 { cell[axis].checked_add(1) } else { cell[axis].checked_sub(1) };
            match step.filter(|&c| c < self.size[axis]) {
                Some(c) => cell[axis] = c,
                None => break,
            }
            next[axis] = border(axis, cell[axis]);
        }
        found.then_some(nearest)
    }

    /// Where the ray enters the grid's square; 0 if it starts inside.
    fn enter(&self, ray: &Ray) -> Option<f64> {
        let (mut near, mut far) = (0.0f64, f64::INFINITY);
        for axis in 0..2 {
            let (o, d) = (ray.origin[axis], ray.direction[axis]);
            let low = self.origin[axis];
            let high = low + self.size[axis] as f64 * CELL_M;
            if d == 0.0 {
                if !(low..=high).contains(&o) {
                    return None;
                }
                continue;
            }
            let (a, b) = ((low - o) / d, (high - o) / d);
            near = near.max(a.min(b));
            far = far.min(a.max(b));
        }
        (near <= far).then_some(near)
    }

    fn cell(&self, axis: usize, at: f64) -> usize {
        // `as` saturates: what lies below the origin falls into cell 0.
        (((at - self.origin[axis]) / CELL_M) as usize).min(self.size[axis] - 1)
    }
}
