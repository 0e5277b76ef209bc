//! Robust point-to-line fitting (Censi 2008 without its closed form): each of their points is drawn to the line of my
//! nearest point that faces the same way, with Cauchy weights at the noise scale that the residuals show.

use super::super::near::{Near, Piece};
use super::super::robust::cauchy_weight;
use super::lines::piece;
use super::se2::Se2;
use nalgebra::{Matrix3, Vector2, Vector3};

/// Least noise scale: a thinned wall is no sharper.
const SIGMA_MIN: f64 = 0.1;

/// Oriented points.
#[derive(Clone, Debug, Default)]
pub struct Walls {
    /// Positions.
    pub points: Vec<Vector2<f64>>,
    /// Unit normals, towards the sensor.
    pub normals: Vec<Vector2<f64>>,
}

impl Walls {
    /// Sorted for the search of neighbours.
    pub fn near(&self) -> Near {
        let pieces: Vec<Piece> = self.points.iter().zip(&self.normals).map(|(p, n)| piece(p, n)).collect();
        Near::new(&pieces)
    }

    /// The mean point.
    pub fn middle(&self) -> Vector2<f64> {
        self.points.iter().sum::<Vector2<f64>>() / self.points.len().max(1) as f64
    }
}

/// What the pairs of one pose say of its local perturbation (x, y, angle).
pub struct System {
    /// Σ w j jᵀ: information in units of 1/σ².
    pub h: Matrix3<f64>,
    /// Σ w j e.
    pub g: Vector3<f64>,
    /// Noise scale of the residuals.
    pub sigma: f64,
    /// Pairs.
    pub pairs: usize,
    /// Their Jacobians and weights.
    rows: Vec<(Vector3<f64>, f64)>,
}

impl System {
    /// Information (in units of 1/σ²) along the principal axes of x, where `to_local` x is the local perturbation, and
    /// its sum. Only pairs that lean at least `lean_min` towards an axis inform about it.
    pub fn leaning(&self, to_local: &Matrix3<f64>, lean_min: f64) -> ([(f64, Vector3<f64>); 3], f64) {
        let eigen = (to_local.transpose() * self.h * to_local).symmetric_eigen();
        let rows: Vec<(Vector3<f64>, f64)> = self.rows.iter().map(|(j, w)| (to_local.transpose() * j, *w)).collect();
        let along = |axis: Vector3<f64>| {
            let leans = rows.iter().map(|(j, w)| (j.dot(&axis), w)).filter(|(lean, _)| lean.abs() >= lean_min);
            (leans.map(|(lean, w)| w * lean * lean).sum::<f64>(), axis)
        };
        let all = [0, 1, 2].map(|k| along(eigen.eigenvectors.column(k).into_owned()));
        (all, all.iter().map(|(value, _)| value).sum())
    }
}

/// My piece of wall nearest to one of their points, facing the same way.
pub fn counterpart(near: &Near, at: &Vector2<f64>, normal: &Vector2<f64>, radius: f64, cos_min: f64) -> Option<Piece> {
    let facing = |mine: &Piece| f64::from(mine.normal[0]) * normal.x + f64::from(mine.normal[1]) * normal.y >= cos_min;
    near.nearest(&[at.x as f32, at.y as f32, 0.0], radius as f32, facing).copied()
}

/// The system of `walls` placed by `pose` before what `near` holds; pairs face alike with at least this cosine.
pub fn system(walls: &Walls, near: &Near, pose: &Se2, radius: f64, cos_min: f64) -> System {
    let mut rows = Vec::with_capacity(walls.points.len());
    for (p, n) in walls.points.iter().zip(&walls.normals) {
        let (at, facing) = (pose.apply(p), pose.turn(n));
        if let Some(mine) = counterpart(near, &at, &facing, radius, cos_min) {
            let normal = Vector2::new(f64::from(mine.normal[0]), f64::from(mine.normal[1]));
            let e = normal.dot(&(at - Vector2::new(f64::from(mine.point[0]), f64::from(mine.point[1]))));
            let m = pose.turn_back(&normal);
            rows.push((Vector3::new(m.x, m.y, p.x * m.y - p.y * m.x), e));
        }
    }
    let mut sizes: Vec<f64> = rows.iter().map(|(_, e)| e.abs()).collect();
    let middle = sizes.len() / 2;
    let sigma = if sizes.is_empty() {
        SIGMA_MIN
    } else {
        (1.4826 * *sizes.select_nth_unstable_by(middle, f64::total_cmp).1).max(SIGMA_MIN)
    };
    let (mut h, mut g) = (Matrix3::zeros(), Vector3::zeros());
    for (j, e) in &mut rows {
        let w = cauchy_weight(*e, sigma);
        h += *j * j.transpose() * w;
        g += *j * (w * *e);
        *e = w;
    }
    System { h, g, sigma, pairs: rows.len(), rows }
}
