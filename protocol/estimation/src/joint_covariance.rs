//! Several anchors at once: their joint covariance, and the relations of many pairs of them.
//!
//! Of each anchor `L⁻¹ E` is kept, E the columns of its own perturbation: it is zero off the way from the anchor to the
//! root of the factor. Every covariance is an inner product of differences of these, as in [`super::marginals`], so
//! that nothing is ever the small difference of large variances.
//!
//! Perturbations are local (on the right): `T ⊕ δ = T Exp(δ)`, `δ = (ρ, φ)` of a rigid pose and `(ρ, φ, λ)` of a
//! similarity, translation first, lengths in the units of the anchor's frame.

use super::graph::{Key, is_rigid};
use super::marginals::{certain, relation, spread};
use super::solve::Solution;
use crate::geometry::sim3::Matrix7;
use crate::geometry::{Relative, Sim3};
use crate::ids::SubmapId;
use nalgebra::DMatrix;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use thiserror::Error;

/// Anchors that a joint covariance may hold: 896 rows, 6.4 MB.
pub const JOINT_ANCHORS_MAX: usize = 128;

/// Why there is no joint covariance.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
pub enum JointError<K = SubmapId> {
    /// More anchors than a dense matrix should hold.
    #[error("{got} anchors, at most {JOINT_ANCHORS_MAX} have a joint covariance; ask for fewer, or for pairs")]
    TooMany {
        /// Anchors asked for.
        got: usize,
    },
    /// An anchor that is not known, or that nothing ties to the reference.
    #[error("anchor {0:?} is not connected to the reference; ask for anchors of one component")]
    Apart(K),
    /// An anchor named twice has a covariance with itself that nobody can invert.
    #[error("anchor {0:?} is named twice; leave one out")]
    Twice(K),
}

/// Anchors as one of them sees them, and their covariance, cross-correlations included.
#[derive(Clone, Debug, PartialEq)]
pub struct JointPoses<K: Key = SubmapId> {
    reference: K,
    anchors: Vec<K>,
    poses: Vec<Sim3>,
    rows: Vec<Range<usize>>,
    covariance: DMatrix<f64>,
    /// Frames whose unit is not the metre.
    unknown_scale: BTreeSet<K::Unit>,
}

impl<K: Key> JointPoses<K> {
    /// The anchor that the others are told from.
    pub fn reference(&self) -> K {
        self.reference
    }

    /// The anchors, in the order they were asked for.
    pub fn anchors(&self) -> &[K] {
        &self.anchors
    }

    /// `t_reference_anchor` of each; its scale is 1 where units are equal.
    pub fn poses(&self) -> &[Sim3] {
        &self.poses
    }

    /// The rows and columns of [`JointPoses::covariance`] that belong to the k-th anchor: six where its pose by the
    /// reference is rigid, seven where it is a similarity.
    pub fn rows(&self, k: usize) -> Option<Range<usize>> {
        self.rows.get(k).cloned()
    }

    /// The covariance of the local perturbations of all [`JointPoses::poses`], one after the other; symmetric. The rows
    /// of the reference itself, if it is among the anchors, are zero.
    pub fn covariance(&self) -> &DMatrix<f64> {
        &self.covariance
    }

    /// `t_a_b` of two of the anchors or the reference, from the joint covariance alone.
    pub fn relative(&self, a: K, b: K) -> Option<Relative> {
        let place = |id: K| self.anchors.iter().position(|&one| one == id);
        let (at_a, at_b) = (place(a), place(b));
        if [(a, at_a), (b, at_b)].iter().any(|&(id, at)| at.is_none() && id != self.reference) {
            return None;
        }
        if a == b {
            return Some(Relative::Metric(certain()));
        }
        let pose = |at: Option<usize>| at.map_or_else(Sim3::identity, |k| self.poses[k]);
        let t_a_b = pose(at_a).inverse() * pose(at_b);
        let adjoint = t_a_b.inverse().adjoint();
        let cross = self.block(at_b, at_a) * adjoint.transpose();
        let covariance =
            self.block(at_b, at_b) - cross - cross.transpose() + adjoint * self.block(at_a, at_a) * adjoint.transpose();
        relation(t_a_b, covariance, is_rigid(a.unit(), b.unit(), &self.unknown_scale))
    }

    /// Zero in what is certain.
    fn block(&self, a: Option<usize>, b: Option<usize>) -> Matrix7 {
        let mut out = Matrix7::zeros();
        if let (Some(a), Some(b)) = (a, b) {
            let (rows, columns) = (&self.rows[a], &self.rows[b]);
            let block = self.covariance.view((rows.start, columns.start), (rows.len(), columns.len()));
            out.view_mut((0, 0), (rows.len(), columns.len())).copy_from(&block);
        }
        out
    }
}

impl<K: Key> Solution<K> {
    /// `t_reference_anchor` of several anchors of the component with their joint covariance. Frames in `unknown_scale`
    /// as in [`Solution::relative`].
    ///
    /// # Errors
    /// [`JointError`].
    pub fn joint<N: Key<Unit = K::Unit> + Into<K>>(
        &self,
        reference: N,
        anchors: &[N],
        unknown_scale: &BTreeSet<K::Unit>,
    ) -> Result<JointPoses<N>, JointError<N>> {
        if anchors.len() > JOINT_ANCHORS_MAX {
            return Err(JointError::TooMany { got: anchors.len() });
        }
        let mut named = BTreeSet::new();
        if let Some(&twice) = anchors.iter().find(|&&id| !named.insert(id)) {
            return Err(JointError::Twice(twice));
        }
        let mut halves = Halves::of(self);
        let place = |id: N| self.graph.position(id.into()).ok_or(JointError::Apart(id));
        let r = place(reference)?;
        let (mut poses, mut rows, mut differences, mut end) = (Vec::new(), Vec::new(), Vec::new(), 0);
        for &id in anchors {
            let k = place(id)?;
            let is_rigid = is_rigid(reference.unit(), id.unit(), unknown_scale);
            let t_reference_anchor = if k == r { Sim3::identity() } else { self.values[r].inverse() * self.values[k] };
            poses.push(if is_rigid { Sim3::from_se3(&t_reference_anchor.to_se3()) } else { t_reference_anchor });
            differences.push(halves.difference(r, k));
            rows.push(end..end + if is_rigid { 6 } else { 7 });
            end += if is_rigid { 6 } else { 7 };
        }
        let mut covariance = DMatrix::zeros(end, end);
        for (a, half) in differences.iter().enumerate() {
            for (b, other) in differences.iter().enumerate().take(a + 1) {
                let block = half.times(other);
                for (r, row) in rows[a].clone().enumerate() {
                    for (c, column) in rows[b].clone().enumerate() {
                        (covariance[(row, column)], covariance[(column, row)]) = (block[(r, c)], block[(r, c)]);
                    }
                }
            }
        }
        let unknown_scale = unknown_scale.clone();
        Ok(JointPoses { reference, anchors: anchors.to_vec(), poses, rows, covariance, unknown_scale })
    }

    /// [`Solution::relative`] of many pairs that share few anchors, at one solve for each anchor.
    pub fn relatives<N: Key<Unit = K::Unit> + Into<K>>(
        &self,
        pairs: impl IntoIterator<Item = (N, N)>,
        unknown_scale: &BTreeSet<K::Unit>,
    ) -> Vec<Option<Relative>> {
        let mut halves = Halves::of(self);
        let mut one = |(i, j): (N, N)| {
            let (a, b) = (self.graph.position(i.into())?, self.graph.position(j.into())?);
            if a == b {
                return Some(Relative::Metric(certain()));
            }
            let difference = halves.difference(a, b);
            let t_i_j = self.values[a].inverse() * self.values[b];
            relation(t_i_j, difference.times(&difference), is_rigid(i.unit(), j.unit(), unknown_scale))
        };
        pairs.into_iter().map(&mut one).collect()
    }
}

/// `L⁻¹ E` of the anchors met so far.
struct Halves<'a, K: Key> {
    solution: &'a Solution<K>,
    of: BTreeMap<usize, Half>,
}

/// Seven columns where they are not zero: by range of scalars, ascending, column after column.
#[derive(Clone, Debug, Default, PartialEq)]
struct Half {
    ranges: Vec<Range<usize>>,
    values: Vec<f64>,
}

impl<'a, K: Key> Halves<'a, K> {
    fn of(solution: &'a Solution<K>) -> Self {
        Self { solution, of: BTreeMap::new() }
    }

    /// `L⁻¹ Aᵀ` of `δ = δ_b − Ad((X_a⁻¹ X_b)⁻¹) δ_a`, the perturbation of `X_a⁻¹ X_b`.
    fn difference(&mut self, a: usize, b: usize) -> Half {
        if a == b {
            return Half::default();
        }
        for node in [a, b] {
            let half = self.of.remove(&node).unwrap_or_else(|| self.solve(node));
            self.of.insert(node, half);
        }
        let t_b_a = self.solution.values[b].inverse() * self.solution.values[a];
        self.of[&b].minus(&t_b_a.adjoint(), &self.of[&a])
    }

    fn solve(&self, node: usize) -> Half {
        let Solution { pattern, factor, .. } = self.solution;
        let n = pattern.scalars();
        let rows = self.solution.row_block(node, &Matrix7::identity());
        let mut columns = spread(&rows, n);
        let ranges = pattern.solve_upwards(factor, rows.iter().map(|(scalar, _)| *scalar), &mut columns);
        let of_range = |range: &Range<usize>| (0..7).map(move |c| c * n).zip(core::iter::repeat(range.clone()));
        let parts = ranges.iter().flat_map(of_range);
        let values = parts.flat_map(|(at, range)| &columns[at + range.start..at + range.end]).copied().collect();
        Half { ranges, values }
    }
}

impl Half {
    /// The ranges with their columns.
    fn parts(&self) -> impl Iterator<Item = (&Range<usize>, &[f64])> {
        let mut rest = &self.values[..];
        self.ranges.iter().map(move |range| {
            let (part, others) = rest.split_at(7 * range.len());
            rest = others;
            (range, part)
        })
    }

    /// The columns less those of `other` by the rows of `a`.
    fn minus(&self, a: &Matrix7, other: &Self) -> Self {
        let mut out = Self::default();
        let (mut mine, mut theirs) = (self.parts().peekable(), other.parts().peekable());
        loop {
            // Two ranges are the same front's, or have nothing in common.
            let starts = [mine.peek(), theirs.peek()].map(|part| part.map_or(usize::MAX, |(range, _)| range.start));
            let next = starts[0].min(starts[1]);
            let own = mine.next_if(|_| starts[0] == next);
            let of_other = theirs.next_if(|_| starts[1] == next);
            let Some(range) = own.or(of_other).map(|(range, _)| range.clone()) else { return out };
            let (len, at) = (range.len(), out.values.len());
            match own {
                Some((_, part)) => out.values.extend_from_slice(part),
                None => out.values.resize(at + 7 * len, 0.0),
            }
            for (c, column) in out.values[at..].chunks_exact_mut(len).enumerate() {
                for (k, given) in of_other.into_iter().flat_map(|(_, part)| part.chunks_exact(len)).enumerate() {
                    column.iter_mut().zip(given).for_each(|(x, y)| *x -= a[(c, k)] * y);
                }
            }
            out.ranges.push(range);
        }
    }

    /// Inner products of the columns of both.
    fn times(&self, other: &Self) -> Matrix7 {
        let mut out = Matrix7::zeros();
        let mut theirs = other.parts().peekable();
        for (range, part) in self.parts() {
            while theirs.next_if(|(of_other, _)| of_other.start < range.start).is_some() {}
            let Some((_, of_other)) = theirs.next_if(|(of_other, _)| of_other.start == range.start) else { continue };
            for (r, x) in part.chunks_exact(range.len()).enumerate() {
                for (c, y) in of_other.chunks_exact(range.len()).enumerate() {
                    out[(r, c)] += x.iter().zip(y).map(|(x, y)| x * y).sum::<f64>();
                }
            }
        }
        out
    }
}

#[cfg(test)]
#[path = "joint_covariance_tests.rs"]
mod tests;
