//! The tree that grows against dense algebra, and what a rejected change leaves behind.

use super::clique::Sum;
use super::tree::{CliqueTree, Terms};
use nalgebra::{DMatrix, DVector};
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Squares `½ |Σ J_v x_v − b|²` over variables of several sizes.
#[derive(Default)]
struct Squares {
    sizes: Vec<usize>,
    terms: Vec<(Vec<Part>, DVector<f64>)>,
}

/// A variable and its Jacobian.
type Part = (usize, DMatrix<f64>);

impl Terms for Squares {
    fn variables(&self, term: usize) -> impl Iterator<Item = usize> {
        self.terms[term].0.iter().map(|part| part.0)
    }

    fn add(&self, term: usize, sum: &mut Sum<'_>) {
        let (parts, b) = &self.terms[term];
        for (k, (p, jacobian)) in parts.iter().enumerate() {
            sum.rhs(*p, (jacobian.transpose() * b).iter());
            for (q, other) in &parts[k..] {
                sum.block(*p, *q, &(jacobian.transpose() * other));
            }
        }
    }
}

impl Squares {
    fn start(&self, variable: usize) -> usize {
        self.sizes[..variable].iter().sum()
    }

    /// A term of full rank in each of its variables.
    fn push(&mut self, rng: &mut ChaCha8Rng, variables: &[usize]) -> usize {
        let rows = 6;
        let part = |&v: &usize| {
            let mut jacobian = DMatrix::from_fn(rows, self.sizes[v], |_, _| rng.random_range(-0.5..0.5));
            (0..self.sizes[v]).for_each(|k| jacobian[(k, k)] += 3.0);
            (v, jacobian)
        };
        let parts = variables.iter().map(part).collect();
        let b = DVector::from_fn(rows, |_, _| rng.random_range(-1.0..1.0));
        self.terms.push((parts, b));
        self.terms.len() - 1
    }

    fn dense(&self) -> (DMatrix<f64>, DVector<f64>) {
        let n = self.sizes.iter().sum();
        let (mut h, mut g) = (DMatrix::zeros(n, n), DVector::zeros(n));
        for (parts, b) in &self.terms {
            let mut jacobian = DMatrix::zeros(b.len(), n);
            for (v, part) in parts {
                jacobian.view_mut((0, self.start(*v)), part.shape()).copy_from(part);
            }
            h += jacobian.transpose() * &jacobian;
            g += jacobian.transpose() * b;
        }
        (h, g)
    }
}

/// What the tree says of everything.
fn said(tree: &CliqueTree, squares: &Squares) -> Vec<f64> {
    (0..squares.sizes.len()).flat_map(|v| tree.solution(v).to_vec()).collect()
}

fn bits(values: &[f64]) -> Vec<u64> {
    values.iter().map(|x| x.to_bits()).collect()
}

/// One random growth: new variables, some hung, and terms among all; returns the terms that were not hung.
fn grow(rng: &mut ChaCha8Rng, squares: &mut Squares, tree: &mut CliqueTree) {
    let known = squares.sizes.len();
    let mut variables = Vec::new();
    for _ in 0..rng.random_range(0..4) {
        // Size 6, so that a single term of six rows says nothing of the others.
        let size = if known == 0 || rng.random_bool(0.7) { 6 } else { rng.random_range(1..6) };
        squares.sizes.push(size);
        variables.push(tree.add_variable(size));
    }
    let (mut terms, mut hung) = (Vec::new(), Vec::new());
    let mut free = Vec::new();
    for &v in &variables {
        if v > 0 && squares.sizes[v] == 6 && rng.random_bool(0.4) {
            let other = rng.random_range(0..v);
            hung.push((v, squares.push(rng, &[other, v])));
        } else {
            free.push(v);
            terms.push(squares.push(rng, &[v]));
        }
        tree.add_term();
    }
    for _ in 0..rng.random_range(0..4) {
        let all: Vec<usize> = (0..known).chain(free.iter().copied()).collect();
        if all.len() < 2 {
            break;
        }
        let mut ends = rand::seq::index::sample(rng, all.len(), 2.min(all.len())).into_vec();
        ends.iter_mut().for_each(|end| *end = all[*end]);
        terms.push(squares.push(rng, &ends));
        tree.add_term();
    }
    let touched: Vec<usize> = terms.iter().flat_map(|&t| squares.variables(t).collect::<Vec<_>>()).collect();
    tree.revise(squares, (&touched, &[]), (&free, &terms)).unwrap();
    tree.substitute(0.0);
    for (v, term) in hung {
        if !tree.hang(squares, v, term).unwrap() {
            let others: Vec<usize> = squares.variables(term).collect();
            tree.revise(squares, (&others, &[]), (&[v], &[term])).unwrap();
            tree.substitute(0.0);
        }
    }
}

proptest! {
    #[test]
    fn a_tree_that_grows_solves_like_dense_algebra(seed: u64, rounds in 1usize..16) {
        let rng = &mut ChaCha8Rng::seed_from_u64(seed);
        let (mut squares, mut tree) = (Squares::default(), CliqueTree::default());
        for _ in 0..rounds {
            grow(rng, &mut squares, &mut tree);
            if rng.random_bool(0.7) {
                tree.accept();
            }
            let (h, g) = squares.dense();
            let inverse = h.try_inverse().unwrap();
            let want = &inverse * &g;
            let error = (DVector::from_vec(said(&tree, &squares)) - &want).amax();
            prop_assert!(error < 1e-9, "{error}");
            prop_assert!((tree.decrease() - g.dot(&want)).abs() < 1e-9 * (1.0 + g.dot(&want)));
            if squares.sizes.is_empty() {
                continue;
            }
            let v = rng.random_range(0..squares.sizes.len());
            let w = rng.random_range(0..squares.sizes.len());
            let unit = |k: usize| crate::geometry::sim3::Vector7::from_fn(|r, _| f64::from(u8::from(r == k)));
            let got = tree.covariance(&[(v, 0, unit(2)), (w, squares.sizes[w] - 1, unit(5))]);
            let (a, b) = (squares.start(v), squares.start(w) + squares.sizes[w] - 1);
            for (x, y) in [((2, 2), (a, a)), ((2, 5), (a, b)), ((5, 5), (b, b))] {
                prop_assert!((got[x] - inverse[y]).abs() < 1e-9, "{x:?}");
            }
        }
    }

    #[test]
    fn a_rejected_change_leaves_no_trace(seed: u64) {
        let rng = &mut ChaCha8Rng::seed_from_u64(seed);
        let (mut squares, mut tree) = (Squares::default(), CliqueTree::default());
        let (mut twin_squares, mut twin) = (Squares::default(), CliqueTree::default());
        for round in 0..8 {
            let sizes = (squares.sizes.len(), squares.terms.len());
            let (before, solution) = (tree.before(), tree.solutions().to_vec());
            for _ in 0..rng.random_range(1..4) {
                grow(rng, &mut squares, &mut tree);
            }
            tree.reject(before, Some(solution));
            squares.sizes.truncate(sizes.0);
            squares.terms.truncate(sizes.1);
            prop_assert_eq!(tree.scalars(), twin.scalars());
            prop_assert_eq!(tree.cliques(), twin.cliques());
            let same = seed ^ round;
            grow(&mut ChaCha8Rng::seed_from_u64(same), &mut squares, &mut tree);
            tree.accept();
            grow(&mut ChaCha8Rng::seed_from_u64(same), &mut twin_squares, &mut twin);
            twin.accept();
            prop_assert_eq!(bits(&said(&tree, &squares)), bits(&said(&twin, &twin_squares)));
            prop_assert_eq!(tree.kept_count(), twin.kept_count());
        }
    }
}

#[test]
fn a_hung_variable_touches_nothing_and_a_free_one_is_named() {
    let rng = &mut ChaCha8Rng::seed_from_u64(5);
    let (mut squares, mut tree) = (Squares::default(), CliqueTree::default());
    while squares.sizes.len() < 30 {
        grow(rng, &mut squares, &mut tree);
    }
    tree.accept();
    let old = bits(&said(&tree, &squares));
    squares.sizes.push(6);
    let new = tree.add_variable(6);
    let term = squares.push(rng, &[3, new]);
    tree.add_term();
    let cliques = tree.cliques();
    assert!(tree.hang(&squares, new, term).unwrap());
    assert_eq!(tree.cliques(), cliques + 1);
    assert_eq!(bits(&said(&tree, &squares))[..old.len()], old);
    // A variable of no term at all.
    squares.sizes.push(2);
    let free = tree.add_variable(2);
    let error = tree.revise(&squares, (&[3], &[]), (&[free], &[])).unwrap_err();
    assert_eq!(error, crate::solve_error::SolveError::Underconstrained { variable: free });
}

#[test]
fn a_variable_stays_unless_it_moves_by_more_than_the_tolerance() {
    for (tolerance, stays) in [(0.9, false), (1.1, true)] {
        let mut squares = Squares { sizes: vec![1], terms: Vec::new() };
        let mut tree = CliqueTree::default();
        tree.add_variable(1);
        tree.add_term();
        // Information 4: a standard deviation of ½, and the solution lies one away from zero.
        squares.terms.push((vec![(0, DMatrix::from_element(1, 1, 2.0))], DVector::from_element(1, 1.0)));
        tree.revise(&squares, (&[], &[]), (&[0], &[0])).unwrap();
        assert_eq!(tree.substitute(tolerance).is_empty(), stays);
        assert_eq!(tree.solution(0), if stays { [0.0] } else { [0.5] });
    }
}
