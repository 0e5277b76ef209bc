//! The trace of a run: BLAKE3 over every input and output of every robot, in order, with its virtual time. Same seed,
//! same hash; two runs that differ anywhere differ here.

use merganser_protocol::agent::io::{Input, Output, Record};
use merganser_protocol::ids::Hash;
use merganser_protocol::submap::Keyframe;
use merganser_protocol::time::Instant;

/// The running hash.
#[derive(Clone, Debug, Default)]
pub struct Trace {
    hasher: blake3::Hasher,
    lines: u64,
}

impl Trace {
    /// A robot took an input.
    pub fn input(&mut self, now: Instant, robot: usize, input: &Input) {
        match input {
            Input::Keyframe(keyframe) => self.line(now, robot, "keyframe", &[&keyframe_digest(keyframe)]),
            Input::KeyframesLost { why, count } => {
                self.line(now, robot, "keyframes lost", &[why.name().as_bytes(), &count.to_le_bytes()]);
            }
            Input::Sighting(s) => self.line(now, robot, "sighting", &[format!("{s:?}").as_bytes()]),
            Input::Position(s) => self.line(now, robot, "position", &[format!("{s:?}").as_bytes()]),
            Input::Received { from, channel, bytes } => {
                self.line(now, robot, "received", &[&from.0, &[*channel as u8], bytes]);
            }
            Input::Asked { token, kind, bytes } => {
                self.line(now, robot, "asked", &[&token.0.to_le_bytes(), &[*kind as u8], bytes]);
            }
            Input::Answered { query, bytes } => {
                let body = bytes.as_deref().unwrap_or_default();
                self.line(now, robot, "answered", &[&query.0.to_le_bytes(), &[u8::from(bytes.is_some())], body]);
            }
            Input::Neighbour { robot: peer, up } => self.line(now, robot, "neighbour", &[&peer.0, &[u8::from(*up)]]),
            Input::Persisted { up_to } => self.line(now, robot, "persisted", &[&up_to.to_le_bytes()]),
            Input::PersistFailed { batch, .. } => self.line(now, robot, "persist failed", &[&batch.to_le_bytes()]),
            // What the result holds shows in the outputs it causes.
            Input::JobDone { job, .. } => self.line(now, robot, "job done", &[&job.0.to_le_bytes()]),
            Input::Timeout => self.line(now, robot, "timeout", &[]),
            Input::Command(command) => self.line(now, robot, "command", &[format!("{command:?}").as_bytes()]),
        }
    }

    /// A robot made an output.
    pub fn output(&mut self, now: Instant, robot: usize, output: &Output) {
        match output {
            Output::Persist { batch, records } => {
                let digest = records_digest(records);
                self.line(now, robot, "persist", &[&batch.to_le_bytes(), &digest]);
            }
            Output::Publish { channel, bytes } => self.line(now, robot, "publish", &[&[*channel as u8], bytes]),
            Output::Ask { query, peer, kind, bytes } => {
                self.line(now, robot, "ask", &[&query.0.to_le_bytes(), &peer.0, &[*kind as u8], bytes]);
            }
            Output::Answer { token, bytes } => self.line(now, robot, "answer", &[&token.0.to_le_bytes(), bytes]),
            Output::Run { id, job } => self.line(now, robot, "run", &[&id.0.to_le_bytes(), job.kind().as_bytes()]),
            Output::Event(event) => self.line(now, robot, "event", &[format!("{event:?}").as_bytes()]),
        }
    }

    /// Something else that must not differ between two runs.
    pub fn note(&mut self, now: Instant, robot: usize, what: &str) {
        self.line(now, robot, what, &[]);
    }

    /// The hash so far.
    pub fn hash(&self) -> Hash {
        Hash(*self.hasher.finalize().as_bytes())
    }

    /// How many inputs and outputs it covers.
    pub fn lines(&self) -> u64 {
        self.lines
    }

    /// Lengths go before contents, so that no two traces share one encoding.
    fn line(&mut self, now: Instant, robot: usize, what: &str, parts: &[&[u8]]) {
        self.lines += 1;
        self.hasher.update(&now.as_nanos().to_le_bytes());
        self.hasher.update(&(robot as u64).to_le_bytes());
        for part in [what.as_bytes()].iter().chain(parts) {
            self.hasher.update(&(part.len() as u64).to_le_bytes());
            self.hasher.update(part);
        }
    }
}

fn keyframe_digest(keyframe: &Keyframe) -> [u8; 32] {
    let mut hasher = blake3::Hasher::new();
    hasher.update(&keyframe.stamp.0.to_le_bytes());
    let pose = &keyframe.pose.pose;
    let floats = pose.translation.iter().copied().chain(pose.rotation.xyzw());
    for x in floats.chain(keyframe.pose.covariance.matrix().iter().copied()) {
        hasher.update(&x.to_bits().to_le_bytes());
    }
    let place = keyframe.place.iter().flat_map(|place| place.vector());
    for x in keyframe.points.iter().flatten().chain(place) {
        hasher.update(&x.to_bits().to_le_bytes());
    }
    *hasher.finalize().as_bytes()
}

fn records_digest(records: &[Record]) -> [u8; 32] {
    let mut hasher = blake3::Hasher::new();
    for record in records {
        let (kind, bytes) = match record {
            Record::Entry { id, bytes } => (format!("entry {id}"), &bytes[..]),
            Record::Blob { hash, bytes } => (format!("blob {hash}"), &bytes[..]),
            Record::Private { submap, bytes } => (format!("private {submap}"), &bytes[..]),
            Record::Fork { frame, proof } => (format!("fork {frame}"), &proof[1][..]),
            Record::EpochClosed { epoch } => (format!("closed {epoch}"), &[][..]),
            Record::Session { epoch, session, over } => (format!("session {epoch}: {session} {over:?}"), &[][..]),
            Record::Refused { i, j, evidence } => (format!("refused {i} {j}: {evidence:?}"), &[][..]),
            Record::Replaced { below, submaps, blobs } => (format!("below {below}: {submaps:?} {blobs:?}"), &[][..]),
            Record::Retired { frame, submaps, blobs } => (format!("retired {frame}: {submaps:?} {blobs:?}"), &[][..]),
        };
        for part in [kind.as_bytes(), bytes] {
            hasher.update(&(part.len() as u64).to_le_bytes());
            hasher.update(part);
        }
    }
    *hasher.finalize().as_bytes()
}
