//! Factors that follow others: the residuals `r_k` of these tell a part of such a factor's own residual r. It counts with
//! `r − Σ G_k r_k` and what is then left of its covariance, and so ties more than two nodes, all of fixed unit.

use super::{Edge, Graph, Key};
use crate::geometry::Sim3;
use nalgebra::{Matrix6, Vector6};

/// What a factor follows.
#[derive(Clone, Debug)]
pub(crate) struct Correlation {
    /// The edges, and by how much of their residuals (G).
    pub(crate) followed: Vec<(usize, Matrix6<f64>)>,
}

/// The residual of such a factor, and its Jacobians by the perturbations of its nodes, ascending.
pub(crate) struct CorrelatedResidual {
    pub(crate) residual: Vector6<f64>,
    pub(crate) by: Vec<(usize, Matrix6<f64>)>,
}

impl Correlation {
    pub(crate) fn residual<K: Key>(&self, graph: &Graph<K>, own: &Edge<K>, values: &[Sim3]) -> Vector6<f64> {
        let of = |edge: &Edge<K>| edge.residual(values).fixed_rows::<6>(0).into_owned();
        let steps = self.followed.iter().map(|(step, gain)| gain * of(&graph.edges()[*step]));
        of(own) - steps.sum::<Vector6<f64>>()
    }

    pub(crate) fn linearise<K: Key>(&self, graph: &Graph<K>, own: &Edge<K>, values: &[Sim3]) -> CorrelatedResidual {
        let mut bent = CorrelatedResidual { residual: Vector6::zeros(), by: Vec::with_capacity(4) };
        bent.add(own, values, &Matrix6::identity());
        self.followed.iter().for_each(|(step, gain)| bent.add(&graph.edges()[*step], values, &-gain));
        bent.by.sort_by_key(|(node, _)| *node);
        bent
    }
}

impl CorrelatedResidual {
    fn add<K: Key>(&mut self, edge: &Edge<K>, values: &[Sim3], gain: &Matrix6<f64>) {
        let (residual, by_j, adjoint) = edge.linearise_rigid(values);
        self.residual += gain * residual;
        let by_j = gain * by_j;
        for (node, jacobian) in [(edge.i, -by_j * adjoint), (edge.j, by_j)] {
            match self.by.iter_mut().find(|(known, _)| *known == node) {
                Some((_, sum)) => *sum += jacobian,
                None => self.by.push((node, jacobian)),
            }
        }
    }
}

impl<K: Key> Graph<K> {
    /// Weighted sum of squared residuals.
    pub(crate) fn chi2(&self, values: &[Sim3]) -> f64 {
        let one = |(k, edge): (usize, &Edge<K>)| match self.correlations.get(&k) {
            None => edge.chi2(values),
            Some(correlation) => {
                let r = correlation.residual(self, edge, values);
                r.dot(&(edge.information_rigid() * r))
            }
        };
        self.edges().iter().enumerate().map(one).sum()
    }

    /// The nodes of a factor that follows others.
    pub(crate) fn nodes_of(&self, correlation: &Correlation, own: &Edge<K>) -> Vec<usize> {
        let followed = correlation.followed.iter().map(|(step, _)| &self.edges()[*step]);
        let mut nodes: Vec<usize> = followed.chain([own]).flat_map(|edge| [edge.i, edge.j]).collect();
        nodes.sort_unstable();
        nodes.dedup();
        nodes
    }
}
