//! Scale from baselines (MATH §5, last line). An alignment of similar frames need not measure scale: it may place a
//! submap of β, whose unit is unknown, in a submap of α by rotation and translation in α's unit alone. Two such then
//! give s = |Δp_α| / |Δp_β|: the distance of their places in α over that of the same places in β, as far as both
//! distances exceed their uncertainty. Everywhere else such an alignment is one whose log-scale is as uncertain as
//! chance leaves it, taken at the scale under which it is tested.

use super::measured::Alignment;
use crate::geometry::{Covariance, Group, PoseWithCovariance, Se2, Se3, Sim3, SimWithCovariance, So3};
use libm::{exp, sqrt};
use nalgebra::{Matrix3, Matrix6, SMatrix, Vector3};

/// ln 400: the range of scales, 0.05 to 20, over which a false similarity may fall.
pub(super) const LOG_SCALE_RANGE: f64 = 5.991_464_547_107_982;
/// ln 400 / √(2π): a Gaussian of this width is as dense at its middle as chance is over the whole range, so that an
/// unmeasured scale counts neither for nor against an alignment.
const UNMEASURED_LOG_SCALE_SIGMA: f64 = 2.390_248_529_367_596;
/// Largest standard deviation of log-scale that counts as measured: at 3σ a length is then wrong by a third at most,
/// and the first-order propagation holds.
pub(super) const LOG_SCALE_SIGMA_MAX: f64 = 0.1;

/// A measurement between two frames of which at least one has unknown scale.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SimMeasurement {
    /// Measures scale too.
    Scaled(SimWithCovariance),
    /// Rotation, and translation in α's unit (so is its covariance); the scale of β is not measured. For one in β's
    /// unit, swap the frames.
    Unscaled(PoseWithCovariance),
}

impl From<SimWithCovariance> for SimMeasurement {
    fn from(scaled: SimWithCovariance) -> Self {
        Self::Scaled(scaled)
    }
}

impl From<PoseWithCovariance> for SimMeasurement {
    fn from(unscaled: PoseWithCovariance) -> Self {
        Self::Unscaled(unscaled)
    }
}

impl SimMeasurement {
    /// As a similarity, and whether it measures scale; if not, at scale 1.
    pub(super) fn parts(&self) -> (Sim3, Covariance<7>, bool) {
        match self {
            Self::Scaled(s) => (s.sim, s.covariance, true),
            Self::Unscaled(p) => {
                let mut m = SMatrix::<f64, 7, 7>::zeros();
                m.fixed_view_mut::<6, 6>(0, 0).copy_from(p.covariance.matrix());
                m[(6, 6)] = UNMEASURED_LOG_SCALE_SIGMA * UNMEASURED_LOG_SCALE_SIGMA;
                (Sim3::from_se3(&p.pose), Covariance::new_or_wider(m), false)
            }
        }
    }
}

/// A group whose elements have a scale, 1 for rigid motions.
pub(super) trait Scaled<const N: usize>: Group<N> {
    fn scale(&self) -> f64;
    #[must_use]
    fn with_scale(&self, scale: f64) -> Self;
    fn translation(&self) -> Vector3<f64>;
    fn rotation(&self) -> So3;
}

impl Scaled<6> for Se3 {
    fn scale(&self) -> f64 {
        1.0
    }
    fn with_scale(&self, _: f64) -> Self {
        *self
    }
    fn translation(&self) -> Vector3<f64> {
        self.translation
    }
    fn rotation(&self) -> So3 {
        self.rotation
    }
}

impl Scaled<3> for Se2 {
    fn scale(&self) -> f64 {
        1.0
    }
    fn with_scale(&self, _: f64) -> Self {
        *self
    }
    fn translation(&self) -> Vector3<f64> {
        self.in_space().translation
    }
    fn rotation(&self) -> So3 {
        self.in_space().rotation
    }
}

impl Scaled<7> for Sim3 {
    fn scale(&self) -> f64 {
        self.scale
    }
    fn with_scale(&self, scale: f64) -> Self {
        Self::new(self.rotation, self.translation, scale)
    }
    fn translation(&self) -> Vector3<f64> {
        self.translation
    }
    fn rotation(&self) -> So3 {
        self.rotation
    }
}

impl<const N: usize, G: Scaled<N>> Alignment<N, G> {
    /// The measurement and its covariance where the frames' scale is `scale`. An unscaled one keeps its translation;
    /// the perturbation that moves it is in units of β, hence 1/`scale` as large.
    pub(super) fn at(&self, scale: f64) -> (G, SMatrix<f64, N, N>) {
        let mut m = *self.covariance.matrix();
        if self.measures_scale {
            return (self.t_i_j, m);
        }
        for k in 0..3 {
            m.row_mut(k).scale_mut(1.0 / scale);
            m.column_mut(k).scale_mut(1.0 / scale);
        }
        (self.t_i_j.with_scale(scale), m)
    }

    /// Measured values: as many as the group has dimensions, but for an unmeasured scale.
    pub(super) fn dimension(&self) -> usize {
        if self.measures_scale { N } else { N - 1 }
    }
}

/// A scale and the standard deviation of its logarithm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Scale {
    pub(super) value: f64,
    pub(super) log_sigma: f64,
}

impl Scale {
    /// The frames' scale as two alignments have it, `a` = t_im_il and `b` = t_jm_jl the odometry between their anchors.
    /// Uncertain beyond use, but within the range of scales, where the baseline is too short.
    pub(super) fn of_pair<const N: usize, G: Scaled<N>>(
        m: &Alignment<N, G>,
        l: &Alignment<N, G>,
        a: &(Se3, Matrix6<f64>),
        b: &(Se3, Matrix6<f64>),
    ) -> Self {
        if let Some(scaled) = [m, l].into_iter().find(|x| x.measures_scale) {
            return Self { value: scaled.t_i_j.scale(), log_sigma: log_scale_sigma(scaled.covariance.matrix()) };
        }
        let of_alpha = baseline_in_alpha(m, l, a);
        let of_beta = Baseline::new(b.0.translation, b.0.rotation.matrix(), &b.1.fixed_view::<3, 3>(0, 0).into_owned());
        let half = exp(0.5 * LOG_SCALE_RANGE);
        let ratio = of_alpha.length / of_beta.length;
        Self {
            value: if ratio.is_finite() { ratio.clamp(1.0 / half, half) } else { 1.0 },
            // σ_s²/s² = σ_α²/|Δp_α|² + σ_β²/|Δp_β|²
            log_sigma: libm::hypot(of_alpha.relative_sigma, of_beta.relative_sigma).min(UNMEASURED_LOG_SCALE_SIGMA),
        }
    }
}

/// The distance between the two places in α: of anchor j_l, seen from i_m through i_l, and of j_m.
fn baseline_in_alpha<const N: usize, G: Scaled<N>>(
    m: &Alignment<N, G>,
    l: &Alignment<N, G>,
    (a, sigma_a): &(Se3, Matrix6<f64>),
) -> Baseline {
    let (p_m, p_l) = (m.t_i_j.translation(), l.t_i_j.translation());
    let r_a = a.rotation.matrix();
    let of = |x: &Alignment<N, G>, r: &Matrix3<f64>| r * x.covariance.matrix().fixed_view::<3, 3>(0, 0) * r.transpose();
    // A point seen through a pose: δp = R_a (δρ − p^ δφ).
    let mut j = SMatrix::<f64, 3, 6>::zeros();
    j.fixed_view_mut::<3, 3>(0, 0).copy_from(&r_a);
    j.fixed_view_mut::<3, 3>(0, 3).copy_from(&(-r_a * p_l.cross_matrix()));
    let sigma =
        of(m, &m.t_i_j.rotation().matrix()) + of(l, &(r_a * l.t_i_j.rotation().matrix())) + j * sigma_a * j.transpose();
    Baseline::new(*a * p_l - p_m, Matrix3::identity(), &sigma)
}

struct Baseline {
    length: f64,
    /// Standard deviation of the length over the length.
    relative_sigma: f64,
}

impl Baseline {
    fn new(between: Vector3<f64>, rotation: Matrix3<f64>, sigma: &Matrix3<f64>) -> Self {
        let length = between.norm();
        let along = rotation.transpose() * between / length;
        let relative_sigma = sqrt((sigma * along).dot(&along).max(0.0)) / length;
        Self { length, relative_sigma: if relative_sigma.is_finite() { relative_sigma } else { f64::INFINITY } }
    }
}

/// Standard deviation of log-scale in a covariance.
pub(super) fn log_scale_sigma<const N: usize>(covariance: &SMatrix<f64, N, N>) -> f64 {
    if N == 7 { sqrt(covariance[(N - 1, N - 1)]) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::sampling::{normals, pose, rng};
    use nalgebra::Vector6;

    #[test]
    fn the_stated_scale_deviation_is_that_of_draws() {
        let mut rng = rng(71);
        let sigmas = |t: f64, r: f64| Vector6::new(t, t, t, r, r, r);
        let matrix = |s: &Vector6<f64>| Matrix6::from_diagonal(&s.component_mul(s));
        let (of_alignment, of_odometry) = (sigmas(0.05, 0.01), sigmas(0.2, 0.01));
        for scale in [0.3, 1.0, 3.0] {
            let (t_m, a, b_in_metres) = (pose(&mut rng), pose(&mut rng), pose(&mut rng));
            // The truth closes the loop: A T_l = T_m B.
            let b = Se3::new(b_in_metres.rotation, b_in_metres.translation * (10.0 / scale));
            let t_l = a.inverse() * t_m * Se3::new(b.rotation, b.translation * scale);
            let alignment = |t: Se3| {
                let covariance = Covariance::new(matrix(&of_alignment)).unwrap();
                let (t_i_j, covariance, measures_scale) =
                    SimMeasurement::from(PoseWithCovariance { pose: t, covariance }).parts();
                Alignment { i: 0, j: 0, t_i_j, covariance, measures_scale, position: 0 }
            };
            let of_beta = of_odometry.component_mul(&sigmas(1.0 / scale, 1.0));
            let stated =
                Scale::of_pair(&alignment(t_m), &alignment(t_l), &(a, matrix(&of_odometry)), &(b, matrix(&of_beta)));
            assert!((stated.value / scale - 1.0).abs() < 1e-9, "{} of {scale}", stated.value);
            let (n, mut sum) = (4000, 0.0);
            for _ in 0..n {
                let mut noisy = |t: Se3, s: &Vector6<f64>| t.retract(&s.component_mul(&normals(&mut rng)));
                let (t_m, t_l) = (noisy(t_m, &of_alignment), noisy(t_l, &of_alignment));
                let (a, b) = (noisy(a, &of_odometry), noisy(b, &of_beta));
                let zero = Matrix6::zeros();
                let drawn = Scale::of_pair(&alignment(t_m), &alignment(t_l), &(a, zero), &(b, zero));
                sum += libm::log(drawn.value / scale).powi(2);
            }
            let drawn = sqrt(sum / f64::from(n));
            assert!((stated.log_sigma / drawn - 1.0).abs() < 0.1, "{} stated, {drawn} drawn", stated.log_sigma);
        }
    }

    #[test]
    fn no_baseline_gives_no_scale() {
        let covariance = Covariance::new(Matrix6::identity() * 1e-4).unwrap();
        let (t_i_j, covariance, measures_scale) =
            SimMeasurement::from(PoseWithCovariance { pose: Se3::identity(), covariance }).parts();
        let one = Alignment { i: 0, j: 0, t_i_j, covariance, measures_scale, position: 0 };
        let still = (Se3::identity(), Matrix6::zeros());
        let scale = Scale::of_pair(&one, &one, &still, &still);
        assert!(scale.value == 1.0 && scale.log_sigma == UNMEASURED_LOG_SCALE_SIGMA, "{scale:?}");
    }

    #[test]
    fn an_unmeasured_scale_is_as_likely_as_chance() {
        let peak = 1.0 / (sqrt(2.0 * core::f64::consts::PI) * UNMEASURED_LOG_SCALE_SIGMA);
        assert!((peak * LOG_SCALE_RANGE - 1.0).abs() < 1e-12);
    }
}
