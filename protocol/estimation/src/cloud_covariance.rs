//! How what a submap's cloud is off by goes with the anchors of a solved component: the covariances from which
//! [`extrapolation`](super::extrapolation) tells how frames begin and how robots go on.

use super::graph::Edge;
use super::marginals::merge;
use super::node::Node;
use super::solve::Solution;
use crate::geometry::sim3::{Matrix7, Vector7};
use crate::ids::SubmapId;
use nalgebra::Matrix6;

impl Solution<Node> {
    /// Covariance of δ in `X_x⁻¹ X_a ⊕ δ` with what the factor of a's cloud is off by, between anchors of one unit.
    pub(super) fn covariance_with_cloud(&self, x: SubmapId, a: SubmapId) -> Option<Matrix6<f64>> {
        let [x, a] = [x, a].map(|id| self.graph.position(Node::Anchor(id)));
        let (to, cloud) = (self.half_solved(x?, a?), self.half_solve(&self.cloud_rows(a?)?));
        Some(Matrix6::from_fn(|r, c| to.dot(r, &cloud, c)))
    }

    /// What [`Solution::covariance_with_cloud`] is from every anchor, at one solve.
    pub(super) fn with_cloud(&self, a: SubmapId) -> Option<WithCloud<'_>> {
        let a = self.graph.position(Node::Anchor(a))?;
        Some(WithCloud { solution: self, a, columns: self.columns_of(&self.cloud_rows(a)?)? })
    }

    /// The row block of what the factor of an anchor's cloud is off by: that of the cloud, and of the steps that it
    /// follows.
    fn cloud_rows(&self, anchor: usize) -> Option<Vec<(usize, Vector7)>> {
        let (place, cloud) = self.graph.cloud_of(anchor)?;
        let of = |edge: &Edge<Node>| {
            self.difference(edge.i, edge.j, &(self.values[edge.j].inverse() * self.values[edge.i]).adjoint())
        };
        let mut rows = of(cloud);
        for (step, gain) in
            self.graph.correlations.get(&place).into_iter().flat_map(|correlation| &correlation.followed)
        {
            let mut follows = Matrix7::zeros();
            follows.fixed_view_mut::<6, 6>(0, 0).copy_from(&-gain);
            let followed =
                of(&self.graph.edges()[*step]).into_iter().map(|(scalar, column)| (scalar, follows * column));
            merge(&mut rows, followed);
        }
        Some(rows)
    }
}

/// How what an anchor's cloud is off by goes with all anchors.
pub(super) struct WithCloud<'a> {
    solution: &'a Solution<Node>,
    a: usize,
    /// Seven.
    columns: Vec<f64>,
}

impl WithCloud<'_> {
    /// As [`Solution::covariance_with_cloud`].
    pub(super) fn seen_from(&self, x: SubmapId) -> Option<Matrix6<f64>> {
        let Solution { graph, values, .. } = self.solution;
        let x = graph.position(Node::Anchor(x))?;
        let adjoint = (values[self.a].inverse() * values[x]).adjoint();
        let rows = |node| self.solution.rows(&self.columns, node);
        Some((rows(self.a) - adjoint * rows(x)).fixed_view::<6, 6>(0, 0).into_owned())
    }
}
