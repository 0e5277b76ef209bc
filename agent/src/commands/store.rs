//! `merganser store`: a look into a robot's store while its agent does not run. Nothing is mended here: the agent does
//! that when it starts.

use super::say;
use crate::config::FileConfig;
use crate::store::owner;
use anyhow::{Context, Result, bail};
use clap::{Subcommand, ValueEnum};
use ed25519_dalek::VerifyingKey;
use merganser_protocol::agent::io::Record;
use merganser_protocol::ids::{EntryId, FrameId, RobotId};
use merganser_protocol::replica::Replica;
use merganser_protocol::submap::{Features, Keypoints};
use merganser_protocol::wire::{Entry, EntryBytes};
use merganser_store::{FileMedium, Inspection, SCHEMA, Schema, inspect};
use std::collections::BTreeMap;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

/// Bytes of a refused pair: two submaps, and a digest.
const REFUSED_LEN: usize = 40;

/// What `merganser store` can be told.
#[derive(Clone, Debug, Subcommand)]
pub enum StoreCommand {
    /// Check every record: seals, hashes, signatures and chains, against the roster.
    ///
    /// Prints what is wrong, a line each, and exits with 1 if anything is. Changes nothing: an agent that starts on a
    /// damaged store drops what is damaged and fetches it again from its peers.
    Verify(StoreArgs),
    /// Print what the store holds: logs, entries, bytes.
    Stats(StoreArgs),
    /// Write all sound entries to a file.
    Export(ExportArgs),
}

/// Which store.
#[derive(Clone, Debug, clap::Args)]
pub struct StoreArgs {
    /// The configuration file of the robot.
    #[arg(long, short, value_name = "FILE")]
    pub config: PathBuf,
}

/// What to export, and where to.
#[derive(Clone, Debug, clap::Args)]
pub struct ExportArgs {
    /// The configuration file of the robot.
    #[arg(long, short, value_name = "FILE")]
    pub config: PathBuf,
    /// The file to write; it must not exist.
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// How entries are written.
    #[arg(long, value_enum, default_value_t = Format::Json)]
    pub format: Format,
}

/// How entries are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// A JSON object a line, facts decoded.
    Json,
    /// Canonical bytes, each entry after its length (4 bytes, little-endian).
    Raw,
}

/// Verifies, counts or exports.
///
/// # Errors
/// If the configuration or the store cannot be read, or the file cannot be written.
pub fn run(command: &StoreCommand) -> Result<bool> {
    match command {
        StoreCommand::Verify(args) => verify(&args.config),
        StoreCommand::Stats(args) => stats(&args.config),
        StoreCommand::Export(args) => export(args),
    }
}

fn open(config: &Path) -> Result<(FileConfig, Inspection)> {
    let config = FileConfig::load(config)?;
    let path = &config.store.path;
    if !path.exists() {
        bail!("store {}: there is none yet; the agent makes it when it first runs", path.display());
    }
    let seen = inspect(&FileMedium::new(path))?;
    match &seen.schema {
        Schema::Version(version) if (1..=SCHEMA).contains(version) => {}
        Schema::Version(version) => bail!("store {}: schema {version}, this program reads {SCHEMA}", path.display()),
        Schema::Unknown(found) => bail!("store {}: a schema {found}", path.display()),
        Schema::New => bail!("store {}: it is empty", path.display()),
    }
    let wanted = owner(&config);
    let wanted = format!("{}/{}", wanted.swarm, wanted.robot);
    match &seen.owner {
        Some(found) if *found != wanted => {
            bail!("store {} belongs to {found}, the configuration to {wanted}", path.display())
        }
        _ => Ok((config, seen)),
    }
}

fn verify(config: &Path) -> Result<bool> {
    let (config, seen) = open(config)?;
    let mut wrong: Vec<String> = seen.damaged.iter().map(|d| format!("{}: {}: {}", d.table, d.what, d.why)).collect();
    let unlisted = seen.damaged_count - seen.damaged.len();
    let keys = keys(&config)?;
    let mut entries = Vec::new();
    let (mut blobs, mut private, mut forks) = (0, 0, 0);
    let mut proofs = Vec::new();
    for record in &seen.records {
        match record {
            Record::Entry { id, bytes } => {
                wrong.extend(wrong_entry(*id, bytes, &keys).map(|why| format!("entries: {id}: {why}")));
                entries.push(bytes.clone());
            }
            Record::Blob { hash, bytes } => {
                blobs += 1;
                wrong.extend(Keypoints::decode(bytes).err().map(|why| format!("blobs: {hash}: {why}")));
            }
            Record::Private { submap, bytes } => {
                private += 1;
                wrong.extend(Features::decode(bytes).err().map(|why| format!("private: {submap}: {why}")));
            }
            Record::Fork { frame, proof: [a, b] } => {
                forks += 1;
                proofs.push((*frame, a.clone(), b.clone()));
            }
            // Their seals are all that can be wrong with them.
            Record::EpochClosed { .. }
            | Record::Session { .. }
            | Record::Refused { .. }
            | Record::Replaced { .. }
            | Record::Retired { .. } => {}
        }
    }
    let count = entries.len();
    let roster = config.roster.iter().map(|(name, key)| (name.clone(), key.to_bytes()));
    let mut replica = Replica::new(&config.swarm, roster, &config.core.gossip)?;
    if let Err(error) = replica.restore(entries) {
        for damage in error.damaged {
            let what = damage.id.map_or_else(|| "an entry".into(), |id| id.to_string());
            let why = damage.why.map_or_else(|| "an entry before it is missing or damaged".into(), |e| e.to_string());
            wrong.push(format!("chain: {what}: {why}"));
        }
    }
    // A fork that was noticed and proven is somebody's fault, not the store's.
    for (frame, _) in replica.forks() {
        wrong.push(format!("chain: log {frame} has two histories"));
    }
    for (frame, a, b) in proofs {
        wrong.extend(replica.ingest_fork(&a, &b).err().map(|why| format!("forks: {frame}: {why}")));
    }
    for line in &wrong {
        say(line)?;
    }
    if unlisted > 0 {
        say(&format!("…and {unlisted} more"))?;
    }
    let verdict = match wrong.len() + unlisted {
        0 => "sound".into(),
        n => format!("{n} wrong"),
    };
    say(&format!(
        "store {}: {count} entries, {blobs} blobs, {private} private records, {forks} forks: {verdict}",
        place(&config)
    ))?;
    Ok(wrong.is_empty())
}

/// What is wrong with an entry by itself: its form, its place, its swarm, its signature.
fn wrong_entry(id: EntryId, bytes: &[u8], keys: &BTreeMap<RobotId, VerifyingKey>) -> Option<String> {
    let entry = match Entry::decode(bytes) {
        Ok(entry) => entry,
        Err(error) => return Some(error.to_string()),
    };
    if entry.id() != id {
        return Some(format!("it is entry {}", entry.id()));
    }
    let Some(key) = keys.get(&id.frame.robot) else {
        return Some("its origin is not in the roster".into());
    };
    entry.verify(key).err().map(|error| error.to_string())
}

fn keys(config: &FileConfig) -> Result<BTreeMap<RobotId, VerifyingKey>> {
    let key = |bytes: [u8; 32]| Ok((RobotId::of_key(&bytes), VerifyingKey::from_bytes(&bytes)?));
    config.roster.values().map(|public| key(public.to_bytes())).collect()
}

fn stats(config: &Path) -> Result<bool> {
    let (config, seen) = open(config)?;
    let mut logs: BTreeMap<FrameId, (u64, u64)> = BTreeMap::new();
    let mut others = BTreeMap::from(["blobs", "forks", "private", "refused"].map(|name| (name, (0, 0))));
    for record in &seen.records {
        let (row, bytes): (&mut (u64, u64), _) = match record {
            Record::Entry { id, bytes } => (logs.entry(id.frame).or_default(), bytes.len()),
            Record::Blob { bytes, .. } => (others.entry("blobs").or_default(), bytes.len()),
            Record::Private { bytes, .. } => (others.entry("private").or_default(), bytes.len()),
            Record::Fork { proof: [a, b], .. } => (others.entry("forks").or_default(), a.len() + b.len()),
            Record::Refused { .. } => (others.entry("refused").or_default(), REFUSED_LEN),
            Record::EpochClosed { .. } | Record::Session { .. } | Record::Replaced { .. } | Record::Retired { .. } => {
                continue;
            }
        };
        row.0 += 1;
        row.1 += bytes as u64;
    }
    let names: BTreeMap<RobotId, _> =
        config.roster.iter().map(|(name, key)| (RobotId::of_key(&key.to_bytes()), name)).collect();
    let schema = match seen.schema {
        Schema::Version(version) => version.to_string(),
        _ => "unknown".into(),
    };
    say(&format!(
        "store {}: schema {schema}, of {}, {} bytes on disk, {} damaged",
        place(&config),
        seen.owner.as_deref().unwrap_or("nobody known"),
        std::fs::metadata(&config.store.path).map_or(0, |file| file.len()),
        seen.damaged_count
    ))?;
    say(&format!("{:<40} {:>8} {:>12}", "log", "entries", "bytes"))?;
    let mut total = (0, 0);
    for (frame, (entries, bytes)) in &logs {
        let name = names.get(&frame.robot).map_or_else(|| frame.robot.to_string(), ToString::to_string);
        say(&format!("{:<40} {entries:>8} {bytes:>12}", format!("{name}/{}", frame.epoch)))?;
        total = (total.0 + entries, total.1 + bytes);
    }
    say(&format!("{:<40} {:>8} {:>12}", format!("{} logs", logs.len()), total.0, total.1))?;
    for (name, (records, bytes)) in others {
        say(&format!("{name:<40} {records:>8} {bytes:>12}"))?;
    }
    Ok(true)
}

fn export(args: &ExportArgs) -> Result<bool> {
    let (config, seen) = open(&args.config)?;
    let out = args.out.display();
    let file = std::fs::File::create_new(&args.out).with_context(|| format!("cannot make {out}"))?;
    let mut file = BufWriter::new(file);
    let mut count = 0_u64;
    for record in &seen.records {
        let Record::Entry { bytes, .. } = record else { continue };
        let written = match args.format {
            Format::Json => writeln!(file, "{}", serde_json::to_string(&EntryBytes(bytes.clone()))?),
            Format::Raw => {
                let length = u32::try_from(bytes.len()).context("an entry of 4 GiB")?;
                file.write_all(&length.to_le_bytes()).and_then(|()| file.write_all(bytes))
            }
        };
        written.with_context(|| format!("cannot write {out}"))?;
        count += 1;
    }
    let synced = file.into_inner().map_err(|error| error.into_error()).and_then(|file| file.sync_all());
    synced.with_context(|| format!("cannot write {out}"))?;
    say(&format!("{count} entries of store {} written to {out}", place(&config)))?;
    if seen.damaged_count > 0 {
        say(&format!("{} damaged records were left out; see `merganser store verify`", seen.damaged_count))?;
    }
    Ok(seen.damaged_count == 0)
}

fn place(config: &FileConfig) -> impl std::fmt::Display + '_ {
    config.store.path.display()
}
