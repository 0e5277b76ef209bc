//! Which of many alignments a consensus should weigh: decides by pairwise agreement, which is cheap, before anything
//! that costs the cube of their number.

use super::clique::{self, Set, bit};
use super::measured::Measured;
use super::pairs::Pairs;
use super::planar;
use super::scaled::Scaled;
use super::{FrameConsensusConfig, PairAlignment, gate};
use crate::geometry::Se3;
use crate::trajectory::Trajectory;

/// Disjoint groups of agreeing alignments that are kept in proportion: the first may be the truth, and the others must
/// be seen as rivals to it.
const GROUPS_MAX: usize = 4;

/// Positions of at most `most` alignments: of the largest groups that agree pairwise, evenly, and if there is room, of
/// the others.
pub(crate) fn promising(
    alpha: &Trajectory,
    beta: &Trajectory,
    alignments: &[PairAlignment],
    config: &FrameConsensusConfig,
    most: usize,
) -> Vec<usize> {
    if planar::is_planar(alpha, beta, alignments) {
        return of(&planar::measured(alpha, beta, alignments, config), most);
    }
    let rigid = alignments.iter().map(|a| (a.i, a.j, (a.t_i_j.pose, a.t_i_j.covariance, true)));
    of(&Measured::<6, Se3>::new(alpha, beta, rigid, config), most)
}

fn of<const N: usize, G: Scaled<N>>(measured: &Measured<'_, N, G>, most: usize) -> Vec<usize> {
    let widest = measured.scales().into_iter().fold(1.0, f64::max);
    let graph = Pairs::new(measured).graph(gate(N, widest));
    let mut rest: Set = (0..measured.alignments.len()).map(bit).sum();
    let mut grouped = Vec::new();
    for _ in 0..GROUPS_MAX {
        let group = clique::maximum_clique(&graph, rest);
        if group.count_ones() < 2 {
            break;
        }
        grouped.extend(clique::vertices(group));
        rest &= !group;
    }
    let others: Vec<usize> = clique::vertices(rest).collect();
    let room = most.saturating_sub(grouped.len());
    let chosen = evenly(&grouped, most).chain(evenly(&others, room));
    let mut positions: Vec<usize> = chosen.map(|l| measured.alignments[l].position).collect();
    positions.sort_unstable();
    positions
}

/// At most `most` of a list, evenly from first to last.
fn evenly(list: &[usize], most: usize) -> impl Iterator<Item = usize> + '_ {
    let kept = list.len().min(most);
    (0..kept).map(move |k| list[k * list.len() / kept])
}
