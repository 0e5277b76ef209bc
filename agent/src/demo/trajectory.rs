//! The robots' paths after merging, in one frame, and their errors.

use super::track::Track;
use super::views::{Views, bodies, pose, relative};
use merganser_protocol::geometry::{Relative, Se3, Sim3, So3};
use merganser_protocol::wire::fact::ScaleKind;
use nalgebra::{Matrix3, Vector3};

/// Stamps are one if they differ by no more than this, s: they travel as floats.
const STAMP_SLACK_SECS: f64 = 1e-6;

/// One robot's path in the frame of the reference robot.
#[derive(Clone, Debug, PartialEq)]
pub struct Corrected {
    /// `t_ref_body`, one per keyframe; the scale is that of the robot's unit.
    pub poses: Vec<Sim3>,
    /// `t_ref_anchor` of its submaps, in order.
    pub anchors: Vec<Relative>,
}

/// A robot's keyframes in the frame of the reference robot: where [`bodies`] has them, by what the robot itself says of
/// its path. A keyframe that the robot knows nothing of, as it refused it or forgot it, goes on by odometry from the last
/// one before it that it knows. `None` if the reference robot does not know where the robot's frame lies.
pub fn correct(track: &Track, reference: &Views, own: &Views) -> Option<Corrected> {
    let frame = &own.frames.own;
    let mut submaps: Vec<_> = reference.map.submaps.iter().filter(|submap| submap.frame == *frame).collect();
    submaps.sort_by_key(|submap| submap.index);
    let anchors: Option<Vec<Relative>> = submaps.iter().map(|submap| relative(submap.t_own_anchor.as_ref()?)).collect();
    let known: Vec<(f64, Sim3, Se3)> = (own.path.keyframes.iter().zip(bodies(&own.path, &reference.map)))
        .filter_map(|(keyframe, body)| Some((keyframe.stamp_secs, body?, pose(&keyframe.t_odom_body)?)))
        .collect();
    let first = known.first()?;
    let poses = track.stamps_secs.iter().zip(&track.odometry).map(|(stamp, t_odom_body)| {
        let until = known.partition_point(|(at, ..)| *at <= stamp + STAMP_SLACK_SECS);
        let (_, t_ref_known, t_odom_known) = until.checked_sub(1).map_or(first, |k| &known[k]);
        *t_ref_known * Sim3::from_se3(&(t_odom_known.inverse() * *t_odom_body))
    });
    Some(Corrected { poses: poses.collect(), anchors: anchors? })
}

/// True `t_world_anchor` of a submap, `name/epoch#index`, of the robot of `track`, whose views are `own`: the anchor
/// moves with the keyframe of the submap that is nearest to it.
pub fn true_anchor(track: &Track, own: &Views, submap: &str) -> Option<Sim3> {
    let (frame, index) = submap.rsplit_once('#')?;
    let index: u32 = index.parse().ok()?;
    let view = own.map.submaps.iter().find(|view| view.frame == frame && view.index == index)?;
    let t_anchor_frame = pose(&view.t_frame_anchor)?.inverse();
    let keyframes = own.path.keyframes.iter().filter(|keyframe| own.path.frame == frame && keyframe.submap == index);
    let within = keyframes.filter_map(|keyframe| {
        let k = track.stamps_secs.partition_point(|stamp| *stamp < keyframe.stamp_secs - STAMP_SLACK_SECS);
        track.stamps_secs.get(k).filter(|stamp| **stamp <= keyframe.stamp_secs + STAMP_SLACK_SECS)?;
        Some((k, t_anchor_frame * pose(&keyframe.t_frame_body)?))
    });
    let (k, t_anchor_body) = within.min_by(|(_, a), (_, b)| a.log().norm().total_cmp(&b.log().norm()))?;
    let unit = Sim3::new(So3::identity(), Vector3::zeros(), track.unit_m?);
    let t_world_body = Sim3::from_se3(track.truth.as_ref()?.get(k)?);
    Some(t_world_body * unit * Sim3::from_se3(&t_anchor_body.inverse()))
}

/// Root mean square errors of keyframe positions, m.
#[derive(Clone, Debug, PartialEq)]
pub struct TrajectoryError {
    /// Odometry alone, given the true start of each robot; per robot and of all.
    pub alone_m: (Vec<f64>, f64),
    /// Merged, given the true start of the first robot only, and its true unit where it does not know the metre.
    pub merged_m: (Vec<f64>, f64),
    /// Merged, after the one motion of the whole swarm that fits best.
    pub fitted_m: (Vec<f64>, f64),
    /// The scale of that motion. The map's unit is the first robot's: where it knows the metre, the motion is rigid and
    /// this is `None`, so that a wrong scale shows; where it does not, nothing in the map says how large it is.
    pub fitted_scale: Option<f64>,
}

/// The paths' errors; `None` unless every robot merged and every truth is known.
pub fn errors(tracks: &[Track], corrected: &[Option<Corrected>]) -> Option<TrajectoryError> {
    let reference = tracks.first()?;
    let t_world_ref = reference.t_world_frame()?;
    let (mut alone, mut merged, mut truths): (Vec<Vec<_>>, Vec<Vec<_>>, Vec<Vec<_>>) = Default::default();
    for (track, corrected) in tracks.iter().zip(corrected) {
        let t_world_frame = track.t_world_frame()?;
        alone.push(track.odometry.iter().map(|pose| t_world_frame * pose.translation).collect());
        merged.push(corrected.as_ref()?.poses.iter().map(|pose| t_world_ref * pose.translation).collect());
        truths.push(track.truth.as_ref()?.iter().map(|pose| pose.translation).collect());
    }
    let (from, to) = (merged.concat(), truths.concat());
    let fit = match reference.scale {
        ScaleKind::Metric => Sim3::from_se3(&fit(&from, &to)),
        ScaleKind::Unknown => fit_similarity(&from, &to),
    };
    let fitted = merged.iter().map(|path| path.iter().map(|p| fit * *p).collect()).collect::<Vec<_>>();
    Some(TrajectoryError {
        alone_m: errors_of(&alone, &truths),
        merged_m: errors_of(&merged, &truths),
        fitted_m: errors_of(&fitted, &truths),
        fitted_scale: (reference.scale == ScaleKind::Unknown).then_some(fit.scale),
    })
}

fn errors_of(paths: &[Vec<Vector3<f64>>], truths: &[Vec<Vector3<f64>>]) -> (Vec<f64>, f64) {
    let each = paths.iter().zip(truths).map(|(path, truth)| rms(path, truth)).collect();
    (each, rms(&paths.concat(), &truths.concat()))
}

fn rms(a: &[Vector3<f64>], b: &[Vector3<f64>]) -> f64 {
    let sum: f64 = a.iter().zip(b).map(|(a, b)| (a - b).norm_squared()).sum();
    (sum / a.len().max(1) as f64).sqrt()
}

/// The similarity T with the least Σ |T aᵢ − bᵢ|² (Umeyama): the rotation is that of the rigid motion, and the scale
/// the least squares one after it. Points that all lie in one place have no size; they are moved rigidly.
pub fn fit_similarity(a: &[Vector3<f64>], b: &[Vector3<f64>]) -> Sim3 {
    let rotation = fit(a, b).rotation;
    let (centre_a, centre_b) = (mean(a), mean(b));
    let turned = a.iter().map(|a| rotation * (a - centre_a));
    let along: f64 = turned.zip(b).map(|(a, b)| a.dot(&(b - centre_b))).sum();
    let spread: f64 = a.iter().map(|a| (a - centre_a).norm_squared()).sum();
    let scale = Some(along / spread).filter(|scale| scale.is_finite() && *scale > 0.0).unwrap_or(1.0);
    Sim3::new(rotation, centre_b - rotation * centre_a * scale, scale)
}

fn mean(points: &[Vector3<f64>]) -> Vector3<f64> {
    points.iter().sum::<Vector3<f64>>() / points.len().max(1) as f64
}

/// The rigid motion T with the least Σ |T aᵢ − bᵢ|² (Kabsch).
pub fn fit(a: &[Vector3<f64>], b: &[Vector3<f64>]) -> Se3 {
    let (centre_a, centre_b) = (mean(a), mean(b));
    let h: Matrix3<f64> = a.iter().zip(b).map(|(a, b)| (b - centre_b) * (a - centre_a).transpose()).sum();
    let svd = h.svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else { return Se3::identity() };
    let mut sign = Vector3::repeat(1.0);
    // A reflection fits better where the points lie in a plane; turn its weakest axis round.
    if (u * v_t).determinant() < 0.0 {
        sign[svd.singular_values.imin()] = -1.0;
    }
    let rotation = So3::from_matrix(&(u * Matrix3::from_diagonal(&sign) * v_t));
    Se3::new(rotation, centre_b - rotation * centre_a)
}
