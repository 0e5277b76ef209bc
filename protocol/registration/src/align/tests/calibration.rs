//! Stated covariances hold.

use super::{Case, Draw, SIGMA, config};
use crate::align::{Model, SolverConfig};
use crate::geometry::Relative;
use nalgebra::{SVector, Vector3};

/// χ² quantiles, 95 %, for 6 and 7 degrees of freedom.
const CHI2_95: [f64; 2] = [12.591_587, 14.067_140];

#[test]
fn the_95_percent_ellipsoid_covers_95_percent() {
    for (n, inliers) in [(100, 50), (100, 20), (150, 15)] {
        let runs = 400;
        let (mut covered, mut found) = (0, 0);
        for seed in 0..runs {
            let case = Case::uniform(20_000 + seed, n, inliers, 1.0);
            let Ok(alignment) = case.solve(&config(3.0 * SIGMA)) else { continue };
            let Relative::Metric(p) = alignment.t_target_source else { panic!("rigid was asked") };
            found += 1;
            covered += usize::from(p.covariance.mahalanobis_squared(&case.rigid_error(&p.pose)) < CHI2_95[0]);
        }
        let share = f64::from(covered as u32) / f64::from(found);
        assert!(f64::from(found) > 0.97 * runs as f64, "{found} of {runs}");
        assert!((0.92..=0.98).contains(&share), "{inliers} of {n}: {share}");
    }
}

#[test]
fn the_95_percent_ellipsoid_of_a_similarity_covers_95_percent() {
    let runs = 300;
    let mut covered = 0;
    for seed in 0..runs {
        let scale = if seed % 2 == 0 { 0.6 } else { 1.7 };
        let case = Case::uniform(40_000 + seed, 60, 30, scale);
        let model = Model::Similarity { scale_min: 0.5, scale_max: 2.0 };
        let found = case.solve(&SolverConfig { model, ..config(4.0 * SIGMA) }).expect("30 of 60");
        let Relative::Similarity(s) = found.t_target_source else { panic!("a similarity was asked") };
        // To first order log(error) of a similarity near 1 is (t, log R, ln s).
        let error = s.sim.inverse() * case.truth;
        let (t, r) = (error.translation, error.rotation.log());
        let delta = SVector::<f64, 7>::from([t.x, t.y, t.z, r.x, r.y, r.z, error.scale.ln()]);
        covered += usize::from(s.covariance.mahalanobis_squared(&delta) < CHI2_95[1]);
    }
    let share = f64::from(covered as u32) / runs as f64;
    assert!((0.92..=0.98).contains(&share), "{share}");
}

/// Share of runs whose truth lies in the 95 % ellipsoid; `tail` draws the factor of each inlier's noise.
fn coverage(inliers: usize, runs: u64, sigma_max: f64, tail: fn(&mut Draw) -> f64) -> f64 {
    let n = 200;
    let (mut covered, mut found) = (0, 0);
    for seed in 0..runs {
        let mut case = Case::uniform(60_000 + seed, n, inliers, 1.0);
        let mut draw = Draw::new(seed + 9_000_000);
        for i in 0..inliers {
            let noise = draw.noise(SIGMA) * tail(&mut draw);
            case.target[i] = (case.truth * Vector3::from(case.source[i]) + noise).into();
        }
        let Ok(alignment) = case.solve(&config(sigma_max)) else { continue };
        let Relative::Metric(p) = alignment.t_target_source else { panic!("rigid was asked") };
        found += 1;
        covered += u64::from(p.covariance.mahalanobis_squared(&case.rigid_error(&p.pose)) < CHI2_95[0]);
    }
    assert!(found as f64 > 0.99 * runs as f64, "{found} of {runs}");
    covered as f64 / found as f64
}

#[test]
fn coverage_holds_at_any_outlier_rate_also_under_heavy_tails() {
    // Student t with 3 degrees of freedom, one factor for the three axes.
    let student = |d: &mut Draw| {
        let chi2 = d.normal().powi(2) + d.normal().powi(2) + d.normal().powi(2);
        (3.0 / chi2).sqrt()
    };
    let mut all = Vec::new();
    for (label, tail) in [("Gaussian", (|_| 1.0) as fn(&mut Draw) -> f64), ("t3", student)] {
        for inliers in [100, 40, 20] {
            for sigma_max in [3.0 * SIGMA, 10.0 * SIGMA] {
                let share = coverage(inliers, 1500, sigma_max, tail);
                all.push((label, inliers, sigma_max, share));
            }
        }
    }
    assert!(all.iter().all(|(_, _, _, share)| (0.93..=0.97).contains(share)), "{all:?}");
}
