//! A relative measurement between two frames or submaps, rigid where both have metric scale and a similarity
//! otherwise, and how far two measurements of one thing lie apart (DESIGN §7).

use super::chi2;
use super::{Covariance, PoseWithCovariance, Se3, Sim3, SimWithCovariance};

/// A relative measurement or estimate between two frames or submaps: rigid where both have metric scale.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Relative {
    /// Both metric: SE(3).
    Metric(PoseWithCovariance),
    /// At least one of unknown scale: SIM(3).
    Similarity(SimWithCovariance),
}

/// How far two measurements of one thing lie apart.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Disagreement {
    /// Squared Mahalanobis distance.
    pub distance_squared: f64,
    /// Its degrees of freedom: 6, or 7 where either is a similarity.
    pub degrees_of_freedom: u32,
}

impl Disagreement {
    /// Whether honest Gaussian measurements would be this far apart at most 999 times in 1,000.
    pub fn is_consistent(&self) -> bool {
        self.distance_squared <= chi2::P999[5 + usize::from(self.degrees_of_freedom == 7)]
    }
}

impl Relative {
    /// The mean as a similarity (scale 1 where metric).
    pub fn sim(&self) -> Sim3 {
        match self {
            Self::Metric(p) => Sim3::from_se3(&p.pose),
            Self::Similarity(s) => s.sim,
        }
    }

    /// As a similarity with covariance; a metric one gets the log-scale variance of
    /// [`SimWithCovariance::from_metric`].
    pub fn lifted(&self) -> SimWithCovariance {
        match self {
            Self::Metric(p) => SimWithCovariance::from_metric(p),
            Self::Similarity(s) => *s,
        }
    }

    /// The same with all standard deviations grown by a factor.
    pub fn widened(&self, sigma_scale: f64) -> Self {
        let k = sigma_scale * sigma_scale;
        match self {
            Self::Metric(p) => Self::Metric(PoseWithCovariance { pose: p.pose, covariance: p.covariance.scaled(k) }),
            Self::Similarity(s) => {
                Self::Similarity(SimWithCovariance { sim: s.sim, covariance: s.covariance.scaled(k) })
            }
        }
    }

    /// Variance of the translation, of the local perturbation summed over its axes, in the squared unit of the source.
    pub fn translation_variance(&self) -> f64 {
        match self {
            Self::Metric(p) => p.covariance.matrix().fixed_view::<3, 3>(0, 0).trace(),
            Self::Similarity(s) => s.covariance.matrix().fixed_view::<3, 3>(0, 0).trace(),
        }
    }

    /// The rigid measurement, where it is one.
    pub fn metric(&self) -> Option<&PoseWithCovariance> {
        match self {
            Self::Metric(p) => Some(p),
            Self::Similarity(_) => None,
        }
    }

    /// `self ∘ other` for independent errors; metric only if both are.
    #[must_use]
    pub fn compose(&self, other: &Self) -> Self {
        match (self, other) {
            (Self::Metric(a), Self::Metric(b)) => Self::Metric(a.compose(b)),
            _ => Self::Similarity(self.lifted().compose(&other.lifted())),
        }
    }

    /// `self ∘ t` for a pose that is exactly known: `Σ = Ad(t⁻¹) Σ_self Ad(t⁻¹)ᵀ`.
    #[must_use]
    pub fn onto(&self, t: &Se3) -> Self {
        match self {
            Self::Metric(p) => {
                let a = t.inverse().adjoint();
                let covariance = Covariance::new_or_wider(a * p.covariance.matrix() * a.transpose());
                Self::Metric(PoseWithCovariance { pose: p.pose * *t, covariance })
            }
            Self::Similarity(s) => {
                let t = Sim3::from_se3(t);
                let a = t.inverse().adjoint();
                let covariance = Covariance::new_or_wider(a * s.covariance.matrix() * a.transpose());
                Self::Similarity(SimWithCovariance { sim: s.sim * t, covariance })
            }
        }
    }

    /// The inverse.
    #[must_use]
    pub fn inverse(&self) -> Self {
        match self {
            Self::Metric(p) => Self::Metric(p.inverse()),
            Self::Similarity(s) => Self::Similarity(s.inverse()),
        }
    }

    /// How far two independent measurements of one thing, in the same direction, lie apart. Symmetric.
    pub fn disagreement(&self, other: &Self) -> Disagreement {
        match (self, other) {
            (Self::Metric(a), Self::Metric(b)) => {
                Disagreement { distance_squared: a.distance_squared(b), degrees_of_freedom: 6 }
            }
            _ => Disagreement {
                distance_squared: self.lifted().distance_squared(&other.lifted()),
                degrees_of_freedom: 7,
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampling::{covariance, draw, pose, rng, similarity};
    use crate::sim3::Vector7;

    #[test]
    fn mixing_lifts_and_metric_stays_metric() {
        let mut rng = rng(11);
        let m = Relative::Metric(PoseWithCovariance { pose: pose(&mut rng), covariance: covariance(&mut rng) });
        let s = Relative::Similarity(SimWithCovariance { sim: similarity(&mut rng), covariance: covariance(&mut rng) });
        assert!(m.compose(&m.inverse()).metric().is_some());
        assert!(m.compose(&s).metric().is_none() && s.compose(&m).metric().is_none());
        let there_and_back = m.compose(&s).compose(&s.inverse()).sim();
        assert!(there_and_back.local(&m.sim()).norm() < 1e-9);
        assert!(m.disagreement(&m).distance_squared < 1e-20);
        assert_eq!(m.disagreement(&m).degrees_of_freedom, 6);
        assert_eq!(m.disagreement(&s).degrees_of_freedom, 7);
    }

    #[test]
    fn an_exact_pose_moves_the_covariance_there_and_back() {
        let mut rng = rng(14);
        for _ in 0..20 {
            let m = Relative::Metric(PoseWithCovariance { pose: pose(&mut rng), covariance: covariance(&mut rng) });
            let s =
                Relative::Similarity(SimWithCovariance { sim: similarity(&mut rng), covariance: covariance(&mut rng) });
            let t = pose(&mut rng);
            for one in [m, s] {
                let (there, back) = (one.onto(&t), one.onto(&t).onto(&t.inverse()));
                // As with a pose that is known to a millionth.
                let exact = PoseWithCovariance { pose: t, covariance: Covariance::from_sigmas([1e-6; 6]).unwrap() };
                let composed = one.compose(&Relative::Metric(exact)).lifted();
                assert!(there.sim().local(&composed.sim).norm() < 1e-9);
                let (a, b) = (there.lifted().covariance, composed.covariance);
                assert!((a.matrix() - b.matrix()).amax() < 1e-6 * b.matrix().amax());
                let (a, b) = (back.lifted().covariance, one.lifted().covariance);
                assert!((a.matrix() - b.matrix()).amax() < 1e-9 * b.matrix().amax());
            }
        }
    }

    #[test]
    fn a_lift_keeps_the_rigid_part() {
        let mut rng = rng(12);
        let p = PoseWithCovariance { pose: pose(&mut rng), covariance: covariance(&mut rng) };
        let q = PoseWithCovariance { pose: pose(&mut rng), covariance: covariance(&mut rng) };
        let lifted = Relative::Metric(p).lifted().compose(&Relative::Metric(q).lifted());
        let rigid = p.compose(&q);
        let top = lifted.covariance.matrix().fixed_view::<6, 6>(0, 0).into_owned();
        assert!((top - rigid.covariance.matrix()).amax() < 1e-6 * rigid.covariance.matrix().amax());
    }

    #[test]
    fn honest_pairs_agree_and_displaced_ones_do_not() {
        let mut rng = rng(13);
        let sigma: Covariance<7> = covariance(&mut rng).scaled(0.01);
        let (n, mut rejected, mut sum) = (4000, 0, 0.0);
        for _ in 0..n {
            let truth = similarity(&mut rng);
            let mut measure = || {
                let delta: Vector7 = draw(&mut rng, &sigma);
                Relative::Similarity(SimWithCovariance { sim: truth.retract(&delta), covariance: sigma })
            };
            let (a, b) = (measure(), measure());
            let d = a.disagreement(&b);
            sum += d.distance_squared;
            rejected += u32::from(!d.is_consistent());
            let displaced = match a {
                Relative::Similarity(s) => {
                    let step = sigma.sigmas() * 10.0;
                    Relative::Similarity(SimWithCovariance { sim: s.sim.retract(&step), ..s })
                }
                Relative::Metric(_) => unreachable!("measured as a similarity"),
            };
            assert!(!displaced.disagreement(&b).is_consistent());
        }
        // Expected 4 of 4,000; 15 is beyond five standard deviations.
        assert!(rejected <= 15, "{rejected}");
        assert!((6.8..7.2).contains(&(sum / f64::from(n))), "{}", sum / f64::from(n));
    }
}
