//! Split covariance intersection on SE(3): decides what two estimates of one pose say together where nobody knows how
//! much of their errors they share.
//!
//! Each covariance is split, `P = C + I`: the error behind `C` may be correlated with the other's in any way, that
//! behind `I` is independent of everything. After Julier and Uhlmann (2001), "General decentralized data fusion with
//! covariance intersection", and Li, Nashashibi and Yang (2013), "Split covariance intersection filter", for ω ∈ (0, 1)
//!
//! ```text
//! P₁ = C_a/ω + I_a,   P₂ = C_b/(1−ω) + I_b
//! P⁻¹ = P₁⁻¹ + P₂⁻¹,  x = P (P₁⁻¹ x_a + P₂⁻¹ x_b)
//! I = P (P₁⁻¹ I_a P₁⁻¹ + P₂⁻¹ I_b P₂⁻¹) P,  C = P − I
//! ```
//!
//! bounds the true covariance of x whatever the correlation. ω is where `log det P` is smallest, which does not depend
//! on units as the trace does. `P₁⁻¹` and `P₂⁻¹` are parallel sums of matrices linear in ω and therefore concave in it,
//! so that `log det P` is convex and its derivative has one zero, found by bisection. Without `C` this is the
//! information-weighted mean, without `I` it is covariance intersection.
//!
//! The means lie on a manifold: both estimates are carried to the fused pose, `δ = −log(X_a⁻¹ X)` with covariance
//! `J_r P J_rᵀ`, fused there, and the pose moves until it stays.
//!
//! It is for imported estimates whose provenance is lost, nothing else: what is known of the correlation is thrown away
//! (MATH §3). Facts are united by their ids.

use super::gaussian::CovarianceError;
use super::{Covariance, PoseWithCovariance, Se3, se3};
use nalgebra::{Matrix6, Vector6};
use thiserror::Error;

/// χ²₆ is larger once in ten thousand times.
pub const DISAGREEMENT_MAX: f64 = 27.856_341_235_954_06;
/// Halvings of the interval in which ω lies; more move no digit of the result that rounding leaves.
const HALVINGS: usize = 40;
/// Steps of the mean during which ω is chosen anew: any ω bounds the covariance, so it may be held after.
const OMEGA_STEPS: usize = 4;
/// Steps of the mean at most; it takes three to five.
const STEPS_MAX: usize = 50;
/// A step smaller than this many standard deviations, squared, is none.
const STEP_MIN: f64 = 1e-20;
/// Two slopes that differ by so small a share cancel: rounding is not to choose between estimates that are equally
/// sure.
const SLOPE_SLACK: f64 = 1e-12;
/// A part of a covariance may be so much below zero by rounding, relative to the whole.
const SLACK: f64 = 1e-9;

/// A pose whose covariance is split into what may be correlated with others and what is independent of them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SplitEstimate {
    pose: Se3,
    common: Matrix6<f64>,
    independent: Matrix6<f64>,
}

/// Why two matrices are no split covariance.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum SplitError {
    /// Their sum is no covariance.
    #[error(transparent)]
    Covariance(#[from] CovarianceError),
    /// One of them is not positive semidefinite.
    #[error("a part of the covariance has a negative eigenvalue; both parts need to be covariances, or zero")]
    Negative,
    /// A share that is none.
    #[error("the independent share {0} of a covariance is not within 0 and 1")]
    Share(f64),
}

/// Why two estimates were not fused.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum FuseError {
    /// They are further apart than their covariances allow, however correlated their errors.
    #[error(
        "the two estimates disagree (χ² {0:.1} of 6 dof, at most {DISAGREEMENT_MAX:.1}); are they of one pose in one \
         frame, and their covariances right?"
    )]
    Disagree(f64),
    /// No mean was found.
    #[error("no mean was found in {STEPS_MAX} steps; the covariances are too wide for poses so far apart")]
    NotConverged,
}

/// What two estimates say together.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fused {
    /// The pose and its split covariance.
    pub estimate: SplitEstimate,
    /// ω: how much the first estimate's common part counts, the second's 1 − ω.
    pub omega: f64,
    /// The least that the estimates' difference is beyond chance, over all correlations: χ² of 6 dof or less.
    pub distance_squared: f64,
}

impl SplitEstimate {
    /// From both parts of the covariance of the local perturbation, order (ρ, φ); m² and rad². Either may be zero.
    ///
    /// # Errors
    /// [`SplitError`] if a part is not positive semidefinite or the sum no [`Covariance`].
    pub fn new(pose: Se3, common: Matrix6<f64>, independent: Matrix6<f64>) -> Result<Self, SplitError> {
        let whole = Covariance::new(common + independent)?;
        // By units of the whole, so that metres do not hide what is wrong with radians.
        let unit = whole.sigmas().map(|s| 1.0 / s);
        for part in [&common, &independent] {
            let scaled = Matrix6::from_fn(|r, c| 0.5 * (part[(r, c)] + part[(c, r)]) * unit[r] * unit[c]);
            if scaled.symmetric_eigenvalues().min() < -SLACK {
                return Err(SplitError::Negative);
            }
        }
        Ok(Self { pose, common: symmetric(common), independent: symmetric(independent) })
    }

    /// An estimate of whose covariance a share, 0 to 1, is independent.
    ///
    /// # Errors
    /// [`SplitError::Share`] if the share is none.
    pub fn with_share(estimate: &PoseWithCovariance, independent: f64) -> Result<Self, SplitError> {
        if !(0.0..=1.0).contains(&independent) {
            return Err(SplitError::Share(independent));
        }
        let whole = estimate.covariance.matrix();
        Ok(Self { pose: estimate.pose, common: whole * (1.0 - independent), independent: whole * independent })
    }

    /// The pose with its whole covariance.
    pub fn estimate(&self) -> PoseWithCovariance {
        PoseWithCovariance { pose: self.pose, covariance: Covariance::new_or_wider(self.common + self.independent) }
    }

    /// The part that may be correlated with other estimates.
    pub fn common(&self) -> &Matrix6<f64> {
        &self.common
    }

    /// The part that is independent of other estimates.
    pub fn independent(&self) -> &Matrix6<f64> {
        &self.independent
    }

    /// What both say together.
    ///
    /// # Errors
    /// [`FuseError`] if they contradict each other.
    pub fn fuse(&self, other: &Self) -> Result<Fused, FuseError> {
        let distance_squared = self.distance_squared(other);
        if distance_squared.is_nan() || distance_squared > DISAGREEMENT_MAX {
            return Err(FuseError::Disagree(distance_squared));
        }
        let (mut pose, mut omega) = (self.pose, 0.5);
        for step in 0..STEPS_MAX {
            let pair = Pair { a: self.carried_to(&pose), b: other.carried_to(&pose) };
            if step < OMEGA_STEPS {
                omega = pair.omega().ok_or(FuseError::NotConverged)?;
            }
            let at = pair.at(omega).ok_or(FuseError::NotConverged)?;
            let delta = at.covariance * (at.first * pair.a.delta + at.second * pair.b.delta);
            pose = pose.retract(&delta);
            if step + 1 >= OMEGA_STEPS && delta.dot(&((at.first + at.second) * delta)) < STEP_MIN {
                let (common, independent) = pair.split(&at, omega);
                let estimate = Self { pose, common, independent };
                return Ok(Fused { estimate, omega, distance_squared });
            }
        }
        Err(FuseError::NotConverged)
    }

    /// How far the two are apart at the least: `eᵀ S⁻¹ e` of the difference, where `S = C_a/ω + C_b/(1−ω) + I_a + I_b`
    /// is no smaller than its covariance for any ω, for the ω that makes it largest.
    fn distance_squared(&self, other: &Self) -> f64 {
        let e = self.pose.local(&other.pose);
        let (l, r) = (se3::left_jacobian_inv(&e), se3::right_jacobian_inv(&e));
        let (c_a, c_b) = (congruent(&l, &self.common), congruent(&r, &other.common));
        let rest = congruent(&l, &self.independent) + congruent(&r, &other.independent);
        let solved = |w: f64| Some((c_a / w + c_b / (1.0 - w) + rest).cholesky()?.solve(&e));
        let slopes = |w: f64| {
            let x = solved(w)?;
            Some([x.dot(&(c_a * x)) / (w * w), x.dot(&(c_b * x)) / ((1.0 - w) * (1.0 - w))])
        };
        bisect(slopes).and_then(solved).map_or(f64::NAN, |x| x.dot(&e))
    }

    /// The estimate as a Gaussian over the perturbation of another pose, exact to first order there.
    fn carried_to(&self, pose: &Se3) -> Carried {
        let r = self.pose.local(pose);
        let j = se3::right_jacobian(&r);
        Carried { delta: -r, common: congruent(&j, &self.common), independent: congruent(&j, &self.independent) }
    }
}

/// An estimate in the tangent space of a pose.
struct Carried {
    delta: Vector6<f64>,
    common: Matrix6<f64>,
    independent: Matrix6<f64>,
}

struct Pair {
    a: Carried,
    b: Carried,
}

/// `P₁⁻¹`, `P₂⁻¹` and `P`.
struct At {
    first: Matrix6<f64>,
    second: Matrix6<f64>,
    covariance: Matrix6<f64>,
}

impl Pair {
    fn at(&self, omega: f64) -> Option<At> {
        let inverse = |m: Matrix6<f64>| Some(symmetric(m.cholesky()?.inverse()));
        let first = inverse(self.a.common / omega + self.a.independent)?;
        let second = inverse(self.b.common / (1.0 - omega) + self.b.independent)?;
        Some(At { covariance: inverse(first + second)?, first, second })
    }

    /// The ω of the smallest determinant, where `tr(P (P₁⁻¹ C_a P₁⁻¹/ω² − P₂⁻¹ C_b P₂⁻¹/(1−ω)²))` is zero.
    fn omega(&self) -> Option<f64> {
        bisect(|w| {
            let at = self.at(w)?;
            let gained = congruent(&at.first, &self.a.common) / (w * w);
            let lost = congruent(&at.second, &self.b.common) / ((1.0 - w) * (1.0 - w));
            Some([gained, lost].map(|slope| (at.covariance * slope).trace()))
        })
    }

    /// The common and the independent part of the fused covariance.
    fn split(&self, at: &At, omega: f64) -> (Matrix6<f64>, Matrix6<f64>) {
        let whole = |of_a: Matrix6<f64>, of_b: Matrix6<f64>| {
            let inner = congruent(&at.first, &of_a) + congruent(&at.second, &of_b);
            congruent(&at.covariance, &inner)
        };
        let common = whole(self.a.common / omega, self.b.common / (1.0 - omega));
        (common, whole(self.a.independent, self.b.independent))
    }
}

/// Where the first slope stops being larger than the second, if their difference falls in (0, 1): the end of it that
/// does not reach zero, or ½ where both are equal everywhere.
fn bisect(slopes: impl Fn(f64) -> Option<[f64; 2]>) -> Option<f64> {
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..HALVINGS {
        let middle = 0.5 * (low + high);
        let [up, down] = slopes(middle)?;
        if (up - down).abs() <= SLOPE_SLACK * (up + down) {
            return Some(middle);
        }
        if up > down { low = middle } else { high = middle }
    }
    Some(0.5 * (low + high))
}

fn congruent(a: &Matrix6<f64>, m: &Matrix6<f64>) -> Matrix6<f64> {
    symmetric(a * m * a.transpose())
}

fn symmetric(m: Matrix6<f64>) -> Matrix6<f64> {
    (m + m.transpose()) * 0.5
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampling::{covariance, draw, pose, rng};
    use rand::Rng;

    fn split(pose: Se3, common: &Covariance<6>, independent: &Covariance<6>) -> SplitEstimate {
        SplitEstimate::new(pose, *common.matrix(), *independent.matrix()).unwrap()
    }

    fn with_share(pose: Se3, covariance: Covariance<6>, share: f64) -> SplitEstimate {
        SplitEstimate::with_share(&PoseWithCovariance { pose, covariance }, share).unwrap()
    }

    fn near(a: &Matrix6<f64>, b: &Matrix6<f64>, share: f64) -> bool {
        (a - b).amax() <= share * b.amax()
    }

    fn nees(truth: &Se3, estimate: &PoseWithCovariance) -> f64 {
        estimate.covariance.mahalanobis_squared(&estimate.pose.local(truth)) / 6.0
    }

    /// The information-weighted mean, as if errors were independent: Gauss–Newton on both residuals.
    fn naive(a: &PoseWithCovariance, b: &PoseWithCovariance) -> PoseWithCovariance {
        let mut pose = a.pose;
        let mut h = Matrix6::zeros();
        for _ in 0..20 {
            let mut g = Vector6::zeros();
            h = Matrix6::zeros();
            for one in [a, b] {
                let r = one.pose.local(&pose);
                let j = se3::right_jacobian_inv(&r);
                h += j.transpose() * one.covariance.information() * j;
                g += j.transpose() * one.covariance.information() * r;
            }
            pose = pose.retract(&-(h.cholesky().unwrap().solve(&g)));
        }
        PoseWithCovariance { pose, covariance: Covariance::new_or_wider(h.try_inverse().unwrap()) }
    }

    #[test]
    fn without_a_common_part_it_is_the_information_weighted_mean() {
        let rng = &mut rng(1);
        for _ in 0..50 {
            let (truth, p, q): (Se3, Covariance<6>, Covariance<6>) = (pose(rng), covariance(rng), covariance(rng));
            let a = with_share(truth.retract(&draw(rng, &p)), p, 1.0);
            let b = with_share(truth.retract(&draw(rng, &q)), q, 1.0);
            let fused = a.fuse(&b).unwrap();
            let want = naive(&a.estimate(), &b.estimate());
            let got = fused.estimate.estimate();
            assert!(want.pose.local(&got.pose).norm() < 1e-10);
            assert!(near(got.covariance.matrix(), want.covariance.matrix(), 1e-9));
            assert!(fused.estimate.common().amax() == 0.0 && fused.omega == 0.5);
            let apart = a.estimate().distance_squared(&b.estimate());
            assert!((fused.distance_squared - apart).abs() < 1e-9 * apart);
        }
    }

    #[test]
    fn all_in_common_is_covariance_intersection() {
        let rng = &mut rng(2);
        for _ in 0..50 {
            let (at, p, q): (Se3, Covariance<6>, Covariance<6>) = (pose(rng), covariance(rng), covariance(rng));
            let fused = with_share(at, p, 0.0).fuse(&with_share(at, q, 0.0)).unwrap();
            let ci = |w: f64| (p.information() * w + q.information() * (1.0 - w)).try_inverse().unwrap();
            let got = *fused.estimate.estimate().covariance.matrix();
            assert!(near(&got, &ci(fused.omega), 1e-9) && at.local(&fused.estimate.pose).norm() < 1e-12);
            // No other ω of a fine grid is better.
            let best = got.determinant();
            assert!((1..1000).all(|k| ci(f64::from(k) / 1000.0).determinant() > best * (1.0 - 1e-9)));
            assert_eq!(fused.estimate.independent().amax(), 0.0);
        }
        // Told twice, nothing is gained, and neither is preferred; and what is worse in all directions adds nothing.
        let (at, p): (Se3, Covariance<6>) = (pose(rng), covariance(rng));
        let twice = with_share(at, p, 0.0).fuse(&with_share(at, p, 0.0)).unwrap();
        assert!(near(twice.estimate.estimate().covariance.matrix(), p.matrix(), 1e-9) && twice.omega == 0.5);
        let worse = with_share(at, p, 0.0).fuse(&with_share(at, p.scaled(4.0), 0.0)).unwrap().estimate.estimate();
        assert!(near(worse.covariance.matrix(), p.matrix(), 1e-9));
    }

    #[test]
    fn the_order_does_not_matter() {
        let rng = &mut rng(3);
        for _ in 0..50 {
            let truth = pose(rng);
            let mut one = || {
                let (c, i): (Covariance<6>, Covariance<6>) = (covariance(rng), covariance(rng));
                split(truth.retract(&(draw(rng, &c) + draw(rng, &i))), &c, &i)
            };
            let (a, b) = (one(), one());
            let (Ok(x), Ok(y)) = (a.fuse(&b), b.fuse(&a)) else { continue };
            assert!((x.omega + y.omega - 1.0).abs() < 1e-6);
            assert!(x.estimate.pose.local(&y.estimate.pose).norm() < 1e-7);
            assert!(near(x.estimate.common(), y.estimate.common(), 1e-6));
            assert!(near(x.estimate.independent(), y.estimate.independent(), 1e-6));
            assert_eq!(a.fuse(&b), Ok(x), "to the bit");
        }
    }

    /// Mean NEES/6 over draws of two estimates whose errors are `common` (correlated as told) plus independent ones: of
    /// the naive mean, of split covariance intersection, and of covariance intersection of the whole.
    fn consistency(
        rng: &mut impl Rng,
        c: &Covariance<6>,
        [i_a, i_b]: [&Covariance<6>; 2],
        correlated: bool,
    ) -> [f64; 3] {
        const DRAWS: u32 = 3000;
        let mut sums = [0.0; 3];
        for _ in 0..DRAWS {
            let truth = pose(rng);
            let shared = draw(rng, c);
            let of_b = if correlated { shared } else { draw(rng, c) };
            let a = split(truth.retract(&(shared + draw(rng, i_a))), c, i_a);
            let b = split(truth.retract(&(of_b + draw(rng, i_b))), c, i_b);
            let all = |one: &SplitEstimate| SplitEstimate::with_share(&one.estimate(), 0.0).unwrap();
            let split = a.fuse(&b).unwrap().estimate.estimate();
            let whole = all(&a).fuse(&all(&b)).unwrap().estimate.estimate();
            sums[0] += nees(&truth, &naive(&a.estimate(), &b.estimate()));
            sums[1] += nees(&truth, &split);
            sums[2] += nees(&truth, &whole);
            let sharper = split.covariance.matrix().determinant() / whole.covariance.matrix().determinant();
            assert!(sharper < 0.9, "what is known of the split is used: {sharper}");
        }
        sums.map(|sum| sum / f64::from(DRAWS))
    }

    #[test]
    fn a_common_error_that_nobody_knows_leaves_it_conservative_where_the_naive_mean_is_not() {
        let rng = &mut rng(4);
        let c: Covariance<6> = covariance(rng);
        let (i_a, i_b): (Covariance<6>, Covariance<6>) = (covariance(rng).scaled(0.3), covariance(rng).scaled(0.3));
        // Standard deviation of the mean of 3,000 draws of χ²₆/6: 0.011.
        let [naive, split, whole] = consistency(rng, &c, [&i_a, &i_b], true);
        println!("ANEES with a common error: naive {naive:.2}, split CI {split:.2}, CI {whole:.2}");
        assert!(naive > 1.2 && split < 1.035 && whole < 1.035, "{naive} {split} {whole}");
        // With no error in common the naive mean is right, and the others stay conservative.
        let [naive, split, whole] = consistency(rng, &c, [&i_a, &i_b], false);
        println!("ANEES with none: naive {naive:.2}, split CI {split:.2}, CI {whole:.2}");
        assert!((naive - 1.0).abs() < 0.035 && split < 1.035 && whole < 1.035, "{naive} {split} {whole}");
    }

    #[test]
    fn what_disagrees_is_refused_however_its_errors_are_correlated() {
        let rng = &mut rng(5);
        let (at, p): (Se3, Covariance<6>) = (pose(rng), covariance(rng));
        let off = |k: f64| at.retract(&(p.sigmas() * k));
        for share in [0.0, 0.5, 1.0] {
            let a = with_share(at, p, share);
            assert!(a.fuse(&with_share(off(0.1), p, share)).is_ok());
            assert!(matches!(a.fuse(&with_share(off(40.0), p, share)), Err(FuseError::Disagree(_))));
            // A second that counts for nothing is still heard where it contradicts.
            let wide = with_share(off(400.0), p.scaled(9.0), share);
            assert!(matches!(a.fuse(&wide), Err(FuseError::Disagree(_))));
        }
        // True ones are seldom refused: less often than once in ten thousand times, because correlation is allowed for.
        let refused = (0..2000).filter(|_| {
            let (a, b) = (at.retract(&draw(rng, &p)), at.retract(&draw(rng, &p)));
            with_share(a, p, 0.3).fuse(&with_share(b, p, 0.3)).is_err()
        });
        assert_eq!(refused.count(), 0);
    }

    #[test]
    fn splits_that_are_none_are_refused() {
        let rng = &mut rng(6);
        let p: Covariance<6> = covariance(rng);
        let at = pose(rng);
        let none = Matrix6::zeros();
        assert!(SplitEstimate::new(at, *p.matrix(), none).is_ok() && SplitEstimate::new(at, none, *p.matrix()).is_ok());
        assert_eq!(SplitEstimate::new(at, p.matrix() * 2.0, -p.matrix()), Err(SplitError::Negative));
        assert!(matches!(SplitEstimate::new(at, none, none), Err(SplitError::Covariance(_))));
        let estimate = PoseWithCovariance { pose: at, covariance: p };
        for share in [-0.1, 1.1, f64::NAN] {
            assert!(matches!(SplitEstimate::with_share(&estimate, share), Err(SplitError::Share(_))));
        }
    }
}
