//! Sharpens a rough alignment of two submaps and states its covariance: robust point-to-plane ICP (Chen & Medioni 1991)
//! of the peer's keypoints against one's own thinned cloud, with Cauchy weights at an estimated noise scale.
//!
//! **Honest covariance.** The textbook σ²H⁻¹ takes residuals as independent; those of two thinned, partial views of one
//! surface are not. On 77 real pairs with known poses its NEES is 185 instead of 6: depth images and the poses inside a
//! submap bend whole submaps, errors that neither shrink with the number of keypoints nor show in the residuals
//! (sandwich and jackknife estimators over patches of 4 to 40 voxels were no better, NEES 170 to 14,000). Measured, the
//! error is nevertheless shaped like H⁻¹: large where the geometry is weak. So the textbook form stays, but however
//! many keypoints there are they count as at most [`INDEPENDENT_MAX`] measurements, and as fewer with the square of the
//! overlap. A LiDAR does not bend what it sees: what its points have in common is the surface's shape between them and
//! the odometry of the submap, and they count as [`INDEPENDENT_LIDAR_MAX`], and as fewer with the overlap.
//!
//! **Degeneracy.** Noise of the normals feigns information along a corridor. Information in a direction counts only
//! from pairs whose normal leans clearly that way; where too little is left, the alignment is refused.
//!
//! **Contradiction.** A refined pose that puts their points where I looked through is refused too ([`contradiction`]).

use super::block::Surfel;
use super::cloud::Index;
use super::features::{Features, Keypoints};
use super::modality::Modality;
use super::robust::cauchy_weight;
use super::visibility::contradiction;
use crate::config::Sensor;
use crate::geometry::{Covariance, PoseWithCovariance, Se3, Sim3, So3};
use nalgebra::{Matrix6, Vector3, Vector6};
use thiserror::Error;

/// Independent measurements that the keypoints of fully overlapping submaps amount to, however many they are, where a
/// depth camera bends its views. Fitted to 7-Scenes (see the [module](self)).
pub const INDEPENDENT_MAX: f64 = 15.5;
/// The same for LiDAR, where they are fewer with the overlap, not with its square. Measured: NEES 2.6 to 3.1 for 6
/// degrees of freedom on KITTI 07; in ray-cast halls 1.4 where nothing drifts inside a submap, and 4.1 and 5.6 where
/// the odometry does. (With the square, of a drive's pairs, 4.9 at one place and 1.6 ten metres apart.)
pub const INDEPENDENT_LIDAR_MAX: f64 = 85.0;
/// Of these, where matched points hold the pose too: such poses were chosen among many, at lower overlaps and in frames
/// that are turned at random. Measured: NEES 4.9 on 7-Scenes.
const ANCHORED_SHARE: f64 = 0.775;
/// Factor on the textbook covariance for what does shrink with the number of keypoints.
const SAMPLING_INFLATION: f64 = 2.0;
/// Floor of the standard deviation in every direction at the pairs' centroid and rim, in voxels: quantisation and the
/// convergence threshold.
const FLOOR_VOXELS: f64 = 0.02;
/// A pair informs about a direction only if its (scaled) Jacobian leans at least this far that way: three standard
/// deviations of a fitted normal.
const LEAN_MIN: f64 = 0.2;
/// Cosine of the largest angle between the normals of a pair.
const NORMALS_COS_MIN: f64 = 0.7;
/// Search radii of the first iterations, in voxels; the last is kept.
const RADII_VOXELS: [f64; 4] = [3.0, 2.5, 2.0, 1.5];
/// A step that moves neither centroid nor rim by more, in voxels, has converged.
const STEP_VOXELS: f64 = 0.02;
/// Radius, in voxels, within which a point of mine confirms one of theirs.
const CONTRADICTION_RADIUS_VOXELS: f64 = 1.5;
/// Least noise scale, in voxels.
const SIGMA_MIN_VOXELS: f64 = 0.01;
/// Standard deviation of a matched point, voxels: matches are accepted up to one and a half off.
const ANCHOR_SIGMA_VOXELS: f64 = 1.0;
/// So many matched points hold a direction that the surfaces leave free.
const ANCHORS_MIN: usize = 4;

/// When a refinement is refused.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RefineConfig {
    /// Iterations at most.
    pub iterations_max: usize,
    /// Pairs needed at least.
    pub pairs_min: usize,
    /// Least share of the information in every direction (1/3 for a translation in a well-shaped place). Measured:
    /// corridors 0 to 0.0005, a street seen by LiDAR 0.002 to 0.01, rooms 0.04.
    pub share_min: f64,
    /// Largest accepted [`contradiction`]. Measured over 154 right alignments at most 0.01, over 8 wrong ones that the
    /// solver accepted 0.08 to 0.18; moving things raise it.
    pub contradiction_max: f64,
    /// Independent measurements that all keypoints together amount to at most.
    pub independent_max: f64,
    /// They shrink with the square of the overlap, not with the overlap.
    pub bends: bool,
}

impl Default for RefineConfig {
    fn default() -> Self {
        Self {
            iterations_max: 30,
            pairs_min: 20,
            share_min: 0.002,
            contradiction_max: 0.04,
            independent_max: INDEPENDENT_MAX,
            bends: true,
        }
    }
}

impl RefineConfig {
    /// What suits the sensor.
    pub fn of(sensor: Sensor) -> Self {
        if Modality::of(sensor).ranges {
            Self { independent_max: INDEPENDENT_LIDAR_MAX, bends: false, ..Self::default() }
        } else {
            Self::default()
        }
    }
}

/// A refined alignment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Refined {
    /// `t_mine_theirs` with the covariance of its local perturbation.
    pub pose: PoseWithCovariance,
    /// Robust standard deviation of the point-to-plane residuals, my frame's units.
    pub rms: f64,
    /// Pairs used.
    pub pairs: usize,
    /// The smallest share of the surfaces' information in any direction (1/3 at best).
    pub share: f64,
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
    /// Their points would stand where my sensor looked through.
    #[error("{share:.2} of the keypoints would stand in space seen to be free; the alignment is wrong")]
    Contradicted {
        /// Their [`contradiction`].
        share: f64,
    },
    /// The steps did not become small.
    #[error("the refinement did not converge; the rough alignment is too far off")]
    NotConverged,
}

/// Refines `t_mine_theirs`, the rough alignment that maps their anchor frame into mine (within about a voxel or two).
///
/// # Errors
/// [`RefineError`] if the pairs do not determine the pose.
pub fn refine(
    theirs: &Keypoints,
    mine: &Features,
    t_mine_theirs: &Se3,
    config: &RefineConfig,
) -> Result<Refined, RefineError> {
    refine_anchored(theirs, mine, t_mine_theirs, &[], config)
}

/// [`refine`] with matched points (theirs, mine) besides the surfaces: along a direction that the surfaces leave free
/// they hold the pose, and the covariance says how loosely. So with enough of them such a direction is no reason to
/// refuse.
///
/// # Errors
/// As [`refine`].
pub(super) fn refine_anchored(
    theirs: &Keypoints,
    mine: &Features,
    t_mine_theirs: &Se3,
    anchors: &[Anchor],
    config: &RefineConfig,
) -> Result<Refined, RefineError> {
    let config =
        &RefineConfig { share_min: if anchors.len() < ANCHORS_MIN { config.share_min } else { 0.0 }, ..*config };
    let with_surface =
        |all: Vec<Surfel>| -> Vec<Surfel> { all.into_iter().filter(|s| s.roughness.is_some()).collect() };
    let (my_surfels, their_surfels) = (with_surface(mine.surfels()), with_surface(theirs.surfels()));
    let my_points: Vec<Vector3<f64>> = my_surfels.iter().map(|s| s.position).collect();
    let scene = Scene { theirs: &their_surfels, mine: &my_surfels, index: Index::new(&my_points), voxel: mine.voxel() };

    let mut pose = *t_mine_theirs;
    for iteration in 0..config.iterations_max {
        let last = RADII_VOXELS.len() - 1;
        let pairs = scene.pair_up(&pose, RADII_VOXELS[iteration.min(last)]);
        let system = System::new(&pairs, anchors, &pose, scene.voxel, config)?;
        if iteration >= last && system.step.amax() < STEP_VOXELS * scene.voxel {
            let (covariance, share) = system.covariance(their_surfels.len(), scene.voxel, config)?;
            let near = CONTRADICTION_RADIUS_VOXELS * scene.voxel;
            let contradicted = contradiction(theirs, mine, &Sim3::from_se3(&pose), near);
            if contradicted > config.contradiction_max {
                return Err(RefineError::Contradicted { share: contradicted });
            }
            let pose = PoseWithCovariance { pose, covariance };
            return Ok(Refined { pose, rms: system.sigma, pairs: pairs.len(), share });
        }
        if iteration + 1 == config.iterations_max {
            // Along a free direction a pose may slide for ever: then that is the reason.
            system.covariance(their_surfels.len(), scene.voxel, config)?;
        }
        pose = pose.retract(&(system.to_anchor() * system.step));
    }
    Err(RefineError::NotConverged)
}

struct Scene<'a> {
    theirs: &'a [Surfel],
    mine: &'a [Surfel],
    index: Index<'a>,
    voxel: f64,
}

struct Pair {
    their_point: Vector3<f64>,
    my_point: Vector3<f64>,
    my_normal: Vector3<f64>,
}

impl Scene<'_> {
    /// Each of their points with the nearest of mine that faces the same way.
    fn pair_up(&self, t_mine_theirs: &Se3, radius_voxels: f64) -> Vec<Pair> {
        let pair = |their: &Surfel| {
            let position = *t_mine_theirs * their.position;
            let normal = t_mine_theirs.rotation * their.normal;
            let near = self.index.within(&position, radius_voxels * self.voxel);
            let mut near = near.into_iter().map(|(k, _)| &self.mine[k as usize]);
            let my = near.find(|my| my.normal.dot(&normal) >= NORMALS_COS_MIN)?;
            Some(Pair { their_point: their.position, my_point: my.position, my_normal: my.normal })
        };
        self.theirs.iter().filter_map(pair).collect()
    }
}

/// The weighted least-squares problem around one pose. Its unknown is a perturbation about the pairs' centroid, with
/// the rotation scaled to the motion of the pairs' rim, so that all six components are lengths of like meaning.
struct System {
    rows: Vec<Row>,
    /// Rows that come from surfaces.
    pairs: usize,
    /// Robust noise scale of the residuals.
    sigma: f64,
    /// Centroid of the pairs in their frame.
    centre: Vector3<f64>,
    /// Root mean square distance from it.
    size: f64,
    /// H = Σ w J Jᵀ.
    information: Matrix6<f64>,
    /// The Gauss–Newton step.
    step: Vector6<f64>,
}

/// A point of theirs and the point of mine that it was matched with.
pub(super) type Anchor = (Vector3<f64>, Vector3<f64>);

/// The axes along which an anchor holds.
const AXES: [fn() -> Vector3<f64>; 3] = [Vector3::x, Vector3::y, Vector3::z];

struct Row {
    jacobian: Vector6<f64>,
    residual: f64,
    weight: f64,
}

impl System {
    fn new(
        pairs: &[Pair],
        anchors: &[Anchor],
        t_mine_theirs: &Se3,
        voxel: f64,
        config: &RefineConfig,
    ) -> Result<Self, RefineError> {
        if pairs.len() < config.pairs_min.max(6) {
            return Err(RefineError::TooFewPairs { pairs: pairs.len(), needed: config.pairs_min });
        }
        let count = pairs.len() as f64;
        let centre = pairs.iter().map(|p| p.their_point).sum::<Vector3<f64>>() / count;
        let spread = pairs.iter().map(|p| (p.their_point - centre).norm_squared()).sum::<f64>() / count;
        let size = spread.sqrt().max(voxel);
        let to_theirs = t_mine_theirs.rotation.inverse();
        let row = |their_point: &Vector3<f64>, my_point: &Vector3<f64>, my_normal: &Vector3<f64>| {
            // d/dδ of nᵀ(T exp(δ) p − q): (Rᵀn, p × Rᵀn).
            let normal = to_theirs * *my_normal;
            let turn = (their_point - centre).cross(&normal) / size;
            let residual = my_normal.dot(&(*t_mine_theirs * *their_point - my_point));
            let jacobian = Vector6::new(normal.x, normal.y, normal.z, turn.x, turn.y, turn.z);
            Row { jacobian, residual, weight: 1.0 }
        };
        let mut rows: Vec<Row> = pairs.iter().map(|p| row(&p.their_point, &p.my_point, &p.my_normal)).collect();
        let sigma = robust_scale(&rows).max(SIGMA_MIN_VOXELS * voxel);
        for row in &mut rows {
            row.weight = cauchy_weight(row.residual, sigma);
        }
        let held = (sigma / (ANCHOR_SIGMA_VOXELS * voxel)) * (sigma / (ANCHOR_SIGMA_VOXELS * voxel));
        for ((their_point, my_point), axis) in anchors.iter().flat_map(|anchor| AXES.map(|axis| (anchor, axis))) {
            rows.push(Row { weight: held, ..row(their_point, my_point, &axis()) });
        }
        let information: Matrix6<f64> = rows.iter().map(|r| r.jacobian * r.jacobian.transpose() * r.weight).sum();
        let gradient: Vector6<f64> = rows.iter().map(|r| r.jacobian * (r.weight * r.residual)).sum();
        // A trace of damping keeps a free direction still instead of flinging the pose along it.
        let damped = information + Matrix6::identity() * (1e-3 * count);
        let solved = damped.cholesky().ok_or(RefineError::Degenerate { share: 0.0 })?.solve(&gradient);
        Ok(Self { rows, pairs: pairs.len(), sigma, centre, size, information, step: -solved })
    }

    /// Maps the system's perturbation to the local perturbation of the pose.
    fn to_anchor(&self) -> Matrix6<f64> {
        let mut unscale = Matrix6::identity();
        (3..6).for_each(|k| unscale[(k, k)] = 1.0 / self.size);
        Se3::new(So3::identity(), self.centre).adjoint() * unscale
    }

    /// Covariance of the local perturbation of the pose, and the smallest share of the surfaces' information in any
    /// direction; `offered` is the number of keypoints that sought a counterpart.
    fn covariance(
        &self,
        offered: usize,
        voxel: f64,
        config: &RefineConfig,
    ) -> Result<(Covariance<6>, f64), RefineError> {
        let weight: f64 = self.rows.iter().map(|r| r.weight).sum();
        let eigen = self.information.symmetric_eigen();
        let (surfaces, anchors) = self.rows.split_at(self.pairs);
        let along = |rows: &[Row], k: usize, least: f64| -> f64 {
            let leans = rows.iter().map(|r| (r.jacobian.dot(&eigen.eigenvectors.column(k)), r.weight));
            leans.filter(|(lean, _)| lean.abs() >= least).fold(0.0, |sum, (lean, w)| sum + w * lean * lean) / weight
        };
        let surfaces = Vector6::from_fn(|k, _| along(surfaces, k, LEAN_MIN));
        let shares = surfaces + Vector6::from_fn(|k, _| along(anchors, k, 0.0));
        let degenerate = RefineError::Degenerate { share: surfaces.min() };
        if surfaces.min() < config.share_min {
            return Err(degenerate);
        }
        let (pairs, offered) = (self.pairs as f64, offered as f64);
        let share = if anchors.is_empty() { 1.0 } else { ANCHORED_SHARE };
        let missed = if config.bends { offered / pairs } else { 1.0 };
        let inflation = SAMPLING_INFLATION + missed * offered / (share * config.independent_max);
        let floor = FLOOR_VOXELS * voxel;
        let variances = shares.map(|share| inflation * self.sigma * self.sigma / (share * weight) + floor * floor);
        let root = self.to_anchor() * eigen.eigenvectors;
        let m = root * Matrix6::from_diagonal(&variances) * root.transpose();
        Covariance::new((m + m.transpose()) * 0.5)
            .map(|covariance| (covariance, surfaces.min()))
            .map_err(|_| degenerate)
    }
}

/// 1.4826 × the median absolute residual; `rows` is not empty.
fn robust_scale(rows: &[Row]) -> f64 {
    let mut sizes: Vec<f64> = rows.iter().map(|r| r.residual.abs()).collect();
    let middle = sizes.len() / 2;
    let (_, &mut median, _) = sizes.select_nth_unstable_by(middle, f64::total_cmp);
    1.4826 * median
}
