//! Keyframes become submaps; submaps become keypoints, descriptors and a summary; a peer's keypoints are matched with
//! one's own features and an alignment is refined on them.
//!
//! The path of the data: [`SubmapBuilder`] cuts the stream of [`Keyframe`]s into [`Submap`]s; [`describe()`] (heavy, a
//! job) turns one into [`Features`] (complete, private), [`Keypoints`] (what a peer may fetch) and a [`Summary`] (what
//! is gossiped). [`match_keypoints`] pairs a peer's few keypoints with all own features; once a solver made a pose of
//! the pairs, [`fit`] says how much of the peer's submap it explains and [`refine()`] sharpens it and states its
//! covariance, unless it is degenerate or puts their points where mine saw nothing but air ([`contradiction`]).
//!
//! Lengths are in frame units (metres, unless the frame's scale is unknown). Everything here is a pure function of its
//! arguments, equal to the bit on every machine.

mod aliasing;
mod block;
pub mod builder;
mod cloud;
pub mod continuity;
pub mod describe;
mod descriptor;
pub mod features;
pub mod gravity;
mod grid;
pub mod habits;
mod hypotheses;
pub mod landmarks;
mod local_descriptor;
pub mod loss;
mod matching;
mod misfit;
mod modality;
mod near;
mod odometry;
mod open;
pub mod place;
pub mod planar;
pub mod reading;
pub mod refine;
mod refusal;
pub mod register;
mod rest;
mod robust;
pub mod runs;
mod sampling;
mod scene;
mod sightings;
pub mod stated;
pub mod summary;
mod surface;
#[doc(hidden)]
pub mod testing;
mod thinning;
mod translation_voting;
mod verifier;
mod views;
mod visibility;

pub use block::{BlockError, Surfel};
pub use builder::{Submap, SubmapBuilder};
pub use describe::{Described, describe};
pub use features::{Features, Keypoints};
pub use gravity::{Up, UpError, Verticals};
pub use landmarks::Mark;
pub use loss::Loss;
pub use matching::{Matches, fit, match_keypoints};
pub use modality::Modality;
pub use place::{PlaceDescriptor, PlaceError};
pub use refine::{RefineConfig, RefineError, Refined, refine};
pub use refusal::KeyframeError;
pub use register::{RegisterConfig, RegisterError, Registered, register};
pub use summary::{Looks, SUMMARY_LEN_MAX, Similarity, Summary, SummaryError};
pub use visibility::contradiction;

use crate::geometry::PoseWithCovariance;
use crate::time::Stamp;

/// One keyframe of the robot's own SLAM.
#[derive(Clone, Debug, PartialEq)]
pub struct Keyframe {
    /// When, on the robot's clock; must rise.
    pub stamp: Stamp,
    /// Which run of the front end it is of, if it says: another one is another frame, hence a new epoch.
    pub session: Option<u64>,
    /// `t_frame_body`: pose of the body in the SLAM's local frame, and a covariance whose meaning `covariance_of`
    /// tells.
    pub pose: PoseWithCovariance,
    /// What the covariance describes.
    pub covariance_of: CovarianceOf,
    /// Points in the body frame, frame units: of surfaces, or the places of landmarks.
    pub points: Vec<[f32; 3]>,
    /// Of landmarks: what else is known of each point. Empty where points lie on surfaces.
    pub marks: Vec<Mark>,
    /// What the user's own place recognition says of it, if it has one.
    pub place: Option<PlaceDescriptor>,
    /// Which way is up, in the body frame, if it is known. Planar robots' is not asked for.
    pub up: Option<Up>,
}

/// What a keyframe's covariance describes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum CovarianceOf {
    /// The motion since the previous keyframe (local perturbation of the relative pose). Preferred.
    #[default]
    Motion,
    /// The absolute pose in the SLAM's frame; the motion's is derived by subtraction.
    Pose,
}
