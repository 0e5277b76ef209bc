//! A journal of everything that happened to an agent: with it, and the same key, the core can be run again to the bit,
//! so that a bug seen in the field becomes a test.
//!
//! A file is a sequence of frames, each a little-endian `u32` length and a postcard [`Frame`]: first the [`Start`],
//! then every input with its moment, at the end the digest that the live run came to. Results of jobs are not written:
//! a job is a pure function of its data, so the replay runs it again. A frame that a crash cut short ends the journal.

use crate::observation::{KeyframeMessage, ObservationError};
use merganser_protocol::agent::io::{
    AskToken, Channel, Command, Input, JobId, PositionSighting, QueryId, QueryKind, Record, Sighting,
};
use merganser_protocol::agent::{Identity, Restored};
use merganser_protocol::config::Config;
use merganser_protocol::ids::{EntryId, FrameId, Hash, Name, RobotId, SubmapId};
use merganser_protocol::submap::Loss;
use merganser_protocol::time::Instant;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufReader, BufWriter, Read, Write};
use std::path::Path;
use thiserror::Error;

/// Version of the format.
const VERSION: u32 = 5;
/// Largest frame read, in bytes: a keyframe of [`crate::observation::POINTS_MAX`] points is 4.8 MB, a restored store
/// may be more.
const FRAME_LEN_MAX: u32 = 1 << 30;

/// What an agent began with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Start {
    /// Version of the format.
    pub version: u32,
    /// The core's configuration, with all overrides.
    pub config: Config,
    /// The swarm.
    pub swarm: Name,
    /// The robot.
    pub robot: Name,
    /// Names and public keys.
    pub roster: BTreeMap<Name, [u8; 32]>,
    /// The core's seed.
    pub seed: u64,
    /// The epoch offered for an empty store.
    pub fresh_epoch: u32,
    /// What the store held.
    pub restored: Vec<StoredRecord>,
    /// The moment of the start.
    pub now: Instant,
}

impl Start {
    /// The start of a run.
    pub fn new(config: &Config, identity: &Identity, seed: u64, restored: &Restored, now: Instant) -> Self {
        Self {
            version: VERSION,
            config: config.clone(),
            swarm: identity.swarm.clone(),
            robot: identity.name.clone(),
            roster: identity.roster.clone(),
            seed,
            fresh_epoch: restored.fresh_epoch,
            restored: restored.records.iter().map(Into::into).collect(),
            now,
        }
    }
}

/// A [`Record`] as it is written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum StoredRecord {
    /// A log entry.
    Entry(EntryId, Vec<u8>),
    /// A keypoint blob.
    Blob(Hash, Vec<u8>),
    /// Features and cloud of an own submap.
    Private(SubmapId, Vec<u8>),
    /// Proof that a log has two histories.
    Fork(FrameId, [Vec<u8>; 2]),
    /// Own epochs that must not be continued.
    EpochClosed(u32),
    /// What a log's writer has replaced.
    Replaced(EntryId, Vec<SubmapId>, Vec<Hash>),
    /// The front end's run of an own epoch, and those that are over.
    Session(u32, u64, Vec<u64>),
    /// A pair that was refused, and what that rests on.
    Refused(SubmapId, SubmapId, Option<u64>),
    /// A log that its writer gave up.
    Retired(FrameId, Vec<SubmapId>, Vec<Hash>),
}

impl From<&Record> for StoredRecord {
    fn from(record: &Record) -> Self {
        match record {
            Record::Entry { id, bytes } => Self::Entry(*id, bytes.clone()),
            Record::Blob { hash, bytes } => Self::Blob(*hash, bytes.clone()),
            Record::Private { submap, bytes } => Self::Private(*submap, bytes.clone()),
            Record::Fork { frame, proof } => Self::Fork(*frame, proof.clone()),
            Record::EpochClosed { epoch } => Self::EpochClosed(*epoch),
            Record::Replaced { below, submaps, blobs } => Self::Replaced(*below, submaps.clone(), blobs.clone()),
            Record::Session { epoch, session, over } => Self::Session(*epoch, *session, over.clone()),
            Record::Refused { i, j, evidence } => Self::Refused(*i, *j, *evidence),
            Record::Retired { frame, submaps, blobs } => Self::Retired(*frame, submaps.clone(), blobs.clone()),
        }
    }
}

impl From<StoredRecord> for Record {
    fn from(record: StoredRecord) -> Self {
        match record {
            StoredRecord::Entry(id, bytes) => Self::Entry { id, bytes },
            StoredRecord::Blob(hash, bytes) => Self::Blob { hash, bytes },
            StoredRecord::Private(submap, bytes) => Self::Private { submap, bytes },
            StoredRecord::Fork(frame, proof) => Self::Fork { frame, proof },
            StoredRecord::EpochClosed(epoch) => Self::EpochClosed { epoch },
            StoredRecord::Replaced(below, submaps, blobs) => Self::Replaced { below, submaps, blobs },
            StoredRecord::Session(epoch, session, over) => Self::Session { epoch, session, over },
            StoredRecord::Refused(i, j, evidence) => Self::Refused { i, j, evidence },
            StoredRecord::Retired(frame, submaps, blobs) => Self::Retired { frame, submaps, blobs },
        }
    }
}

/// An [`Input`] as it is written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum StoredInput {
    /// See [`Input::Keyframe`].
    Keyframe(Box<KeyframeMessage>),
    /// See [`Input::Sighting`].
    Sighting(Sighting),
    /// See [`Input::Received`].
    Received(RobotId, Channel, Vec<u8>),
    /// See [`Input::Asked`].
    Asked(AskToken, QueryKind, Vec<u8>),
    /// See [`Input::Answered`].
    Answered(QueryId, Option<Vec<u8>>),
    /// See [`Input::Neighbour`].
    Neighbour(RobotId, bool),
    /// See [`Input::Persisted`].
    Persisted(u64),
    /// See [`Input::PersistFailed`].
    PersistFailed(u64, String),
    /// See [`Input::JobDone`]; the result is computed again.
    JobDone(JobId),
    /// See [`Input::Timeout`].
    Timeout,
    /// See [`Input::Command`].
    Command(Command),
    /// See [`Input::Position`].
    Position(PositionSighting),
    /// See [`Input::KeyframesLost`].
    KeyframesLost(Loss, u64),
}

impl From<&Input> for StoredInput {
    fn from(input: &Input) -> Self {
        match input {
            Input::Keyframe(keyframe) => Self::Keyframe(Box::new(keyframe.into())),
            Input::Sighting(sighting) => Self::Sighting(sighting.clone()),
            Input::Received { from, channel, bytes } => Self::Received(*from, *channel, bytes.clone()),
            Input::Asked { token, kind, bytes } => Self::Asked(*token, *kind, bytes.clone()),
            Input::Answered { query, bytes } => Self::Answered(*query, bytes.clone()),
            Input::Neighbour { robot, up } => Self::Neighbour(*robot, *up),
            Input::Persisted { up_to } => Self::Persisted(*up_to),
            Input::PersistFailed { batch, reason } => Self::PersistFailed(*batch, reason.clone()),
            Input::JobDone { job, .. } => Self::JobDone(*job),
            Input::Timeout => Self::Timeout,
            Input::Command(command) => Self::Command(*command),
            Input::Position(sighting) => Self::Position(sighting.clone()),
            Input::KeyframesLost { why, count } => Self::KeyframesLost(*why, *count),
        }
    }
}

/// What a stored input means: an input, or a job whose result is to be computed.
#[derive(Debug)]
pub enum Replayed {
    /// Hand it to the core.
    Input(Box<Input>),
    /// Run this job, then hand its result to the core.
    JobDone(JobId),
}

impl StoredInput {
    /// The input itself.
    ///
    /// # Errors
    /// [`ObservationError`] if a keyframe does not pass its checks: the journal was damaged.
    pub fn replayed(self) -> Result<Replayed, ObservationError> {
        Ok(Replayed::Input(Box::new(match self {
            Self::Keyframe(message) => Input::Keyframe((*message).try_into()?),
            Self::Sighting(sighting) => Input::Sighting(sighting),
            Self::Received(from, channel, bytes) => Input::Received { from, channel, bytes },
            Self::Asked(token, kind, bytes) => Input::Asked { token, kind, bytes },
            Self::Answered(query, bytes) => Input::Answered { query, bytes },
            Self::Neighbour(robot, up) => Input::Neighbour { robot, up },
            Self::Persisted(up_to) => Input::Persisted { up_to },
            Self::PersistFailed(batch, reason) => Input::PersistFailed { batch, reason },
            Self::JobDone(job) => return Ok(Replayed::JobDone(job)),
            Self::Timeout => Input::Timeout,
            Self::Command(command) => Input::Command(command),
            Self::Position(sighting) => Input::Position(sighting),
            Self::KeyframesLost(why, count) => Input::KeyframesLost { why, count },
        })))
    }
}

/// One frame of a journal.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Frame {
    /// The first.
    Start(Box<Start>),
    /// Something happened.
    Input(Instant, Box<StoredInput>),
    /// The last of a run that ended in order, with the digest of its set of facts.
    End(Instant, Hash),
}

/// Why a journal cannot be read.
#[derive(Debug, Error)]
pub enum JournalError {
    /// The file cannot be read.
    #[error("journal: {0}")]
    Io(#[from] io::Error),
    /// A frame makes no sense.
    #[error("journal, frame {frame}: {reason}; was it written by this version?")]
    Frame {
        /// Which, from 0.
        frame: u64,
        /// What is wrong.
        reason: String,
    },
    /// The first frame is no start, or of another version.
    #[error("this file is no journal of version {VERSION}")]
    NotAJournal,
}

/// Writes a journal. Bytes reach the file when the buffer is full, on [`Writer::flush`] and at the end.
#[derive(Debug)]
pub struct Writer {
    file: BufWriter<File>,
}

impl Writer {
    /// Begins a journal in a new file (an existing one is replaced).
    ///
    /// # Errors
    /// Any of the file system.
    pub fn create(path: &Path, start: Start) -> io::Result<Self> {
        let mut writer = Self { file: BufWriter::with_capacity(1 << 16, File::create(path)?) };
        writer.write(&Frame::Start(Box::new(start)))?;
        Ok(writer)
    }

    /// Appends a frame.
    ///
    /// # Errors
    /// Any of the file system.
    pub fn write(&mut self, frame: &Frame) -> io::Result<()> {
        let bytes = postcard::to_stdvec(frame).map_err(io::Error::other)?;
        let length = u32::try_from(bytes.len()).map_err(io::Error::other)?;
        self.file.write_all(&length.to_le_bytes())?;
        self.file.write_all(&bytes)
    }

    /// Hands what is buffered to the system.
    ///
    /// # Errors
    /// Any of the file system.
    pub fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// Reads a journal, frame by frame.
#[derive(Debug)]
pub struct Reader {
    file: BufReader<File>,
    frame: u64,
}

impl Reader {
    /// Opens a journal and reads its start.
    ///
    /// # Errors
    /// [`JournalError`].
    pub fn open(path: &Path) -> Result<(Start, Self), JournalError> {
        let mut reader = Self { file: BufReader::with_capacity(1 << 16, File::open(path)?), frame: 0 };
        match reader.next_frame() {
            Ok(Some(Frame::Start(start))) if start.version == VERSION => Ok((*start, reader)),
            Err(JournalError::Io(error)) => Err(error.into()),
            _ => Err(JournalError::NotAJournal),
        }
    }

    /// The next frame; `None` at the end, or where a crash cut the file.
    ///
    /// # Errors
    /// [`JournalError`].
    pub fn next_frame(&mut self) -> Result<Option<Frame>, JournalError> {
        let mut length = [0; 4];
        if !self.fill(&mut length)? {
            return Ok(None);
        }
        let length = u32::from_le_bytes(length);
        if length > FRAME_LEN_MAX {
            return Err(self.bad(format!("claims {length} bytes")));
        }
        let mut bytes = Vec::new(); // grows with what is really there, not with what is claimed
        (&mut self.file).take(u64::from(length)).read_to_end(&mut bytes)?;
        if bytes.len() < length as usize {
            return Ok(None);
        }
        let frame = match postcard::take_from_bytes(&bytes) {
            Ok((frame, [])) => frame,
            Ok((_, rest)) => return Err(self.bad(format!("{} bytes too many", rest.len()))),
            Err(error) => return Err(self.bad(error.to_string())),
        };
        self.frame += 1;
        Ok(Some(frame))
    }

    fn fill(&mut self, bytes: &mut [u8]) -> Result<bool, JournalError> {
        match self.file.read_exact(bytes) {
            Ok(()) => Ok(true),
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Ok(false),
            Err(error) => Err(error.into()),
        }
    }

    fn bad(&self, reason: String) -> JournalError {
        JournalError::Frame { frame: self.frame, reason }
    }
}
