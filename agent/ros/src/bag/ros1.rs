//! ROS 1 bags of format 2.0, from front to back, without their index: so one that was cut, or never closed, is read
//! as far as it goes. Records are a header of fields `name=value` and data; messages and connections stand in chunks
//! (`none`, `bz2`, `lz4`). A reader of our own: the one crate there is (`rosbag` 0.6) trusts offsets and lengths in
//! the file.

use super::{
    BagError, BagProblem, CHUNK_BYTES_MAX, Damage, Flow, MESSAGE_BYTES_MAX, RECORD_HEADER_BYTES_MAX, Record, Topics,
};
use crate::wire::Serialization;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

/// The first line of a bag.
pub(super) const MAGIC: &[u8] = b"#ROSBAG V2.0\n";

/// What a record is (its field `op`).
const MESSAGE: u8 = 2;
const CHUNK: u8 = 5;
const CONNECTION: u8 = 7;

pub(super) fn scan(
    path: &Path,
    topics: &mut Topics,
    damage: &mut Damage,
    each: &mut dyn FnMut(Record<'_>) -> Flow,
) -> Result<Flow, BagError> {
    let told = |error: std::io::Error| BagProblem::Io(error).of(path);
    let mut file = BufReader::with_capacity(1 << 20, File::open(path).map_err(told)?);
    let mut connections = BTreeMap::new();
    let mut magic = [0; MAGIC.len()];
    file.read_exact(&mut magic).map_err(told)?;
    let mut any = false;
    loop {
        let (header, data) = match record(&mut file).map_err(told)? {
            Ok(Some(record)) => record,
            Ok(None) => return Ok(Flow::On),
            Err(why) if any => {
                damage.stop(path, why);
                return Ok(Flow::On);
            }
            Err(why) => return Err(BagProblem::Damaged(why, "rosbag reindex").of(path)),
        };
        any = true;
        let mut reader = Reader { topics, connections: &mut connections, damage, each };
        match operation(&header) {
            Some(CHUNK) => match unpack(&header, &data) {
                Ok(records) => match reader.chunk(&records) {
                    Ok(Flow::On) => {}
                    Ok(Flow::Stop) => return Ok(Flow::Stop),
                    Err(Refusal::Bag(problem)) => return Err(problem.of(path)),
                    Err(Refusal::Chunk(why)) => damage.stop(path, why),
                },
                Err(Unpack::Unknown(by)) => return Err(BagProblem::Compression(by).of(path)),
                Err(Unpack::Damaged(why)) => damage.stop(path, format!("a chunk is left out: {why}")),
            },
            // At the end all connections stand once more; in an unchunked bag they and messages stand alone.
            Some(CONNECTION | MESSAGE) => match reader.record(&header, &data) {
                Ok(Flow::On) => {}
                Ok(Flow::Stop) => return Ok(Flow::Stop),
                Err(Refusal::Bag(problem)) => return Err(problem.of(path)),
                Err(Refusal::Chunk(why)) => damage.stop(path, why),
            },
            _ => {}
        }
    }
}

type Fields<'a> = BTreeMap<&'a [u8], &'a [u8]>;

/// Header and data of a record, `None` at the end of the file, or why there is none before it.
type Next = Result<Option<(Vec<u8>, Vec<u8>)>, String>;

/// The next record of the file; the inner error tells why there is none though the file goes on.
fn record(file: &mut impl Read) -> std::io::Result<Next> {
    let header = match part(file, RECORD_HEADER_BYTES_MAX)? {
        Part::Whole(header) => header,
        Part::End => return Ok(Ok(None)),
        Part::Cut => return Ok(Err(CUT.into())),
        Part::Long(length) => return Ok(Err(format!("a record's header claims {length} bytes"))),
    };
    match part(file, CHUNK_BYTES_MAX)? {
        Part::Whole(data) => Ok(Ok(Some((header, data)))),
        Part::End | Part::Cut => Ok(Err(CUT.into())),
        Part::Long(length) => {
            Ok(Err(format!("a record claims {length} bytes, of which {CHUNK_BYTES_MAX} (CHUNK_BYTES_MAX) are read")))
        }
    }
}

const CUT: &str = "ends early, in the middle of a record: was the recorder stopped?";

enum Part {
    Whole(Vec<u8>),
    End,
    Cut,
    Long(u32),
}

/// A length of four bytes, and so many bytes. Memory grows as they come.
fn part(file: &mut impl Read, length_max: usize) -> std::io::Result<Part> {
    let mut length = Vec::new();
    file.by_ref().take(4).read_to_end(&mut length)?;
    let Some(length) = length.first_chunk::<4>().map(|bytes| u32::from_le_bytes(*bytes)) else {
        return Ok(if length.is_empty() { Part::End } else { Part::Cut });
    };
    if length as usize > length_max {
        return Ok(Part::Long(length));
    }
    let mut bytes = Vec::new();
    file.by_ref().take(u64::from(length)).read_to_end(&mut bytes)?;
    Ok(if bytes.len() == length as usize { Part::Whole(bytes) } else { Part::Cut })
}

/// The fields of a header, as far as they are some.
fn fields(mut header: &[u8]) -> Fields<'_> {
    let mut fields = Fields::new();
    while let Some((length, rest)) = header.split_first_chunk::<4>() {
        let Some((field, rest)) = rest.split_at_checked(u32::from_le_bytes(*length) as usize) else { break };
        header = rest;
        if let Some(at) = field.iter().position(|byte| *byte == b'=') {
            fields.insert(&field[..at], &field[at + 1..]);
        }
    }
    fields
}

fn operation(header: &[u8]) -> Option<u8> {
    match fields(header).get(&b"op"[..]) {
        Some([operation]) => Some(*operation),
        _ => None,
    }
}

fn number<const N: usize>(fields: &Fields<'_>, name: &[u8]) -> Option<[u8; N]> {
    fields.get(name).and_then(|value| (*value).try_into().ok())
}

enum Unpack {
    Unknown(String),
    Damaged(String),
}

/// The records of a chunk.
fn unpack(header: &[u8], data: &[u8]) -> Result<Vec<u8>, Unpack> {
    let fields = fields(header);
    let size = number(&fields, b"size").map(u32::from_le_bytes);
    let size = size.ok_or_else(|| Unpack::Damaged("it states no size".into()))? as usize;
    if size > CHUNK_BYTES_MAX {
        return Err(Unpack::Damaged(format!("{size} bytes, more than {CHUNK_BYTES_MAX} (CHUNK_BYTES_MAX)")));
    }
    let compression = fields.get(&b"compression"[..]).copied().unwrap_or_default();
    let limit = size as u64 + 1;
    let mut records = Vec::new();
    let read = match compression {
        b"none" => data.take(limit).read_to_end(&mut records),
        b"bz2" => bzip2::read::BzDecoder::new(data).take(limit).read_to_end(&mut records),
        b"lz4" => lz4::Decoder::new(data).and_then(|packed| packed.take(limit).read_to_end(&mut records)),
        other => return Err(Unpack::Unknown(String::from_utf8_lossy(other).chars().take(32).collect())),
    };
    match read {
        Err(error) => Err(Unpack::Damaged(error.to_string())),
        Ok(_) if records.len() == size => Ok(records),
        Ok(_) => Err(Unpack::Damaged(format!("it does not have the {size} bytes that it states"))),
    }
}

enum Refusal {
    /// Of the bag as a whole.
    Bag(BagProblem),
    /// Of the rest of a chunk.
    Chunk(String),
}

struct Reader<'a> {
    topics: &'a mut Topics,
    connections: &'a mut BTreeMap<u32, usize>,
    damage: &'a mut Damage,
    each: &'a mut dyn FnMut(Record<'_>) -> Flow,
}

impl Reader<'_> {
    fn chunk(&mut self, mut records: &[u8]) -> Result<Flow, Refusal> {
        while !records.is_empty() {
            let header = cut(&mut records);
            let (Some(header), Some(data)) = (header, cut(&mut records)) else {
                return Err(Refusal::Chunk("a chunk ends in the middle of a record".into()));
            };
            if self.record(header, data)? == Flow::Stop {
                return Ok(Flow::Stop);
            }
        }
        Ok(Flow::On)
    }

    fn record(&mut self, header: &[u8], data: &[u8]) -> Result<Flow, Refusal> {
        let head = fields(header);
        let connection = number(&head, b"conn").map(u32::from_le_bytes);
        match (operation(header), connection) {
            (Some(CONNECTION), Some(connection)) => {
                // The topic in the header is the one under which it was stored, the one in the data that of the
                // publisher.
                let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
                let name = text(head.get(&b"topic"[..]).copied().unwrap_or_default());
                let kind = text(fields(data).get(&b"type"[..]).copied().unwrap_or_default());
                let index = self.topics.index(&name, &kind, Some(Serialization::Ros1)).map_err(Refusal::Bag)?;
                self.connections.insert(connection, index);
            }
            (Some(MESSAGE), Some(connection)) => {
                let time = number::<8>(&head, b"time").map(u64::from_le_bytes);
                let (Some(topic), Some(time)) = (self.connections.get(&connection), time) else {
                    self.damage.lost += 1;
                    return Ok(Flow::On);
                };
                if data.len() > MESSAGE_BYTES_MAX {
                    self.damage.long += 1;
                    return Ok(Flow::On);
                }
                // Seconds in the lower half, nanoseconds in the upper.
                let received_ns = (time & 0xffff_ffff) as i64 * 1_000_000_000 + (time >> 32) as i64;
                return Ok((self.each)(Record { topic: *topic, received_ns, bytes: data }));
            }
            (Some(MESSAGE), None) => self.damage.lost += 1,
            _ => {}
        }
        Ok(Flow::On)
    }
}

/// A length of four bytes, and so many bytes.
fn cut<'a>(records: &mut &'a [u8]) -> Option<&'a [u8]> {
    let (length, rest) = records.split_first_chunk::<4>()?;
    let (part, rest) = rest.split_at_checked(u32::from_le_bytes(*length) as usize)?;
    *records = rest;
    Some(part)
}
