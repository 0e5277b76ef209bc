//! Bad input is answered by a typed error or refusal, never by a panic.

use super::{Case, Draw, SIGMA, config};
use crate::align::{AlignError, COORDINATE_MAX, Model, Problem, Refusal, SolverConfig, Weighting, align};
use crate::kinds::RefusalReason;
use nalgebra::Vector3;
use proptest::prelude::*;

#[test]
fn malformed_calls_are_errors() {
    let points = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
    fn call(s: &[[f64; 3]], t: &[[f64; 3]], scores: Option<&[f64]>, config: &SolverConfig) -> Result<(), AlignError> {
        align(&Problem { source: s, target: t, scores, ..Problem::default() }, config).map(drop)
    }
    let good = config(0.1);
    assert_eq!(
        call(&points, &points[..2], None, &good),
        Err(AlignError::LengthMismatch { source_len: 3, target_len: 2, scores_len: None })
    );
    assert_eq!(
        call(&points, &points, Some(&[1.0]), &good),
        Err(AlignError::LengthMismatch { source_len: 3, target_len: 3, scores_len: Some(1) })
    );
    for bad in [f64::NAN, f64::INFINITY, -f64::INFINITY, 1.001 * COORDINATE_MAX] {
        let mut broken = points;
        broken[1][2] = bad;
        assert_eq!(call(&broken, &points, None, &good), Err(AlignError::NotFinite { index: 1 }));
        assert_eq!(call(&points, &broken, None, &good), Err(AlignError::NotFinite { index: 1 }));
    }
    assert_eq!(call(&points, &points, Some(&[0.0, 1.0, f64::NAN]), &good), Err(AlignError::NotFinite { index: 2 }));
    let full = SolverConfig { points_max: 3, ..config(0.1) };
    assert!(call(&points, &points, None, &full).is_ok());
    let narrow = SolverConfig { points_max: 2, ..config(0.1) };
    assert_eq!(call(&points, &points, None, &narrow), Err(AlignError::TooManyPoints { len: 3, max: 2 }));
}

#[test]
fn settings_out_of_range_are_errors_that_name_the_setting() {
    let named = |config: SolverConfig| match config.check() {
        Err(AlignError::BadConfig { field, .. }) => field,
        other => panic!("{other:?}"),
    };
    for sigma_max in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert_eq!(named(config(sigma_max)), "sigma_max");
    }
    assert_eq!(named(SolverConfig { log10_nfa_max: 1.0, ..config(0.1) }), "log10_nfa_max");
    assert_eq!(named(SolverConfig { log10_nfa_provisional: Some(-5.0), ..config(0.1) }), "log10_nfa_provisional");
    assert_eq!(named(SolverConfig { support_min: 3.9, ..config(0.1) }), "support_min");
    assert_eq!(named(SolverConfig { rival_ratio: 0.0, ..config(0.1) }), "rival_ratio");
    assert_eq!(named(SolverConfig { rotation_sigma_max: 0.0, ..config(0.1) }), "rotation_sigma_max");
    assert_eq!(named(SolverConfig { hypotheses_max: 0, ..config(0.1) }), "hypotheses_max");
    assert_eq!(named(SolverConfig { points_max: 65_536, ..config(0.1) }), "points_max");
    for (scale_min, field) in [(0.0, "scale_min"), (1e9, "scale_min"), (2.0, "scale_max")] {
        let model = Model::Similarity { scale_min, scale_max: 1.0 };
        assert_eq!(named(SolverConfig { model, ..config(0.1) }), field);
    }
    assert_eq!(config(0.1).check(), Ok(()));
}

#[test]
fn too_few_distinct_points_are_refused() {
    let case = Case::uniform(1, 6, 6, 1.0);
    assert!(case.solve(&config(0.03)).is_ok());
    for n in 0..6 {
        let few = Case { source: case.source[..n].to_vec(), target: case.target[..n].to_vec(), truth: case.truth };
        assert_eq!(few.solve(&config(0.03)), Err(Refusal::TooFew { distinct: n, needed: 6 }));
    }
    let same = Case { source: vec![[1.0; 3]; 50], target: vec![[2.0; 3]; 50], truth: case.truth };
    assert_eq!(same.solve(&config(0.03)), Err(Refusal::TooFew { distinct: 1, needed: 6 }));
}

#[test]
fn degenerate_geometry_is_refused_as_such() {
    let mut draw = Draw::new(2);
    let truth = draw.motion();
    let axis = Vector3::new(0.6, 0.0, 0.8);
    // Inliers on a line, on a line with less thickness than noise, and in one cluster; outliers anywhere.
    type Place<'a> = &'a dyn Fn(&mut Draw) -> Vector3<f64>;
    let line: Place = &|d| axis * d.unit();
    let thick: Place = &|d| axis * d.unit() + d.noise(0.3 * SIGMA);
    let cluster: Place = &|d| Vector3::repeat(0.5) + d.noise(0.7 * SIGMA);
    for (label, place) in [("line", line), ("thick line", thick), ("cluster", cluster)] {
        for inliers in [30, 100] {
            let mut case = Case::uniform(3, 100, 0, 1.0);
            for i in 0..inliers {
                let p = place(&mut draw);
                case.source[i] = p.into();
                case.target[i] = (truth * p + draw.noise(SIGMA)).into();
            }
            let answer = case.solve(&config(3.0 * SIGMA));
            let good = match label {
                "cluster" => answer.is_err(),
                _ => matches!(answer, Err(Refusal::Degenerate { .. })),
            };
            assert!(good, "{label}, {inliers} inliers: {answer:?}");
        }
    }
}

#[test]
fn a_plane_is_not_degenerate() {
    let mut draw = Draw::new(5);
    let mut case = Case::uniform(4, 100, 0, 1.0);
    for i in 0..40 {
        let p = Vector3::new(draw.unit(), draw.unit(), 0.3);
        case.source[i] = p.into();
        case.target[i] = (case.truth * p + draw.noise(SIGMA)).into();
    }
    let found = case.solve(&config(3.0 * SIGMA)).expect("a plane of labelled points fixes all six degrees");
    assert!(case.recovered_by(&found));
    assert_eq!(found.information_eigenvalues.len(), 6);
    assert!(found.information_eigenvalues.is_sorted() && found.information_eigenvalues[0] > 0.0);
}

#[test]
fn refusals_have_wire_reasons() {
    let reasons = [
        (Refusal::TooFew { distinct: 0, needed: 6 }, RefusalReason::TooFew),
        (Refusal::NoConsensus { log10_nfa: 0.0, support: 0.0 }, RefusalReason::NoConsensus),
        (Refusal::Ambiguous { support: 9.0, rival_support: 8.0, apart: 1.0 }, RefusalReason::Ambiguous),
        (Refusal::Degenerate { rotation_sigma: 1.0 }, RefusalReason::Degenerate),
    ];
    for (refusal, reason) in reasons {
        assert_eq!(RefusalReason::from(refusal), reason);
        assert!(!refusal.to_string().is_empty());
    }
}

/// Coordinates that break careless arithmetic.
fn coordinate() -> impl Strategy<Value = f64> {
    prop_oneof![
        -1.0..1.0_f64,
        prop::sample::select(vec![0.0, -0.0, 1e-300, -1e-12, 1.0, 1e-9, 1e9, -1e9, 1e6]),
        -1e9..1e9_f64,
    ]
}

pub(super) fn points(n: usize) -> impl Strategy<Value = Vec<[f64; 3]>> {
    prop::collection::vec([coordinate(), coordinate(), coordinate()], n)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, ..ProptestConfig::default() })]

    #[test]
    fn nothing_panics_and_answers_are_finite(
        (source, target) in (0_usize..60).prop_flat_map(|n| (points(n), points(n))),
        copies in 0_usize..3,
        sigma_max in prop::sample::select(vec![1e-9, 1e-3, 1.0, 1e3, 1e9]),
        similar in any::<bool>(),
        weighting in prop::sample::select(vec![Weighting::Auto, Weighting::Em, Weighting::Kde]),
        truth in any::<bool>(),
    ) {
        let target = if truth { source.clone() } else { target };
        let (mut s, mut t) = (source.clone(), target.clone());
        for _ in 0..copies {
            s.extend_from_slice(&source);
            t.extend(target.iter().rev());
        }
        let model = if similar { Model::Similarity { scale_min: 1e-6, scale_max: 1e-5 } } else { Model::Rigid };
        let config = SolverConfig { model, weighting, support_min: 4.0, ..config(sigma_max) };
        let answer = align(&Problem { source: &s, target: &t, ..Problem::default() }, &config).expect("well-formed");
        if let Ok(found) = answer {
            prop_assert!(found.sigma.is_finite() && found.support.is_finite() && found.log10_nfa.is_finite());
            prop_assert!(found.inlier_probabilities.iter().all(|p| (0.0..=1.0).contains(p)));
            prop_assert_eq!(found.inlier_probabilities.len(), s.len());
            let sim = found.t_target_source.sim();
            prop_assert!(sim.translation.iter().all(|x| x.is_finite()) && sim.scale > 0.0);
        }
    }

    #[test]
    fn degenerate_shapes_of_any_size_are_answered(
        shape in 0_usize..5,
        n in 0_usize..200,
        size in prop::sample::select(vec![1e-9, 1e-3, 1.0, 1e6, 1e9]),
        sigma_max in prop::sample::select(vec![1e-9, 0.03, 1e3]),
        true_share in prop::sample::select(vec![0.0, 0.2, 1.0]),
        model in prop::sample::select(vec![
            Model::Rigid,
            Model::Similarity { scale_min: 0.4, scale_max: 2.5 },
            Model::Similarity { scale_min: 1e-6, scale_max: 1e6 },
        ]),
        seed in any::<u64>(),
    ) {
        let mut draw = Draw::new(seed);
        // A line, a plane, one cluster, four points of a line many times, anywhere.
        let mut place = || match shape {
            0 => Vector3::new(0.6, 0.0, 0.8) * draw.unit(),
            1 => Vector3::new(draw.unit(), draw.unit(), 0.5),
            2 => Vector3::repeat(0.5) + draw.noise(1e-6),
            3 => Vector3::repeat((draw.unit() * 4.0).floor() / 4.0),
            _ => draw.in_cube(),
        };
        let source: Vec<[f64; 3]> = (0..n).map(|_| (place() * size).into()).collect();
        let target: Vec<[f64; 3]> = (0..n)
            .map(|i| if (i as f64) < true_share * n as f64 { source[i] } else { (place() * size).into() })
            .collect();
        let config = SolverConfig { model, support_min: 4.0, ..config(sigma_max) };
        let answer = align(&Problem { source: &source, target: &target, ..Problem::default() }, &config).expect("well-formed");
        if let Ok(found) = answer {
            prop_assert!(found.sigma.is_finite() && found.log10_nfa <= config.log10_nfa_max);
            prop_assert!(found.information_eigenvalues.iter().all(|x| x.is_finite() && *x > 0.0));
            prop_assert!(shape != 0 && shape != 3, "a line leaves a rotation open: {:?}", found);
        }
    }

    #[test]
    fn malformed_numbers_are_named(
        n in 1_usize..30,
        at in any::<prop::sample::Index>(),
        axis in 0_usize..3,
        side in any::<bool>(),
        bad in prop::sample::select(vec![f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1.1e9, -1.1e9]),
    ) {
        let mut case = Case::uniform(7, n, n, 1.0);
        let index = at.index(n);
        if side { case.source[index][axis] = bad } else { case.target[index][axis] = bad }
        let problem = Problem { source: &case.source, target: &case.target, ..Problem::default() };
        prop_assert_eq!(align(&problem, &config(0.1)), Err(AlignError::NotFinite { index }));
    }
}
