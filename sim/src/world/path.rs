//! Where robots drive: smooth closed loops, one per robot, laid out on a sunflower spiral so that each overlaps its
//! neighbours (neighbours drive in opposite directions and start elsewhere, so places are seen with other headings), or
//! stretches of a recorded drive.

use crate::dice::Dice;
use core::f64::consts::TAU;
use libm::{atan2, cos, sin, sqrt};

/// Corners of the polyline that stands for a loop.
const CORNERS: usize = 720;
/// Turn between successive loop centres (the golden angle), rad.
const GOLDEN_ANGLE: f64 = 2.399_963_229_728_653;
/// Robots begin within so many cells of an aisle.
const STARTS_CELLS: f64 = 3.0;
/// Corners of a recorded drive are this far apart, m.
const DRIVE_STEP_M: f64 = 0.5;
/// The heading is that of a chord as long as a robot, not of one polyline edge, so that it has no steps, m...
const LOOP_CHORD_M: f64 = 0.4;
/// ...and on a recorded drive of one as long as a car, whose recorded poses are about a metre apart, m.
const DRIVE_CHORD_M: f64 = 4.0;

/// A closed loop or a stretch on the ground, parametrised by arc length.
#[derive(Clone, Debug)]
pub struct Path {
    corners: Vec<[f64; 2]>,
    /// Arc length at each corner; the last is the whole path's.
    lengths: Vec<f64>,
    is_closed: bool,
}

impl Path {
    /// The loop of robot `index`: mean radius `radius_m`, centres about `spread_m` apart.
    pub fn of_robot(index: usize, radius_m: f64, spread_m: f64, dice: &mut Dice) -> Self {
        let away = spread_m * sqrt(index as f64);
        let bearing = GOLDEN_ANGLE * index as f64 + dice.range(-0.2, 0.2);
        let centre = [away * cos(bearing), away * sin(bearing)];
        let harmonics = [2.0, 3.0, 4.0].map(|order| (order, dice.range(0.03, 0.10), dice.range(0.0, TAU)));
        let start = dice.range(0.0, TAU);
        let turn = if index.is_multiple_of(2) { 1.0 } else { -1.0 };
        let corners = (0..CORNERS).map(|k| {
            let angle = start + turn * TAU * k as f64 / CORNERS as f64;
            let bumps: f64 = harmonics.iter().map(|(order, size, phase)| size * cos(order * angle + phase)).sum();
            let radius = radius_m * (1.0 + bumps);
            [centre[0] + radius * cos(angle), centre[1] + radius * sin(angle)]
        });
        Self::closed(corners.collect())
    }

    /// The aisle of robot `index` through a lattice of cells: two robots share one, in opposite directions, from
    /// anywhere within its first few cells.
    pub fn of_aisle(index: usize, cell_m: f64, length_m: f64, dice: &mut Dice) -> Self {
        let y = cell_m * ((index / 2) as f64 + 0.5);
        let start = dice.range(0.0, STARTS_CELLS * cell_m);
        let (from, to) = (start, start + length_m);
        let ends = if index.is_multiple_of(2) { [from, to] } else { [to, from] };
        Self::along(&ends.map(|x| [x, y]))
    }

    /// The drive along these points, at least two, no two in a row the same.
    pub fn along(points: &[[f64; 2]]) -> Self {
        let rough = Self::of(points.to_vec(), false);
        rough.stretch(0.0, rough.length())
    }

    /// The part of a path that ends between `from` and `to`, m along it.
    pub fn stretch(&self, from: f64, to: f64) -> Self {
        let steps = libm::ceil((to - from) / DRIVE_STEP_M).max(1.0);
        let corner = |k: usize| self.point(from + (to - from) * k as f64 / steps);
        Self::of((0..=steps as usize).map(corner).collect(), false)
    }

    fn closed(mut corners: Vec<[f64; 2]>) -> Self {
        corners.push(corners[0]);
        Self::of(corners, true)
    }

    fn of(corners: Vec<[f64; 2]>, is_closed: bool) -> Self {
        let mut lengths = vec![0.0];
        let mut length = 0.0;
        for pair in corners.windows(2) {
            length += distance(pair[0], pair[1]);
            lengths.push(length);
        }
        Self { corners, lengths, is_closed }
    }

    /// Where the path ends, m along it; a loop does not.
    pub fn end(&self) -> Option<f64> {
        (!self.is_closed).then(|| self.length())
    }

    /// Length of the path, of a loop that of one lap, m.
    pub fn length(&self) -> f64 {
        self.lengths.last().copied().unwrap_or(0.0)
    }

    /// Position and heading (rad) after `distance` m; of a loop lap after lap.
    pub fn at(&self, distance: f64) -> ([f64; 2], f64) {
        let half = if self.is_closed { LOOP_CHORD_M } else { DRIVE_CHORD_M } / 2.0;
        let ahead = self.point(distance + half);
        let behind = self.point(distance - half);
        (self.point(distance), atan2(ahead[1] - behind[1], ahead[0] - behind[0]))
    }

    fn point(&self, distance: f64) -> [f64; 2] {
        let lap = self.length();
        let s = if self.is_closed { distance - lap * libm::floor(distance / lap) } else { distance.clamp(0.0, lap) };
        let edge = self.lengths.partition_point(|&l| l <= s).clamp(1, self.corners.len() - 1) - 1;
        let share = (s - self.lengths[edge]) / (self.lengths[edge + 1] - self.lengths[edge]);
        let (a, b) = (self.corners[edge], self.corners[edge + 1]);
        [a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share]
    }

    /// Distance from `p` to the nearest corner.
    pub fn clearance(&self, p: [f64; 2]) -> f64 {
        self.corners.iter().map(|&c| distance(c, p)).fold(f64::INFINITY, f64::min)
    }

    /// Bounding box `[x0, y0, x1, y1]`.
    pub fn bounds(&self) -> [f64; 4] {
        self.corners.iter().fold([f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY], |b, c| {
            [b[0].min(c[0]), b[1].min(c[1]), b[2].max(c[0]), b[3].max(c[1])]
        })
    }
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    libm::hypot(a[0] - b[0], a[1] - b[1])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_is_smooth_closed_and_measured_in_metres() {
        for index in 0..10 {
            let path = Path::of_robot(index, 5.0, 3.0, &mut Dice::new(7, "path"));
            let lap = path.length();
            assert!((20.0..60.0).contains(&lap), "{lap}");
            let (start, end) = (path.at(0.0).0, path.at(lap).0);
            assert!(distance(start, end) < 1e-6);
            let step = 0.05;
            let mut heading = path.at(0.0).1;
            for k in 1..1500 {
                let (a, b) = (path.at(step * f64::from(k - 1)).0, path.at(step * f64::from(k)));
                assert!((distance(a, b.0) - step).abs() < 1e-3, "arc length");
                let turn = libm::remainder(b.1 - heading, TAU);
                assert!(turn.abs() < 0.1, "robot {index}, {} m: turned {turn} rad in {step} m", step * f64::from(k));
                heading = b.1;
            }
        }
    }
}
