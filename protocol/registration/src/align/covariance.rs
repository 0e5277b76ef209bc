//! What an alignment is worth: the covariance of its local perturbation and the geometry's eigenvalues.
//!
//! A local perturbation moves `s R p + t` by `J δ`, J = s R [I, −p^, p] (the last column for SIM(3) only). At the
//! inliers' centroid the information Σ w JᵀJ / σ̂² falls apart into translation, rotation and scale; the result is
//! carried to the source origin by Ad. w = p + r p′(r) / 3 is the mean slope of the estimator's influence p r at a
//! match, for the Gaussian mixture p (1 − (1 − p) r² / 3σ²): matches of doubtful membership inform less. How widely the
//! influences really scatter, Σ p² r², scales the covariance (A⁻¹ B A⁻¹ of robust statistics): under Gaussian noise it
//! adds nothing, under heavy tails it is what keeps the covariance honest. The covariance is inflated so that its χ²
//! ellipsoid covers 95 % although σ̂ is estimated from ν = 3 Σp − dof residuals.

use super::Weighting;
use super::noise;
use super::refine::{Context, Fit};
use crate::geometry::so3::hat;
use crate::geometry::{Covariance, PoseWithCovariance, Relative, Se3, Sim3, SimWithCovariance, So3};
use nalgebra::{Matrix3, Matrix6, SMatrix, Vector3};

/// Degrees of freedom of σ̂² assumed at least.
const FREEDOM_MIN: f64 = 4.0;

/// The scatter of influences lowers the covariance to this share at most.
const HONEST_MIN: f64 = 0.8;

/// An alignment with its uncertainty.
#[derive(Clone, Debug)]
pub(super) struct Estimate {
    pub relative: Relative,
    /// Ascending.
    pub eigenvalues: Vec<f64>,
    /// Largest standard deviation of a rotation axis, rad.
    pub rotation_sigma: f64,
}

/// The information at the inliers' centroid.
struct Information {
    /// Centroid in centred source coordinates.
    centroid: Vector3<f64>,
    /// Of each translation axis.
    translation: f64,
    /// Of rotation.
    rotation: Matrix3<f64>,
    /// Of log-scale.
    scale: f64,
}

/// The estimate of a fit; `None` where a rotation or the scale is wholly undetermined.
pub(super) fn estimate(context: &Context, fit: &Fit) -> Option<Estimate> {
    if fit.shapes.is_some() {
        return shaped_estimate(context, fit);
    }
    let information = information(context, fit);
    let axes = information.rotation.symmetric_eigen();
    let weakest = axes.eigenvalues.min();
    let determined = weakest > 1e-12 * axes.eigenvalues.max();
    if !determined {
        return None;
    }
    let inflation = inflation(3.0 * fit.support() - context.dof(), context.with_scale);
    let rotation = Matrix3::from_diagonal(&axes.eigenvalues.map(|l| inflation / l));
    let rotation = axes.eigenvectors * rotation * axes.eigenvectors.transpose();
    let translation = inflation / information.translation;
    let mut eigenvalues: Vec<f64> = vec![information.translation; 3];
    eigenvalues.extend(axes.eigenvalues.iter());
    if context.with_scale {
        eigenvalues.push(information.scale);
    }
    eigenvalues.sort_unstable_by(f64::total_cmp);
    let mut local = SMatrix::<f64, 7, 7>::zeros();
    local.fixed_view_mut::<3, 3>(0, 0).fill_diagonal(translation);
    local.fixed_view_mut::<3, 3>(3, 3).copy_from(&rotation);
    local[(6, 6)] = inflation / information.scale;
    let relative = carried(context, fit, &local, &information.centroid)?;
    Some(Estimate { relative, eigenvalues, rotation_sigma: (inflation / weakest).sqrt() })
}

/// The estimate where residuals have covariances of their own: the information is Σ w Jᵀ C⁻¹ J / σ̂², and does not fall
/// apart.
fn shaped_estimate(context: &Context, fit: &Fit) -> Option<Estimate> {
    let shapes = fit.shapes.as_ref()?;
    let (weights, total, honest) = honest_weights(context, fit);
    let source = &context.matches.source;
    let centroid = weights.iter().map(|(i, w)| source[*i] * *w).sum::<Vector3<f64>>() / total;
    let mut information = SMatrix::<f64, 7, 7>::zeros();
    for (i, w) in &weights {
        let j = noise::jacobian(&fit.motion, &(source[*i] - centroid));
        information += j.transpose() * (shapes.precision[*i] * *w) * j;
    }
    information *= motion_gain(1.0, fit.motion.residual_unit(), fit.sigma * fit.sigma) * honest;
    if !context.with_scale {
        information.row_mut(6).fill(0.0);
        information.column_mut(6).fill(0.0);
        information[(6, 6)] = 1.0;
    }
    let inflation = inflation(3.0 * fit.support() - context.dof(), context.with_scale);
    let local = information.cholesky()?.inverse() * inflation;
    let widest = local.fixed_view::<3, 3>(3, 3).into_owned().symmetric_eigenvalues().max();
    let relative = carried(context, fit, &local, &centroid)?;
    let mut eigenvalues: Vec<f64> = if context.with_scale {
        information.symmetric_eigenvalues().iter().copied().collect()
    } else {
        information.fixed_view::<6, 6>(0, 0).into_owned().symmetric_eigenvalues().iter().copied().collect()
    };
    eigenvalues.sort_unstable_by(f64::total_cmp);
    let determined = eigenvalues[0] > 0.0 && widest.is_finite();
    determined.then(|| Estimate { relative, eigenvalues, rotation_sigma: widest.sqrt() })
}

/// The motion with a covariance that is known about the inliers' centroid.
fn carried(context: &Context, fit: &Fit, local: &SMatrix<f64, 7, 7>, centroid: &Vector3<f64>) -> Option<Relative> {
    let motion = &fit.motion;
    // x ↦ target_centre + motion(x − source_centre)
    let turned = motion.rotation * context.matches.source_centre * motion.scale;
    let moved = context.matches.target_centre + motion.translation - turned;
    let centre = context.matches.source_centre + centroid;
    let so3 = So3::from_matrix(&motion.rotation);
    Some(if context.with_scale {
        let sim = Sim3::new(so3, moved, motion.scale);
        Relative::Similarity(SimWithCovariance { sim, covariance: carried_sim(local, &centre)? })
    } else {
        let pose = Se3::new(so3, moved);
        let local = local.fixed_view::<6, 6>(0, 0).into_owned();
        Relative::Metric(PoseWithCovariance { pose, covariance: carried_pose(&local, &centre)? })
    })
}

fn information(context: &Context, fit: &Fit) -> Information {
    let (weights, total, honest) = honest_weights(context, fit);
    let source = &context.matches.source;
    let centroid = weights.iter().map(|(i, w)| source[*i] * *w).sum::<Vector3<f64>>() / total;
    let (mut scatter, mut spread) = (Matrix3::zeros(), 0.0);
    for (i, w) in &weights {
        let x = source[*i] - centroid;
        scatter += x * x.transpose() * *w;
        spread += x.norm_squared() * *w;
    }
    let k = motion_gain(fit.motion.scale, fit.motion.residual_unit(), fit.sigma * fit.sigma) * honest;
    let rotation = (Matrix3::identity() * spread - scatter) * k;
    Information { centroid, translation: total * k, rotation, scale: spread * k }
}

/// How much each match informs, the sum, and the factor by which all do so less, or little more, than that.
fn honest_weights(context: &Context, fit: &Fit) -> (Vec<(usize, f64)>, f64, f64) {
    let variance = fit.sigma * fit.sigma;
    let mut weights = slopes(fit);
    let plain: f64 = fit.support();
    let mut total: f64 = weights.iter().map(|(_, w)| w).sum();
    if total < 0.5 * plain {
        // The slope may turn negative in hopeless mixtures; then fall back to the plain posteriors, and say as little.
        weights.iter_mut().for_each(|(i, w)| *w = 0.5 * fit.probabilities[*i]);
        total = 0.5 * plain;
    }
    let influence = |i: usize| fit.probabilities[i] * fit.probabilities[i] * fit.squared[i];
    let freedom = (3.0 * plain - context.dof()).max(FREEDOM_MIN);
    let scatter_of_influence = weights.iter().map(|(i, _)| influence(*i)).sum::<f64>() / (3.0 * variance);
    let honest = total / (scatter_of_influence * 3.0 * plain / freedom).max(HONEST_MIN * total);
    (weights, total, honest)
}

/// Matches of positive probability with the mean slope of their influence.
fn slopes(fit: &Fit) -> Vec<(usize, f64)> {
    let variance = fit.sigma * fit.sigma;
    let mut inliers: Vec<(usize, f64)> =
        (0..fit.probabilities.len()).filter(|&i| fit.probabilities[i] > 0.0).map(|i| (i, 0.0)).collect();
    if fit.weighting != Weighting::Kde {
        for (i, w) in &mut inliers {
            let p = fit.probabilities[*i];
            *w = p * (1.0 - (1.0 - p) * fit.squared[*i] / (3.0 * variance));
        }
        return inliers;
    }
    // p(r) is known at the residuals only: its slope is that between residuals some ranks apart.
    inliers.sort_unstable_by(|a, b| fit.squared[a.0].total_cmp(&fit.squared[b.0]).then(a.0.cmp(&b.0)));
    let window = (inliers.len() / 20).max(4);
    for k in 0..inliers.len() {
        let (low, high) = (inliers[k.saturating_sub(window)].0, inliers[(k + window).min(inliers.len() - 1)].0);
        let run = fit.squared[high].sqrt() - fit.squared[low].sqrt();
        let rise = fit.probabilities[high] - fit.probabilities[low];
        let p = fit.probabilities[inliers[k].0];
        let slope = if run > 0.0 { rise / run } else { 0.0 };
        inliers[k].1 = (p + fit.squared[inliers[k].0].sqrt() * slope / 3.0).clamp(-1.0, 1.0);
    }
    inliers
}

/// s² / σ² with σ in target units.
fn motion_gain(scale: f64, unit: f64, variance: f64) -> f64 {
    scale * scale / (variance * unit * unit)
}

/// Ad of a translation by `c` maps the perturbation about c to the one about the origin: ρ₀ = ρ + c × φ (− c λ).
fn carried_pose(local: &Matrix6<f64>, c: &Vector3<f64>) -> Option<Covariance<6>> {
    let mut ad = Matrix6::identity();
    ad.fixed_view_mut::<3, 3>(0, 3).copy_from(&hat(c));
    representable(ad * local * ad.transpose())
}

fn carried_sim(local: &SMatrix<f64, 7, 7>, c: &Vector3<f64>) -> Option<Covariance<7>> {
    let mut ad = SMatrix::<f64, 7, 7>::identity();
    ad.fixed_view_mut::<3, 3>(0, 3).copy_from(&hat(c));
    ad.fixed_view_mut::<3, 1>(0, 6).copy_from(&-c);
    representable(ad * local * ad.transpose())
}

/// The covariance, widened by a hair where a far origin makes it singular in double precision.
fn representable<const N: usize>(m: SMatrix<f64, N, N>) -> Option<Covariance<N>> {
    let m = (m + m.transpose()) * 0.5;
    let widened = || m + SMatrix::from_diagonal(&(m.diagonal() * 1e-11));
    Covariance::new(m).or_else(|_| Covariance::new(widened())).ok()
}

/// How much wider the 95 % ellipsoid is when σ̂² has ν degrees of freedom: d F₀.₉₅(d, ν) / χ²₀.₉₅(d), which is 1 +
/// 4.3/(ν − 2) for d = 6 and 1 + 4.5/(ν − 2) for d = 7 within 2 % from ν = 6 on. MATH's ν/(ν − 2) fits the mean of d²
/// instead and covers less.
fn inflation(freedom: f64, with_scale: bool) -> f64 {
    let excess = if with_scale { 4.5 } else { 4.3 };
    1.0 + excess / (freedom.max(FREEDOM_MIN) - 2.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use statrs::distribution::{ChiSquared, ContinuousCDF, FisherSnedecor};

    #[test]
    fn inflation_is_that_of_the_f_distribution() {
        for (d, with_scale) in [(6.0, false), (7.0, true)] {
            let chi = ChiSquared::new(d).expect("positive").inverse_cdf(0.95);
            for nu in [6.0, 9.0, 15.0, 24.0, 60.0, 300.0, 3000.0] {
                let f = FisherSnedecor::new(d, nu).expect("positive").inverse_cdf(0.95);
                let ratio = inflation(nu, with_scale) / (d * f / chi);
                assert!((ratio - 1.0).abs() < 0.02, "d = {d}, ν = {nu}: {ratio}");
            }
        }
    }
}
