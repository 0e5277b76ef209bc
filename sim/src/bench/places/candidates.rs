//! How well summaries tell which pairs are worth asking for: pairs ranked by similarity, those that overlap in either
//! direction are the ones to find.

use super::measure::{OVERLAP_FOUND, Tried, place};
use super::sets::Set;

/// A ranking's worth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Ranking {
    /// Pairs to find.
    pub positives: usize,
    /// Other pairs.
    pub negatives: usize,
    /// Share of the pairs to find that rank above all others.
    pub recall_at_full_precision: f64,
    /// Area under the precision–recall curve (average precision).
    pub area: f64,
}

/// Of the pairs whose submaps belong to the given sets.
pub(super) fn ranking(sets: &[Set], tried: &[Tried], of: &[usize]) -> Ranking {
    let within = tried.iter().filter(|t| t.their < t.mine && of.contains(&t.their.0) && of.contains(&t.mine.0));
    let overlaps = |a: &Tried| {
        let back = tried.iter().find(|t| (t.their, t.mine) == (a.mine, a.their)).map_or(0.0, |t| t.overlap);
        a.overlap.max(back) >= OVERLAP_FOUND
    };
    let scored = |t: &Tried| {
        let (a, b) = (place(sets, t.their), place(sets, t.mine));
        (a.described.summary.similarity(&b.described.summary), overlaps(t))
    };
    rank(within.map(scored).collect())
}

fn rank(mut scored: Vec<(f64, bool)>) -> Ranking {
    // Ties count against us.
    scored.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let positives = scored.iter().filter(|s| s.1).count();
    let first = scored.iter().take_while(|s| s.1).count();
    let (mut hits, mut area) = (0.0, 0.0);
    for (rank, _) in scored.iter().enumerate().filter(|(_, s)| s.1) {
        hits += 1.0;
        area += hits / (rank + 1) as f64;
    }
    let share = |x: f64| if positives > 0 { x / positives as f64 } else { 0.0 };
    let negatives = scored.len() - positives;
    Ranking { positives, negatives, recall_at_full_precision: share(first as f64), area: share(area) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ranking_is_worth_what_its_curve_says() {
        let all = |scores: &[(f64, bool)]| rank(scores.to_vec());
        let perfect = all(&[(0.2, false), (0.9, true), (0.8, true)]);
        assert_eq!((perfect.positives, perfect.negatives), (2, 1));
        assert_eq!((perfect.recall_at_full_precision, perfect.area), (1.0, 1.0));
        let mixed = all(&[(0.9, true), (0.8, false), (0.7, true)]);
        assert_eq!((mixed.recall_at_full_precision, mixed.area), (0.5, (1.0 + 2.0 / 3.0) / 2.0));
        assert_eq!(all(&[(0.5, true), (0.5, false)]).recall_at_full_precision, 0.0);
        assert_eq!(all(&[]).area, 0.0);
    }
}
