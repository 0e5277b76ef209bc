//! My submap as a raster: which way walls face in each cell, and which cells my beams passed through.

use super::fit::Walls;
use libm::atan2;
use nalgebra::Vector2;

/// Directions that walls are told apart by.
pub const SECTORS: u32 = 8;
/// Set in a cell that beams passed through and where nothing stands.
pub const FREE: u16 = 1 << SECTORS;
/// Edge of a cell.
pub const EDGE: f64 = 2.0;
/// Cells along an axis at most: what lies farther out is left out.
pub const CELLS_MAX: usize = 1 << 10;
/// Beams end where they are this near to the wall that they hit...
const SHORT: f64 = 3.0;
/// ...or this far before something that is no wall, or a wall that they graze...
const SHORT_MAX: f64 = 40.0;
/// ...are looked at in steps of this length...
const STRIDE: f64 = 1.0;
/// ...so many at most...
const STRIDES_MAX: usize = 4096;
/// Cells around something that are not free.
const GUARD: i32 = 1;

/// The raster.
pub struct Codec {
    low: Vector2<f64>,
    /// Cells along x and y.
    pub size: [i32; 2],
    cells: Vec<u16>,
}

/// A beam: where from, and what it hit.
#[derive(Clone, Copy, Debug)]
pub struct Beam {
    /// The sensor.
    pub from: Vector2<f64>,
    /// The point.
    pub to: Vector2<f64>,
    /// Which way the wall faces there, if there is one.
    pub normal: Option<Vector2<f64>>,
}

impl Beam {
    /// How much of it surely is air.
    fn clear_length(&self) -> f64 {
        let way = self.to - self.from;
        let length = way.norm();
        let lean = self.normal.map_or(0.3, |n| n.dot(&way).abs() / length.max(1e-9));
        length - (SHORT / lean.max(1e-9)).min(SHORT_MAX)
    }
}

/// For each of the points how many beams passed through its cell.
pub fn passed(points: &[Vector2<f64>], beams: &[Beam]) -> Vec<u8> {
    let chart = Codec::blank(points);
    let passed = chart.passed(beams);
    points.iter().map(|p| chart.position(chart.cell(p)).map_or(0, |at| passed[at])).collect()
}

impl Codec {
    /// Of oriented points; `all` are those and the ones without orientation. Cells are free through which at least
    /// `beams_min` beams passed.
    pub fn new(walls: &Walls, all: &[Vector2<f64>], beams: &[Beam], beams_min: u8) -> Self {
        let mut chart = Self::blank(all);
        let passed = chart.passed(beams);
        for (cell, beams) in chart.cells.iter_mut().zip(passed) {
            *cell = if beams >= beams_min { FREE } else { 0 };
        }
        for p in all {
            chart.around(p, GUARD, |cell| *cell &= !FREE);
        }
        for (p, n) in walls.points.iter().zip(&walls.normals) {
            chart.around(p, 1, |cell| *cell |= facing(n));
        }
        chart
    }

    fn blank(all: &[Vector2<f64>]) -> Self {
        let (low, high) = bounds(all);
        let size = (high - low).map(|x| ((x / EDGE).floor() as usize).min(CELLS_MAX - 1) as i32 + 1);
        Self { low, size: size.into(), cells: vec![0; (size.x * size.y) as usize] }
    }

    /// How many beams passed through each cell.
    fn passed(&self, beams: &[Beam]) -> Vec<u8> {
        let mut passed = vec![0_u8; self.cells.len()];
        for beam in beams {
            let length = beam.clear_length();
            let Some(step) = (beam.to - beam.from).try_normalize(1e-9).filter(|_| length > 0.0) else { continue };
            let mut last = usize::MAX;
            for k in 0..((length / STRIDE) as usize).min(STRIDES_MAX) {
                let Some(at) = self.position(self.cell(&(beam.from + step * (STRIDE * k as f64)))) else { continue };
                // Once a beam.
                if at != last {
                    passed[at] = passed[at].saturating_add(1);
                    last = at;
                }
            }
        }
        passed
    }

    fn around(&mut self, p: &Vector2<f64>, by: i32, mut each: impl FnMut(&mut u16)) {
        let [x, y] = self.cell(p);
        for i in x - by..=x + by {
            for j in y - by..=y + by {
                if let Some(at) = self.position([i, j]) {
                    each(&mut self.cells[at]);
                }
            }
        }
    }

    /// The cell of a place, which may lie outside.
    pub fn cell(&self, p: &Vector2<f64>) -> [i32; 2] {
        ((p - self.low) / EDGE).map(|x| x.floor() as i32).into()
    }

    /// The place where the cell (0, 0) begins.
    pub fn corner(&self) -> Vector2<f64> {
        self.low
    }

    fn position(&self, [x, y]: [i32; 2]) -> Option<usize> {
        let inside = (0..self.size[0]).contains(&x) && (0..self.size[1]).contains(&y);
        inside.then_some((y * self.size[0] + x) as usize)
    }

    /// What is known of a cell; nothing outside.
    pub fn at(&self, cell: [i32; 2]) -> u16 {
        self.position(cell).map_or(0, |at| self.cells[at])
    }

    /// Whether beams passed through a place and nothing stands near.
    pub fn is_free(&self, p: &Vector2<f64>) -> bool {
        self.at(self.cell(p)) & FREE != 0
    }

    /// For each cell all that is set in the `span`² cells that begin with it: what a shift by less than `span` cells
    /// can reach. It begins `span` cells earlier.
    pub fn reachable(&self, span: i32) -> Self {
        let low = self.low - Vector2::repeat(EDGE * f64::from(span));
        let size = self.size.map(|n| n + span);
        let mut wide = Self { low, size, cells: vec![0; (size[0] * size[1]) as usize] };
        for y in 0..self.size[1] {
            for x in 0..self.size[0] {
                wide.cells[((y + span) * size[0] + x + span) as usize] = self.at([x, y]);
            }
        }
        for along in [[1, 0], [0, 1]] {
            let mut cells = Vec::with_capacity(wide.cells.len());
            for y in 0..size[1] {
                for x in 0..size[0] {
                    let window = (0..span).map(|k| wide.at([x + k * along[0], y + k * along[1]]));
                    cells.push(window.fold(0, |all, cell| all | cell));
                }
            }
            wide.cells = cells;
        }
        wide
    }
}

/// The sectors that a wall facing `n` may be taken for: its own and the nearer neighbour.
fn facing(n: &Vector2<f64>) -> u16 {
    let place = place(n);
    let own = place.floor();
    let beside = if place - own < 0.5 { own - 1.0 } else { own + 1.0 };
    bit(own) | bit(beside)
}

/// The sector that a wall facing `n` is looked up by.
pub fn sector(n: &Vector2<f64>) -> u16 {
    bit(place(n).floor())
}

/// The direction in sectors.
fn place(n: &Vector2<f64>) -> f64 {
    atan2(n.y, n.x) / core::f64::consts::TAU * f64::from(SECTORS)
}

fn bit(sector: f64) -> u16 {
    1 << (sector as i32).rem_euclid(SECTORS as i32)
}

fn bounds(points: &[Vector2<f64>]) -> (Vector2<f64>, Vector2<f64>) {
    let first = points.first().copied().unwrap_or_else(Vector2::zeros);
    points.iter().fold((first, first), |(low, high), p| (low.inf(p), high.sup(p)))
}
