//! The poses of all keyframes and the places of all landmarks at once, by least squares: what a SLAM comes to that
//! keeps refining its keyframes. Poses form a chain, and there are few landmarks: the normal equations are block
//! tridiagonal with a border, are solved pose by pose, and their inverse is wanted for neighbours only.

use libm::{atan2, cos, sin};
use nalgebra::{DMatrix, DVector, Matrix2, Matrix2x3, Matrix3, Matrix3x2, Matrix3xX, Vector2, Vector3};
use std::collections::BTreeMap;

/// Gauss–Newton steps.
const STEPS: usize = 8;
/// Squared distance at which a sighting counts half (Cauchy).
const DOUBTED: f64 = 6.0;
/// Information that holds the first pose fixed.
const FIXED: f64 = 1e8;
/// Information that every landmark has of itself, so that one without sightings does no harm.
const LEAST: f64 = 1e-9;

/// A landmark as seen from a pose.
#[derive(Clone, Copy, Debug)]
pub struct Seen {
    /// Which.
    pub barcode: u32,
    /// In the body frame...
    pub at: Vector2<f64>,
    /// ...and the covariance of that.
    pub covariance: Matrix2<f64>,
}

/// A pose of the chain.
#[derive(Clone, Debug)]
pub struct Node {
    /// x, y and heading in the frame of the first, m and rad: a guess at first.
    pub pose: Vector3<f64>,
    /// The wheels' way to it from the one before, in that one's axes, and its covariance; unused of the first.
    pub way: (Vector3<f64>, Matrix3<f64>),
    /// What was seen from it.
    pub seen: Vec<Seen>,
}

/// One pose's part of the normal equations, eliminated.
struct Part {
    /// Inverse of the diagonal block...
    inverse: Matrix3<f64>,
    /// ...block with the next pose...
    next: Matrix3<f64>,
    /// ...and with the landmarks.
    border: Matrix3xX<f64>,
    gradient: Vector3<f64>,
}

/// Moves the poses to the least-squares solution; gives back, for each but the first, the covariance of the way to it
/// from the one before in that one's axes. `None` if there is no solution.
pub fn smooth(nodes: &mut [Node]) -> Option<Vec<Matrix3<f64>>> {
    let mut places: BTreeMap<u32, Vector2<f64>> = BTreeMap::new();
    for node in nodes.iter() {
        for seen in &node.seen {
            places.entry(seen.barcode).or_insert_with(|| node.pose.xy() + turn(node.pose.z) * seen.at);
        }
    }
    for _ in 0..STEPS {
        let (parts, d, g) = normal(nodes, &places)?;
        let landmarks = -(d.cholesky()?.solve(&g));
        let mut next = Vector3::zeros();
        for (node, part) in nodes.iter_mut().zip(&parts).rev() {
            let border = &part.border * &landmarks;
            next = -(part.inverse * (part.gradient + part.next * next + border.fixed_rows::<3>(0)));
            node.pose += next;
        }
        for (place, step) in places.values_mut().zip(landmarks.as_slice().as_chunks::<2>().0) {
            *place += Vector2::from(*step);
        }
    }
    let (parts, d, _) = normal(nodes, &places)?;
    covariances(nodes, &parts, d.cholesky()?.inverse())
}

/// The equations, with the poses eliminated from first to last: their parts, and what is left for the landmarks.
fn normal(nodes: &[Node], places: &BTreeMap<u32, Vector2<f64>>) -> Option<(Vec<Part>, DMatrix<f64>, DVector<f64>)> {
    let of: BTreeMap<u32, usize> = places.keys().enumerate().map(|(k, code)| (*code, 2 * k)).collect();
    let b = 2 * places.len();
    let (mut d, mut g) = (DMatrix::<f64>::identity(b, b) * LEAST, DVector::<f64>::zeros(b));
    let mut parts: Vec<Part> = Vec::with_capacity(nodes.len());
    // What the pose before leaves for this one.
    let (mut block, mut gradient) = (Matrix3::from_diagonal_element(FIXED), Vector3::zeros());
    let mut border = Matrix3xX::<f64>::zeros(b);
    for (k, node) in nodes.iter().enumerate() {
        for seen in &node.seen {
            let (Some(place), Some(&at)) = (places.get(&seen.barcode), of.get(&seen.barcode)) else { continue };
            let back = turn(node.pose.z).transpose();
            let here = back * (place - node.pose.xy());
            let error = here - seen.at;
            let information = seen.covariance.try_inverse()?;
            let information = information / (1.0 + error.dot(&(information * error)) / DOUBTED);
            let j = Matrix2x3::new(-back.m11, -back.m12, here.y, -back.m21, -back.m22, -here.x);
            block += j.transpose() * information * j;
            gradient += j.transpose() * information * error;
            let cross: Matrix3x2<f64> = j.transpose() * information * back;
            let mut view = border.fixed_view_mut::<3, 2>(0, at);
            view += cross;
            let own: Matrix2<f64> = back.transpose() * information * back;
            let mut view = d.fixed_view_mut::<2, 2>(at, at);
            view += own;
            let pull: Vector2<f64> = back.transpose() * information * error;
            let mut rows = g.fixed_rows_mut::<2>(at);
            rows += pull;
        }
        let mut next = Matrix3::zeros();
        let (mut next_block, mut next_gradient) = (Matrix3::zeros(), Vector3::zeros());
        if let Some(after) = nodes.get(k + 1) {
            let (from, to) = jacobians(&node.pose, &after.pose);
            let mut error = between(&node.pose, &after.pose) - after.way.0;
            error.z = atan2(sin(error.z), cos(error.z));
            let information = after.way.1.try_inverse()?;
            block += from.transpose() * information * from;
            gradient += from.transpose() * information * error;
            next = from.transpose() * information * to;
            next_block = to.transpose() * information * to;
            next_gradient = to.transpose() * information * error;
        }
        let inverse = block.try_inverse()?;
        let carried = inverse * &border;
        d -= border.transpose() * &carried;
        g -= carried.transpose() * gradient;
        let next_border = -(next.transpose() * &carried);
        let left = next.transpose() * inverse;
        (next_block, next_gradient) = (next_block - left * next, next_gradient - left * gradient);
        parts.push(Part { inverse, next, border, gradient });
        (block, gradient, border) = (next_block, next_gradient, next_border);
    }
    Some((parts, d, g))
}

/// Of the ways between neighbours, from the last to the first: the blocks of the inverse that belong to a pose, the one
/// after it and the landmarks follow from those of the one after it.
fn covariances(nodes: &[Node], parts: &[Part], landmarks: DMatrix<f64>) -> Option<Vec<Matrix3<f64>>> {
    let mut ways = Vec::new();
    let (mut own, mut with) = (Matrix3::zeros(), Matrix3xX::<f64>::zeros(landmarks.nrows()));
    for (k, part) in parts.iter().enumerate().rev() {
        let border = part.inverse * &part.border;
        let next = part.inverse * part.next;
        let with_next = -(next * own + (&border * with.transpose()).fixed_view::<3, 3>(0, 0));
        let with_landmarks = -(next * &with + &border * &landmarks);
        let shared = (&with_landmarks * border.transpose()).fixed_view::<3, 3>(0, 0).into_owned();
        let here = part.inverse - with_next * next.transpose() - shared;
        if let Some(after) = nodes.get(k + 1) {
            let (from, to) = jacobians(&nodes[k].pose, &after.pose);
            let cross = from * with_next * to.transpose();
            ways.push(from * here * from.transpose() + to * own * to.transpose() + cross + cross.transpose());
        }
        (own, with) = (here, with_landmarks);
    }
    ways.reverse();
    ways.iter().flatten().all(|x: &f64| x.is_finite()).then_some(ways)
}

fn turn(angle: f64) -> Matrix2<f64> {
    Matrix2::new(cos(angle), -sin(angle), sin(angle), cos(angle))
}

/// The second pose in the axes of the first.
pub fn between(a: &Vector3<f64>, b: &Vector3<f64>) -> Vector3<f64> {
    let off = turn(a.z).transpose() * (b - a).xy();
    Vector3::new(off.x, off.y, b.z - a.z)
}

/// Of [`between`] about both poses.
fn jacobians(a: &Vector3<f64>, b: &Vector3<f64>) -> (Matrix3<f64>, Matrix3<f64>) {
    let (back, off) = (turn(a.z).transpose(), between(a, b));
    let from = Matrix3::new(-back.m11, -back.m12, off.y, -back.m21, -back.m22, -off.x, 0.0, 0.0, -1.0);
    let to = Matrix3::new(back.m11, back.m12, 0.0, back.m21, back.m22, 0.0, 0.0, 0.0, 1.0);
    (from, to)
}
