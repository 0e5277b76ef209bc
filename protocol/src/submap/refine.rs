//! Sharpens a rough alignment of two submaps and states its covariance. Robust point-to-plane ICP (Chen & Medioni 1991)
//! of the peer's keypoints against one's own thinned cloud, with Cauchy weights at an estimated noise scale.
//!
//! **Honest covariance.** The textbook σ²(JᵀWJ)⁻¹ takes residuals as independent; those of two thinned, partial views of
//! one surface are not: neighbours share the error of the depth image or of the poses inside the submap. So three
//! parts are added: the textbook term times [`RefineConfig::inflation`]; a cluster-robust "sandwich" H⁻¹(Σ g gᵀ)H⁻¹
//! whose score g is summed over patches a few voxels wide, so that errors that agree within a patch count once; and a
//! floor for what bends whole submaps. The constants were fitted to real pairs with known poses (see
//! [`RefineConfig`]). Directions in which the surfaces say (nearly) nothing are refused as degenerate: there the normals'
//! own noise would feign information.

use super::block::Surfel;
use super::cloud::Index;
use super::features::{Features, Keypoints};
use crate::geometry::{Covariance, PoseWithCovariance, Se3, So3};
use nalgebra::{Matrix6, Vector3, Vector6};
use std::collections::BTreeMap;
use thiserror::Error;

/// How an alignment is refined and how its covariance is stated. The defaults are calibrated together.
#[derive(Clone, Debug, PartialEq)]
pub struct RefineConfig {
    /// Radii of the search for a counterpart, in voxels: one per iteration, the last one repeated until convergence.
    pub radii_voxels: Vec<f64>,
    /// Iterations at most.
    pub iterations_max: usize,
    /// Pairs needed at least.
    pub pairs_min: usize,
    /// Normals of a pair differ by at most this angle, as its cosine.
    pub normals_cos_min: f64,
    /// Factor on the textbook covariance: keypoints per independent measurement.
    pub inflation: f64,
    /// Factor on the sandwich.
    pub sandwich: f64,
    /// Edge of a patch within which errors may agree, in voxels.
    pub patch_voxels: f64,
    /// Floor of the translation's standard deviation at the pairs' centroid, in voxels.
    pub floor_voxels: f64,
    /// Floor of the rotation's standard deviation, as motion of the pairs' rim in voxels.
    pub floor_rim_voxels: f64,
    /// Share of the information that normals' noise feigns in every direction: taken off before inverting.
    pub feigned: f64,
    /// Least share of the information per direction (1/3 each for the translation in a well-shaped place).
    pub share_min: f64,
}

impl Default for RefineConfig {
    fn default() -> Self {
        Self {
            radii_voxels: vec![3.0, 2.5, 2.0, 1.5],
            iterations_max: 20,
            pairs_min: 20,
            normals_cos_min: 0.7,
            inflation: 1.0,
            sandwich: 1.0,
            patch_voxels: 8.0,
            floor_voxels: 0.1,
            floor_rim_voxels: 0.1,
            feigned: 0.2,
            share_min: 0.004,
        }
    }
}

/// A refined alignment.
#[derive(Clone, Debug, PartialEq)]
pub struct Refined {
    /// `t_mine_theirs` with the covariance of its local perturbation.
    pub pose: PoseWithCovariance,
    /// Robust standard deviation of the point-to-plane residuals, my frame's units.
    pub rms: f64,
    /// Pairs used.
    pub pairs: usize,
}

/// Why an alignment was not refined.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum RefineError {
    /// Too few keypoints have a counterpart with a like normal.
    #[error("only {pairs} keypoints have a counterpart, {needed} are needed; the submaps overlap too little")]
    TooFewPairs {
        /// Pairs found.
        pairs: usize,
        /// Pairs needed.
        needed: usize,
    },
    /// The common surface leaves a direction (nearly) free: a corridor, a plane, a ball.
    #[error("the common surface leaves a direction free (information share {share:.4}); look for another pair")]
    Degenerate {
        /// The smallest share of the information.
        share: f64,
    },
    /// The steps did not become small.
    #[error("the refinement did not converge; the rough alignment is too far off")]
    NotConverged,
}

/// Refines `t_mine_theirs`.
///
/// # Errors
/// [`RefineError`] if the pairs do not determine the pose.
pub fn refine(
    theirs: &Keypoints,
    mine: &Features,
    t_mine_theirs: &Se3,
    config: &RefineConfig,
) -> Result<Refined, RefineError> {
    let my_surfels: Vec<Surfel> = mine.surfels().into_iter().filter(|s| s.roughness.is_some()).collect();
    let my_points: Vec<Vector3<f64>> = my_surfels.iter().map(|s| s.position).collect();
    let their_surfels: Vec<Surfel> = theirs.surfels().into_iter().filter(|s| s.roughness.is_some()).collect();
    let index = Index::new(&my_points);
    let voxel = mine.voxel();

    let mut pose = *t_mine_theirs;
    let mut converged = false;
    let mut system = None;
    for iteration in 0..config.iterations_max {
        let last = config.radii_voxels.len().saturating_sub(1);
        let radius = config.radii_voxels.get(iteration.min(last)).copied().unwrap_or(1.0) * voxel;
        let pairs = pair_up(&their_surfels, &my_surfels, &index, &pose, radius, config.normals_cos_min);
        let now = System::new(&pairs, &pose, voxel, config)?;
        let (step, size) = (now.step, now.size);
        system = Some(now);
        if converged {
            break;
        }
        pose = pose.retract(&step);
        converged = iteration >= last && now_norm(&step, size) < STEP_MIN * voxel;
    }
    if let (Some(path), Some(sys)) = (std::env::var_os("DUMP"), &system) {
        use std::io::Write;
        let mut f = std::fs::OpenOptions::new().append(true).create(true).open(path).unwrap();
        writeln!(f, "P {} {} {:?} {} {} {} {} {:?}", converged, sys.sigma, sys.centre.as_slice(), sys.size, voxel, sys.rows.len(), theirs.len(), pose.log().as_slice()).unwrap();
        for r in &sys.rows { writeln!(f, "R {:?} {} {} {:?}", r.jacobian.as_slice(), r.residual, r.weight, r.at.as_slice()).unwrap(); }
    }
    if let (Some(path), Some(sys)) = (std::env::var_os("DUMP"), &system) {
        use std::io::Write;
        let mut f = std::fs::OpenOptions::new().append(true).create(true).open(path).unwrap();
        writeln!(f, "P {} {} {:?} {} {} {} {} {:?}", converged, sys.sigma, sys.centre.as_slice(), sys.size, voxel, sys.rows.len(), theirs.len(), pose.log().as_slice()).unwrap();
        for r in &sys.rows { writeln!(f, "R {:?} {} {} {:?}", r.jacobian.as_slice(), r.residual, r.weight, r.at.as_slice()).unwrap(); }
    }
    let system = system.filter(|_| converged).ok_or(RefineError::NotConverged)?;
    let covariance = system.covariance(voxel, config)?;
    Ok(Refined { pose: PoseWithCovariance { pose, covariance }, rms: system.sigma, pairs: system.rows.len() })
}

/// A step (in voxels and radians) below which the pose has converged.
const STEP_MIN: f64 = 0.02;
fn now_norm(s: &Vector6<f64>, size: f64) -> f64 { s.fixed_rows::<3>(0).norm().max(s.fixed_rows::<3>(3).norm() * size) }
/// Least noise scale, in voxels.
const SIGMA_MIN_VOXELS: f64 = 0.01;

struct Pair {
    their_point: Vector3<f64>,
    my_point: Vector3<f64>,
    my_normal: Vector3<f64>,
}

fn pair_up(
    theirs: &[Surfel],
    mine: &[Surfel],
    index: &Index<'_>,
    t_mine_theirs: &Se3,
    radius: f64,
    cos_min: f64,
) -> Vec<Pair> {
    let mut pairs = Vec::with_capacity(theirs.len());
    for surfel in theirs {
        let position = *t_mine_theirs * surfel.position;
        let normal = t_mine_theirs.rotation * surfel.normal;
        let like = |k: u32| mine[k as usize].normal.dot(&normal) >= cos_min;
        let Some((k, _)) = index.within(&position, radius).into_iter().find(|hit| like(hit.0)) else { continue };
        let my = &mine[k as usize];
        pairs.push(Pair { their_point: surfel.position, my_point: my.position, my_normal: my.normal });
    }
    pairs
}

/// The weighted least-squares problem around one pose, in coordinates centred on the pairs and scaled to their size.
struct System {
    rows: Vec<Row>,
    /// Robust noise scale of the residuals.
    sigma: f64,
    /// Centroid of the pairs in their frame.
    centre: Vector3<f64>,
    /// Root mean square distance from it.
    size: f64,
    /// Σ w J Jᵀ.
    information: Matrix6<f64>,
    /// The Gauss–Newton step, a local perturbation of the pose.
    step: Vector6<f64>,
}

struct Row {
    jacobian: Vector6<f64>,
    residual: f64,
    weight: f64,
    patch: [i32; 3],
    at: Vector3<f64>,
}

impl System {
    fn new(pairs: &[Pair], t_mine_theirs: &Se3, voxel: f64, config: &RefineConfig) -> Result<Self, RefineError> {
        let count = pairs.len();
        if count < config.pairs_min {
            return Err(RefineError::TooFewPairs { pairs: count, needed: config.pairs_min });
        }
        let centre = pairs.iter().map(|p| p.their_point).sum::<Vector3<f64>>() / count as f64;
        let size = (pairs.iter().map(|p| (p.their_point - centre).norm_squared()).sum::<f64>() / count as f64).sqrt();
        let size = size.max(voxel);
        let mut rows: Vec<Row> = pairs
            .iter()
            .map(|pair| {
                let normal = t_mine_theirs.rotation.inverse() * pair.my_normal;
                let turn = (pair.their_point - centre).cross(&normal) / size;
                let residual = pair.my_normal.dot(&(*t_mine_theirs * pair.their_point - pair.my_point));
                let patch = pair.my_point / (config.patch_voxels * voxel);
                Row {
                    jacobian: Vector6::new(normal.x, normal.y, normal.z, turn.x, turn.y, turn.z),
                    residual,
                    weight: 1.0, at: pair.their_point,
                    patch: [patch.x, patch.y, patch.z].map(|x| x.floor() as i32),
                }
            })
            .collect();
        let sigma = robust_scale(&rows).max(SIGMA_MIN_VOXELS * voxel);
        for row in &mut rows {
            // Cauchy, 95 % efficient for Gaussian noise.
            let x = row.residual / (2.385 * sigma);
            row.weight = 1.0 / (1.0 + x * x);
        }
        let information: Matrix6<f64> = rows.iter().map(|r| r.jacobian * r.jacobian.transpose() * r.weight).sum();
        let gradient: Vector6<f64> = rows.iter().map(|r| r.jacobian * (r.weight * r.residual)).sum();
        let share = information.symmetric_eigenvalues().min() / rows.iter().map(|r| r.weight).sum::<f64>();
        if !(share > 1e-9) {
            return Err(RefineError::Degenerate { share });
        }
        let solved = information.cholesky().ok_or(RefineError::Degenerate { share })?.solve(&gradient);
        let mut system = Self { rows, sigma, centre, size, information, step: Vector6::zeros() };
        system.step = system.to_anchor() * -solved;
        Ok(system)
    }

    /// Maps a centred, scaled perturbation into the local perturbation of the pose.
    fn to_anchor(&self) -> Matrix6<f64> {
        let mut unscale = Matrix6::identity();
        (3..6).for_each(|k| unscale[(k, k)] = 1.0 / self.size);
        Se3::new(So3::identity(), self.centre).adjoint() * unscale
    }

    fn covariance(&self, voxel: f64, config: &RefineConfig) -> Result<Covariance<6>, RefineError> {
        let weight: f64 = self.rows.iter().map(|r| r.weight).sum();
        let eigen = self.information.symmetric_eigen();
        let shares = Vector6::from_fn(|k, _| {
            let along = self.rows.iter().map(|r| (r.jacobian.dot(&eigen.eigenvectors.column(k)), r.weight));
            along.filter(|(j, _)| j.abs() > config.feigned).map(|(j, w)| w * j * j).sum::<f64>() / weight
        });
        let share = shares.min();
        if std::env::var_os("EIG").is_some() { println!("eig {:?} {:?}", (eigen.eigenvalues/weight).as_slice(), shares.as_slice()); }
        let degenerate = RefineError::Degenerate { share };
        if share < config.share_min {
            return Err(degenerate);
        }
        let inverse_values = shares.map(|share| 1.0 / (share * weight));
        let inverse = eigen.eigenvectors * Matrix6::from_diagonal(&inverse_values) * eigen.eigenvectors.transpose();
        let mut scores: BTreeMap<[i32; 3], Vector6<f64>> = BTreeMap::new();
        for row in &self.rows {
            *scores.entry(row.patch).or_insert_with(Vector6::zeros) += row.jacobian * (row.weight * row.residual);
        }
        let patches = scores.len() as f64;
        let meat: Matrix6<f64> = scores.values().map(|g| g * g.transpose()).sum();
        let sandwich = inverse * meat * inverse * (patches / (patches - 6.0).max(1.0));
        let (floor, rim) = (config.floor_voxels * voxel, config.floor_rim_voxels * voxel);
        let floor = Vector6::new(floor, floor, floor, rim, rim, rim).map(|s| s * s);
        let centred = inverse * (config.inflation * self.sigma * self.sigma)
            + sandwich * config.sandwich
            + Matrix6::from_diagonal(&floor);
        let to_anchor = self.to_anchor();
        let at_anchor = to_anchor * centred * to_anchor.transpose();
        Covariance::new((at_anchor + at_anchor.transpose()) * 0.5).map_err(|_| degenerate)
    }
}

/// 1.4826 × the median absolute residual.
fn robust_scale(rows: &[Row]) -> f64 {
    let mut sizes: Vec<f64> = rows.iter().map(|r| r.residual.abs()).collect();
    let middle = sizes.len() / 2;
    let (_, &mut median, _) = sizes.select_nth_unstable_by(middle, f64::total_cmp);
    1.4826 * median
}
