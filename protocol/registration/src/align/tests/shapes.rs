//! Covariances of the points' own: they sharpen the estimate, stay calibrated, and are checked.

use super::hostile::points;
use super::{Case, Draw, config};
use crate::align::{AlignError, Alignment, CONDITION_MAX, Model, Problem, Refusal, SolverConfig, align};
use crate::geometry::{Covariance, CovarianceError, Relative, So3};
use nalgebra::{Matrix3, Vector3};
use proptest::prelude::*;

/// Standard deviations of a stereo camera's points: good across, ten times worse along the ray.
const ACROSS: f64 = 0.003;
const ALONG: f64 = 0.03;
/// Three times the root mean square over the axes.
const SIGMA_MAX: f64 = 0.0525;

/// Matches whose points have covariances of their own.
#[derive(Clone)]
struct Shaped {
    case: Case,
    source: Vec<Covariance<3>>,
    target: Vec<Covariance<3>>,
}

/// A ray of any direction: its covariance, and an error drawn from it.
fn ray(draw: &mut Draw) -> (Covariance<3>, Vector3<f64>) {
    let turn = draw.motion().rotation.matrix();
    let sigmas = Vector3::new(ACROSS, ACROSS, ALONG);
    let covariance = turn * Matrix3::from_diagonal(&sigmas.component_mul(&sigmas)) * turn.transpose();
    (Covariance::new(covariance).expect("positive"), turn * draw.noise(1.0).component_mul(&sigmas))
}

impl Shaped {
    /// `n` matches, `inliers` of them true; noise in the target, and in the source too where `both`.
    fn new(seed: u64, n: usize, inliers: usize, scale: f64, both: bool) -> Self {
        let mut case = Case::uniform(seed, n, 0, scale);
        let mut draw = Draw::new(seed + 31_000_000);
        let (mut source, mut target) = (Vec::new(), Vec::new());
        for i in 0..n {
            let ((a, of_source), (b, of_target)) = (ray(&mut draw), ray(&mut draw));
            source.push(a);
            target.push(b);
            if i < inliers {
                let p = Vector3::from(case.source[i]);
                case.target[i] = (case.truth * p + of_target).into();
                if both {
                    case.source[i] = (p + of_source).into();
                }
            }
        }
        if !both {
            source.clear();
        }
        Self { case, source, target }
    }

    fn problem(&self) -> Problem<'_> {
        Problem {
            source: &self.case.source,
            target: &self.case.target,
            source_covariances: (!self.source.is_empty()).then_some(&self.source),
            target_covariances: (!self.target.is_empty()).then_some(&self.target),
            ..Problem::default()
        }
    }

    fn solve(&self, config: &SolverConfig) -> Result<Alignment, Refusal> {
        align(&self.problem(), config).expect("well-formed")
    }

    fn error_of(&self, found: &Alignment) -> f64 {
        (found.t_target_source.sim().rotation.inverse() * self.case.truth.rotation).angle()
    }
}

fn similar() -> SolverConfig {
    SolverConfig { model: Model::Similarity { scale_min: 0.4, scale_max: 2.5 }, ..config(SIGMA_MAX) }
}

#[test]
fn knowing_the_shape_of_the_noise_makes_the_error_smaller() {
    for (both, settings) in [(false, config(SIGMA_MAX)), (true, config(2.0 * SIGMA_MAX)), (false, similar())] {
        let (mut gains, mut known_sum, mut alike_sum) = (Vec::new(), 0.0, 0.0);
        for seed in 0..120 {
            let shaped = Shaped::new(seed, 100, 50, 1.0, both);
            let known = shaped.error_of(&shaped.solve(&settings).expect("50 of 100"));
            let alike = shaped.error_of(&shaped.case.solve(&settings).expect("50 of 100"));
            gains.push(alike - known);
            known_sum += known;
            alike_sum += alike;
        }
        let n = gains.len() as f64;
        let mean = gains.iter().sum::<f64>() / n;
        let deviation = (gains.iter().map(|g| (g - mean).powi(2)).sum::<f64>() / (n - 1.0)).sqrt();
        assert!(mean > 5.0 * deviation / n.sqrt(), "gain {mean} ± {}", deviation / n.sqrt());
        assert!(known_sum < 0.6 * alike_sum, "{known_sum} against {alike_sum}, both sides: {both}");
    }
}

#[test]
fn coverage_holds_with_covariances() {
    for (both, inliers, settings) in
        [(false, 50, config(SIGMA_MAX)), (true, 50, config(2.0 * SIGMA_MAX)), (false, 20, config(SIGMA_MAX))]
    {
        let runs = 1500;
        let (mut covered, mut found) = (0.0, 0.0);
        for seed in 0..runs {
            let shaped = Shaped::new(50_000 + seed, 100, inliers, 1.0, both);
            let Ok(alignment) = shaped.solve(&settings) else { continue };
            let Relative::Metric(p) = alignment.t_target_source else { panic!("rigid was asked") };
            found += 1.0;
            let error = shaped.case.rigid_error(&p.pose);
            covered += f64::from(u8::from(p.covariance.mahalanobis_squared(&error) < 12.591_587));
        }
        assert!(found > 0.99 * runs as f64, "{found} of {runs}");
        assert!((0.93..=0.97).contains(&(covered / found)), "{inliers} inliers, both {both}: {}", covered / found);
    }
}

#[test]
fn sigma_is_that_of_a_typical_match() {
    let typical = ((2.0 * ACROSS * ACROSS + ALONG * ALONG) / 3.0).sqrt();
    for seed in 0..20 {
        let mut shaped = Shaped::new(seed, 1000, 200, 1.0, false);
        let sigma = |s: &Shaped| s.solve(&config(SIGMA_MAX)).expect("200 of 1000").sigma;
        let stated = sigma(&shaped);
        assert!((stated / typical - 1.0).abs() < 0.1, "seed {seed}: {stated}");
        shaped.target = shaped.target.iter().map(|c| c.scaled(49.0)).collect();
        assert!((sigma(&shaped) / stated - 1.0).abs() < 1e-9, "covariances count up to a common factor");
    }
}

#[test]
fn equal_covariances_are_none() {
    for (seed, settings) in (0..10).flat_map(|s| [(s, config(0.03)), (s, similar())]) {
        let case = Case::uniform(seed, 200, 40, 1.0);
        let round = vec![Covariance::from_sigmas([0.2; 3]).expect("positive"); 200];
        let plain = case.solve(&settings).expect("40 of 200");
        for (source, target) in [(false, true), (true, false), (true, true)] {
            let side = |on: bool| if on { round.clone() } else { Vec::new() };
            let shaped = Shaped { case: case.clone(), source: side(source), target: side(target) };
            let found = shaped.solve(&settings).expect("40 of 200");
            let (a, b) = (found.t_target_source.sim(), plain.t_target_source.sim());
            assert!(
                (a.translation - b.translation).norm() < 1e-6 && (a.rotation.inverse() * b.rotation).angle() < 1e-6
            );
            assert!((found.support - plain.support).abs() < 1e-3);
            // Noise of a source grows with the scale, so the match's is another than at scale 1.
            let factor =
                if target { if source { (0.5 + 0.5 * a.scale * a.scale).sqrt() } else { 1.0 } } else { a.scale };
            assert!((found.sigma * factor / plain.sigma - 1.0).abs() < 1e-5, "{} {}", found.sigma, plain.sigma);
        }
    }
}

#[test]
fn frames_are_free_to_choose() {
    for (seed, settings) in (0..10).flat_map(|s| [(s, config(2.0 * SIGMA_MAX)), (s, similar())]) {
        let shaped = Shaped::new(seed, 150, 60, 1.0, true);
        let mut draw = Draw::new(seed + 5);
        let (g, h) = (draw.motion(), draw.motion());
        let turned = |points: &[[f64; 3]], by: &crate::geometry::Sim3| -> Vec<[f64; 3]> {
            points.iter().map(|p| (*by * Vector3::from(*p)).into()).collect()
        };
        let shapes = |all: &[Covariance<3>], by: &So3| -> Vec<Covariance<3>> {
            all.iter().map(|c| c.transported(&by.matrix()).expect("a rotation")).collect()
        };
        let moved = Shaped {
            case: Case {
                source: turned(&shaped.case.source, &g),
                target: turned(&shaped.case.target, &h),
                truth: h * shaped.case.truth * g.inverse(),
            },
            source: shapes(&shaped.source, &g.rotation),
            target: shapes(&shaped.target, &h.rotation),
        };
        let here = shaped.solve(&settings).expect("60 of 150").t_target_source.sim();
        let there = moved.solve(&settings).expect("60 of 150").t_target_source.sim();
        let back = h.inverse() * there * g;
        assert!((back.translation - here.translation).norm() < 1e-4, "seed {seed}");
        assert!((back.rotation.inverse() * here.rotation).angle() < 1e-4, "seed {seed}");
    }
}

#[test]
fn order_and_copies_change_nothing_to_the_bit_with_covariances() {
    let shaped = Shaped::new(3, 120, 50, 1.0, true);
    let wide = |c: &Covariance<3>| c.scaled(4.0);
    // Copies of the first thirty matches with wider covariances, at the end or at the beginning.
    let join = |a: &[Covariance<3>], first: bool| -> Vec<Covariance<3>> {
        let copies: Vec<_> = a[..30].iter().map(wide).collect();
        if first { copies.into_iter().chain(a.to_vec()).collect() } else { a.iter().copied().chain(copies).collect() }
    };
    let points = |a: &[[f64; 3]], first: bool| -> Vec<[f64; 3]> {
        if first { a[..30].iter().chain(a).copied().collect() } else { a.iter().chain(&a[..30]).copied().collect() }
    };
    let with = |first: bool| Shaped {
        case: Case {
            source: points(&shaped.case.source, first),
            target: points(&shaped.case.target, first),
            truth: shaped.case.truth,
        },
        source: join(&shaped.source, first),
        target: join(&shaped.target, first),
    };
    let settings = config(2.0 * SIGMA_MAX);
    let (plain, before, after) = (shaped.solve(&settings), with(true).solve(&settings), with(false).solve(&settings));
    let plain = plain.expect("50 of 120");
    for other in [before.expect("50 of 120"), after.expect("50 of 120")] {
        assert_eq!(plain.t_target_source, other.t_target_source);
        assert_eq!(plain.sigma.to_bits(), other.sigma.to_bits());
        assert_eq!(plain.support.to_bits(), other.support.to_bits());
    }
}

#[test]
fn chance_is_not_accepted_with_covariances() {
    for (settings, runs) in [(config(SIGMA_MAX), 300), (similar(), 100)] {
        for seed in 0..runs {
            let answer = Shaped::new(70_000 + seed, 100, 0, 1.0, seed % 2 == 0).solve(&settings);
            assert!(answer.is_err(), "seed {seed}: {answer:?}");
        }
    }
}

#[test]
fn bad_covariances_are_errors() {
    let refused = |m: Matrix3<f64>| Covariance::new(m).expect_err("no covariance");
    let with = |at: (usize, usize), value: f64| {
        let mut m = Matrix3::identity();
        m[at] = value;
        m
    };
    assert_eq!(refused(with((1, 1), f64::NAN)), CovarianceError::NotFinite);
    assert_eq!(refused(with((0, 1), 0.3)), CovarianceError::NotSymmetric);
    assert_eq!(refused(with((2, 2), -1.0)), CovarianceError::OutOfRange);
    let tilted = Matrix3::new(1.0, 2.0, 0.0, 2.0, 1.0, 0.0, 0.0, 0.0, 1.0);
    assert_eq!(refused(tilted), CovarianceError::NotPositiveDefinite);

    let shaped = Shaped::new(1, 20, 20, 1.0, true);
    let call = |change: &dyn Fn(&mut Shaped)| {
        let mut changed = shaped.clone();
        change(&mut changed);
        align(&changed.problem(), &config(SIGMA_MAX)).map(drop)
    };
    let count = |side| Err(AlignError::CovarianceCount { side, covariances: 19, matches: 20 });
    assert_eq!(call(&|s| s.source.truncate(19)), count("source"));
    assert_eq!(call(&|s| s.target.truncate(19)), count("target"));
    let needle = |variance| {
        move |s: &mut Shaped| {
            let m = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, variance));
            s.target = vec![Covariance::new(m).expect("positive"); 20];
        }
    };
    assert!(matches!(call(&needle(1e-16)), Err(AlignError::CovarianceRange { side: "target", .. })));
    assert!(matches!(call(&needle(0.999 / CONDITION_MAX)), Err(AlignError::CovarianceRange { .. })));
    assert_eq!(call(&needle(1.001 / CONDITION_MAX)), Ok(()));
}

/// Needles, discs and balls of any size and direction.
fn shapes(n: usize) -> impl Strategy<Value = Vec<Covariance<3>>> {
    let sigma = prop::sample::select(vec![1e-4, 1e-2, 1.0]);
    prop::collection::vec(([sigma.clone(), sigma.clone(), sigma], any::<u64>()), n).prop_map(|all| {
        let one = |(sigmas, seed): ([f64; 3], u64)| {
            let turn = Draw::new(seed).motion().rotation.matrix();
            Covariance::from_sigmas(sigmas).expect("positive").transported(&turn).expect("a rotation")
        };
        all.into_iter().map(one).collect()
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, ..ProptestConfig::default() })]

    #[test]
    fn nothing_panics_with_covariances(
        (source, target, a, b) in (0_usize..60).prop_flat_map(|n| (points(n), points(n), shapes(n), shapes(n))),
        truth in any::<bool>(),
        similar in any::<bool>(),
        sides in 0..3,
        sigma_max in prop::sample::select(vec![1e-9, 1e-3, 1.0, 1e3, 1e9]),
        size in prop::sample::select(vec![1e-5, 1.0, 1e5]),
    ) {
        let target = if truth { source.clone() } else { target };
        let (a, b): (Vec<_>, Vec<_>) = a.iter().zip(&b).map(|(a, b)| (a.scaled(size), b.scaled(size))).unzip();
        let problem = Problem {
            source: &source,
            target: &target,
            source_covariances: (sides != 0).then_some(&a),
            target_covariances: (sides != 1).then_some(&b),
            ..Problem::default()
        };
        let model = if similar { Model::Similarity { scale_min: 1e-6, scale_max: 1e6 } } else { Model::Rigid };
        let settings = SolverConfig { model, support_min: 4.0, ..config(sigma_max) };
        let answer = match align(&problem, &settings) {
            Err(AlignError::CovarianceRange { .. }) => return Ok(()),
            other => other.expect("well-formed"),
        };
        if let Ok(found) = answer {
            prop_assert!(found.sigma.is_finite() && found.log10_nfa.is_finite());
            prop_assert!(found.inlier_probabilities.iter().all(|p| (0.0..=1.0).contains(p)), "{found:?}");
            prop_assert!(found.information_eigenvalues.iter().all(|x| x.is_finite() && *x > 0.0));
            let sim = found.t_target_source.sim();
            prop_assert!(sim.translation.iter().all(|x| x.is_finite()) && sim.scale > 0.0);
        }
    }
}
