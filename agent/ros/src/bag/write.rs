//! Writers of small bags, for tests.

use std::collections::BTreeMap;
use std::fs;
use std::io::{BufWriter, Write as _};
use std::path::Path;

/// A message to be written, or read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Written {
    /// Its topic.
    pub topic: String,
    /// Its type.
    pub kind: String,
    /// When it was received, ns.
    pub received_ns: i64,
    /// It.
    pub bytes: Vec<u8>,
}

/// An MCAP file, in chunks of a few messages or without chunks.
pub fn mcap(path: &Path, messages: &[Written], by: Option<mcap::Compression>, chunks: bool, encoding: &str) {
    let options = mcap::WriteOptions::new().compression(by).use_chunks(chunks).chunk_size(Some(1000));
    let file = BufWriter::new(fs::File::create(path).unwrap());
    let mut writer = options.profile("ros2").create(file).unwrap();
    let mut channels = BTreeMap::new();
    for (sequence, message) in messages.iter().enumerate() {
        let channel = *channels.entry(&message.topic).or_insert_with(|| {
            let schema = writer.add_schema(&message.kind, "ros2msg", b"# left out").unwrap();
            writer.add_channel(schema, &message.topic, encoding, &BTreeMap::new()).unwrap()
        });
        let time = message.received_ns as u64;
        let header = mcap::records::MessageHeader {
            channel_id: channel,
            sequence: sequence as u32,
            log_time: time,
            publish_time: time,
        };
        writer.write_to_known_channel(&header, &message.bytes).unwrap();
    }
    writer.finish().unwrap();
}

/// A sqlite3 file of ROS 2, as Humble writes it or with type definitions, as later versions do.
pub fn db3(path: &Path, messages: &[Written], defined: bool, packed: bool) {
    let mut bag = rusqlite::Connection::open(path).unwrap();
    let tables = if defined {
        "CREATE TABLE schema (schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
         CREATE TABLE metadata (id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL);
         CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
            serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL, type_description_hash TEXT NOT NULL);
         CREATE TABLE message_definitions (id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding TEXT NOT NULL,
            encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL);"
    } else {
        "CREATE TABLE topics (id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
            serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);"
    };
    let more = "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
            data BLOB NOT NULL);
         CREATE INDEX timestamp_idx ON messages (timestamp ASC);";
    bag.execute_batch(&format!("{tables}{more}")).unwrap();
    let transaction = bag.transaction().unwrap();
    let mut topics = BTreeMap::new();
    for message in messages {
        let next = topics.len() as i64 + 1;
        let id = *topics.entry(&message.topic).or_insert_with(|| {
            let values = (next, &message.topic, &message.kind);
            let insert = if defined {
                "INSERT INTO topics VALUES (?1, ?2, ?3, 'cdr', '', 'RIHS01_0')"
            } else {
                "INSERT INTO topics VALUES (?1, ?2, ?3, 'cdr', '')"
            };
            transaction.execute(insert, values).unwrap();
            next
        });
        let bytes = if packed { zstd::encode_all(&*message.bytes, 1).unwrap() } else { message.bytes.clone() };
        let insert = "INSERT INTO messages (topic_id, timestamp, data) VALUES (?1, ?2, ?3)";
        transaction.execute(insert, (id, message.received_ns, bytes)).unwrap();
    }
    transaction.commit().unwrap();
}

/// A ROS 1 bag, in chunks of ten messages, without an index.
pub fn ros1(path: &Path, messages: &[Written], by: &str) {
    let mut bag = b"#ROSBAG V2.0\n".to_vec();
    let zero = 0_u64.to_le_bytes();
    bag.extend(record(
        &[("op", &[3]), ("index_pos", &zero), ("conn_count", &zero[..4]), ("chunk_count", &zero[..4])],
        &[b' '; 100],
    ));
    let mut connections = BTreeMap::new();
    for part in messages.chunks(10) {
        let mut records = Vec::new();
        for message in part {
            let next = connections.len() as u32;
            let connection = *connections.entry(&message.topic).or_insert_with(|| {
                let head = [("op", &[7][..]), ("conn", &next.to_le_bytes()), ("topic", message.topic.as_bytes())];
                let data = fields(&[
                    ("topic", message.topic.as_bytes()),
                    ("type", message.kind.as_bytes()),
                    ("md5sum", b"*"),
                    ("message_definition", b"# left out"),
                ]);
                records.extend(record(&head, &data));
                next
            });
            let (secs, nanos) = (message.received_ns / 1_000_000_000, message.received_ns % 1_000_000_000);
            let time = [(secs as u32).to_le_bytes(), (nanos as u32).to_le_bytes()].concat();
            let head = [("op", &[2][..]), ("conn", &connection.to_le_bytes()), ("time", &time)];
            records.extend(record(&head, &message.bytes));
        }
        let packed = match by {
            "bz2" => {
                let mut encoder = bzip2::write::BzEncoder::new(Vec::new(), bzip2::Compression::fast());
                encoder.write_all(&records).unwrap();
                encoder.finish().unwrap()
            }
            "lz4" => {
                let mut encoder = lz4::EncoderBuilder::new().build(Vec::new()).unwrap();
                encoder.write_all(&records).unwrap();
                encoder.finish().0
            }
            _ => records.clone(),
        };
        let size = (records.len() as u32).to_le_bytes();
        bag.extend(record(&[("op", &[5]), ("compression", by.as_bytes()), ("size", &size)], &packed));
    }
    fs::write(path, bag).unwrap();
}

fn fields(fields: &[(&str, &[u8])]) -> Vec<u8> {
    let field = |(name, value): &(&str, &[u8])| {
        let field = [name.as_bytes(), b"=", value].concat();
        [&(field.len() as u32).to_le_bytes()[..], &field].concat()
    };
    fields.iter().flat_map(field).collect()
}

fn record(head: &[(&str, &[u8])], data: &[u8]) -> Vec<u8> {
    let head = fields(head);
    [&(head.len() as u32).to_le_bytes()[..], &head, &(data.len() as u32).to_le_bytes(), data].concat()
}
