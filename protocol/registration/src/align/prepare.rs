//! From a hostile slice of matches to a canonical, bounded problem: checked, sorted (so that order changes nothing),
//! exact duplicates merged, centred on medians, best scores first.

use super::chance::Chance;
use super::noise::PointNoise;
use super::{AlignError, CONDITION_MAX, COORDINATE_MAX, Problem, SolverConfig};
use crate::geometry::Covariance;
use core::cmp::Ordering;
use core::ops::Range;
use nalgebra::{Matrix3, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// Distinct matches in search order, centred.
#[derive(Debug)]
pub(super) struct Matches {
    pub source: Vec<Vector3<f64>>,
    pub target: Vec<Vector3<f64>>,
    /// Subtracted from the source and target points.
    pub source_centre: Vector3<f64>,
    pub target_centre: Vector3<f64>,
    /// For each input match, the distinct match it became.
    pub distinct_of_input: Vec<u32>,
    /// Equal numbers mark equal points, so that a point in several matches is counted once.
    pub source_id: Vec<u32>,
    pub target_id: Vec<u32>,
    /// Whether any point is in several matches.
    pub repeats: bool,
    /// Distinct sources or targets, whichever are fewer: the most that can be inliers at once.
    pub inliers_max: usize,
    /// Robust extents of the target along its principal axes; a uniform box of the same spread.
    pub target_extent: [f64; 3],
    /// How often its matches agree by chance.
    pub chance: Chance,
    /// The points' own covariances, if stated.
    pub noise: Option<PointNoise>,
}

impl Matches {
    /// Number of distinct matches.
    pub fn len(&self) -> usize {
        self.source.len()
    }
}

/// Checks and prepares a problem.
///
/// # Errors
/// [`AlignError`] for anything malformed.
pub(super) fn prepare(problem: &Problem, config: &SolverConfig) -> Result<Matches, AlignError> {
    check(problem, config)?;
    let mut rng = ChaCha8Rng::seed_from_u64(config.seed);
    let (order, classes) = search_order(problem, &mut rng);
    let n = problem.source.len();
    let mut distinct_of_input = vec![0; n];
    let (mut source, mut target): (Vec<[f64; 3]>, Vec<[f64; 3]>) = (Vec::with_capacity(n), Vec::with_capacity(n));
    for class in &classes {
        let members = &order[class.start as usize..class.end as usize];
        for &i in members {
            distinct_of_input[i as usize] = source.len() as u32;
        }
        source.push(normal(problem.source[members[0] as usize]));
        target.push(normal(problem.target[members[0] as usize]));
    }
    let (source_id, sources) = point_ids(&source);
    let (target_id, targets) = point_ids(&target);
    let (source_centre, target_centre) = (median(&source), median(&target));
    let centred = |points: &[[f64; 3]], centre| points.iter().map(|&p| Vector3::from(p) - centre).collect::<Vec<_>>();
    let (source, target) = (centred(&source, source_centre), centred(&target, target_centre));
    let target_extent = extent(&target);
    let chosen = classes.iter().map(|class| order[class.start as usize] as usize);
    Ok(Matches {
        chance: Chance::measure(&source, &target, config.model.scale_range(), target_extent, &mut rng),
        noise: PointNoise::of(problem, chosen),
        target_extent,
        repeats: sources.min(targets) < source.len(),
        inliers_max: sources.min(targets),
        source,
        target,
        source_centre,
        target_centre,
        distinct_of_input,
        source_id,
        target_id,
    })
}

fn check(problem: &Problem, config: &SolverConfig) -> Result<(), AlignError> {
    config.check()?;
    let (source_len, target_len) = (problem.source.len(), problem.target.len());
    let scores_len = problem.scores.map(<[f64]>::len);
    if source_len != target_len || scores_len.is_some_and(|l| l != source_len) {
        return Err(AlignError::LengthMismatch { source_len, target_len, scores_len });
    }
    for (side, given) in [("source", problem.source_covariances), ("target", problem.target_covariances)] {
        if let Some(given) = given {
            check_covariances(side, given, source_len)?;
        }
    }
    if source_len > config.points_max {
        return Err(AlignError::TooManyPoints { len: source_len, max: config.points_max });
    }
    let bad = |x: &f64| !x.is_finite() || x.abs() > COORDINATE_MAX;
    let bad_match = |i: &usize| {
        problem.source[*i].iter().any(bad)
            || problem.target[*i].iter().any(bad)
            || problem.scores.is_some_and(|s| !s[*i].is_finite())
    };
    match (0..source_len).find(bad_match) {
        Some(index) => Err(AlignError::NotFinite { index }),
        None => Ok(()),
    }
}

/// One each, and none so much narrower than another that rounding would decide.
fn check_covariances(side: &'static str, given: &[Covariance<3>], matches: usize) -> Result<(), AlignError> {
    if given.len() != matches {
        return Err(AlignError::CovarianceCount { side, covariances: given.len(), matches });
    }
    let (mut least, mut most) = (f64::INFINITY, 0.0_f64);
    for covariance in given {
        let variances = covariance.matrix().symmetric_eigenvalues();
        (least, most) = (least.min(variances.min()), most.max(variances.max()));
    }
    let ratio = if least > 0.0 { most / least } else { f64::INFINITY };
    let fits = given.is_empty() || ratio <= CONDITION_MAX;
    if fits { Ok(()) } else { Err(AlignError::CovarianceRange { side, ratio }) }
}

/// −0 becomes 0, so that equal points compare equal.
fn normal(p: [f64; 3]) -> [f64; 3] {
    p.map(|x| x + 0.0)
}

fn compare(a: &[f64; 3], b: &[f64; 3]) -> Ordering {
    a.iter().zip(b).map(|(x, y)| x.total_cmp(y)).find(|o| o.is_ne()).unwrap_or(Ordering::Equal)
}

fn compare_covariances(a: &Covariance<3>, b: &Covariance<3>) -> Ordering {
    let (a, b) = (a.matrix(), b.matrix());
    let elements = a.iter().zip(b.iter()).map(|(x, y)| (x + 0.0).total_cmp(&(y + 0.0)));
    elements.fold(a.trace().total_cmp(&b.trace()), Ordering::then)
}

/// Input indices, identical matches adjacent, and the ranges of identical ones: best score first, equal scores shuffled
/// from a canonical order.
fn search_order(problem: &Problem, rng: &mut ChaCha8Rng) -> (Vec<u32>, Vec<Range<u32>>) {
    let score = |i: u32| problem.scores.map_or(0.0, |s| s[i as usize] + 0.0);
    let points = |i: u32| (normal(problem.source[i as usize]), normal(problem.target[i as usize]));
    let same = |a: u32, b: u32| {
        let ((p, q), (r, s)) = (points(a), points(b));
        compare(&p, &r).then_with(|| compare(&q, &s))
    };
    // Of matches of the same points the one of the best score stands for all; of equal ones that of the narrower noise.
    let wider = |a: u32, b: u32| {
        let sides = [problem.source_covariances, problem.target_covariances];
        let compared = sides.into_iter().flatten().map(|c| compare_covariances(&c[a as usize], &c[b as usize]));
        compared.fold(Ordering::Equal, Ordering::then)
    };
    let mut order: Vec<u32> = (0..problem.source.len() as u32).collect();
    order.sort_unstable_by(|&a, &b| {
        let first = same(a, b).then_with(|| score(b).total_cmp(&score(a)));
        first.then_with(|| wider(a, b)).then(a.cmp(&b))
    });
    let mut classes: Vec<Range<u32>> = Vec::with_capacity(order.len());
    let mut start = 0;
    for class in order.chunk_by(|&a, &b| same(a, b).is_eq()) {
        classes.push(start..start + class.len() as u32);
        start += class.len() as u32;
    }
    for i in (1..classes.len()).rev() {
        let j = ((u128::from(rng.next_u64()) * (i as u128 + 1)) >> 64) as usize;
        classes.swap(i, j);
    }
    if problem.scores.is_some() {
        let best = |c: &Range<u32>| score(order[c.start as usize]);
        classes.sort_by(|a, b| best(b).total_cmp(&best(a)));
    }
    (order, classes)
}

/// An id per point, equal for equal points, and the number of different ones.
fn point_ids(points: &[[f64; 3]]) -> (Vec<u32>, usize) {
    let mut order: Vec<u32> = (0..points.len() as u32).collect();
    order.sort_unstable_by(|&a, &b| compare(&points[a as usize], &points[b as usize]).then(a.cmp(&b)));
    let mut ids = vec![0; points.len()];
    let mut count = 0;
    for class in order.chunk_by(|&a, &b| compare(&points[a as usize], &points[b as usize]).is_eq()) {
        for &i in class {
            ids[i as usize] = count;
        }
        count += 1;
    }
    (ids, count as usize)
}

/// The upper median; 1 of nothing.
pub(super) fn median_of(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    let middle = values.len() / 2;
    if values.is_empty() { 1.0 } else { *values.select_nth_unstable_by(middle, f64::total_cmp).1 }
}

/// Coordinate-wise median: a centre that no far outlier moves.
fn median(points: &[[f64; 3]]) -> Vector3<f64> {
    let mut column: Vec<f64> = Vec::with_capacity(points.len());
    Vector3::from_fn(|axis, _| {
        column.clear();
        column.extend(points.iter().map(|p| p[axis]));
        match column.len() {
            0 => 0.0,
            n => *column.select_nth_unstable_by(n / 2, f64::total_cmp).1,
        }
    })
}

/// √12 × the standard deviation along each principal axis, or the 5–95 % range over 0.9 where that is smaller: both
/// are the width of a uniform box, the second ignores far outliers.
fn extent(points: &[Vector3<f64>]) -> [f64; 3] {
    let n = points.len();
    if n == 0 {
        return [0.0; 3];
    }
    let mean = points.iter().sum::<Vector3<f64>>() / n as f64;
    let scatter = points.iter().map(|p| (p - mean) * (p - mean).transpose()).sum::<Matrix3<f64>>() / n as f64;
    let axes = scatter.symmetric_eigen();
    let mut along: Vec<f64> = Vec::with_capacity(n);
    core::array::from_fn(|k| {
        along.clear();
        along.extend(points.iter().map(|p| axes.eigenvectors.column(k).dot(p)));
        let (low, high) = (n / 20, n - 1 - n / 20);
        let high_value = *along.select_nth_unstable_by(high, f64::total_cmp).1;
        let low_value = *along.select_nth_unstable_by(low, f64::total_cmp).1;
        let spread = (12.0 * axes.eigenvalues[k].max(0.0)).sqrt();
        spread.min((high_value - low_value) / 0.9)
    })
}
