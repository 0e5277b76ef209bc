//! SIM(3): similarities, tangent (ρ, φ, λ).

use super::se3::Se3;
use super::so3::So3;
use nalgebra::Vector3;

/// A similarity `p_a = s R p_b + t`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sim3 {
    /// Rotation.
    pub rotation: So3,
    /// Translation, in units of the target frame.
    pub translation: Vector3<f64>,
    /// Scale s > 0: units of the target frame per unit of the source frame.
    pub scale: f64,
}

impl Sim3 {
    /// The identity.
    pub fn identity() -> Self {
        Self::from_se3(&Se3::identity())
    }

    /// From its parts.
    pub fn new(rotation: So3, translation: Vector3<f64>, scale: f64) -> Self {
        Self { rotation, translation, scale }
    }

    /// A rigid motion as a similarity of scale 1.
    pub fn from_se3(t: &Se3) -> Self {
        Self::new(t.rotation, t.translation, 1.0)
    }

    /// Rotation and translation, the scale dropped.
    pub fn to_se3(&self) -> Se3 {
        Se3::new(self.rotation, self.translation)
    }

    /// The inverse.
    #[must_use]
    pub fn inverse(&self) -> Self {
        let r = self.rotation.inverse();
        Self::new(r, -(r * self.translation) / self.scale, 1.0 / self.scale)
    }
}

impl core::ops::Mul for Sim3 {
    type Output = Self;
    fn mul(self, other: Self) -> Self {
        Self::new(self.rotation * other.rotation, self * other.translation, self.scale * other.scale)
    }
}

impl core::ops::Mul<Vector3<f64>> for Sim3 {
    type Output = Vector3<f64>;
    fn mul(self, p: Vector3<f64>) -> Vector3<f64> {
        self.rotation * p * self.scale + self.translation
    }
}
