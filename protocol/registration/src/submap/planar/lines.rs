//! Which way a wall faces at each point of a planar cloud: principal components of the neighbourhood.

use super::super::near::{Near, Piece};
use libm::{atan2, cos, sin};
use nalgebra::Vector2;

/// Radius of the neighbourhood.
const RADIUS: f32 = 3.0;
/// Points (itself included) that make a line at least.
const POINTS_MIN: u32 = 4;
/// A line is at most this thick for its length (ratio of standard deviations).
const THICKNESS_MAX: f64 = 0.5;

/// A point's piece of wall.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Line {
    /// Unit normal, towards the viewpoint.
    pub normal: Vector2<f64>,
    /// Standard deviation of the neighbourhood about its line; `None` where there is no line to speak of.
    pub roughness: Option<f64>,
    /// Points in the neighbourhood, itself included.
    pub neighbours: u32,
}

/// Of each point, seen from `viewpoint(k)`.
pub fn lines(points: &[Vector2<f64>], viewpoint: impl Fn(usize) -> Vector2<f64>) -> Vec<Line> {
    let pieces: Vec<Piece> = points.iter().map(|p| piece(p, &Vector2::zeros())).collect();
    let near = Near::new(&pieces);
    let line = |(k, p): (usize, &Vector2<f64>)| line(&near, p, &(viewpoint(k) - p));
    points.iter().enumerate().map(line).collect()
}

/// A piece of wall among those in space.
pub fn piece(p: &Vector2<f64>, normal: &Vector2<f64>) -> Piece {
    Piece { point: [p.x as f32, p.y as f32, 0.0], normal: [normal.x as f32, normal.y as f32, 0.0] }
}

fn line(near: &Near, p: &Vector2<f64>, towards: &Vector2<f64>) -> Line {
    let (mut n, mut sum, mut xx, mut xy, mut yy) = (0, Vector2::zeros(), 0.0, 0.0, 0.0);
    near.within(&[p.x as f32, p.y as f32, 0.0], RADIUS, |piece| {
        let d = Vector2::new(f64::from(piece.point[0]), f64::from(piece.point[1])) - p;
        n += 1;
        sum += d;
        (xx, xy, yy) = (xx + d.x * d.x, xy + d.x * d.y, yy + d.y * d.y);
    });
    let seen = towards.try_normalize(1e-9).unwrap_or_else(Vector2::x);
    if n < POINTS_MIN {
        return Line { normal: seen, roughness: None, neighbours: n };
    }
    let count = f64::from(n);
    let mean = sum / count;
    let (a, b, c) = (xx / count - mean.x * mean.x, xy / count - mean.x * mean.y, yy / count - mean.y * mean.y);
    let (middle, half) = ((a + c) / 2.0, libm::hypot((a - c) / 2.0, b));
    let (thick, long) = ((middle - half).max(0.0).sqrt(), (middle + half).max(0.0).sqrt());
    // The long axis lies at half the angle of (a − c, 2b).
    let along = atan2(2.0 * b, a - c) / 2.0;
    let normal = Vector2::new(-sin(along), cos(along));
    let normal = if normal.dot(towards) < 0.0 { -normal } else { normal };
    let is_line = long > 0.0 && thick <= THICKNESS_MAX * long;
    Line { normal: if is_line { normal } else { seen }, roughness: is_line.then_some(thick), neighbours: n }
}
