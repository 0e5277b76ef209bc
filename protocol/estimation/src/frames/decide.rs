//! The decision: which sets of alignments are candidates at all, and whether the best explanation is one to merge on.

use super::FrameOutcome;
use super::clique::{self, Set, bit};
use super::doubt::Doubt;
use super::evidence::Evidence;
use super::explain::Explanation;
use super::gate;
use super::hypothesis::Hypothesis;
use super::measured::{Alignment, Measured};
use super::pairs::Pairs;
use super::scaled::Scaled;
use crate::geometry::Covariance;

/// A rival with this share of the best set's members makes the frames ambiguous.
const RIVAL_SHARE: f64 = 0.8;
/// One more gate, for candidates only: so much beyond the widest that a truth which chance stretched is still found
/// whole.
const REACH: f64 = 1.3;
/// Doubtful members leave the answer open if the other frame's map is to be expected off, should they be false, by more
/// than this share of an alignment's reach.
const RISK_MAX: f64 = 0.15;
/// Submaps on either side that the alignments of merged frames tie.
const SUBMAPS_MIN: usize = 2;
/// Too few or too weak to merge are shown below this: chance does as well in one case of ten.
const SHOWN_LOG10_NFA_MAX: f64 = -1.0;

impl<const N: usize, G: Scaled<N>> Measured<'_, N, G> {
    pub(super) fn outcome(&self) -> FrameOutcome<(G, Covariance<N>)> {
        let n = self.alignments.len();
        if n == 0 {
            return FrameOutcome::None;
        }
        let pairs = Pairs::new(self);
        let mut evidence = Evidence::new(self, &pairs);
        let candidates = self.candidates(&pairs);
        let explanation = Explanation::best(self, &pairs, &mut evidence, &candidates);
        let Some(explanation) = explanation else { return FrameOutcome::Inconsistent };
        let Some(best) = Hypothesis::settle(self, &pairs, explanation.used(&mut evidence, n)) else {
            return FrameOutcome::Inconsistent;
        };
        let (best, certain) = self.beyond_doubt(&pairs, &mut evidence, best);
        if let Some(rival) = self.rival(&pairs, &explanation) {
            return FrameOutcome::Ambiguous { best: best.consensus(self), rival: rival.consensus(self) };
        }
        let used = best.set.count_ones() as usize;
        // A single alignment has no frame-level evidence; it merges where the configuration trusts single ones.
        let significant = best.log10_nfa <= self.config.log10_nfa_max;
        let shown = best.log10_nfa <= SHOWN_LOG10_NFA_MAX || 2 * used > n;
        match best.lacks_scale(self) {
            Some(log_scale_sigma) if significant || shown => FrameOutcome::BaselineTooShort { log_scale_sigma },
            None if certain && self.suffices(best.set) && (significant || n == 1) => {
                FrameOutcome::Merged(best.consensus(self))
            }
            None if shown => FrameOutcome::Provisional(best.consensus(self)),
            _ => FrameOutcome::Inconsistent,
        }
    }

    /// As many as are wanted, and, where one alone would not do, of more than one submap on either side: what one
    /// submap alone says, however often it is asked, may be said of a place that only looks the same.
    fn suffices(&self, set: Set) -> bool {
        let distinct = |of: fn(&Alignment<N, G>) -> usize| {
            let mut submaps: Vec<usize> = clique::vertices(set).map(|k| of(&self.alignments[k])).collect();
            submaps.sort_unstable();
            submaps.dedup();
            submaps.len()
        };
        let wanted = self.config.alignments_min;
        set.count_ones() as usize >= wanted && distinct(|x| x.i).min(distinct(|x| x.j)) >= wanted.min(SUBMAPS_MIN)
    }

    /// `best` without its doubtful members, and that it is certain; or with them, and that it is not, where too few
    /// would be left or too much hangs on them. Its covariance reckons with the doubt that remains.
    fn beyond_doubt(
        &self,
        pairs: &Pairs,
        evidence: &mut Evidence<'_, N, G>,
        mut best: Hypothesis<N, G>,
    ) -> (Hypothesis<N, G>, bool) {
        let mut doubt = Doubt::of(self, pairs, evidence, &best);
        let needed = self.config.alignments_min.min(best.set.count_ones() as usize);
        let safe = doubt.risk <= RISK_MAX * self.config.search_edge_min;
        let certain = safe && doubt.certain.count_ones() as usize >= needed;
        if certain
            && doubt.certain != best.set
            && let Some(without) = Hypothesis::settle(self, pairs, doubt.certain)
        {
            best = without;
            doubt = Doubt::of(self, pairs, evidence, &best);
        }
        best.widen(&doubt.covariance);
        (best, certain)
    }

    /// Sets that may speak of one transform: at each gate a largest clique, and a largest with each alignment, settled.
    fn candidates(&self, pairs: &Pairs) -> Vec<Set> {
        let everyone = || 0..self.alignments.len();
        let scales = self.scales();
        let widest = scales.into_iter().fold(1.0, f64::max);
        let mut graphs: Vec<Vec<Set>> = Vec::new();
        for scale in scales.into_iter().chain([REACH * widest]) {
            let graph = pairs.graph(gate(N, scale));
            if !graphs.contains(&graph) {
                graphs.push(graph);
            }
        }
        let (mut tried, mut found): (Vec<Set>, Vec<Set>) = (Vec::new(), Vec::new());
        for graph in &graphs {
            let largest = clique::maximum_clique(graph, everyone().map(bit).sum());
            for set in core::iter::once(largest).chain(everyone().map(|v| clique::largest_with(graph, v))) {
                if set.count_ones() >= 2 && !tried.contains(&set) {
                    tried.push(set);
                    let settled = Hypothesis::settle(self, pairs, set).map(|h| h.set);
                    found.extend(settled.filter(|set| !found.contains(set)));
                }
            }
        }
        if found.is_empty() { vec![bit(0)] } else { found }
    }

    /// The second set, where it is significant and, with what may be its own, has about as many members as the first.
    fn rival(&self, pairs: &Pairs, explanation: &Explanation) -> Option<Hypothesis<N, G>> {
        let rival = (explanation.second | explanation.contested).count_ones();
        if explanation.second == 0 || f64::from(rival) < RIVAL_SHARE * f64::from(explanation.first.count_ones()) {
            return None;
        }
        Hypothesis::settle(self, pairs, explanation.second).filter(|h| h.log10_nfa <= self.config.log10_nfa_max)
    }
}
