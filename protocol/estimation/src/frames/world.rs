//! A seeded world to measure the consensus on, for tests, benchmarks and the simulator's table: two robots drive the
//! same figure-eight with drifting odometry, meet, and align; some alignments are false, some of those agree with each
//! other (perceptual aliasing). The world of MATH §5's table; nothing in the agent uses it.

use super::PairAlignment;
use crate::geometry::{Covariance, PoseWithCovariance, Se2, Se3, Sim3, SimWithCovariance, So3, se3};
use crate::trajectory::Trajectory;
use core::f64::consts::PI;
use libm::{cos, exp, log, sin};
use nalgebra::{Matrix3, SMatrix, SVector, Vector3, Vector6};
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const ANCHORS: usize = 150;
const ODOMETRY_SIGMAS: [f64; 2] = [0.02, 0.003];
const ALIGNMENT_SIGMAS: [f64; 2] = [0.05, 0.01];
/// Errors below which an estimate is right, 8° and 3 m.
const RIGHT_RAD: f64 = 8.0 * PI / 180.0;
const RIGHT_M: f64 = 3.0;

/// What is drawn.
#[derive(Clone, Copy, Debug)]
pub struct Draw {
    /// Alignments that are true.
    pub real: usize,
    /// False alignments that agree with each other.
    pub aliased: usize,
    /// False alignments at random.
    pub random: usize,
    /// Factor by which true alignments are noisier than they claim.
    pub under_reported: f64,
}

/// Two robots, what they measured, and the truth.
#[derive(Clone, Debug)]
pub struct World {
    /// α's odometry.
    pub alpha: Trajectory,
    /// β's odometry.
    pub beta: Trajectory,
    /// Alignments, true and false, in random order.
    pub alignments: Vec<PairAlignment>,
    /// Whether each alignment is true.
    pub real: Vec<bool>,
    /// The truth.
    pub t_alpha_beta: Se3,
    beta_centre: Vector3<f64>,
}

impl World {
    /// The world of a seed.
    pub fn new(seed: u64, draw: Draw) -> Self {
        Self::drawn(seed, draw, &Kind::SPATIAL)
    }

    /// As [`Self::new`], of robots that drive on one floor and measure in its plane: what they know of the rest is a
    /// gauge, as `merganser_registration` states it.
    pub fn planar(seed: u64, draw: Draw) -> Self {
        Self::drawn(seed, draw, &Kind::PLANAR)
    }

    fn drawn(seed: u64, draw: Draw, kind: &Kind) -> Self {
        let rng = &mut ChaCha8Rng::seed_from_u64(seed);
        let (start_a, start_b) = (uniform(rng, 0.0, 2.0 * PI), uniform(rng, 0.0, 2.0 * PI));
        let at = |start: f64, k: usize| kind.pose(&circuit(start + 2.0 * PI * k as f64 / ANCHORS as f64));
        let true_a: Vec<Se3> = (0..ANCHORS).map(|k| at(start_a, k)).collect();
        let true_b: Vec<Se3> = (0..ANCHORS).map(|k| at(start_b, k).retract(&kind.scaled(rng, [0.3, 0.05]))).collect();
        let mut near: Vec<(usize, usize)> = (0..ANCHORS)
            .flat_map(|i| (0..ANCHORS).map(move |j| (i, j)))
            .filter(|&(i, j)| (true_a[i].translation - true_b[j].translation).norm() < 3.0)
            .collect();
        near.shuffle(rng);
        let mut found: Vec<(usize, usize, Se3, bool)> = Vec::new();
        for &(i, j) in near.iter().take(draw.real) {
            let noise = kind.scaled(rng, ALIGNMENT_SIGMAS) * draw.under_reported;
            found.push((i, j, (true_a[i].inverse() * true_b[j]).retract(&noise), true));
        }
        let mut shift: Vector3<f64> = normals(rng);
        shift.z *= 0.1 * kind.rises;
        let displaced = Se3::new(So3::identity(), shift * (5.0 / shift.norm()));
        for _ in 0..draw.aliased {
            let (i, j) = near[rng.random_range(0..near.len())];
            let t_i_j = (true_a[i].inverse() * displaced * true_b[j]).retract(&kind.scaled(rng, ALIGNMENT_SIGMAS));
            found.push((i, j, t_i_j, false));
        }
        for _ in 0..draw.random {
            found.push((
                rng.random_range(0..ANCHORS),
                rng.random_range(0..ANCHORS),
                kind.pose(&false_alignment(rng)),
                false,
            ));
        }
        found.shuffle(rng);
        let covariance = kind.covariance(ALIGNMENT_SIGMAS, kind.aligned);
        let t_alpha_beta = true_a[0].inverse() * true_b[0];
        let centre = true_b.iter().map(|t| (true_b[0].inverse() * *t).translation).sum::<Vector3<f64>>();
        Self {
            alpha: odometry(rng, &true_a, kind),
            beta: odometry(rng, &true_b, kind),
            real: found.iter().map(|f| f.3).collect(),
            alignments: found
                .into_iter()
                .map(|(i, j, pose, _)| PairAlignment { i, j, t_i_j: PoseWithCovariance { pose, covariance } })
                .collect(),
            t_alpha_beta,
            beta_centre: centre / ANCHORS as f64,
        }
    }

    /// Whether an estimate is right: within 8° and, at the middle of β's map, 3 m of the truth.
    pub fn is_right(&self, t_alpha_beta: &Se3) -> bool {
        let error = self.t_alpha_beta.inverse() * *t_alpha_beta;
        let shift = (error * self.beta_centre - self.beta_centre).norm();
        error.rotation.angle() < RIGHT_RAD && shift < RIGHT_M
    }

    /// Normalised estimation error squared.
    pub fn nees(&self, estimate: &PoseWithCovariance) -> f64 {
        estimate.covariance.mahalanobis_squared(&estimate.pose.local(&self.t_alpha_beta))
    }
}

/// A [`World`] whose β is in units of its own; `T` is what an alignment measures.
#[derive(Clone, Debug)]
pub struct SimWorld<T> {
    /// α's odometry, m.
    pub alpha: Trajectory,
    /// β's odometry, in its own unit.
    pub beta: Trajectory,
    /// Alignments, true and false.
    pub alignments: Vec<PairAlignment<T>>,
    /// The truth.
    pub t_alpha_beta: Sim3,
    beta_centre: Vector3<f64>,
}

impl<T> SimWorld<T> {
    /// Whether an estimate, its scale included, is right: as [`World::is_right`].
    pub fn is_right(&self, t_alpha_beta: &Sim3) -> bool {
        let error = self.t_alpha_beta.inverse() * *t_alpha_beta;
        let shift = (*t_alpha_beta * self.beta_centre - self.t_alpha_beta * self.beta_centre).norm();
        error.rotation.angle() < RIGHT_RAD && shift < RIGHT_M
    }
}

impl World {
    /// The same world, β's unit drawn between 0.2 and 5 m; true alignments measure it to 3 %, false ones tell any.
    pub fn with_unknown_scale(&self, seed: u64) -> SimWorld<SimWithCovariance> {
        let rng = &mut ChaCha8Rng::seed_from_u64(seed);
        let unit = exp(uniform(rng, -1.6, 1.6));
        // A length in metres is 1/unit of β's; so are translations' standard deviations.
        let [m, r] = ALIGNMENT_SIGMAS;
        let of_alignment = covariance_of([m / unit, m / unit, m / unit, r, r, r, 0.03]);
        let alignments = self.alignments.iter().zip(&self.real).map(|(a, &real)| {
            let told = if real { 0.03 * normal(rng) } else { uniform(rng, -1.0, 1.0) };
            let sim = Sim3::new(a.t_i_j.pose.rotation, a.t_i_j.pose.translation, unit * exp(told));
            PairAlignment { i: a.i, j: a.j, t_i_j: SimWithCovariance { sim, covariance: of_alignment } }
        });
        self.in_unit(unit, alignments.collect())
    }

    /// The same world, β's unit drawn between 0.3 and 3 m; no alignment measures it.
    pub fn with_unmeasured_scale(&self, seed: u64) -> SimWorld<PoseWithCovariance> {
        let rng = &mut ChaCha8Rng::seed_from_u64(seed);
        let unit = exp(uniform(rng, log(0.3), log(3.0)));
        self.in_unit(unit, self.alignments.clone())
    }

    /// β in a unit of `unit` metres.
    fn in_unit<T>(&self, unit: f64, alignments: Vec<PairAlignment<T>>) -> SimWorld<T> {
        let mut beta = Trajectory::default();
        let mut previous = Se3::identity();
        for k in 0..self.beta.len() {
            let anchor = self.beta.pose(k).unwrap_or_else(Se3::identity);
            let step = previous.inverse() * anchor;
            let sigmas = if k == 0 { [1e-8, 1e-8] } else { [ODOMETRY_SIGMAS[0] / unit, ODOMETRY_SIGMAS[1]] };
            let pose = Se3::new(step.rotation, step.translation / unit);
            beta.push(PoseWithCovariance { pose, covariance: covariance(sigmas) });
            previous = anchor;
        }
        let truth = self.t_alpha_beta;
        SimWorld {
            alpha: self.alpha.clone(),
            beta,
            alignments,
            t_alpha_beta: Sim3::new(truth.rotation, truth.translation, unit),
            beta_centre: self.beta_centre / unit,
        }
    }
}

/// How its robots move and measure.
struct Kind {
    /// 1 in space, 0 in the plane: what is left of heights and tilts.
    rises: f64,
    /// Standard deviations of height (m) and tilts (rad) that an alignment states in the plane.
    aligned: [f64; 2],
    /// The same of an odometry step.
    driven: [f64; 2],
}

impl Kind {
    const SPATIAL: Self = Self { rises: 1.0, aligned: ALIGNMENT_SIGMAS, driven: ODOMETRY_SIGMAS };
    const PLANAR: Self = Self { rises: 0.0, aligned: [0.4, 0.08], driven: [1e-3, 1e-4] };

    fn pose(&self, t: &Se3) -> Se3 {
        if self.rises > 0.0 { *t } else { Se2::of(t).in_space() }
    }

    fn scaled(&self, rng: &mut ChaCha8Rng, sigmas: [f64; 2]) -> Vector6<f64> {
        let r = self.rises;
        scaled(rng, sigmas).component_mul(&Vector6::new(1.0, 1.0, r, r, r, 1.0))
    }

    fn covariance(&self, [m, r]: [f64; 2], out_of_plane: [f64; 2]) -> Covariance<6> {
        let [height, tilt] = if self.rises > 0.0 { [m, r] } else { out_of_plane };
        covariance_of([m, m, height, tilt, tilt, r])
    }
}

/// A point of the figure-eight, about 60 × 30 × 3 m, heading along the way.
fn circuit(s: f64) -> Se3 {
    let point = |s: f64| Vector3::new(30.0 * sin(s), 15.0 * sin(2.0 * s), 1.5 * sin(3.0 * s));
    let x = (Vector3::new(30.0 * cos(s), 30.0 * cos(2.0 * s), 4.5 * cos(3.0 * s))).normalize();
    let y = Vector3::z().cross(&x).normalize();
    Se3::new(So3::from_matrix(&Matrix3::from_columns(&[x, y, x.cross(&y)])), point(s))
}

fn odometry(rng: &mut ChaCha8Rng, truth: &[Se3], kind: &Kind) -> Trajectory {
    // A frame is its first anchor, exactly.
    let origin = PoseWithCovariance { pose: Se3::identity(), covariance: covariance([1e-8, 1e-8]) };
    let mut trajectory = Trajectory::new([origin]);
    for pair in truth.windows(2) {
        let pose = kind.pose(&(pair[0].inverse() * pair[1]).retract(&kind.scaled(rng, ODOMETRY_SIGMAS)));
        trajectory.push(PoseWithCovariance { pose, covariance: kind.covariance(ODOMETRY_SIGMAS, kind.driven) });
    }
    trajectory
}

/// Up to 3 m, nearly level, mostly of about the same heading.
fn false_alignment(rng: &mut ChaCha8Rng) -> Se3 {
    let turned = rng.random_bool(0.3);
    let yaw = if turned { uniform(rng, -PI, PI) } else { 0.0 } + 0.1 * normal(rng);
    let rho = Vector3::new(uniform(rng, -3.0, 3.0), uniform(rng, -3.0, 3.0), uniform(rng, -0.3, 0.3));
    Se3::exp(&se3::join(&rho, &Vector3::new(0.05 * normal(rng), 0.05 * normal(rng), yaw)))
}

fn scaled(rng: &mut ChaCha8Rng, [metres, radians]: [f64; 2]) -> Vector6<f64> {
    normals::<6>(rng).component_mul(&Vector6::new(metres, metres, metres, radians, radians, radians))
}

fn covariance([m, r]: [f64; 2]) -> Covariance<6> {
    covariance_of([m, m, m, r, r, r])
}

fn covariance_of<const N: usize>(sigmas: [f64; N]) -> Covariance<N> {
    Covariance::new_or_wider(SMatrix::from_diagonal(&SVector::from(sigmas.map(|s| s * s))))
}

fn uniform(rng: &mut ChaCha8Rng, low: f64, high: f64) -> f64 {
    low + (high - low) * rng.random::<f64>()
}

/// Standard normal (Box–Muller).
fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let (u, v) = (1.0 - rng.random::<f64>(), rng.random::<f64>());
    libm::sqrt(-2.0 * log(u)) * cos(2.0 * PI * v)
}

fn normals<const N: usize>(rng: &mut ChaCha8Rng) -> SVector<f64, N> {
    SVector::from_fn(|_, _| normal(rng))
}
