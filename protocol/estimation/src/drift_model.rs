//! How a submap's cloud follows the odometry that made it. Odometry loses its way at random, a little with every
//! keyframe; the cloud lies where its keyframes do in the mean, its anchor is the middle one (`submap::builder` of the
//! registration).
//!
//! Of n keyframes b = ⌊(n−1)/2⌋ come before the anchor and a = n−1−b after it, and from anchor to anchor it is n steps,
//! each of `W/n` if `W` is the walk. A step that has k keyframes beyond it, seen from the anchor, moves the cloud by
//! `k/n`. Hence the cloud lies off its anchor by `W (Σ_{k≤a} k² + Σ_{k≤b} k²)/n³`, and what is lost from the anchor to
//! the last keyframe, `W a/n`, goes with that by `W a(a+1)/2n²`, as does, with b for a, what is lost from the anchor
//! back to the first. For ever more keyframes these tend to `W/12`, `W/2` and `W/8`, which are taken where nobody told
//! how many they are. Few are far from it: of four, two come after the anchor and one before it, and of what is lost
//! there the cloud follows three eighths and a quarter.

use crate::geometry::Covariance;
use core::num::NonZero;

/// The walk of the odometry while a submap was made.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct DriftModel {
    /// From anchor to anchor.
    pub(super) whole: Covariance<6>,
    /// How many keyframes made the submap, if that was told.
    pub(super) keyframes: Option<NonZero<u16>>,
}

/// The part of it on one side of the anchor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Stretch {
    /// What is lost there.
    pub(super) lost: Covariance<6>,
    /// By how much of that the cloud follows, in the mean.
    pub(super) follows: f64,
}

impl DriftModel {
    /// Where the cloud lies by its anchor. `None` for a single keyframe: there it is.
    pub(super) fn off_anchor(&self) -> Option<Covariance<6>> {
        self.share(1.0 / 12.0, |n, [b, a]| (squares(b) + squares(a)) / (n * n * n))
    }

    /// From the anchor to the last keyframe. `None` if none comes after it.
    pub(super) fn after_anchor(&self) -> Option<Stretch> {
        self.stretch(|[_, after]| after)
    }

    /// From the anchor back to the first keyframe. `None` if none comes before it.
    pub(super) fn before_anchor(&self) -> Option<Stretch> {
        self.stretch(|[before, _]| before)
    }

    fn stretch(&self, side: impl Fn([f64; 2]) -> f64) -> Option<Stretch> {
        let lost = self.share(0.5, |n, around| side(around) / n)?;
        Some(Stretch { lost, follows: self.counts().map_or(0.25, |(n, around)| (side(around) + 1.0) / (2.0 * n)) })
    }

    fn share(&self, of_many: f64, of: impl FnOnce(f64, [f64; 2]) -> f64) -> Option<Covariance<6>> {
        let share = self.counts().map_or(of_many, |(n, around)| of(n, around));
        (share > 0.0).then(|| self.whole.scaled(share))
    }

    /// Keyframes, and those before and after the anchor.
    fn counts(&self) -> Option<(f64, [f64; 2])> {
        let n = self.keyframes?.get();
        let before = (n - 1) / 2;
        Some((f64::from(n), [before, n - 1 - before].map(f64::from)))
    }
}

/// 1² + 2² + … + k².
fn squares(k: f64) -> f64 {
    k * (k + 1.0) * (2.0 * k + 1.0) / 6.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_graphs::sigmas;

    fn walk(keyframes: Option<u16>) -> DriftModel {
        DriftModel { whole: sigmas(1.0, 1.0), keyframes: keyframes.and_then(NonZero::new) }
    }

    /// Shares of the variance: off the anchor; of either side, what is lost there and how that goes with the first.
    fn shares(keyframes: Option<u16>) -> [f64; 5] {
        let walk = walk(keyframes);
        let of = |covariance: Covariance<6>| covariance.matrix()[(3, 3)];
        let around = [walk.before_anchor(), walk.after_anchor()];
        let [before, after] = around.map(|s| s.map_or([0.0; 2], |s| [of(s.lost), of(s.lost) * s.follows]));
        [walk.off_anchor().map_or(0.0, of), before[0], before[1], after[0], after[1]]
    }

    /// The same step by step: what each step, of 1/n, seen from the anchor, moves the mean of the keyframes by.
    fn summed(n: usize) -> [f64; 5] {
        let anchor = (n - 1) / 2;
        let count = n as f64;
        // Step k leads from keyframe k to the next; beyond it lie k + 1 keyframes or n - 1 - k.
        let moves = |step: usize| (if step < anchor { step + 1 } else { n - 1 - step }) as f64 / count;
        let mut sums = [0.0; 5];
        for step in 0..n - 1 {
            let side = if step < anchor { 1 } else { 3 };
            sums[0] += moves(step).powi(2) / count;
            sums[side] += 1.0 / count;
            sums[side + 1] += moves(step) / count;
        }
        sums
    }

    #[test]
    fn the_shares_are_those_of_the_steps() {
        for n in 1..=40u16 {
            let (shares, summed) = (shares(Some(n)), summed(usize::from(n)));
            assert!(shares.iter().zip(summed).all(|(a, b)| (a - b).abs() < 1e-12), "{n}: {shares:?} {summed:?}");
        }
    }

    #[test]
    fn many_keyframes_are_as_many_as_nobody_counted() {
        let far = |n| shares(Some(n)).iter().zip(shares(None)).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(far(4) > 0.06 && far(u16::MAX) < 1e-4, "{} {}", far(4), far(u16::MAX));
    }

    #[test]
    fn a_single_keyframe_is_its_own_cloud() {
        assert_eq!(shares(Some(1)), [0.0; 5]);
        assert_eq!(walk(Some(1)).off_anchor(), None);
        assert_eq!((walk(Some(2)).before_anchor(), shares(Some(2))[3]), (None, 0.5));
    }
}
