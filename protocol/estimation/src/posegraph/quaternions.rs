//! Whether a graph's quaternions were written w first, as many programs hold them, and not `x y z w` as g2o has them.
//!
//! - A measurement from one pose to the next turns little. With w first it is read as a half turn about x.
//! - Values of poses and measurements between them are of one order, or contradict one another in all but the right one.
//! - Where there are values only, how the bodies move tells it ([`QuaternionOrder`]).

use super::robust::robot_of;
use super::{Measurement, PoseGraph};
use crate::geometry::So3;
use crate::geometry::quaternion_order::{QuaternionOrder, w_first};
use core::fmt;

/// Measurements it takes, and how many are looked at.
const MEASUREMENTS_MIN: usize = 10;
const LOOKED_AT_MAX: usize = 10_000;
/// Share of the steps that are half turns about x.
const STEPS_SHARE: f64 = 0.9;
/// What the quaternion of about a half turn about x has: x at least, w at most.
const HALF_TURN: [f64; 2] = [0.9, 0.3];
/// Median angle, rad, between values and measurements: at most in the right order, at least as they are read, and the latter
/// is so many times the former.
const AGREE_MAX: f64 = 0.1;
const CONTRADICT_MIN: f64 = 0.3;
const CONTRADICT_RATIO: f64 = 5.0;

/// Which quaternions seem to be written w first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WFirst {
    /// Those of poses.
    Vertices,
    /// Those of measurements.
    Edges,
    /// Both.
    All,
}

impl fmt::Display for WFirst {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let lines = match self {
            Self::Vertices => "the VERTEX_SE3:QUAT lines",
            Self::Edges => "the EDGE_SE3:QUAT lines",
            Self::All => "all lines",
        };
        write!(f, "the quaternions of {lines} seem to be written w first; g2o has them as x y z w: put w last")
    }
}

/// Looks at the values of a graph's poses and some of its measurements, as those of one file.
pub fn w_first_in<'a>(graph: &PoseGraph, measurements: impl Iterator<Item = &'a Measurement>) -> Option<WFirst> {
    if graph.planar {
        return None;
    }
    let measurements: Vec<&Measurement> = measurements.collect();
    let value = |id: &u64| graph.poses.get(id).copied().flatten().map(|pose| pose.rotation);
    let every = measurements.len().div_ceil(LOOKED_AT_MAX).max(1);
    let joined: Vec<[So3; 3]> = measurements
        .iter()
        .step_by(every)
        .filter_map(|m| Some([value(&m.i)?, value(&m.j)?, m.t_i_j.rotation]))
        .collect();
    if half_turns(&measurements) {
        let are_all = !joined.is_empty() && off(&joined, w_first, w_first) < off(&joined, as_read, w_first);
        return Some(if are_all { WFirst::All } else { WFirst::Edges });
    }
    if joined.len() >= MEASUREMENTS_MIN {
        return contradiction(&joined);
    }
    if measurements.is_empty() && moves_so(graph) { Some(WFirst::Vertices) } else { None }
}

/// Whether steps from one pose to the next are half turns about x.
fn half_turns(measurements: &[&Measurement]) -> bool {
    let steps = measurements.iter().filter(|m| m.i.abs_diff(m.j) == 1);
    let (mut all, mut halves) = (0_usize, 0_usize);
    for m in steps {
        let [x, _, _, w] = m.t_i_j.rotation.xyzw();
        all += 1;
        halves += usize::from(x.abs() >= HALF_TURN[0] && w.abs() <= HALF_TURN[1]);
    }
    all >= MEASUREMENTS_MIN && halves as f64 >= STEPS_SHARE * all as f64
}

/// Reads a rotation in an order.
type Order = fn(&So3) -> So3;

fn as_read(read: &So3) -> So3 {
    *read
}

/// The median angle, rad, between values of poses and measurements between them, each in an order.
fn off(joined: &[[So3; 3]], of_values: Order, of_edges: Order) -> f64 {
    let one = |[i, j, edge]: &[So3; 3]| (of_edges(edge).inverse() * of_values(i).inverse() * of_values(j)).angle();
    let mut angles: Vec<f64> = joined.iter().map(one).collect();
    let middle = angles.len() / 2;
    *angles.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Which order lets values and measurements agree, if the one that was read does not.
fn contradiction(joined: &[[So3; 3]]) -> Option<WFirst> {
    let stated = off(joined, as_read, as_read);
    let others = [
        (WFirst::All, off(joined, w_first, w_first)),
        (WFirst::Vertices, off(joined, w_first, as_read)),
        (WFirst::Edges, off(joined, as_read, w_first)),
    ];
    let (which, best) = others.into_iter().reduce(|a, b| if b.1 < a.1 { b } else { a })?;
    let is_clear = best <= AGREE_MAX && stated >= CONTRADICT_MIN && stated >= CONTRADICT_RATIO * best;
    is_clear.then_some(which)
}

/// Whether most robots' poses, in the order of their numbers, move as if they were written w first.
fn moves_so(graph: &PoseGraph) -> bool {
    let mut robots: Vec<(u8, QuaternionOrder)> = Vec::new();
    for (id, value) in &graph.poses {
        let Some(value) = value else { continue };
        let robot = robot_of(*id);
        if robots.last().is_none_or(|(last, _)| *last != robot) {
            robots.push((robot, QuaternionOrder::default()));
        }
        if let Some((_, order)) = robots.last_mut() {
            order.push(value);
        }
    }
    let doubted = robots.iter().filter(|(_, order)| order.is_doubtful()).count();
    2 * doubted > robots.len()
}

#[cfg(test)]
#[path = "quaternions_tests.rs"]
mod tests;
