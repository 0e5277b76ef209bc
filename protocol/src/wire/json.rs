//! How messages look to people: hexadecimal ids, poses as translation, quaternion, covariance and standard deviations.

use super::beacon::Beacon;
use super::entry::Entry;
use super::fact::{Fact, VerdictOutcome};
use super::have::{HaveVector, Head, Members};
use super::life::{Life, Nonce};
use crate::geometry::{PoseWithCovariance, Relative, Sim3};
use crate::ids::{Hash, RobotId};
use core::fmt::Display;
use nalgebra::SMatrix;
use serde::{Serialize, Serializer};
use serde_json::{Value, json};

/// An id as text for people, as bytes on the wire.
pub(super) fn id<S: Serializer, T: Display + Serialize>(id: &T, s: S) -> Result<S::Ok, S::Error> {
    if s.is_human_readable() { s.collect_str(id) } else { id.serialize(s) }
}

/// A root hash, likewise.
pub(super) fn tag<S: Serializer>(tag: &[u8; 8], s: S) -> Result<S::Ok, S::Error> {
    if s.is_human_readable() { s.collect_str(&RobotId(*tag)) } else { tag.serialize(s) }
}

/// Only the number of bytes.
pub(super) fn length<S: Serializer>(bytes: &[u8], s: S) -> Result<S::Ok, S::Error> {
    s.serialize_u64(bytes.len() as u64)
}

pub(super) fn count<S: Serializer>(values: &[[u8; 32]], s: S) -> Result<S::Ok, S::Error> {
    s.serialize_u64(values.len() as u64)
}

pub(super) fn beacon<S: Serializer>(beacon: &Beacon, s: S) -> Result<S::Ok, S::Error> {
    json!({
        "robot": beacon.robot().to_string(),
        "anchor": beacon.anchor.to_string(),
        "stamp_secs": beacon.stamp.as_secs_f64(),
        "counter": beacon.counter,
        "t_anchor_body": pose(&beacon.t_anchor_body),
    })
    .serialize(s)
}

/// A drawn number.
pub(super) fn nonce<S: Serializer>(nonce: &Nonce, s: S) -> Result<S::Ok, S::Error> {
    s.collect_str(&format_args!("{:032x}", u128::from_be_bytes(*nonce)))
}

pub(super) fn life<S: Serializer>(life: &Life, s: S) -> Result<S::Ok, S::Error> {
    let content = life.content();
    let latest = content.latest.map(
        |latest| json!({ "epoch": latest.epoch, "stamp_secs": latest.stamp.as_secs_f64(), "counter": latest.counter }),
    );
    let nonce = format!("{:032x}", u128::from_be_bytes(content.nonce));
    json!({ "robot": content.robot.to_string(), "nonce": nonce, "latest": latest }).serialize(s)
}

pub(super) fn have<S: Serializer>(have: &HaveVector, s: S) -> Result<S::Ok, S::Error> {
    let hex = |bytes: [u8; 4]| format!("{:08x}", u32::from_be_bytes(bytes));
    let robot = |place: u16| match &have.members {
        Members::Listed(robots) => robots.get(usize::from(place)).map(ToString::to_string),
        Members::Roster(_) => None,
    };
    let robot = |place: u16| robot(place).unwrap_or_else(|| format!("#{place}"));
    let head = |head: &Head| match head {
        Head::Log { len, tag: Some(tag) } => json!({ "len": len, "tag": hex(*tag) }),
        Head::Log { len, tag: None } => json!({ "len": len }),
        Head::Forked => json!("forked"),
    };
    let heads: serde_json::Map<_, _> =
        have.heads.iter().map(|(place, epoch, h)| (format!("{}/{epoch}", robot(*place)), head(h))).collect();
    json!({
        "roster": match &have.members { Members::Roster(hash) => json!(hex(*hash)), Members::Listed(_) => json!("listed") },
        "asker": robot(have.asker),
        "named": have.named,
        "after": have.after.map(|frame| frame.to_string()),
        "until": have.until.map(|frame| frame.to_string()),
        "heads": heads,
    })
    .serialize(s)
}

/// An entry from its bytes, or what is wrong with them.
pub(super) fn entry(bytes: &[u8]) -> Value {
    match Entry::decode(bytes) {
        Ok(entry) => json!({
            "id": entry.id().to_string(),
            "kind": Fact::kind_name(entry.kind()),
            "floor": entry.floor(),
            "previous": entry.previous().to_string(),
            "hash": Hash::of(bytes).to_string(),
            "len": bytes.len(),
            "fact": entry.fact().map_or_else(|error| json!({ "error": error.to_string() }), |f| fact(&f)),
        }),
        Err(error) => json!({ "len": bytes.len(), "error": error.to_string() }),
    }
}

fn fact(of: &Fact) -> Value {
    match of {
        Fact::Submap(f) => json!({
            "index": f.index,
            "stamps_secs": f.stamps.map(|stamp| stamp.as_secs_f64()),
            "odometry": pose(&f.odometry),
            "extent": f.extent,
            "summary_len": f.summary.len(),
            "keypoint_count": f.keypoint_count,
            "blob": f.blob.to_string(),
            "scale": f.scale,
        }),
        Fact::Alignment(f) => json!({
            "i": f.i.to_string(),
            "j": f.j.to_string(),
            "t_i_j": relative(&f.t_i_j),
            "sigma": f.sigma,
            "support": f.support,
            "log10_nfa": f.log10_nfa,
            "blobs": f.blobs.map(|blob| blob.to_string()),
        }),
        Fact::Verdict(f) => json!({
            "alignment": f.alignment.to_string(),
            "outcome": match &f.outcome {
                VerdictOutcome::Measured { t_i_j, sigma, support } => {
                    json!({ "t_i_j": relative(t_i_j), "sigma": sigma, "support": support })
                }
                VerdictOutcome::Refused(reason) => json!({ "refused": reason }),
            },
        }),
        Fact::Sighting(f) => json!({
            "stamp_secs": f.stamp.as_secs_f64(),
            "i": f.i.to_string(),
            "j": f.j.to_string(),
            "t_i_j": pose(&f.t_i_j),
        }),
        Fact::Position(f) => json!({
            "stamp_secs": f.stamp.as_secs_f64(),
            "i": f.i.to_string(),
            "j": f.j.to_string(),
            "p_i": f.p_i,
            "p_j": f.p_j,
            "covariance": upper_triangle(f.covariance.matrix()),
        }),
        Fact::Lookalike(f) => json!({ "i": f.i, "j": f.j }),
        Fact::Retired(f) => json!({ "below": f.below }),
        Fact::Condensed(f) => json!({
            "carried": f.carried.iter().map(|one| json!({
                "seq": one.seq,
                "kind": Fact::kind_name(one.fact.kind()),
                "after": one.after,
                "fact": fact(&one.fact),
            })).collect::<Vec<_>>(),
        }),
    }
}

fn pose(p: &PoseWithCovariance) -> Value {
    relative(&Relative::Metric(*p))
}

fn relative(r: &Relative) -> Value {
    match r {
        Relative::Metric(p) => estimate(&r.sim(), p.covariance.matrix()),
        Relative::Similarity(s) => estimate(&r.sim(), s.covariance.matrix()),
    }
}

fn upper_triangle<const N: usize>(p: &SMatrix<f64, N, N>) -> Vec<f64> {
    (0..N).flat_map(|r| (r..N).map(move |c| p[(r, c)])).collect()
}

/// As `snapshot::RelationView`: the covariance is its upper triangle, row by row, tangent order (ρ, φ[, λ]).
fn estimate<const N: usize>(t: &Sim3, p: &SMatrix<f64, N, N>) -> Value {
    let translation: [f64; 3] = t.translation.into();
    let sigmas: Vec<f64> = (0..N).map(|i| p[(i, i)].sqrt()).collect();
    json!({
        "pose": { "translation": translation, "rotation": t.rotation.xyzw(), "scale": t.scale },
        "covariance": upper_triangle(p),
        "sigmas": sigmas,
    })
}
