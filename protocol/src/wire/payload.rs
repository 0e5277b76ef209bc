//! Facts as payload bytes and back. The raw structs are plain numbers; [`Fact::from_payload`] is the one place where
//! they become checked domain values. Writing a fact projects it onto what can be written exactly, so that
//! `parse ∘ encode ∘ parse = parse` to the bit, and a payload that is not the encoding of its own parse is refused.

use super::condensed::RawCondensed;
use super::fact::{
    AlignmentFact, Fact, LookalikeFact, PositionFact, RefusalReason, RetiredFact, ScaleKind, SightingFact, SubmapFact,
    VerdictFact, VerdictOutcome,
};
use super::frame::to_bytes;
use super::limits::{self, LENGTH_MAX, PAYLOAD_LEN_MAX, SUMMARY_LEN_MAX};
use super::pose::{EstimateError, RawPointCovariance, RawPoseWithCovariance, RawSimWithCovariance};
use crate::geometry::Relative;
use crate::ids::{EntryId, Hash, SubmapId};
use crate::time::Stamp;
use core::num::NonZero;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Entry kind of a [`SubmapFact`].
pub const KIND_SUBMAP: u8 = 1;
/// Entry kind of an [`AlignmentFact`].
pub const KIND_ALIGNMENT: u8 = 2;
/// Entry kind of a [`VerdictFact`].
pub const KIND_VERDICT: u8 = 3;
/// Entry kind of a [`SightingFact`].
pub const KIND_SIGHTING: u8 = 4;
/// Entry kind of a [`CondensedFact`](super::fact::CondensedFact).
pub const KIND_CONDENSED: u8 = 5;
/// Entry kind of a [`PositionFact`].
pub const KIND_POSITION: u8 = 6;
/// Entry kind of a [`LookalikeFact`].
pub const KIND_LOOKALIKE: u8 = 7;
/// Entry kind of a [`RetiredFact`].
pub const KIND_RETIRED: u8 = 8;

/// Why a payload is no fact, or a fact cannot be written. No state changes.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum FactError {
    /// A kind this version does not know: the entry is carried, its payload is not read.
    #[error("unknown kind of fact {0}; a newer robot wrote it")]
    UnknownKind(u8),
    /// Longer than [`PAYLOAD_LEN_MAX`].
    #[error("payload of {0} bytes is longer than {PAYLOAD_LEN_MAX}")]
    TooLong(usize),
    /// Truncated, over an inner limit, or no value of its type.
    #[error("payload is malformed: {0}")]
    Malformed(postcard::Error),
    /// Bytes after the fact.
    #[error("payload has {0} bytes after the fact")]
    Trailing(usize),
    /// The same fact has another, canonical encoding.
    #[error("payload is not canonically encoded")]
    NonCanonical,
    /// A pose or covariance is not acceptable.
    #[error("{field}: {why}")]
    Estimate {
        /// Which.
        field: &'static str,
        /// What is wrong with it.
        why: EstimateError,
    },
    /// Another value is not acceptable.
    #[error("{field} {mend}")]
    Value {
        /// Which.
        field: &'static str,
        /// What it should be.
        mend: &'static str,
    },
}

impl FactError {
    /// A short name for counters.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::UnknownKind(_) => "unknown_fact",
            Self::TooLong(_) => "fact_too_long",
            Self::Malformed(_) => "fact_malformed",
            Self::Trailing(_) => "fact_trailing",
            Self::NonCanonical => "fact_non_canonical",
            Self::Estimate { .. } => "fact_estimate",
            Self::Value { .. } => "fact_value",
        }
    }
}

impl Fact {
    /// The entry kind under which this fact is written.
    pub fn kind(&self) -> u8 {
        match self {
            Self::Submap(_) => KIND_SUBMAP,
            Self::Alignment(_) => KIND_ALIGNMENT,
            Self::Verdict(_) => KIND_VERDICT,
            Self::Sighting(_) => KIND_SIGHTING,
            Self::Condensed(_) => KIND_CONDENSED,
            Self::Position(_) => KIND_POSITION,
            Self::Lookalike(_) => KIND_LOOKALIKE,
            Self::Retired(_) => KIND_RETIRED,
        }
    }

    /// The name of an entry kind, for people.
    pub fn kind_name(kind: u8) -> &'static str {
        match kind {
            KIND_SUBMAP => "submap",
            KIND_ALIGNMENT => "alignment",
            KIND_VERDICT => "verdict",
            KIND_SIGHTING => "sighting",
            KIND_CONDENSED => "condensed",
            KIND_POSITION => "position",
            KIND_LOOKALIKE => "lookalike",
            KIND_RETIRED => "retired",
            _ => "unknown",
        }
    }

    /// The payload bytes of (the projection of) this fact: [`Fact::from_payload`] accepts them, and gives a fact that
    /// differs by the losses stated in the modules `pose` and `lattice`, never by a smaller covariance.
    ///
    /// # Errors
    /// [`FactError`] if a value is out of its bounds or the payload would be too long.
    pub fn to_payload(&self) -> Result<Vec<u8>, FactError> {
        let mut raw = Raw::of(self)?;
        // A rounded value may round once more (ties between quaternion components, a standard deviation carried over
        // a power of two); the second round is always the last.
        for _ in 0..4 {
            let again = Raw::of(&raw.parse()?)?;
            if again == raw {
                let bytes = raw.to_bytes();
                return if bytes.len() > PAYLOAD_LEN_MAX { Err(FactError::TooLong(bytes.len())) } else { Ok(bytes) };
            }
            raw = again;
        }
        Err(FactError::NonCanonical)
    }

    /// The fact in a payload.
    ///
    /// # Errors
    /// [`FactError`], naming the first check that failed.
    pub fn from_payload(kind: u8, payload: &[u8]) -> Result<Self, FactError> {
        if payload.len() > PAYLOAD_LEN_MAX {
            return Err(FactError::TooLong(payload.len()));
        }
        let fact = Raw::from_bytes(kind, payload)?.parse()?;
        if Raw::of(&fact)?.to_bytes() != payload {
            return Err(FactError::NonCanonical);
        }
        Ok(fact)
    }
}

/// A fact as plain numbers.
#[derive(Clone, Debug, PartialEq)]
enum Raw {
    Submap(RawSubmap, Option<NonZero<u16>>),
    Alignment(RawAlignment),
    Verdict(RawVerdict),
    Sighting(RawSighting),
    Condensed(RawCondensed),
    Position(RawPosition),
    Lookalike(RawLookalike),
    Retired(NonZero<u32>),
}

impl Raw {
    fn of(fact: &Fact) -> Result<Self, FactError> {
        Ok(match fact {
            Fact::Submap(f) => Self::Submap(RawSubmap::of(f)?, f.keyframes),
            Fact::Alignment(f) => Self::Alignment(RawAlignment::of(f)?),
            Fact::Verdict(f) => Self::Verdict(RawVerdict::of(f)?),
            Fact::Sighting(f) => Self::Sighting(RawSighting::of(f)?),
            Fact::Condensed(f) => Self::Condensed(RawCondensed::of(f)?),
            Fact::Position(f) => Self::Position(RawPosition::of(f)?),
            Fact::Lookalike(f) => Self::Lookalike(RawLookalike::of(f)?),
            Fact::Retired(f) => Self::Retired(f.below),
        })
    }

    fn parse(&self) -> Result<Fact, FactError> {
        Ok(match self {
            Self::Submap(raw, keyframes) => Fact::Submap(SubmapFact { keyframes: *keyframes, ..raw.parse()? }),
            Self::Alignment(raw) => Fact::Alignment(raw.parse()?),
            Self::Verdict(raw) => Fact::Verdict(raw.parse()?),
            Self::Sighting(raw) => Fact::Sighting(raw.parse()?),
            Self::Condensed(raw) => Fact::Condensed(raw.parse()?),
            Self::Position(raw) => Fact::Position(raw.parse()?),
            Self::Lookalike(raw) => Fact::Lookalike(raw.parse()?),
            Self::Retired(below) => Fact::Retired(RetiredFact { below: *below }),
        })
    }

    fn to_bytes(&self) -> Vec<u8> {
        match self {
            Self::Submap(raw, None) => to_bytes(raw),
            Self::Submap(raw, Some(keyframes)) => [to_bytes(raw), to_bytes(keyframes)].concat(),
            Self::Alignment(raw) => to_bytes(raw),
            Self::Verdict(raw) => to_bytes(raw),
            Self::Sighting(raw) => to_bytes(raw),
            Self::Condensed(raw) => to_bytes(raw),
            Self::Position(raw) => to_bytes(raw),
            Self::Lookalike(raw) => to_bytes(raw),
            Self::Retired(below) => to_bytes(below),
        }
    }

    fn from_bytes(kind: u8, bytes: &[u8]) -> Result<Self, FactError> {
        Ok(match kind {
            KIND_SUBMAP => submap(bytes)?,
            KIND_ALIGNMENT => Self::Alignment(whole(bytes)?),
            KIND_VERDICT => Self::Verdict(whole(bytes)?),
            KIND_SIGHTING => Self::Sighting(whole(bytes)?),
            KIND_CONDENSED => Self::Condensed(whole(bytes)?),
            KIND_POSITION => Self::Position(whole(bytes)?),
            KIND_LOOKALIKE => Self::Lookalike(whole(bytes)?),
            KIND_RETIRED => Self::Retired(whole(bytes)?),
            other => return Err(FactError::UnknownKind(other)),
        })
    }
}

/// A submap, and the number of its keyframes behind it, where it is told: what submaps were written as before it was
/// stays what it is.
fn submap(bytes: &[u8]) -> Result<Raw, FactError> {
    let (submap, rest) = postcard::take_from_bytes(bytes).map_err(FactError::Malformed)?;
    let keyframes = if rest.is_empty() { None } else { Some(whole(rest)?) };
    Ok(Raw::Submap(submap, keyframes))
}

fn whole<'a, T: Deserialize<'a>>(bytes: &'a [u8]) -> Result<T, FactError> {
    let (value, rest) = postcard::take_from_bytes(bytes).map_err(FactError::Malformed)?;
    if rest.is_empty() { Ok(value) } else { Err(FactError::Trailing(rest.len())) }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct RawSubmap {
    index: u32,
    first: Stamp,
    /// Nanoseconds from the first to the last keyframe.
    lasting: u64,
    odometry: RawPoseWithCovariance,
    extent: [f32; 3],
    scale: ScaleKind,
    keypoint_count: u16,
    blob: Hash,
    #[serde(serialize_with = "limits::as_bytes", deserialize_with = "limits::bytes::<_, SUMMARY_LEN_MAX>")]
    summary: Vec<u8>,
}

impl RawSubmap {
    fn of(f: &SubmapFact) -> Result<Self, FactError> {
        let [first, last] = f.stamps;
        let stamps = || FactError::Value { field: "stamps", mend: "must not fall" };
        check(f.summary.len() <= SUMMARY_LEN_MAX, "summary", "must have at most 400 bytes")?;
        Ok(Self {
            index: f.index,
            first,
            lasting: last.0.checked_sub(first.0).and_then(|d| u64::try_from(d).ok()).ok_or_else(stamps)?,
            odometry: pose(&f.odometry, "odometry")?,
            extent: extent(f.extent)?,
            scale: f.scale,
            keypoint_count: f.keypoint_count,
            blob: f.blob,
            summary: f.summary.clone(),
        })
    }

    fn parse(&self) -> Result<SubmapFact, FactError> {
        let stamps = || FactError::Value { field: "stamps", mend: "must fit in 64 bits" };
        Ok(SubmapFact {
            index: self.index,
            stamps: [self.first, Stamp(self.first.0.checked_add_unsigned(self.lasting).ok_or_else(stamps)?)],
            odometry: parsed(&self.odometry, "odometry")?,
            extent: extent(self.extent)?,
            summary: self.summary.clone(),
            keypoint_count: self.keypoint_count,
            blob: self.blob,
            scale: self.scale,
            keyframes: None,
        })
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
enum RawRelative {
    Metric(RawPoseWithCovariance),
    Similarity(RawSimWithCovariance),
}

impl RawRelative {
    fn of(r: &Relative) -> Result<Self, FactError> {
        Ok(match r {
            Relative::Metric(p) => Self::Metric(pose(p, "t_i_j")?),
            Relative::Similarity(s) => Self::Similarity(
                RawSimWithCovariance::of(s).map_err(|why| FactError::Estimate { field: "t_i_j", why })?,
            ),
        })
    }

    fn parse(&self) -> Result<Relative, FactError> {
        Ok(match self {
            Self::Metric(raw) => Relative::Metric(parsed(raw, "t_i_j")?),
            Self::Similarity(raw) => {
                Relative::Similarity(raw.parse().map_err(|why| FactError::Estimate { field: "t_i_j", why })?)
            }
        })
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct RawAlignment {
    i: SubmapId,
    j: SubmapId,
    t_i_j: RawRelative,
    sigma: f32,
    support: u16,
    log10_nfa: f32,
    blobs: [Hash; 2],
}

impl RawAlignment {
    fn of(f: &AlignmentFact) -> Result<Self, FactError> {
        let raw = Self {
            i: f.i,
            j: f.j,
            t_i_j: RawRelative::of(&f.t_i_j)?,
            sigma: f.sigma,
            support: f.support,
            log10_nfa: f.log10_nfa,
            blobs: f.blobs,
        };
        raw.check()?;
        Ok(raw)
    }

    fn parse(&self) -> Result<AlignmentFact, FactError> {
        self.check()?;
        Ok(AlignmentFact {
            i: self.i,
            j: self.j,
            t_i_j: self.t_i_j.parse()?,
            sigma: self.sigma,
            support: self.support,
            log10_nfa: self.log10_nfa,
            blobs: self.blobs,
        })
    }

    fn check(&self) -> Result<(), FactError> {
        different(self.i, self.j)?;
        sigma(self.sigma)?;
        check(self.log10_nfa.is_finite(), "log10_nfa", "must be finite")
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct RawVerdict {
    alignment: EntryId,
    outcome: RawOutcome,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
enum RawOutcome {
    Measured { t_i_j: RawRelative, sigma: f32, support: u16 },
    Refused(RefusalReason),
}

impl RawVerdict {
    fn of(f: &VerdictFact) -> Result<Self, FactError> {
        let outcome = match &f.outcome {
            VerdictOutcome::Measured { t_i_j, sigma: s, support } => {
                sigma(*s)?;
                RawOutcome::Measured { t_i_j: RawRelative::of(t_i_j)?, sigma: *s, support: *support }
            }
            VerdictOutcome::Refused(reason) => RawOutcome::Refused(*reason),
        };
        Ok(Self { alignment: f.alignment, outcome })
    }

    fn parse(&self) -> Result<VerdictFact, FactError> {
        let outcome = match &self.outcome {
            RawOutcome::Measured { t_i_j, sigma: s, support } => {
                sigma(*s)?;
                VerdictOutcome::Measured { t_i_j: t_i_j.parse()?, sigma: *s, support: *support }
            }
            RawOutcome::Refused(reason) => VerdictOutcome::Refused(*reason),
        };
        Ok(VerdictFact { alignment: self.alignment, outcome })
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct RawSighting {
    stamp: Stamp,
    i: SubmapId,
    j: SubmapId,
    t_i_j: RawPoseWithCovariance,
}

impl RawSighting {
    fn of(f: &SightingFact) -> Result<Self, FactError> {
        different(f.i, f.j)?;
        Ok(Self { stamp: f.stamp, i: f.i, j: f.j, t_i_j: pose(&f.t_i_j, "t_i_j")? })
    }

    fn parse(&self) -> Result<SightingFact, FactError> {
        different(self.i, self.j)?;
        Ok(SightingFact { stamp: self.stamp, i: self.i, j: self.j, t_i_j: parsed(&self.t_i_j, "t_i_j")? })
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct RawPosition {
    stamp: Stamp,
    i: SubmapId,
    j: SubmapId,
    p_i: [f32; 3],
    p_j: [f32; 3],
    covariance: RawPointCovariance,
}

impl RawPosition {
    fn of(f: &PositionFact) -> Result<Self, FactError> {
        different(f.i, f.j)?;
        let why = |why| FactError::Estimate { field: "covariance", why };
        let covariance = RawPointCovariance::of(&f.covariance).map_err(why)?;
        let (p_i, p_j) = (point(f.p_i, "p_i")?, point(f.p_j, "p_j")?);
        Ok(Self { stamp: f.stamp, i: f.i, j: f.j, p_i, p_j, covariance })
    }

    fn parse(&self) -> Result<PositionFact, FactError> {
        different(self.i, self.j)?;
        let why = |why| FactError::Estimate { field: "covariance", why };
        let covariance = self.covariance.parse().map_err(why)?;
        let (p_i, p_j) = (point(self.p_i, "p_i")?, point(self.p_j, "p_j")?);
        Ok(PositionFact { stamp: self.stamp, i: self.i, j: self.j, p_i, p_j, covariance })
    }
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct RawLookalike {
    i: u32,
    j: u32,
}

impl RawLookalike {
    fn of(f: &LookalikeFact) -> Result<Self, FactError> {
        check(f.i < f.j, "j", "must be a later submap than i")?;
        Ok(Self { i: f.i, j: f.j })
    }

    fn parse(&self) -> Result<LookalikeFact, FactError> {
        check(self.i < self.j, "j", "must be a later submap than i")?;
        Ok(LookalikeFact { i: self.i, j: self.j })
    }
}

fn point(p: [f32; 3], field: &'static str) -> Result<[f32; 3], FactError> {
    check(p.iter().all(|c| c.abs() <= LENGTH_MAX), field, "must be finite, within 1e6")?;
    Ok(p)
}

fn pose(p: &crate::geometry::PoseWithCovariance, field: &'static str) -> Result<RawPoseWithCovariance, FactError> {
    RawPoseWithCovariance::of(p).map_err(|why| FactError::Estimate { field, why })
}

fn parsed(raw: &RawPoseWithCovariance, field: &'static str) -> Result<crate::geometry::PoseWithCovariance, FactError> {
    raw.parse().map_err(|why| FactError::Estimate { field, why })
}

fn extent(e: [f32; 3]) -> Result<[f32; 3], FactError> {
    check(e.iter().all(|c| (0.0..=LENGTH_MAX).contains(c)), "extent", "must be finite, 0 to 1e6")?;
    Ok(e)
}

fn sigma(s: f32) -> Result<(), FactError> {
    check((0.0..=LENGTH_MAX).contains(&s), "sigma", "must be finite, 0 to 1e6")
}

fn different(i: SubmapId, j: SubmapId) -> Result<(), FactError> {
    check(i != j, "j", "must be another submap than i")
}

fn check(good: bool, field: &'static str, mend: &'static str) -> Result<(), FactError> {
    if good { Ok(()) } else { Err(FactError::Value { field, mend }) }
}
