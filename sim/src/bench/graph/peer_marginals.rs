//! Are our covariances GTSAM's? On one graph at the same poses, computed by both.
//!
//! GTSAM leaves out the Jacobian of a measurement's logarithm, which is the identity where residuals vanish. So the
//! graph compared is the file's with every measurement replaced by what the solved poses say of it.

use super::peer::{json_line, or_told};
use anyhow::Context;
use merganser_protocol::estimate::posegraph::{Measurement, PoseGraph, g2o};
use merganser_protocol::geometry::Se3;
use nalgebra::Matrix6;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

const SCRIPT: &str = include_str!("peer_marginals.py");
/// Poses compared.
const POSES: usize = 50;
/// Larger graphs are not compared: one takes GTSAM seconds a pose.
pub(super) const GRAPH_POSES_MAX: usize = 1_000;
/// Where GTSAM has each of our directions (ρ, φ): rotations come first there.
const PLACES: [usize; 6] = [3, 4, 5, 0, 1, 2];

#[derive(Deserialize)]
struct Output {
    covariances: Vec<(u64, Vec<f64>)>,
}

/// The largest difference of a covariance's element, relative to its standard deviations, and the poses compared. `None`
/// where the peer fails.
///
/// # Errors
/// A graph that cannot be solved, or a peer that names poses that are not there.
pub(super) fn difference(
    python: &Path,
    name: &str,
    graph: &PoseGraph,
    values: &[Se3],
) -> anyhow::Result<Option<(f64, usize)>> {
    let exact = without_residuals(graph, values);
    let ours: BTreeMap<u64, Matrix6<f64>> =
        exact.solve(values, 0)?.marginals().into_iter().map(|(id, c)| (id, *c.matrix())).collect();
    let file = std::env::temp_dir().join(format!("merganser-marginals-{}.g2o", std::process::id()));
    std::fs::write(&file, g2o::write(&exact)).with_context(|| file.display().to_string())?;
    let output = Command::new(python).args(["-c", SCRIPT]).arg(&file).arg(POSES.to_string()).output();
    std::fs::remove_file(&file).with_context(|| file.display().to_string())?;
    let Some(theirs) = or_told(json_line::<Output>(python, &file, output), name) else { return Ok(None) };
    let mut worst = 0.0_f64;
    for (id, numbers) in &theirs.covariances {
        let own = ours.get(id).with_context(|| format!("the peer names pose {id}"))?;
        worst = worst.max(apart(own, numbers).context("the peer's covariance is no 6 × 6 matrix")?);
    }
    Ok(Some((worst, theirs.covariances.len())))
}

fn apart(own: &Matrix6<f64>, numbers: &[f64]) -> Option<f64> {
    let mut worst = 0.0_f64;
    for r in 0..6 {
        for c in 0..6 {
            let theirs = numbers.get(6 * PLACES[r] + PLACES[c])?;
            worst = worst.max((own[(r, c)] - theirs).abs() / (own[(r, r)] * own[(c, c)]).sqrt());
        }
    }
    Some(worst)
}

/// The graph with measurements that the poses fit exactly, those of the first pose from there.
fn without_residuals(graph: &PoseGraph, values: &[Se3]) -> PoseGraph {
    let poses: BTreeMap<u64, Option<Se3>> = graph.poses.keys().copied().zip(values.iter().map(|t| Some(*t))).collect();
    let first = graph.poses.keys().next().copied();
    let exact = |m: &Measurement| {
        let at = |id: u64| poses.get(&id).copied().flatten().unwrap_or_else(Se3::identity);
        let t_i_j = at(m.i).inverse() * at(m.j);
        if Some(m.j) == first {
            // δ of the inverse is −Ad(t) δ.
            let back = t_i_j.inverse().adjoint();
            let information = back.transpose() * m.information * back;
            let information = (information + information.transpose()) * 0.5;
            return Measurement { i: m.j, j: m.i, t_i_j: t_i_j.inverse(), information, ..m.clone() };
        }
        Measurement { t_i_j, ..m.clone() }
    };
    PoseGraph { measurements: graph.measurements.iter().map(exact).collect(), poses, ..PoseGraph::default() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directions_are_put_in_order_and_differences_are_relative() {
        let own = Matrix6::from_fn(|r, c| if r == c { (r + 1) as f64 } else { 0.01 * (r + c) as f64 });
        let mut theirs = vec![0.0; 36];
        for r in 0..6 {
            for c in 0..6 {
                theirs[6 * PLACES[r] + PLACES[c]] = own[(r, c)];
            }
        }
        assert!(apart(&own, &theirs).unwrap() < 1e-15);
        theirs[6 * PLACES[3] + PLACES[3]] += 0.4;
        assert!((apart(&own, &theirs).unwrap() - 0.1).abs() < 1e-12);
        assert_eq!(apart(&own, &theirs[..30]), None);
    }
}
