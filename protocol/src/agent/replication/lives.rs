//! Whether robots are there now: questions to those whose beacons are heard, and answers to theirs.

use super::Replication;
use super::gossip::About;
use crate::agent::context::Context;
use crate::agent::io::QueryKind;
use crate::ids::RobotId;
use crate::time::Instant;
use crate::wire::messages::Message;
use crate::wire::{BeaconAge, Life, LifeContent, Nonce};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;

/// Proofs that are signed each second at most: whoever asks is not known, and a signature costs some 30 µs.
pub const PROOFS_PER_SEC: u32 = 50;

/// Stream of the numbers that are drawn for questions.
const NONCES: u64 = 1;

/// What questions and answers need.
pub(super) struct Lives {
    rng: ChaCha8Rng,
    /// The last beacon of ours that went out.
    pub(super) latest: Option<BeaconAge>,
    /// The second that began then, and how many proofs were signed in it.
    signed: Option<(Instant, u32)>,
}

impl Lives {
    pub(super) fn new(context: &Context) -> Self {
        Self { rng: context.rng_beside(NONCES), latest: None, signed: None }
    }
}

impl Replication {
    /// Asks a robot to prove that it is there, if there is room to speak.
    pub(super) fn ask_life(&mut self, context: &mut Context, robot: RobotId) {
        if self.may_speak(context) {
            self.beacons.asked(robot, context.now());
            let mut nonce = Nonce::default();
            self.lives.rng.fill_bytes(&mut nonce);
            self.ask(context, robot, QueryKind::Life, &Message::LifeRequest { nonce }, About::Life(nonce));
        }
    }

    /// Takes an answer. Whether it is one.
    pub(super) fn on_life(&mut self, context: &mut Context, asked: (RobotId, Nonce), life: &Life) -> bool {
        let LifeContent { robot, nonce, latest } = *life.content();
        if (robot, nonce) != asked || !self.replica.verify_life(life) {
            let detail = "it is not signed by the robot that was asked, over what was asked";
            context.reject_unsigned(asked.0, "life: signature", detail);
            return false;
        }
        if let Some(latest) = latest {
            self.beacons.prove(robot, latest, context.now());
        }
        true
    }

    /// The proof that we are there; nothing if too many were asked for.
    pub(super) fn prove_life(&mut self, context: &mut Context, nonce: Nonce) -> Option<Message> {
        let now = context.now();
        let (began, count) =
            self.lives.signed.filter(|(began, _)| now.since(*began).as_secs() == 0).unwrap_or((now, 0));
        if count >= PROOFS_PER_SEC {
            context.reject(None, "life: too many questions", "the robots that asked will ask again");
            return None;
        }
        self.lives.signed = Some((began, count + 1));
        let content = LifeContent { robot: context.robot(), nonce, latest: self.lives.latest };
        Some(Message::LifeReply(Life::sign(&context.me().key, self.replica.swarm(), content)))
    }
}
