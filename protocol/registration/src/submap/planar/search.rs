//! All poses of their keypoints on my chart, from coarse to fine. Rotations are those under which the two histograms of
//! wall directions agree (Censi's Hough scan matching, 2005); for each of them every translation has a bound of how
//! many keypoints can lie on my walls ([`Codec::reachable`], as in Olson 2009), and the most promising are looked at
//! cell by cell.

use super::codec::{Codec, EDGE, FREE, sector};
use super::fit::Walls;
use super::se2::Se2;
use core::f64::consts::TAU;
use libm::atan2;
use nalgebra::Vector2;

/// Bins of the histograms of directions.
const BINS: usize = 360;
/// Half width of their smoothing, bins.
const SMOOTH: usize = 3;
/// Rotations tried at most...
const ROTATIONS_MAX: usize = 6;
/// ...if they agree at least this well, for the best one.
const AGREEMENT_MIN: f64 = 0.35;
/// Cells that a translation is stepped by at first.
const SPAN: i32 = 4;
/// Keypoints that count at first: an even cover.
const COARSE_POINTS: usize = 128;
/// The first so many...
const COARSE: usize = 32;
/// ...of which so many must lie on walls for the rest to be looked at.
const GLANCED_MIN: u32 = 6;
/// Squares of translations that are looked at cell by cell.
const SQUARES_MAX: usize = 400;
/// What a keypoint in free space costs, in keypoints on a wall.
const FREE_COST: f64 = 1.0;
/// Poses at most...
const POSES_MAX: usize = 64;
/// ...that differ by this many cells or this angle.
const SAME: (f64, f64) = (2.0, 0.1);

/// Their keypoints, rotated: cell and sector of each.
struct Rotated {
    angle: f64,
    cells: Vec<([i32; 2], u16)>,
    low: [i32; 2],
    high: [i32; 2],
}

/// Distinct poses `t_mine_theirs`, the most promising first.
pub fn poses(theirs: &Walls, mine: &Walls, chart: &Codec) -> Vec<Se2> {
    let coarse = chart.reachable(SPAN);
    let rotated: Vec<Rotated> = rotations(theirs, mine).into_iter().map(|angle| Rotated::new(angle, theirs)).collect();
    let mut squares: Vec<(u32, usize, [i32; 2])> = Vec::new();
    for (k, turned) in rotated.iter().enumerate() {
        let from = [0, 1].map(|axis| -turned.high[axis] - SPAN);
        let to = [0, 1].map(|axis| chart.size[axis] - turned.low[axis]);
        for i in (from[0]..to[0]).step_by(SPAN as usize) {
            for j in (from[1]..to[1]).step_by(SPAN as usize) {
                let bound = turned.bound(&coarse, [i, j]);
                if bound > 0 {
                    squares.push((bound, k, [i, j]));
                }
            }
        }
    }
    // Ties go by place, so that the order is that of no sort.
    squares.sort_unstable_by(|a, b| b.0.cmp(&a.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    squares.truncate(SQUARES_MAX);
    let mut found: Vec<(f64, usize, [i32; 2])> = Vec::new();
    for (_, k, [x, y]) in squares {
        for i in x..x + SPAN {
            for j in y..y + SPAN {
                found.push((rotated[k].score(chart, [i, j]), k, [i, j]));
            }
        }
    }
    found.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    distinct(&found, &rotated, theirs, chart)
}

fn distinct(found: &[(f64, usize, [i32; 2])], rotated: &[Rotated], theirs: &Walls, chart: &Codec) -> Vec<Se2> {
    let middle = theirs.middle();
    let mut poses: Vec<Se2> = Vec::new();
    for &(score, k, shift) in found {
        if score <= 0.0 || poses.len() == POSES_MAX {
            break;
        }
        let pose = Se2::new(rotated[k].angle, chart.corner() + Vector2::from(shift).map(f64::from) * EDGE);
        if poses.iter().all(|other| pose.differs(other, &middle, SAME.0 * EDGE, SAME.1)) {
            poses.push(pose);
        }
    }
    poses
}

impl Rotated {
    fn new(angle: f64, walls: &Walls) -> Self {
        let turn = Se2::new(angle, Vector2::zeros());
        let cell = |p: &Vector2<f64>| -> [i32; 2] { (turn.turn(p) / EDGE).map(|x| x.floor() as i32).into() };
        let cells: Vec<([i32; 2], u16)> =
            walls.points.iter().zip(&walls.normals).map(|(p, n)| (cell(p), sector(&turn.turn(n)))).collect();
        let bound = |pick: fn(i32, i32) -> i32| {
            [0, 1].map(|axis| cells.iter().map(|(c, _)| c[axis]).reduce(pick).unwrap_or_default())
        };
        let (low, high) = (bound(i32::min), bound(i32::max));
        Self { angle, cells, low, high }
    }

    fn bound(&self, coarse: &Codec, shift: [i32; 2]) -> u32 {
        // The coarse chart begins one span earlier.
        let count = |some: &[([i32; 2], u16)]| {
            some.iter()
                .filter(|(c, sector)| coarse.at([c[0] + shift[0] + SPAN, c[1] + shift[1] + SPAN]) & sector != 0)
                .count() as u32
        };
        let (first, rest) = self.cells.split_at(self.cells.len().min(COARSE));
        let seen = count(first);
        if seen < GLANCED_MIN {
            return 0;
        }
        seen + count(&rest[..rest.len().min(COARSE_POINTS - COARSE)])
    }

    fn score(&self, chart: &Codec, shift: [i32; 2]) -> f64 {
        let value = |(c, sector): &([i32; 2], u16)| {
            let cell = chart.at([c[0] + shift[0], c[1] + shift[1]]);
            if cell & sector != 0 {
                1.0
            } else if cell & FREE != 0 {
                -FREE_COST
            } else {
                0.0
            }
        };
        self.cells.iter().map(value).sum()
    }
}

/// Rotations under which their walls face as mine do, best first.
fn rotations(theirs: &Walls, mine: &Walls) -> Vec<f64> {
    let (their, my) = (histogram(theirs), histogram(mine));
    let agreement: Vec<f64> = (0..BINS).map(|by| (0..BINS).map(|k| their[k] * my[(k + by) % BINS]).sum()).collect();
    let best = agreement.iter().fold(0.0_f64, |best, &a| best.max(a));
    let is_peak = |k: usize| {
        let near = (1..=2 * SMOOTH).flat_map(|by| [(k + by) % BINS, (k + BINS - by) % BINS]);
        agreement[k] >= AGREEMENT_MIN * best
            && agreement[k] > 0.0
            && near
                .into_iter()
                .all(|other| agreement[other] < agreement[k] || (agreement[other] == agreement[k] && other > k))
    };
    let mut peaks: Vec<usize> = (0..BINS).filter(|&k| is_peak(k)).collect();
    peaks.sort_by(|&a, &b| agreement[b].total_cmp(&agreement[a]).then(a.cmp(&b)));
    peaks.truncate(ROTATIONS_MAX);
    peaks.into_iter().map(|k| k as f64 * TAU / BINS as f64).collect()
}

/// How much wall faces each way.
fn histogram(walls: &Walls) -> [f64; BINS] {
    let mut bins = [0.0; BINS];
    for n in &walls.normals {
        let place = (atan2(n.y, n.x) / TAU * BINS as f64).rem_euclid(BINS as f64) as usize;
        for by in 0..=2 * SMOOTH {
            let weight = (SMOOTH + 1) as f64 - (by as f64 - SMOOTH as f64).abs();
            bins[(place + by + BINS - SMOOTH) % BINS] += weight;
        }
    }
    bins
}
