//! Proof that a robot is there now. A beacon that was recorded can be played to a robot that was not there to hear it
//! and cannot tell; so whoever hears of a robot asks it to sign a number that it draws, with the age of its latest
//! beacon. Beacons of that age or later are of a robot that is there.

use super::entry::SwarmTag;
use super::frame::to_bytes;
use crate::ids::RobotId;
use crate::time::Stamp;
use ed25519_dalek::{Signature, Signer, SigningKey, VerifyingKey};
use serde::{Deserialize, Serialize};

/// Keeps a signature over a proof of life from standing for anything else.
const SIGNING_CONTEXT: &[u8] = b"merganser life 1\n";

/// A number that is drawn anew for each question.
pub type Nonce = [u8; 16];

/// Which of a robot's beacons is later: of a later epoch; of one, with a later stamp; of one keyframe, with a higher
/// counter, which begins anew with the process.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct BeaconAge {
    /// Epoch of its anchor.
    pub epoch: u32,
    /// Stamp of its keyframe.
    pub stamp: Stamp,
    /// Its counter.
    pub counter: u64,
}

/// What a proof of life says.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LifeContent {
    /// Who is there.
    pub robot: RobotId,
    /// The number it was asked to sign.
    pub nonce: Nonce,
    /// Its latest beacon, if it sent one since it started.
    pub latest: Option<BeaconAge>,
}

/// A signed [`LifeContent`]. Decoding does not look at the signature: [`Life::verify`] does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Life {
    content: LifeContent,
    signature: [[u8; 32]; 2],
}

impl Life {
    /// Signs a proof of life.
    pub fn sign(key: &SigningKey, swarm: SwarmTag, content: LifeContent) -> Self {
        let signature = key.sign(&signed_bytes(swarm, &content)).to_bytes();
        let half = |k: usize| core::array::from_fn(|i| signature[32 * k + i]);
        Self { content, signature: [half(0), half(1)] }
    }

    /// What it says.
    pub fn content(&self) -> &LifeContent {
        &self.content
    }

    /// Whether `key` signed this for this swarm.
    #[must_use]
    pub fn verify(&self, key: &VerifyingKey, swarm: SwarmTag) -> bool {
        let signature: [u8; 64] = core::array::from_fn(|i| self.signature[i / 32][i % 32]);
        key.verify_strict(&signed_bytes(swarm, &self.content), &Signature::from_bytes(&signature)).is_ok()
    }
}

fn signed_bytes(swarm: SwarmTag, content: &LifeContent) -> Vec<u8> {
    [SIGNING_CONTEXT, &swarm.0, &to_bytes(content)].concat()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::samples::{self, key, life};

    #[test]
    fn a_proof_stands_for_its_own_content_swarm_and_key_alone() {
        let swarm = SwarmTag::of(&samples::swarm());
        let good = life();
        let verifies = |life: &Life, n: u8, swarm| life.verify(&key(n).verifying_key(), swarm);
        assert!(verifies(&good, 0, swarm));
        assert!(!verifies(&good, 1, swarm));
        assert!(!verifies(&good, 0, SwarmTag::of(&crate::ids::Name::new("other").unwrap())));
        let mut other = good;
        other.content.nonce[0] ^= 1;
        assert!(!verifies(&other, 0, swarm));
        other = good;
        other.content.latest = None;
        assert!(!verifies(&other, 0, swarm));
    }
}
