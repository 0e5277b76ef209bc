//! Factor, solutions and entries of the inverse against dense algebra.

use super::*;
use nalgebra::{DMatrix, DVector};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A positive definite matrix with blocks of random sizes where `pairs` couple them, and its pattern.
struct Case {
    sizes: Vec<usize>,
    pattern: BlockPattern,
    values: Vec<f64>,
    dense: DMatrix<f64>,
}

impl Case {
    fn new(seed: u64, variables: usize, couplings: usize) -> Self {
        let rng = &mut ChaCha8Rng::seed_from_u64(seed);
        let sizes: Vec<usize> = (0..variables).map(|_| rng.random_range(1..7)).collect();
        let mut pairs: Vec<(usize, usize)> = (0..variables).map(|v| (v, v)).collect();
        pairs.extend((1..variables).filter(|_| !seed.is_multiple_of(3)).map(|v| (v - 1, v)));
        pairs.extend((0..couplings).map(|_| (rng.random_range(0..variables), rng.random_range(0..variables))));
        let pattern = BlockPattern::new(&sizes, pairs.iter().copied()).unwrap();
        let mut values = vec![0.0; pattern.value_count()];
        let mut dense = DMatrix::zeros(pattern.scalars(), pattern.scalars());
        for &(a, b) in &pairs {
            let mut m = DMatrix::from_fn(sizes[a], sizes[b], |_, _| rng.random_range(-1.0..1.0));
            if a == b {
                m = &m + m.transpose() + DMatrix::identity(sizes[a], sizes[a]) * 6.0 * pairs.len() as f64;
            }
            BlockPattern::add(&mut values, pattern.slot(a, b), &m);
            let at = (pattern.start(a), pattern.start(b));
            let mut block = dense.view_mut(at, m.shape());
            block += &m;
            if a != b {
                let mut block = dense.view_mut((at.1, at.0), (m.ncols(), m.nrows()));
                block += m.transpose();
            }
        }
        Self { sizes, pattern, values, dense }
    }
}

proptest! {
    #[test]
    fn solves_and_inverts_like_dense_algebra(seed: u64, variables in 1usize..40, couplings in 0usize..60) {
        let case = Case::new(seed, variables, couplings);
        let factor = case.pattern.factorise(case.values.clone(), &mut Workspace::default()).unwrap();
        let inverse = case.dense.clone().try_inverse().unwrap();
        let n = case.pattern.scalars();
        let b = DVector::from_fn(2 * n, |r, _| (r as f64).sin());
        let mut x = b.as_slice().to_vec();
        case.pattern.solve(&factor, &mut x);
        for k in 0..2 {
            let want = &inverse * b.rows(k * n, n);
            prop_assert!((DVector::from_column_slice(&x[k * n..(k + 1) * n]) - want).amax() < 1e-12);
        }
        let all = (0..variables).flat_map(|a| (0..variables).map(move |b| (a, b)));
        let selected = case.pattern.selected_inverse(&factor, all);
        let diagonal = case.pattern.selected_inverse(&factor, []);
        for a in 0..variables {
            for b in 0..variables {
                for (r, c) in (0..case.sizes[a]).flat_map(|r| (0..case.sizes[b]).map(move |c| (r, c))) {
                    let want = inverse[(case.pattern.start(a) + r, case.pattern.start(b) + c)];
                    let got = selected.get((a, r), (b, c));
                    prop_assert!(got.is_none_or(|got| (got - want).abs() < 1e-12));
                    prop_assert!(got.is_some() || a != b);
                    prop_assert_eq!(diagonal.get((a, r), (b, c)), got.filter(|_| a == b));
                }
            }
        }
    }
}

#[test]
fn what_another_factorisation_left_in_memory_does_not_matter() {
    let (small, large) = (Case::new(8, 20, 30), Case::new(10, 40, 60));
    let fresh = |case: &Case| case.pattern.factorise(case.values.clone(), &mut Workspace::default()).unwrap().values;
    let space = &mut Workspace::default();
    let broken = large.values.iter().map(|_| f64::NAN).collect();
    assert!(large.pattern.factorise(broken, space).is_err());
    for case in [&large, &small, &large] {
        assert_eq!(case.pattern.factorise(case.values.clone(), space).unwrap().values, fresh(case));
    }
}

#[test]
fn variables_of_other_sizes_share_the_analysis() {
    let case = Case::new(5, 30, 40);
    let pairs = (1..30).map(|v| (v - 1, v)).chain([(0, 29), (4, 17), (9, 21)]);
    let [_, of_one] = BlockPattern::of_sizes([&case.sizes, &[1; 30]], pairs.clone()).unwrap();
    let (mut values, mut dense) = (vec![0.0; of_one.value_count()], DMatrix::zeros(30, 30));
    let mut add = |a: usize, b: usize, x: f64| {
        BlockPattern::add(&mut values, of_one.slot(a, b), &nalgebra::Matrix1::new(x));
        dense[(of_one.start(a), of_one.start(b))] = x;
        dense[(of_one.start(b), of_one.start(a))] = x;
    };
    (0..30).for_each(|v| add(v, v, 8.0));
    pairs.for_each(|(a, b)| add(a, b, -1.0));
    let factor = of_one.factorise(values, &mut Workspace::default()).unwrap();
    let b = DVector::from_fn(30, |r, _| (r as f64).cos());
    let mut x = b.as_slice().to_vec();
    of_one.solve(&factor, &mut x);
    assert!((dense * DVector::from_vec(x) - b).amax() < 1e-12);
}

#[test]
fn the_diagonal_is_where_it_is_said_to_be() {
    let case = Case::new(7, 30, 40);
    let got: Vec<f64> = case.pattern.diagonal().map(|at| case.values[at]).collect();
    assert_eq!(got, case.dense.diagonal().as_slice());
}

#[test]
fn a_pivot_that_is_not_positive_names_its_variable() {
    let case = Case::new(4, 30, 40);
    for variable in [0, 13, 29] {
        let mut values = case.values.clone();
        let slot = case.pattern.slot(variable, variable);
        values[slot.at + (case.sizes[variable] - 1) * (slot.stride + 1)] = -1e9;
        assert_eq!(
            case.pattern.factorise(values.clone(), &mut Workspace::default()).unwrap_err(),
            SolveError::Underconstrained { variable }
        );
    }
    let mut values = case.values.clone();
    values[case.pattern.slot(5, 5).at] = f64::NAN;
    assert!(case.pattern.factorise(values.clone(), &mut Workspace::default()).is_err());
}

/// Sizes of variables, and each one's neighbours of smaller index.
fn pattern(seed: u64) -> (Vec<usize>, Vec<Vec<usize>>) {
    let rng = &mut ChaCha8Rng::seed_from_u64(seed);
    let sizes: Vec<usize> = (0..60).map(|_| rng.random_range(1..7)).collect();
    let mut below = vec![Vec::new(); sizes.len()];
    for _ in 0..90 {
        let (a, b) = (rng.random_range(0..60usize), rng.random_range(0..60usize));
        if a != b && !below[a.max(b)].contains(&a.min(b)) {
            below[a.max(b)].push(a.min(b));
        }
    }
    below.iter_mut().for_each(|list| list.sort_unstable());
    (sizes, below)
}

#[test]
fn a_factorisation_is_refused_from_the_first_byte_above_its_limit() {
    for seed in 0..50 {
        let (sizes, below) = pattern(seed);
        let pairs = || below.iter().enumerate().flat_map(|(a, list)| list.iter().map(move |&b| (a, b)));
        let needs = Needs::of(&order::analyse(&sizes, &below, u64::MAX).unwrap(), &sizes, &below);
        let bytes = needs.bytes();
        let [at_limit] = BlockPattern::within([&sizes], pairs(), bytes).unwrap();
        assert_eq!(at_limit.value_count() as u64, needs.values);
        let error = BlockPattern::within([&sizes], pairs(), bytes - 1).unwrap_err();
        assert_eq!(error, SolveError::TooDense { bytes, limit: bytes - 1 });
        // Far above, the structure is not even found.
        let SolveError::TooDense { bytes: so_far, .. } = BlockPattern::within([&sizes], pairs(), 500).unwrap_err()
        else {
            panic!("refused for another reason")
        };
        assert!(so_far > 500 && so_far < bytes);
    }
}

#[test]
fn updates_wait_in_just_the_memory_that_was_said() {
    for seed in 0..50 {
        let mut case = Case::new(seed, 40, 40);
        for less in [0, 1] {
            case.pattern.update_count = case.pattern.update_count.saturating_sub(less);
            let mut space = Workspace::default();
            case.pattern.factorise(case.values.clone(), &mut space).unwrap();
            let grown = space.capacity() > case.pattern.update_count;
            assert_eq!(grown, less == 1 && space.capacity() > 0, "seed {seed}");
        }
    }
}

#[test]
fn counting_saturates() {
    let (sizes, below) = ([usize::MAX >> 1; 2], [vec![], vec![0]]);
    let two = order::analyse(&sizes, &below, u64::MAX).unwrap();
    assert_eq!(Needs::of(&two, &sizes, &below).bytes(), u64::MAX);
    assert!(memory::within(u64::MAX, u64::MAX).is_ok() && memory::within(u64::MAX, FACTOR_BYTES_MAX).is_err());
}
