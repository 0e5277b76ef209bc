//! From a peer's planar keypoints to an alignment or a refusal: all poses on a raster, the best judged, the winner
//! fitted.

use super::super::block::{Stored, Surfel};
use super::super::descriptor::PACKED_LEN;
use super::super::features::{Features, Keypoints, UNSEEN};
use super::super::refine::{RefineError, Refined};
use super::super::register::{RegisterError, Registered, check_comparable};
use super::OUT_OF_PLANE_ALIGNED;
use super::codec::{Beam, CELLS_MAX, Codec, EDGE};
use super::describe::unpacked;
use super::fit::{Walls, system};
use super::se2::{Se2, in_space};
use super::search;
use super::verifier::{ALIKE, Judged, PoseVerifier};
use nalgebra::{Matrix3, Vector2, Vector3};

/// Farthest that a point may lie from its anchor along an axis, voxels.
const WALLS_MAX: f64 = EDGE * CELLS_MAX as f64 / 2.0;
/// From natural to base-10 logarithms.
const LOG10: f64 = core::f64::consts::LOG10_E;
/// A cell is free if so many of my beams passed through.
const BEAMS_MIN: u8 = 2;
/// Search radius of the last fit.
const RADIUS: f64 = 2.0;
/// Independent measurements that the pairs of fully overlapping submaps amount to: what bends a submap does not average
/// out over its points.
const INDEPENDENT_MAX: f64 = 8.0;
/// A pair informs about a direction only if its (scaled) Jacobian leans at least this far that way: noise of the
/// normals feigns information along a corridor.
const LEAN_MIN: f64 = 0.25;
/// Least standard deviation: voxels...
const FLOOR: f64 = 0.3;
/// ...and rad.
const FLOOR_RAD: f64 = 0.005;
/// Largest accepted standard deviation of a direction, voxels: beyond it the answer is that the place leaves it free.
const SIGMA_MAX: f64 = 10.0;

/// When a planar alignment is refused.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlanarConfig {
    /// Least score, nats.
    pub score_min: f64,
    /// Least share of the keypoints on my walls.
    pub fit_min: f64,
    /// Largest share of contradictions among what I can judge.
    pub contradiction_max: f64,
    /// A rival with this share of the score makes the answer ambiguous.
    pub rival_ratio: f64,
}

impl Default for PlanarConfig {
    fn default() -> Self {
        Self { score_min: 38.0, fit_min: 0.3, contradiction_max: 0.1, rival_ratio: 0.55 }
    }
}

/// Aligns their planar submap with mine.
///
/// # Errors
/// [`RegisterError`]: a refusal with its reason.
pub fn register(theirs: &Keypoints, mine: &Features, config: &PlanarConfig) -> Result<Registered, RegisterError> {
    check_comparable(theirs, mine)?;
    let voxel = mine.voxel();
    let (their_surfels, my_surfels) = (theirs.surfels(), mine.surfels());
    if !their_surfels.iter().chain(&my_surfels).all(|s| s.position.z == 0.0) {
        return Err(RegisterError::NotPlanar);
    }
    let their_walls = walls(&their_surfels, voxel);
    let my_walls = walls(&my_surfels, voxel);
    let near = my_walls.near();
    let (chart, their_chart) = (chart(mine, &my_surfels, &my_walls), their_chart(theirs, &their_surfels, voxel));
    let sample = sample(&my_walls, their_walls.points.len());
    let poses = search::poses(&their_walls, &my_walls, &chart);
    let verifier = PoseVerifier {
        theirs: &their_walls,
        middle: their_walls.middle(),
        their_chart: &their_chart,
        near: &near,
        mine: &sample,
        chart: &chart,
    };
    let judged = verifier.judge(&poses);
    let passes = |j: &&Judged| {
        j.score >= config.score_min && j.fit() >= config.fit_min && j.contradiction() <= config.contradiction_max
    };
    let Some(best) = judged.iter().find(passes) else {
        let (score, fit, contradiction) =
            judged.first().map_or((0.0, 0.0, 0.0), |best| (best.score, best.fit(), best.contradiction()));
        return Err(RegisterError::NoConsensus { poses: poses.len(), score, fit, contradiction });
    };
    // A rival need not pass itself: it is enough that it is credible.
    let credible = |j: &&Judged| j.fit() >= config.fit_min && j.contradiction() <= 2.0 * config.contradiction_max;
    let rival = judged.iter().filter(credible).find(|j| verifier.rivals(&best.pose, &j.pose));
    let rival = rival.map_or(0.0, |rival| rival.score);
    if rival >= config.rival_ratio * best.score {
        return Err(RegisterError::Ambiguous { score: best.score, rival, elsewhere: false });
    }
    let refined = refined(&verifier, &best.pose, voxel)?;
    Ok(Registered {
        refined,
        support: best.hits as f64,
        log10_nfa: libm::log10(poses.len() as f64) - best.score * LOG10,
        fit: best.fit(),
        contradiction: best.contradiction(),
        score: best.score,
    })
}

/// Oriented points, in my voxels. What lies farther out than any chart reaches is left out: it would only lengthen the
/// search.
fn walls(surfels: &[Surfel], voxel: f64) -> Walls {
    let within = |s: &&Surfel| s.position.xy().amax() <= WALLS_MAX * voxel;
    let clear = surfels.iter().filter(within).filter(|s| s.roughness.is_some() && s.normal.xy().norm() > 0.5);
    let (points, normals) = clear.map(|s| (s.position.xy() / voxel, s.normal.xy().normalize())).unzip();
    Walls { points, normals }
}

fn chart(mine: &Features, surfels: &[Surfel], walls: &Walls) -> Codec {
    let all: Vec<Vector2<f64>> = surfels.iter().map(|s| s.position.xy() / mine.voxel()).collect();
    let eyes: Vec<Vector2<f64>> = mine.viewpoints().iter().map(|p| p.xy() / mine.voxel()).collect();
    let beam = |((&to, s), &by): ((&Vector2<f64>, &Surfel), &u8)| {
        let from = *eyes.get(usize::from(by)).filter(|_| by != UNSEEN)?;
        Some(Beam { from, to, normal: s.roughness.map(|_| s.normal.xy()) })
    };
    let beams: Vec<Beam> = all.iter().zip(surfels).zip(mine.seen_from()).filter_map(beam).collect();
    Codec::new(walls, &all, &beams, BEAMS_MIN)
}

/// What their beams passed through. They sent few of them, so one says as much as several of mine.
fn their_chart(theirs: &Keypoints, surfels: &[Surfel], voxel: f64) -> Codec {
    let all: Vec<Vector2<f64>> = surfels.iter().map(|s| s.position.xy() / voxel).collect();
    let step = theirs.block.step();
    let beam = |((&to, s), stored): ((&Vector2<f64>, &Surfel), &Stored<PACKED_LEN>)| {
        let from = unpacked(&stored.descriptor, step)? / voxel;
        Some(Beam { from, to, normal: s.roughness.map(|_| s.normal.xy()) })
    };
    let beams: Vec<Beam> = all.iter().zip(surfels).zip(&theirs.block.points).filter_map(beam).collect();
    Codec::new(&Walls::default(), &all, &beams, 1)
}

/// Every so many of my points, about `count`.
fn sample(walls: &Walls, count: usize) -> Vec<Vector2<f64>> {
    let stride = (walls.points.len() / count.max(1)).max(1);
    walls.points.iter().step_by(stride).copied().collect()
}

/// The pose with a covariance that reflects the walls.
fn refined(verifier: &PoseVerifier, pose: &Se2, voxel: f64) -> Result<Refined, RefineError> {
    let system = system(verifier.theirs, verifier.near, pose, RADIUS, ALIKE);
    // About the middle of their points, an angle as what it moves at their rim: so x, y and the angle compare.
    let middle = verifier.middle;
    let spread = verifier.theirs.points.iter().map(|p| (p - middle).norm_squared()).sum::<f64>();
    let lever = (spread / verifier.theirs.points.len().max(1) as f64).sqrt().max(1.0);
    #[rustfmt::skip]
    let from_middle = Matrix3::new(
        1.0, 0.0, middle.y / lever,
        0.0, 1.0, -middle.x / lever,
        0.0, 0.0, 1.0 / lever,
    );
    let (information, total) = system.leaning(&from_middle, LEAN_MIN);
    let share = information.iter().fold(f64::INFINITY, |least, (value, _)| least.min(*value)) / total.max(1e-9);
    let overlap = system.pairs as f64 / verifier.theirs.points.len().max(1) as f64;
    let counted = (INDEPENDENT_MAX * overlap * overlap / system.pairs.max(1) as f64).min(1.0);
    let mut covariance = Matrix3::zeros();
    for (value, axis) in &information {
        let variance = system.sigma * system.sigma / (counted * value).max(1e-9);
        if variance > SIGMA_MAX * SIGMA_MAX {
            return Err(RefineError::Degenerate { share });
        }
        covariance += axis * axis.transpose() * variance;
    }
    covariance += Matrix3::from_diagonal(&Vector3::new(FLOOR * FLOOR, FLOOR * FLOOR, 0.0));
    covariance[(2, 2)] += (FLOOR_RAD * lever) * (FLOOR_RAD * lever);
    let covariance = from_middle * covariance * from_middle.transpose();
    let pose = in_space(pose, voxel, &covariance, OUT_OF_PLANE_ALIGNED);
    Ok(Refined { pose, rms: system.sigma * voxel, pairs: system.pairs, share })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_count_up_to_the_edge_of_any_chart() {
        let voxel = 0.1;
        let at =
            |x: f64| Surfel { position: Vector3::new(x * voxel, 0.0, 0.0), normal: Vector3::x(), roughness: Some(0.1) };
        let kept = walls(&[at(0.0), at(-WALLS_MAX), at(WALLS_MAX + 1.0), at(1e6)], voxel);
        assert_eq!(kept.points.len(), 2);
    }
}
