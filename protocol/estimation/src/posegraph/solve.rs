//! Solving a pose graph: decides the start, and says what is known about the minimum that is found.

use super::fault::{self, MeasurementFault, PoseGraphError};
use super::{PoseGraph, covariance_of};
use crate::certificate::Certificate;
use crate::geometry::{Covariance, PoseWithCovariance, Relative, Se3, Sim3};
use crate::graph::{Factor, Graph};
use crate::solve::{Solution, minimum, solve};
use std::collections::BTreeSet;

/// Where a minimisation starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Start {
    /// Chordal relaxation: needs no values and is close to the global minimum where noise is moderate.
    Relaxed,
    /// The minimum of the chordal cost, which can be certified; costs more, and is right where noise is large.
    Chordal,
    /// The values of the file.
    Given,
}

/// The certified side of a solution.
#[derive(Clone, Debug, PartialEq)]
pub struct ChordalOutcome {
    /// SE-Sync's cost at its minimum.
    pub cost: f64,
    /// Iterations used.
    pub iterations: usize,
    /// Whether the last step was negligible, or the next would be.
    pub converged: bool,
    /// Whether that minimum is the global one.
    pub certificate: Certificate,
}

/// A minimum of χ², without what covariances need.
#[derive(Clone, Debug, PartialEq)]
pub struct Minimised {
    /// `t_world_pose` in the order of [`PoseGraph::poses`]; the first is the identity, or as given.
    pub values: Vec<Se3>,
    /// Weighted sum of squared residuals.
    pub chi2: f64,
    /// Iterations used.
    pub iterations: usize,
    /// Whether the last step was negligible, or the next would be.
    pub converged: bool,
}

/// A solved graph.
#[derive(Clone, Debug)]
pub struct Solved {
    /// Poses' names, in the order of [`Solved::values`].
    pub ids: Vec<u64>,
    /// `t_world_pose`; the first pose is the identity, or as given.
    pub values: Vec<Se3>,
    /// The solution from which covariances are drawn.
    pub solution: Solution<u64>,
}

impl PoseGraph {
    /// The start, in the order of the poses.
    ///
    /// # Errors
    /// [`PoseGraphError`] if a value is wanted that is not there, or the graph is not connected.
    pub fn start(&self, start: Start, iterations_max: usize) -> Result<Vec<Se3>, PoseGraphError> {
        match start {
            Start::Relaxed => self.chordal().relaxed().map_err(|e| self.told(e)),
            Start::Chordal => {
                let chordal = self.chordal();
                let minimum = chordal.relaxed().and_then(|start| chordal.minimise(&start, iterations_max));
                Ok(minimum.map_err(|e| self.told(e))?.values)
            }
            Start::Given => {
                let given = self.poses.iter().map(|(&id, value)| value.ok_or(PoseGraphError::NoValue(id)));
                given.collect()
            }
        }
    }

    /// The minimum of SE-Sync's cost with its certificate; the poses in the order of [`PoseGraph::poses`].
    ///
    /// # Errors
    /// [`PoseGraphError`] if the graph is not connected or cannot be solved.
    pub fn certified(&self, iterations_max: usize) -> Result<(Vec<Se3>, ChordalOutcome), PoseGraphError> {
        let chordal = self.chordal();
        let minimum = chordal.relaxed().and_then(|start| chordal.minimise(&start, iterations_max));
        let minimum = minimum.map_err(|e| self.told(e))?;
        let certificate = chordal.certify(&minimum.values).map_err(|e| self.told(e))?;
        let (cost, iterations, converged) = (minimum.cost, minimum.iterations, minimum.converged);
        Ok((minimum.values, ChordalOutcome { cost, iterations, converged, certificate }))
    }

    /// The minimum of χ² near a start.
    ///
    /// # Errors
    /// [`PoseGraphError`] if the graph is not connected or cannot be solved.
    pub fn minimise(&self, start: &[Se3], iterations_max: usize) -> Result<Minimised, PoseGraphError> {
        let start = start.iter().map(Sim3::from_se3).collect();
        let found = minimum(&self.graph()?, start, iterations_max).map_err(|e| self.told_of_component(e))?;
        let values = found.values.iter().map(Sim3::to_se3).collect();
        Ok(Minimised { values, chi2: found.chi2, iterations: found.iterations, converged: found.converged })
    }

    /// The same, with the factorisation that covariances are drawn from.
    ///
    /// # Errors
    /// As [`PoseGraph::minimise`].
    pub fn solve(&self, start: &[Se3], iterations_max: usize) -> Result<Solved, PoseGraphError> {
        let start = start.iter().map(Sim3::from_se3).collect();
        let solution = solve(self.graph()?, start, iterations_max).map_err(|e| self.told_of_component(e))?;
        let values = solution.values().iter().map(Sim3::to_se3).collect();
        Ok(Solved { ids: self.poses.keys().copied().collect(), values, solution })
    }

    /// The one component as the estimate's own graph.
    fn graph(&self) -> Result<Graph<u64>, PoseGraphError> {
        let factor = |m: &super::Measurement| {
            if !m.t_i_j.translation.iter().all(|x| x.is_finite()) {
                return Err(fault::overflow(m));
            }
            let what = MeasurementFault::Information;
            let covariance = covariance_of(&m.information).ok_or(PoseGraphError::At { line: m.line, what })?;
            let t_i_j = Relative::Metric(PoseWithCovariance { pose: m.t_i_j, covariance });
            Ok(Factor { label: (), i: m.i, j: m.j, t_i_j, weight: 1.0 })
        };
        let factors = self.measurements.iter().map(factor).collect::<Result<_, PoseGraphError>>()?;
        let nodes: BTreeSet<u64> = self.poses.keys().copied().collect();
        let mut graphs = Graph::components(&nodes, &BTreeSet::new(), factors)?;
        match (graphs.pop(), graphs.len()) {
            (Some(graph), 0) => Ok(graph),
            (_, more) => Err(PoseGraphError::Parts(more + 1)),
        }
    }
}

impl Solved {
    /// The covariance of every pose relative to the first (local perturbation of `t_first_pose`), by selected
    /// inversion; in the order of [`Solved::ids`].
    pub fn marginals(&self) -> Vec<(u64, Covariance<6>)> {
        self.marginals_from(0)
    }

    /// The same relative to another pose, by its place among [`Solved::ids`].
    pub fn marginals_from(&self, origin: usize) -> Vec<(u64, Covariance<6>)> {
        let Some(&origin) = self.ids.get(origin) else { return Vec::new() };
        let relations = self.solution.relatives_to(origin, &BTreeSet::new());
        relations.into_iter().filter_map(|(id, t)| Some((id, t.metric()?.covariance))).collect()
    }
}
