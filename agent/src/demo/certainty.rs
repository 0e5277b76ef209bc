//! How sure a map is by what it says itself, also where nobody knows the truth: how many of the alignments on which both
//! robots agreed hold in it, how many speak against it, and how well it knows where the two lie where both were.

use super::views::{Views, relative};
use merganser_protocol::geometry::Relative;

/// Of two robots, or of the loops of one.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Certainty {
    /// Agreed alignments that count in the map.
    pub hold: usize,
    /// Such that do not, because the rest of what is known contradicts them.
    pub contradict: usize,
    /// The two anchors in the middle of what both saw, and the standard deviations of how they lie, in tangent order, m (or
    /// units of the second) and rad.
    pub middle: Option<([String; 2], Vec<f64>)>,
}

impl Certainty {
    /// What `views` know of two frames, or, if they are one, of its loops.
    pub fn of(views: &Views, frames: &[&str; 2]) -> Self {
        let frame = |submap: &str| submap.rsplit_once('#').map_or(String::new(), |(frame, _)| frame.to_owned());
        let ties = |i: &str, j: &str| {
            let ends = [frame(i), frame(j)];
            (ends[0] == frames[0] && ends[1] == frames[1]) || (ends[0] == frames[1] && ends[1] == frames[0])
        };
        let between = || views.graph.edges.iter().filter(|edge| edge.kind == "alignment" && ties(&edge.i, &edge.j));
        let middle = views.pair(frames[0], frames[1]).and_then(|(pair, _)| pair.middle.as_ref());
        let sigmas = |t: Relative| match t {
            Relative::Metric(t) => t.covariance.sigmas().as_slice().to_vec(),
            Relative::Similarity(t) => t.covariance.sigmas().as_slice().to_vec(),
        };
        Self {
            hold: between().filter(|edge| edge.weight > 0.0).count(),
            contradict: between().filter(|edge| edge.agreed && edge.contradicts).count(),
            middle: middle.and_then(|m| Some(([m.i.clone(), m.j.clone()], sigmas(relative(&m.t_i_j)?)))),
        }
    }
}
