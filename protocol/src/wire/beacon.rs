//! The live pose beacon: where a robot is now, relative to the anchor of its latest submap. Best effort, latest wins,
//! never stored. It is signed (context, swarm and content), fits in 160 bytes in the worst case, and its covariance is
//! never smaller than the one given (at most about 3 % of a variance larger); the pose is rounded by at most 2.2e-4 rad
//! and half an ulp of f32.

use super::entry::SwarmTag;
use super::frame::{WireError, to_bytes};
use super::life::BeaconAge;
use super::pose::{EstimateError, RawBeaconPose};
use crate::geometry::PoseWithCovariance;
use crate::ids::{FrameId, RobotId, SubmapId};
use crate::time::Stamp;
use core::ops::Deref;
use ed25519_dalek::{Signature, Signer, SigningKey, VerifyingKey};
use serde::{Deserialize, Serialize};

/// Keeps a signature over a beacon from standing for anything else.
const SIGNING_CONTEXT: &[u8] = b"merganser pose 1\n";

/// What a beacon says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BeaconContent {
    /// The submap the pose is relative to; its frame names the robot.
    pub anchor: SubmapId,
    /// When, on the robot's clock.
    pub stamp: Stamp,
    /// Rises with every beacon of one frame: the latest wins.
    pub counter: u64,
    /// Pose of the body in the anchor, with the covariance of its local perturbation.
    pub t_anchor_body: PoseWithCovariance,
}

impl BeaconContent {
    /// Which of the robot's beacons it is.
    pub fn age(&self) -> BeaconAge {
        BeaconAge { epoch: self.anchor.frame.epoch, stamp: self.stamp, counter: self.counter }
    }
}

/// A signed [`BeaconContent`], which it derefs to. Decoding does not look at the signature: [`Beacon::verify`] does.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Beacon {
    content: BeaconContent,
    raw: RawBeacon,
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct RawBeacon {
    body: RawBody,
    signature: [[u8; 32]; 2],
}

#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct RawBody {
    robot: RobotId,
    epoch: u32,
    index: u32,
    stamp: Stamp,
    counter: u64,
    pose: RawBeaconPose,
}

impl Beacon {
    /// Signs a beacon. Its content is what a receiver will read: rounded, with a covariance that is never
    /// smaller.
    ///
    /// # Errors
    /// [`EstimateError`] if the pose is out of range.
    pub fn sign(key: &SigningKey, swarm: SwarmTag, content: &BeaconContent) -> Result<Self, EstimateError> {
        let mut body = RawBody::of(content)?;
        // As in `Fact::to_payload`: a rounded value may round once more.
        for _ in 0..4 {
            let again = RawBody::of(&body.parse()?)?;
            if again == body {
                break;
            }
            body = again;
        }
        let signature = key.sign(&body.signed_bytes(swarm)).to_bytes();
        let half = |k: usize| core::array::from_fn(|i| signature[32 * k + i]);
        Ok(Self { content: body.parse()?, raw: RawBeacon { body, signature: [half(0), half(1)] } })
    }

    /// The robot that claims to have sent it.
    pub fn robot(&self) -> RobotId {
        self.anchor.frame.robot
    }

    /// Whether `key` signed this beacon for this swarm.
    #[must_use]
    pub fn verify(&self, key: &VerifyingKey, swarm: SwarmTag) -> bool {
        let mut signature = [0; 64];
        signature[..32].copy_from_slice(&self.raw.signature[0]);
        signature[32..].copy_from_slice(&self.raw.signature[1]);
        key.verify_strict(&self.raw.body.signed_bytes(swarm), &Signature::from_bytes(&signature)).is_ok()
    }

    pub(super) fn raw(&self) -> &RawBeacon {
        &self.raw
    }
}

impl Deref for Beacon {
    type Target = BeaconContent;
    fn deref(&self) -> &BeaconContent {
        &self.content
    }
}

impl RawBeacon {
    /// The beacon; `Ok(None)` if the content has another, canonical encoding.
    pub fn parse(self) -> Result<Option<Beacon>, WireError> {
        let wrong = |e| match e {
            EstimateError::Pose(e) => WireError::Pose(e),
            EstimateError::Covariance(e) => WireError::Covariance(e),
        };
        let content = self.body.parse().map_err(wrong)?;
        let canonical = RawBody::of(&content).map_err(wrong)?;
        Ok((to_bytes(&canonical) == to_bytes(&self.body)).then_some(Beacon { content, raw: self }))
    }
}

impl RawBody {
    fn of(content: &BeaconContent) -> Result<Self, EstimateError> {
        let SubmapId { frame: FrameId { robot, epoch }, index } = content.anchor;
        let pose = RawBeaconPose::of(&content.t_anchor_body)?;
        Ok(Self { robot, epoch, index, stamp: content.stamp, counter: content.counter, pose })
    }

    fn parse(&self) -> Result<BeaconContent, EstimateError> {
        let frame = FrameId { robot: self.robot, epoch: self.epoch };
        Ok(BeaconContent {
            anchor: SubmapId { frame, index: self.index },
            stamp: self.stamp,
            counter: self.counter,
            t_anchor_body: self.pose.parse()?,
        })
    }

    fn signed_bytes(&self, swarm: SwarmTag) -> Vec<u8> {
        let mut bytes = SIGNING_CONTEXT.to_vec();
        bytes.extend_from_slice(&swarm.0);
        bytes.extend_from_slice(&to_bytes(self));
        bytes
    }
}
