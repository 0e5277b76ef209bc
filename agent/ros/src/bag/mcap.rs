//! MCAP, by the `mcap` crate's reader from front to back, which needs no index: chunks (zstd, lz4, unpacked) are
//! checked by their sums before anything of them is used.

use super::{BagError, BagProblem, CHUNK_BYTES_MAX, Damage, Flow, MESSAGE_BYTES_MAX, Record, Topics};
use crate::wire::{Field as _, Ros1Reader, Serialization, Source as _};
use mcap::McapError;
use mcap::records::op;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read as _};
use std::path::Path;

/// Schemas and channels by their numbers, as met so far.
#[derive(Default)]
struct Known {
    schemas: BTreeMap<u16, String>,
    channels: BTreeMap<u16, usize>,
}

pub(super) fn scan(
    path: &Path,
    topics: &mut Topics,
    damage: &mut Damage,
    each: &mut dyn FnMut(Record<'_>) -> Flow,
) -> Result<Flow, BagError> {
    let told = |error: std::io::Error| BagProblem::Io(error).of(path);
    let mut file = BufReader::with_capacity(1 << 20, File::open(path).map_err(told)?);
    let options = LinearReaderOptions::default().with_prevalidate_chunk_crcs(true);
    let mut reader = LinearReader::new_with_options(options.with_record_length_limit(CHUNK_BYTES_MAX));
    let mut known = Known::default();
    let mut any = false;
    while let Some(event) = reader.next_event() {
        match event {
            Ok(LinearReadEvent::ReadRequest(wanted)) => {
                let read = file.read(reader.insert(wanted)).map_err(told)?;
                reader.notify_read(read);
            }
            Ok(LinearReadEvent::Record { opcode, data }) => {
                match known.take(opcode, data, topics, damage) {
                    Ok(Some(record)) if each(record) == Flow::Stop => return Ok(Flow::Stop),
                    Ok(_) => any = true,
                    Err(Refusal::Bag(problem)) => return Err(problem.of(path)),
                    Err(Refusal::Record) => damage.lost += 1,
                }
                // What follows says nothing new.
                if opcode == op::DATA_END {
                    return Ok(Flow::On);
                }
            }
            Err(McapError::UnsupportedCompression(by)) => return Err(BagProblem::Compression(by).of(path)),
            Err(error) if any => {
                damage.stop(path, stopped(&error));
                return Ok(Flow::On);
            }
            Err(error) => return Err(BagProblem::Damaged(error.to_string(), "mcap recover").of(path)),
        }
    }
    Ok(Flow::On)
}

fn stopped(error: &McapError) -> String {
    match error {
        McapError::UnexpectedEof => "ends early, in the middle of a record: was the recorder stopped?".into(),
        McapError::BadChunkCrc { .. } => "a chunk does not have the sum that it states: is the file damaged?".into(),
        other => format!("cannot be read on: {other}"),
    }
}

enum Refusal {
    /// Of the bag as a whole.
    Bag(BagProblem),
    /// Of this record.
    Record,
}

impl Known {
    fn take<'a>(
        &mut self,
        opcode: u8,
        data: &'a [u8],
        topics: &mut Topics,
        damage: &mut Damage,
    ) -> Result<Option<Record<'a>>, Refusal> {
        // Nothing else is parsed: attachments may be long, and of indices we have no need. The crate's own parser takes
        // memory for any length that a text claims, up to 4 GB; ROS 1 writes numbers and texts alike.
        let mut fields = Ros1Reader::new(data);
        let number = |fields: &mut Ros1Reader<'_>| fields.u16("id").map_err(|_| Refusal::Record);
        let text = |fields: &mut Ros1Reader<'_>| String::read(fields, "text").map_err(|_| Refusal::Record);
        match opcode {
            op::SCHEMA => {
                let id = number(&mut fields)?;
                self.schemas.insert(id, text(&mut fields)?);
            }
            op::CHANNEL => {
                let (id, schema) = (number(&mut fields)?, number(&mut fields)?);
                let (topic, encoding) = (text(&mut fields)?, text(&mut fields)?);
                let kind = self.schemas.get(&schema).map_or("", String::as_str);
                let serialization = match encoding.as_str() {
                    "cdr" => Some(Serialization::Cdr),
                    "ros1" => Some(Serialization::Ros1),
                    _ => None,
                };
                let index = topics.index(&topic, kind, serialization).map_err(Refusal::Bag)?;
                self.channels.insert(id, index);
            }
            op::MESSAGE => {
                let channel = number(&mut fields)?;
                let topic = *self.channels.get(&channel).ok_or(Refusal::Record)?;
                fields.u32("sequence").map_err(|_| Refusal::Record)?;
                let received = fields.u64("log_time").map_err(|_| Refusal::Record)?;
                fields.u64("publish_time").map_err(|_| Refusal::Record)?;
                let left = fields.left();
                if left > MESSAGE_BYTES_MAX {
                    damage.long += 1;
                    return Ok(None);
                }
                let bytes = fields.raw("data", left).map_err(|_| Refusal::Record)?;
                let received_ns = i64::try_from(received).unwrap_or(i64::MAX);
                return Ok(Some(Record { topic, received_ns, bytes }));
            }
            _ => {}
        }
        Ok(None)
    }
}
