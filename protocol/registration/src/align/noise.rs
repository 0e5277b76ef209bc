//! Per-point covariances: how far each match may lie apart, and in which direction.
//!
//! The residual of a true match has covariance `σ² C`, `C = C_target + s² R C_source Rᵀ`. The covariances are known up
//! to the common factor σ², which is marginalised as ever: they are divided by the median over the matches of a third
//! of the trace of `C` at scale 1, so that σ̂ stays the standard deviation per axis of a typical match, in metres.
//! Search and prescore take each match by that typical σ alone; evidence, posteriors, refinement, acceptance and
//! covariance take `C`.

use super::Problem;
use super::prepare::median_of;
use super::solve::Motion;
use crate::geometry::{Covariance, So3};
use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

/// Largest over smallest variance that a problem's points may have, in any directions: four digits of standard
/// deviation.
pub const CONDITION_MAX: f64 = 1e8;
/// Steps of Gauss and Newton per refit: the next refit goes on from there.
const STEPS: usize = 2;

/// The normalised covariances of distinct matches, in their order.
#[derive(Debug)]
pub(super) struct PointNoise {
    source: Vec<Matrix3<f64>>,
    target: Vec<Matrix3<f64>>,
    /// Means of the largest variances.
    source_widest: f64,
    target_widest: f64,
}

/// The covariances of all residuals at one motion.
#[derive(Clone, Debug)]
pub(super) struct Shapes {
    /// C⁻¹.
    pub precision: Vec<Matrix3<f64>>,
    /// ½ ln det C.
    pub log_root: Vec<f64>,
    /// The mean of √det C: how much larger a typical acceptance region is than a sphere.
    pub volume: f64,
}

impl PointNoise {
    /// Of the matches `chosen`; `None` if the problem states none.
    pub fn of(problem: &Problem, chosen: impl Iterator<Item = usize> + Clone) -> Option<Self> {
        if problem.source_covariances.is_none() && problem.target_covariances.is_none() {
            return None;
        }
        let side = |given: Option<&[Covariance<3>]>| -> Vec<Matrix3<f64>> {
            chosen.clone().map(|i| given.map_or_else(Matrix3::zeros, |c| *c[i].matrix())).collect()
        };
        let (mut source, mut target) = (side(problem.source_covariances), side(problem.target_covariances));
        let typical = median_of(source.iter().zip(&target).map(|(a, b)| (a.trace() + b.trace()) / 3.0));
        for c in source.iter_mut().chain(&mut target) {
            *c /= typical;
        }
        let widest = |side: &[Matrix3<f64>]| {
            side.iter().map(|c| c.symmetric_eigenvalues().max()).sum::<f64>() / side.len().max(1) as f64
        };
        Some(Self { source_widest: widest(&source), target_widest: widest(&target), source, target })
    }

    /// The covariances of residuals at a motion.
    pub fn shapes(&self, motion: &Motion) -> Shapes {
        let turn = motion.rotation * motion.scale;
        let n = self.source.len();
        let mut shapes = Shapes { precision: Vec::with_capacity(n), log_root: Vec::with_capacity(n), volume: 0.0 };
        for (source, target) in self.source.iter().zip(&self.target) {
            let c = target + turn * source * turn.transpose();
            let det = c.determinant();
            shapes.precision.push(adjugate(&c) / det);
            shapes.log_root.push(0.5 * libm::log(det));
            shapes.volume += det.sqrt() / n as f64;
        }
        shapes
    }

    /// The root mean square of the largest standard deviations of residuals at a scale.
    pub fn widest(&self, scale: f64) -> f64 {
        (self.target_widest + scale * scale * self.source_widest).sqrt()
    }
}

/// det(C) C⁻¹ of a symmetric matrix.
fn adjugate(c: &Matrix3<f64>) -> Matrix3<f64> {
    let (a, b, d) = (c[(0, 0)], c[(1, 1)], c[(2, 2)]);
    let (x, y, z) = (c[(0, 1)], c[(0, 2)], c[(1, 2)]);
    let (xy, xz, yz) = (y * z - x * d, x * z - y * b, x * y - a * z);
    Matrix3::new(b * d - z * z, xy, xz, xy, a * d - y * y, yz, xz, yz, a * b - x * x)
}

/// Minimises `Σ w rᵀ C⁻¹ r` from a motion nearby, at the shapes given.
pub(super) fn refit(
    source: &[Vector3<f64>],
    target: &[Vector3<f64>],
    weights: &[f64],
    shapes: &Shapes,
    start: Motion,
    with_scale: bool,
) -> Option<Motion> {
    let mut motion = start;
    for _ in 0..STEPS {
        let (mut information, mut pull) = (SMatrix::<f64, 7, 7>::zeros(), SVector::<f64, 7>::zeros());
        for i in (0..weights.len()).filter(|&i| weights[i] > 0.0) {
            let j = jacobian(&motion, &source[i]);
            let weighted = j.transpose() * (shapes.precision[i] * weights[i]);
            information += weighted * j;
            pull += weighted * (target[i] - motion.apply(&source[i]));
        }
        if !with_scale {
            information.row_mut(6).fill(0.0);
            information.column_mut(6).fill(0.0);
            (information[(6, 6)], pull[6]) = (1.0, 0.0);
        }
        let step = information.cholesky()?.solve(&pull);
        let moved = motion.rotation * Vector3::new(step[0], step[1], step[2]) * motion.scale;
        let turned = So3::exp(&Vector3::new(step[3], step[4], step[5])).matrix();
        motion = Motion {
            scale: motion.scale * libm::exp(step[6]),
            rotation: motion.rotation * turned,
            translation: motion.translation + moved,
        };
        if !(motion.scale.is_finite() && motion.translation.iter().chain(&motion.rotation).all(|x| x.is_finite())) {
            return None;
        }
    }
    Some(motion)
}

/// `s R [I, −p^, p]`: how an image moves with a local perturbation (ρ, φ, λ).
pub(super) fn jacobian(motion: &Motion, p: &Vector3<f64>) -> SMatrix<f64, 3, 7> {
    let a = motion.rotation * motion.scale;
    let mut j = SMatrix::<f64, 3, 7>::zeros();
    j.fixed_view_mut::<3, 3>(0, 0).copy_from(&a);
    j.fixed_view_mut::<3, 3>(0, 3).copy_from(&(a * crate::geometry::so3::hat(&-p)));
    j.fixed_view_mut::<3, 1>(0, 6).copy_from(&(a * p));
    j
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_adjugate_is_det_times_inverse() {
        let c = Matrix3::new(4.0, 1.0, -0.5, 1.0, 3.0, 0.2, -0.5, 0.2, 0.7);
        assert!((adjugate(&c) * c - Matrix3::identity() * c.determinant()).amax() < 1e-12);
    }
}
