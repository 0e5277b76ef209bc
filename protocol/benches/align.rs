//! Time of one alignment, by number of matches and share of outliers, and of the kernel density weights.
#![allow(missing_docs, clippy::unwrap_used)]

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use merganser_protocol::align::sigma::{NormDensity, kde_weight};
use merganser_protocol::align::{Model, Problem, SolverConfig, align};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use std::hint::black_box;

const SIGMA: f64 = 0.01;

type Points = Vec<[f64; 3]>;

/// Matches in the unit cube; the first `inliers` follow a translation with noise, the rest land anywhere.
fn matches(n: usize, inliers: usize) -> (Points, Points) {
    let mut rng = ChaCha8Rng::seed_from_u64(n as u64);
    let mut unit = || (rng.next_u64() >> 11) as f64 / (1_u64 << 53) as f64;
    let source: Points = (0..n).map(|_| core::array::from_fn(|_| unit())).collect();
    // The sum of twelve uniforms is close enough to a Gaussian here.
    let mut noise = || SIGMA * ((0..12).map(|_| unit()).sum::<f64>() - 6.0);
    let mut target: Points = source.iter().map(|p| p.map(|x| x + 0.3 + noise())).collect();
    for q in &mut target[inliers..] {
        *q = core::array::from_fn(|_| unit() + 0.3);
    }
    (source, target)
}

fn alignments(c: &mut Criterion) {
    let mut group = c.benchmark_group("align");
    group.sample_size(20);
    let rigid = Model::Rigid;
    let similar = Model::Similarity { scale_min: 0.4, scale_max: 2.5 };
    for (name, model) in [("se3", rigid), ("sim3", similar)] {
        for (n, inliers) in
            [(100, 50), (100, 10), (300, 20), (300, 0), (1000, 500), (1000, 50), (1000, 10), (5000, 2500)]
        {
            let (source, target) = matches(n, inliers);
            let config = SolverConfig { model, sigma_max: 3.0 * SIGMA, ..SolverConfig::default() };
            group.bench_function(BenchmarkId::new(name, format!("{inliers}_of_{n}")), |b| {
                let problem = Problem { source: &source, target: &target, ..Problem::default() };
                b.iter(|| black_box(align(&problem, &config).unwrap()));
            });
        }
    }
    group.finish();
}

/// Ten times the true σ as its bound.
fn generous_bound(c: &mut Criterion) {
    let mut group = c.benchmark_group("align_10_sigma");
    group.sample_size(20);
    for (n, inliers) in [(100, 10), (1000, 50), (1000, 10)] {
        let (source, target) = matches(n, inliers);
        let config = SolverConfig { sigma_max: 10.0 * SIGMA, ..SolverConfig::default() };
        group.bench_function(BenchmarkId::new("se3", format!("{inliers}_of_{n}")), |b| {
            let problem = Problem { source: &source, target: &target, ..Problem::default() };
            b.iter(|| black_box(align(&problem, &config).unwrap()));
        });
    }
    group.finish();
}

fn kernel_density(c: &mut Criterion) {
    for n in [500, 5000] {
        let samples: Vec<f64> = (0..n).map(|k| 0.03 * f64::from(k) / f64::from(n)).collect();
        c.bench_function(&format!("kde/direct_{n}"), |b| b.iter(|| kde_weight(black_box(0.01), &samples, SIGMA)));
        let mut density = NormDensity::default();
        c.bench_function(&format!("kde/tree_{n}_build"), |b| b.iter(|| density.set(samples.iter().copied())));
        c.bench_function(&format!("kde/tree_{n}"), |b| b.iter(|| density.at(black_box(0.01), SIGMA)));
    }
}

criterion_group!(benches, alignments, generous_bound, kernel_density);
criterion_main!(benches);
