//! Why a pose graph cannot be solved, told by the poses and lines of its files.
//!
//! The solver knows variables; whoever mends a file wants the line. Where a pivot fails, or numbers overflow, the
//! measurement is named that most likely did it: the one that says least, of the pose concerned if it says too little
//! there, and the one of the largest numbers.

use super::robust::{RobustSolved, Verdict, robot_of};
use super::solve::Start;
use super::{Measurement, PoseGraph};
use crate::Unused;
use crate::graph::GraphError;
use crate::solve::{ComponentError, SolveError};
use core::fmt;
use std::collections::{BTreeMap, BTreeSet};
use thiserror::Error;

/// Information that is a smaller share of the largest is lost in rounding where both meet.
const SPREAD_MAX: f64 = 1e-12;

/// Why a graph could not be solved.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum PoseGraphError {
    /// The numbers do not allow it, and no measurement is to blame.
    #[error(transparent)]
    Solve(SolveError),
    /// Factors that are no graph.
    #[error(transparent)]
    Graph(#[from] GraphError<u64>),
    /// The start wants a value that the file does not give.
    #[error("{} has no value; add its vertex or start from the relaxation", PoseName(*.0))]
    NoValue(u64),
    /// A measurement that cannot be used.
    #[error("line {line}: {what}")]
    At {
        /// Its [`Measurement::line`].
        line: usize,
        /// What is wrong with it.
        what: MeasurementFault,
    },
    /// Poses that no measurement ties together.
    #[error("the graph has {0} parts; solve each by itself")]
    Parts(usize),
}

/// What is wrong with a measurement.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum MeasurementFault {
    /// Its information is no inverse of a covariance.
    #[error(
        "the information matrix is not positive definite, or a variance is outside [1e-18, 1e12] m² or rad²; mend it, \
         or solve with isotropic weights in its place"
    )]
    Information,
    /// A pose that the measurements leave free, or tie so weakly beside others that rounding does.
    #[error(
        "{} is not determined: this measurement of {} from {} has an information of only {least:.0e} in one direction, \
         beside {most:.0e} elsewhere, too far apart for doubles; measure it in all directions, or state the \
         information that there really is",
        PoseName(*.pose), PoseName(*.j), PoseName(*.i)
    )]
    Undetermined {
        /// The pose.
        pose: u64,
        /// Target pose of the measurement.
        i: u64,
        /// Source pose of the measurement.
        j: u64,
        /// Smallest eigenvalue of the measurement's information.
        least: f64,
        /// Largest diagonal element of any information.
        most: f64,
    },
    /// Numbers overflowed, and these are the largest.
    #[error(
        "numbers overflow, and those of this measurement of {} from {} are the largest: {length:.0e} m with an \
         information up to {most:.0e}; check its units",
        PoseName(*.j), PoseName(*.i)
    )]
    Overflow {
        /// Target pose.
        i: u64,
        /// Source pose.
        j: u64,
        /// Length of the translation.
        length: f64,
        /// Largest diagonal element of the information.
        most: f64,
    },
}

/// A pose's id as people read it: with the robot's letter and the number of its pose, if the top byte is a letter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PoseName(pub u64);

impl fmt::Display for PoseName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let letter = char::from(robot_of(self.0));
        write!(f, "pose {}", self.0)?;
        if letter.is_ascii_alphabetic() { write!(f, " ({letter}{})", self.0 & ((1 << 56) - 1)) } else { Ok(()) }
    }
}

/// Poses that the robust solver found no place for.
#[derive(Clone, Debug, PartialEq)]
pub struct Unsolved {
    /// The smallest of them.
    pub first: u64,
    /// How many.
    pub poses: usize,
    /// What solving the measurements between them meets; `None` if they can be solved by themselves.
    pub why: Option<PoseGraphError>,
}

impl PoseGraph {
    /// The solver's error in terms of this graph, which is one that it could not solve.
    pub(super) fn told(&self, error: SolveError) -> PoseGraphError {
        let fault = match error {
            SolveError::Underconstrained { .. } | SolveError::NotFinite if self.parts().len() > 1 => {
                return PoseGraphError::Parts(self.parts().len());
            }
            // Variables are the poses in ascending order, without the first, which is held.
            SolveError::Underconstrained { variable } => {
                self.poses.keys().nth(variable + 1).and_then(|pose| self.undetermined(*pose))
            }
            SolveError::NotFinite => self.overflow(),
            SolveError::Start { .. } | SolveError::TooDense { .. } | SolveError::OutOfMemory => None,
        };
        fault.unwrap_or(PoseGraphError::Solve(error))
    }

    /// The same of the minimum of χ².
    pub(super) fn told_of_component(&self, error: ComponentError<u64>) -> PoseGraphError {
        match error {
            ComponentError::UnderconstrainedNode(pose) => {
                let place = self.poses.range(..pose).count();
                self.told(SolveError::Underconstrained { variable: place.saturating_sub(1) })
            }
            // No pose has a scale of its own.
            ComponentError::UnderconstrainedScale(()) => self.told(SolveError::NotFinite),
            ComponentError::Solve(error) => self.told(error),
        }
    }

    /// The fault that leaves a pose free.
    fn undetermined(&self, pose: u64) -> Option<PoseGraphError> {
        let most = self.measurements.iter().map(most).fold(0.0, f64::max);
        let least = |m: &Measurement| m.information.symmetric_eigenvalues().min();
        let weakest = |of: &dyn Fn(&Measurement) -> bool| {
            let told = self.measurements.iter().filter(|m| of(m)).map(|m| (least(m), m));
            told.min_by(|x, y| x.0.total_cmp(&y.0))
        };
        // A pose that is well measured itself hangs on what is not.
        let own = weakest(&|m| m.i == pose || m.j == pose).filter(|(least, _)| *least <= SPREAD_MAX * most);
        let (least, m) = own.or_else(|| weakest(&|_| true))?;
        let what = MeasurementFault::Undetermined { pose, i: m.i, j: m.j, least, most };
        Some(PoseGraphError::At { line: m.line, what })
    }

    fn overflow(&self) -> Option<PoseGraphError> {
        let size = |m: &Measurement| m.t_i_j.translation.amax().max(1.0).powi(2) * most(m);
        let largest = self.measurements.iter().max_by(|x, y| size(x).total_cmp(&size(y)))?;
        Some(overflow(largest))
    }

    /// The poses for which [`PoseGraph::solve_robustly`] found no place, by connected runs of what it trusts.
    pub fn unsolved(&self, solved: &RobustSolved) -> Vec<Unsolved> {
        let placed: BTreeSet<u64> = solved.components.iter().flat_map(BTreeMap::keys).copied().collect();
        let is_left = |id: &u64| !placed.contains(id);
        let of_verdicts = |wanted: fn(&Verdict) -> bool| {
            let kept = self.measurements.iter().zip(&solved.verdicts);
            let kept = kept.filter(|(m, verdict)| wanted(verdict) && is_left(&m.i) && is_left(&m.j));
            Self {
                poses: self.poses.iter().filter(|(id, _)| is_left(id)).map(|(&id, &value)| (id, value)).collect(),
                measurements: kept.map(|(m, _)| m.clone()).collect(),
                ..self.clone_empty()
            }
        };
        let trusted = of_verdicts(|v| *v == Verdict::Odometry);
        let tried = of_verdicts(|v| matches!(v, Verdict::Odometry | Verdict::Unused(Unused::Failed(_))));
        // What closures could not be solved with is told of the parts that they joined.
        let parts = if trusted.parts().iter().all(|part| part.fails().is_none()) { tried } else { trusted }.parts();
        let unsolved = |part: &Self| {
            let first = part.poses.keys().next().copied()?;
            Some(Unsolved { first, poses: part.poses.len(), why: part.fails() })
        };
        parts.iter().filter_map(unsolved).collect()
    }

    /// What solving this part meets.
    fn fails(&self) -> Option<PoseGraphError> {
        const ITERATIONS_MAX: usize = 20;
        let start = self.start(Start::Relaxed, ITERATIONS_MAX);
        start.and_then(|start| self.solve(&start, ITERATIONS_MAX)).err()
    }

    fn clone_empty(&self) -> Self {
        Self { planar: self.planar, fixed: self.fixed.clone(), ..Self::default() }
    }
}

/// The fault of a measurement whose numbers are too large.
pub(super) fn overflow(m: &Measurement) -> PoseGraphError {
    let (i, j, length, most) = (m.i, m.j, m.t_i_j.translation.norm(), most(m));
    PoseGraphError::At { line: m.line, what: MeasurementFault::Overflow { i, j, length, most } }
}

fn most(m: &Measurement) -> f64 {
    m.information.diagonal().amax()
}
