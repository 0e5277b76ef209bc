//! Properties of the whole estimator on synthetic matches.

mod calibration;
mod hostile;
mod recovery;
mod shapes;

use super::{Alignment, Problem, Refusal, SolverConfig, align};
use crate::geometry::{Se3, Sim3, So3};
use nalgebra::{Vector3, Vector6};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// Noise of synthetic inliers, per axis, in a scene of one unit.
const SIGMA: f64 = 0.01;

/// Seeded random numbers.
struct Draw(ChaCha8Rng);

impl Draw {
    fn new(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    /// Uniform in [0, 1).
    fn unit(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        let (u, v) = (1.0 - self.unit(), self.unit());
        (-2.0 * libm::log(u)).sqrt() * libm::cos(2.0 * core::f64::consts::PI * v)
    }

    fn in_cube(&mut self) -> Vector3<f64> {
        Vector3::from_fn(|_, _| self.unit())
    }

    fn noise(&mut self, sigma: f64) -> Vector3<f64> {
        Vector3::from_fn(|_, _| self.normal() * sigma)
    }

    fn motion(&mut self) -> Sim3 {
        let q = [self.normal(), self.normal(), self.normal(), self.normal()];
        let translation = self.in_cube() * 2.0 - Vector3::repeat(1.0);
        Sim3::new(So3::from_xyzw(q).expect("a normal quaternion"), translation, 1.0)
    }
}

/// Matches with their truth.
#[derive(Clone)]
struct Case {
    source: Vec<[f64; 3]>,
    target: Vec<[f64; 3]>,
    truth: Sim3,
}

impl Case {
    /// `n` matches in the unit cube, `inliers` of them true with noise [`SIGMA`]; the others land anywhere in the
    /// scene.
    fn uniform(seed: u64, n: usize, inliers: usize, scale: f64) -> Self {
        let mut draw = Draw::new(seed);
        let truth = Sim3 { scale, ..draw.motion() };
        let mut case = Self { source: Vec::new(), target: Vec::new(), truth };
        for i in 0..n {
            let p = draw.in_cube();
            let image = if i < inliers { p } else { draw.in_cube() };
            case.push(p, truth * image + draw.noise(SIGMA));
        }
        case
    }

    fn push(&mut self, p: Vector3<f64>, q: Vector3<f64>) {
        self.source.push(p.into());
        self.target.push(q.into());
    }

    fn solve(&self, config: &SolverConfig) -> Result<Alignment, Refusal> {
        let problem = Problem { source: &self.source, target: &self.target, ..Problem::default() };
        align(&problem, config).expect("a well-formed problem")
    }

    /// Rotation below 5°, translation below 0.1, scale within 10 %.
    fn recovered_by(&self, found: &Alignment) -> bool {
        let sim = found.t_target_source.sim();
        (sim.rotation.inverse() * self.truth.rotation).angle() < 5.0_f64.to_radians()
            && (sim.translation - self.truth.translation).norm() < 0.1
            && (sim.scale / self.truth.scale - 1.0).abs() < 0.1
    }

    /// δ with `found ⊕ δ = truth`, rigid.
    fn rigid_error(&self, found: &Se3) -> Vector6<f64> {
        found.local(&self.truth.to_se3())
    }
}

fn config(sigma_max: f64) -> SolverConfig {
    SolverConfig { sigma_max, ..SolverConfig::default() }
}
