//! Whether a joint estimate lies at the global optimum, as far as that can be proved: for graphs with isotropic
//! weights, by the dual certificate ([`super::certificate`]) of the minimum of SE-Sync's cost next to the estimate.

use super::chordal::{ChordalEdge, ChordalGraph};
use super::graph::{Factor, Key};
use super::solve::Solution;
use crate::geometry::{Covariance, Relative, Sim3};
pub use crate::kinds::Optimality;

/// Iterations after which the minimum next to an estimate counts as not found.
const ITERATIONS_MAX: usize = 50;
/// How far, relatively, a covariance may be from an isotropic one.
const ISOTROPIC: f64 = 1e-6;
/// How far an anchor of the certified minimum may lie from the estimate, as a share of the standard deviation that the
/// weights of its measurements suggest: the two costs have their minima close together, but not in one place.
const NEAR_SIGMAS: f64 = 3.0;

impl<K: Key> Solution<K> {
    /// Tries to prove that this is the global optimum.
    pub fn optimality(&self) -> Optimality {
        if self.values.len() < 2 {
            return Optimality::Certified;
        }
        let edges: Option<Vec<ChordalEdge>> = self.graph.factors().map(|factor| self.isotropic(&factor)).collect();
        let speaks = self.graph.scale_count() == 0 && self.graph.correlations.is_empty();
        let Some(edges) = edges.filter(|_| speaks) else { return Optimality::NotApplicable };
        let chordal = ChordalGraph { nodes: self.values.len(), edges };
        let start: Vec<_> = self.values.iter().map(Sim3::to_se3).collect();
        let Ok(minimum) = chordal.minimise(&start, ITERATIONS_MAX) else { return Optimality::NotCertified };
        let weakest = chordal.edges.iter().fold(f64::INFINITY, |least, edge| least.min(edge.tau));
        let reach = NEAR_SIGMAS / weakest.sqrt() * (self.values.len() as f64).sqrt();
        let near = start.iter().zip(&minimum.values).all(|(a, b)| (a.translation - b.translation).norm() <= reach);
        let certified = near && minimum.converged && chordal.certify(&minimum.values).is_ok_and(|c| c.certified);
        if certified { Optimality::Certified } else { Optimality::NotCertified }
    }

    /// SE-Sync's form of a factor, if its weight is isotropic.
    fn isotropic(&self, factor: &Factor<K>) -> Option<ChordalEdge> {
        let Relative::Metric(t_i_j) = factor.t_i_j else { return None };
        let [translation, rotation] = isotropic_variances(&t_i_j.covariance)?;
        Some(ChordalEdge {
            i: self.graph.position(factor.i)?,
            j: self.graph.position(factor.j)?,
            r_i_j: t_i_j.pose.rotation.matrix(),
            p_i_j: t_i_j.pose.translation,
            kappa: factor.weight / (2.0 * rotation),
            tau: factor.weight / translation,
        })
    }
}

/// The variances of translation and rotation, if no direction is special.
fn isotropic_variances(covariance: &Covariance<6>) -> Option<[f64; 2]> {
    let p = covariance.matrix();
    let (translation, rotation) = (p[(0, 0)], p[(3, 3)]);
    let scale = |k: usize| if k < 3 { translation.sqrt() } else { rotation.sqrt() };
    let off = |r: usize, c: usize| (p[(r, c)] / (scale(r) * scale(c)) - f64::from(r == c)).abs();
    (0..6).all(|r| (0..6).all(|c| off(r, c) <= ISOTROPIC)).then_some([translation, rotation])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::EstimateConfig;
    use crate::geometry::{PoseWithCovariance, Se3};
    use crate::ids::SubmapId;
    use crate::test_graphs::rng;
    use crate::test_world::World;
    use crate::{JointEstimate, solve_map};
    use nalgebra::Matrix6;

    fn solved(world: &World) -> JointEstimate {
        solve_map(&world.problem, &EstimateConfig::default())
    }

    fn world() -> World {
        let mut rng = rng(4);
        let mut world = World::new(&mut rng, 3, 12, false);
        world.align_all(&mut rng, 4, false);
        world
    }

    #[test]
    fn isotropic_maps_are_certified_and_one_direction_more_is_not_applicable() {
        let mut world = world();
        assert_eq!(solved(&world).optimality(), Optimality::Certified);
        let chain = world.problem.frames.values_mut().next().unwrap();
        let mut p: Matrix6<f64> = *chain.odometry[5].covariance.matrix();
        p[(0, 0)] *= 1.01;
        chain.odometry[5].covariance = Covariance::new(p).unwrap();
        assert_eq!(solved(&world).optimality(), Optimality::NotApplicable);
    }

    #[test]
    fn unknown_scales_have_no_certificate() {
        let mut rng = rng(5);
        let mut world = World::scaled(&mut rng, &[None, Some(2.0)], 12, false);
        world.align_all(&mut rng, 5, false);
        assert_eq!(solved(&world).optimality(), Optimality::NotApplicable);
    }

    /// A ring that was wound once too often is a stationary point of its own.
    #[test]
    fn a_local_optimum_is_not_certified() {
        let frame = crate::test_graphs::frame(0);
        let (nodes, sigma) = (12u32, 0.1);
        let covariance = Covariance::from_sigmas([sigma; 6]).unwrap();
        let id = |index| SubmapId { frame, index };
        let turn = |k: f64| crate::geometry::So3::exp(&nalgebra::Vector3::new(0.0, 0.0, k));
        let factor = |i: u32, j: u32| Factor {
            label: crate::graph::Source::Odometry,
            i: id(i),
            j: id(j),
            t_i_j: Relative::Metric(PoseWithCovariance { pose: Se3::identity(), covariance }),
            weight: 1.0,
        };
        let factors: Vec<Factor<SubmapId>> = (0..nodes).map(|k| factor(k, (k + 1) % nodes)).collect();
        let ids = (0..nodes).map(id).collect();
        let solve_from = |winding: f64| {
            let graphs = crate::graph::Graph::components(&ids, &Default::default(), factors.clone());
            let step = core::f64::consts::TAU * winding / f64::from(nodes);
            let start = (0..nodes).map(|k| Sim3::from_se3(&Se3::new(turn(step * f64::from(k)), Default::default())));
            crate::solve::solve(graphs.unwrap().remove(0), start.collect(), 50).unwrap()
        };
        let (straight, wound) = (solve_from(0.0), solve_from(1.0));
        assert!(straight.chi2 < 1e-9 && wound.chi2 > 1.0, "{} {}", straight.chi2, wound.chi2);
        assert_eq!(straight.optimality(), Optimality::Certified);
        assert_eq!(wound.optimality(), Optimality::NotCertified);
    }
}
