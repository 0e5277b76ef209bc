//! One's own submap as a judge of poses: which of a peer's points would lie on my surface, and which where I saw
//! nothing but air ([`Views`]). Built once per alignment and asked many times. Lengths are in voxels.

use super::features::{Features, in_voxels};
use super::near::{Near, Piece};
use super::views::Views;
use nalgebra::{Matrix3, Vector3};

/// A point this near to one of mine...
pub const NEAR: f32 = 1.5;
/// ...with a normal this like (cosine) lies on my surface.
const NORMALS_COS_MIN: f32 = 0.7;
/// Looked at closely, its normal is this like...
const CLOSE_COS_MIN: f32 = 0.8;
/// ...and it is at most this far from the other's plane.
const CLOSE_PLANE_MAX: f32 = 0.5;

/// A pose in voxels.
#[derive(Clone, Copy, Debug)]
pub struct Pose {
    /// Turns their directions into mine.
    pub rotation: Matrix3<f64>,
    /// Their origin in my frame.
    pub translation: Vector3<f64>,
}

impl Pose {
    /// Maps a point.
    pub fn apply(&self, p: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * p + self.translation
    }

    /// Whether two poses place the points about `middle` differently: by more than `distance`, or turned by more than
    /// `angle` (rad).
    pub fn differs(&self, other: &Self, middle: &Vector3<f64>, distance: f64, angle: f64) -> bool {
        // The cosine is (tr − 1) / 2; the trace of RᵀS is the sum of the products of their numbers.
        (self.apply(middle) - other.apply(middle)).norm_squared() > distance * distance
            || (self.rotation.dot(&other.rotation) - 1.0) / 2.0 < libm::cos(angle)
    }
}

/// Oriented points.
#[derive(Clone, Debug, Default)]
pub struct Cloud {
    /// Positions.
    pub points: Vec<Vector3<f64>>,
    /// Unit normals.
    pub normals: Vec<Vector3<f64>>,
}

/// What my submap says of a peer's point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// It lies on my surface.
    Confirmed,
    /// It would stand where I saw nothing but air.
    Contradicted,
    /// I cannot tell.
    Unknown,
}

/// The judge.
pub struct Scene {
    surface: Near,
    views: Views,
}

impl Scene {
    /// From one's own features.
    pub fn new(mine: &Features) -> Self {
        let (points, normals) = in_voxels(&mine.block);
        let pieces: Vec<Piece> = points.iter().zip(normals).map(|(&point, normal)| Piece { point, normal }).collect();
        Self { surface: Near::new(&pieces), views: Views::new(mine, &points) }
    }

    /// Position and normal of my point nearest to one of theirs at `at` with `normal`, within `radius` and facing the
    /// same way.
    pub fn counterpart(
        &self,
        at: &Vector3<f64>,
        normal: &Vector3<f64>,
        radius: f32,
    ) -> Option<(Vector3<f64>, Vector3<f64>)> {
        let n = single(normal);
        let found = self.surface.nearest(&single(at), radius, |piece| dot(&piece.normal, &n) >= NORMALS_COS_MIN)?;
        Some((Vector3::from(found.point.map(f64::from)), Vector3::from(found.normal.map(f64::from))))
    }

    /// Whether a point of theirs at `at` with `normal` lies on my surface.
    pub fn confirms(&self, at: &Vector3<f64>, normal: &Vector3<f64>) -> bool {
        let n = single(normal);
        self.surface.any(&single(at), NEAR, |piece| dot(&piece.normal, &n) >= NORMALS_COS_MIN)
    }

    /// A first look at a point of theirs.
    pub fn coarse_score(&self, at: &Vector3<f64>, normal: &Vector3<f64>) -> Verdict {
        if self.confirms(at, normal) {
            Verdict::Confirmed
        } else if self.views.looked_through(at) {
            Verdict::Contradicted
        } else {
            Verdict::Unknown
        }
    }

    /// A close look at a point of theirs, once a pose is polished; and whether any point of mine is near.
    pub fn judge(&self, at: &Vector3<f64>, normal: &Vector3<f64>) -> (Verdict, bool) {
        let (n, p) = (single(normal), single(at));
        if let Some(mine) = self.surface.nearest(&p, NEAR, |piece| dot(&piece.normal, &n) >= CLOSE_COS_MIN) {
            let aside = [0, 1, 2].map(|axis| p[axis] - mine.point[axis]);
            let lies = dot(&aside, &mine.normal).abs() <= CLOSE_PLANE_MAX;
            return (if lies { Verdict::Confirmed } else { Verdict::Unknown }, true);
        }
        if self.surface.any(&p, NEAR, |_| true) {
            (Verdict::Unknown, true)
        } else if self.views.looked_through(at) {
            (Verdict::Contradicted, false)
        } else {
            (Verdict::Unknown, false)
        }
    }
}

fn single(v: &Vector3<f64>) -> [f32; 3] {
    [v.x as f32, v.y as f32, v.z as f32]
}

fn dot(a: &[f32; 3], b: &[f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}
