//! What `align` tells: text, JSON and a picture.

use super::{Outcome, t_a_b};
use crate::picture::{Robot, Scene};
use anyhow::Result;
use merganser_protocol::agent::job::Refused;
use merganser_protocol::geometry::Relative;
use merganser_protocol::kinds::RefusalReason;
use merganser_protocol::snapshot::RelationView;
use merganser_protocol::submap::RegisterConfig;
use merganser_protocol::wire::fact::ScaleKind;
use nalgebra::Vector3;
use serde_json::{Value, json};
use std::fmt::Write as _;

/// Colours that colour-blind people tell apart (Okabe and Ito).
const COLOURS: [&str; 2] = ["#0072b2", "#d55e00"];

/// No sensor on a robot sees farther, m.
const RANGE_MAX: f64 = 500.0;

pub(super) fn text(outcome: &Outcome) -> String {
    let mut text = String::new();
    let submap = &outcome.config.submap;
    for (letter, side) in ["A", "B"].iter().zip(&outcome.sides) {
        let [read, left] = side.points;
        let (name, keypoints) = (&side.name, side.keypoints.len());
        let _ = writeln!(
            text,
            "{letter}  {name}: {read} points, nine in ten within {:.1} m; {left} left, {keypoints} keypoints",
            side.range
        );
    }
    if let Some(far) = outcome.sides.iter().find(|side| side.range > RANGE_MAX) {
        let _ = writeln!(
            text,
            "   {} reaches {:.0} m: are these millimetres, or a map's coordinates?",
            far.name, far.range
        );
    }
    let sigma = outcome.config.align.sigma_max_voxels * submap.voxel_m;
    let sensor = name(&submap.sensor);
    let _ = writeln!(text, "   as {sensor}, thinned to {} m, noise of {sigma:.3} m at most\n", submap.voxel_m);
    match &outcome.found {
        Ok(found) => {
            let (covariance, pose) = (sigmas(&found.t_mine_theirs), found.t_mine_theirs.sim());
            let turn = pose.rotation.log().map(f64::to_degrees);
            let [x, y, z] = pose.translation.into();
            let s = &covariance;
            let unit = if submap.scale == ScaleKind::Unknown { "of A's units" } else { "m" };
            // Things on a table want more of them.
            let d = if submap.voxel_m < 0.02 { 5 } else { 3 };
            let _ = write!(
                text,
                "aligned: t_a_b, which maps B into A\n\
                 \x20   translation ({x:8.d$}, {y:8.d$}, {z:8.d$}) {unit}   σ ({:.d$}, {:.d$}, {:.d$})\n\
                 \x20   rotation    ({:8.2}, {:8.2}, {:8.2}) °   σ ({:.2}, {:.2}, {:.2}) °\n\
                 \x20   {:.0} keypoints support it, at a noise of {:.d$} {unit}; as good by chance: once in 10^{:.0}",
                s[0],
                s[1],
                s[2],
                turn.x,
                turn.y,
                turn.z,
                s[3].to_degrees(),
                s[4].to_degrees(),
                s[5].to_degrees(),
                found.support,
                found.sigma,
                -found.log10_nfa
            );
            if outcome.fused {
                text += "\n    free space was not looked at (--fused): it tells no places apart that look alike";
            }
            if let Relative::Similarity(t) = &found.t_mine_theirs {
                let sigma = t.covariance.matrix()[(6, 6)].sqrt();
                let _ = write!(
                    text,
                    "\n    scale       {:8.4}   σ {:.4}: so much of A's unit is one of B's",
                    pose.scale,
                    pose.scale * sigma
                );
            }
        }
        Err(refused) => {
            let (what, cure) = advice(outcome, refused);
            let _ = write!(text, "not aligned: {what}\n    {}\n    {cure}", refused.why);
        }
    }
    if let Some(path) = &outcome.picture {
        let _ = write!(text, "\n    picture: {}", path.display());
    }
    text
}

pub(super) fn json(outcome: &Outcome) -> Result<String> {
    let side = |side: &super::side::Side| {
        let [read, left] = side.points;
        json!({"name": side.name, "points": read, "thinned": left, "range_m": side.range, "keypoints": side.keypoints.len()})
    };
    let submap = &outcome.config.submap;
    let found = match &outcome.found {
        Ok(found) => json!({
            "t_a_b": RelationView::from(&found.t_mine_theirs),
            "support": found.support,
            "sigma_m": found.sigma,
            "log10_nfa": found.log10_nfa,
        }),
        Err(_) => Value::Null,
    };
    let refused = outcome.found.as_ref().err().map(|refused| {
        let (what, cure) = advice(outcome, refused);
        json!({"reason": refused.not.reason, "what": what, "why": refused.why, "cure": cure})
    });
    let all = json!({
        "conventions": "t_a_b maps coordinates in B into A; quaternion [x, y, z, w]; covariance: upper triangle, row by \
                        row, of the local perturbation (translation m, rotation rad); as in the agents' views",
        "a": side(&outcome.sides[0]),
        "b": side(&outcome.sides[1]),
        "sensor": submap.sensor,
        "scale": submap.scale,
        "fused": outcome.fused,
        "voxel_m": submap.voxel_m,
        "sigma_max_m": outcome.config.align.sigma_max_voxels * submap.voxel_m,
        "aligned": outcome.found.is_ok(),
        "found": found,
        "refused": refused,
        "picture": outcome.picture,
    });
    Ok(serde_json::to_string_pretty(&all)?)
}

fn covariance(t_a_b: &Relative) -> nalgebra::Matrix6<f64> {
    match t_a_b {
        Relative::Metric(t) => *t.covariance.matrix(),
        Relative::Similarity(t) => t.covariance.matrix().fixed_view::<6, 6>(0, 0).into_owned(),
    }
}

fn sigmas(t_a_b: &Relative) -> [f64; 6] {
    let matrix = covariance(t_a_b);
    core::array::from_fn(|k| matrix[(k, k)].sqrt())
}

/// What a refusal means, and what to try. That points would stand where a sensor looked through is no reason against a
/// pose of clouds which were not seen from their origin, and nothing in a cloud tells that.
fn advice(outcome: &Outcome, refused: &Refused) -> (&'static str, &'static str) {
    let has_unseen = !outcome.fused && outcome.sides.iter().any(|side| side.is_cloud);
    match words(refused.not.reason) {
        (what, _) if has_unseen && is_seen_through(&refused.why) => (
            what,
            "try: --fused, if a cloud is made of several views or its sensor was not at its origin: points stand where, \
             seen from the origin, the other cloud shows free space. Else: do they overlap by a third? Is --sensor \
             right, and the unit the metre?",
        ),
        words => words,
    }
}

/// Whether free space is what a refusal names, or more of what it names than passes.
fn is_seen_through(why: &str) -> bool {
    let share = why.rsplit_once("contradiction ").and_then(|(_, share)| share.parse::<f64>().ok());
    why.contains("seen to be free") || share.is_some_and(|share| share > RegisterConfig::default().contradiction_max)
}

fn words(reason: RefusalReason) -> (&'static str, &'static str) {
    match reason {
        RefusalReason::TooFew => {
            ("too few points match", "try: a smaller --voxel; clouds of more than one scan; is the unit the metre?")
        }
        RefusalReason::NoConsensus => (
            "nothing better than chance",
            "try: do they overlap by a third? Are points in metres, each seen from its \
             origin, and --sensor right? A larger --sigma-max for a noisy sensor",
        ),
        RefusalReason::Ambiguous => (
            "the place looks like another, or like itself turned or slid",
            "try: larger submaps, which show more than one repetition",
        ),
        RefusalReason::Degenerate => (
            "the surfaces leave a direction free, as a corridor or a plane does",
            "try: larger submaps, which show an end or a corner",
        ),
        RefusalReason::PoorFit => (
            "the best pose does not fit the rest of the two",
            "try: do they overlap by a sixth at least? Did things move in between?",
        ),
        RefusalReason::BadInput => ("the points cannot be used so", "try: the reason says which; --voxel or --sensor"),
    }
}

fn name(sensor: &merganser_protocol::config::Sensor) -> String {
    serde_json::to_value(sensor).ok().and_then(|value| value.as_str().map(Into::into)).unwrap_or_default()
}

/// Both, drawn over one another as they are, and B where it lies in A.
pub(super) fn scene(outcome: &Outcome) -> Scene {
    let t = t_a_b(outcome).map(Relative::sim);
    let robots = outcome.sides.iter().enumerate().map(|(k, side)| {
        let there = |p: &Vector3<f64>| if k == 0 { Some(*p) } else { t.map(|t| t * *p) };
        let origin = there(&Vector3::zeros());
        Robot {
            name: format!("{}: {}", ["A", "B"][k], side.name),
            colour: COLOURS[k].into(),
            alone: (side.cloud.clone(), vec![Vector3::zeros()]),
            merged: (side.cloud.iter().filter_map(there).collect(), origin.into_iter().collect()),
            ..Robot::default()
        }
    });
    let (title, subtitle) = match &outcome.found {
        Ok(found) => {
            ("aligned".into(), format!("{:.0} keypoints support it, noise {:.3} m", found.support, found.sigma))
        }
        Err(refused) => (format!("not aligned: {}", words(refused.not.reason).0), refused.why.clone()),
    };
    Scene {
        title,
        subtitle,
        up: Vector3::z(),
        robots: robots.collect(),
        alignments: Vec::new(),
        in_metres: outcome.config.submap.scale == ScaleKind::Metric,
    }
}

#[cfg(test)]
mod tests {
    use super::is_seen_through;
    use merganser_protocol::submap::RegisterError;

    #[test]
    fn free_space_is_named_as_the_reason_only_where_it_is() {
        let refused = |contradiction| RegisterError::NoConsensus { poses: 9, score: 10.0, fit: 0.1, contradiction };
        assert!(is_seen_through(&refused(0.07).to_string()));
        assert!(!is_seen_through(&refused(0.05).to_string()), "score and fit are too low");
        assert!(!is_seen_through("two poses with scores 90 and 88: the place looks like another"));
    }
}
