//! Writers of small bags, for tests.

use std::collections::BTreeMap;
use std::fs;
use std::io::{BufWriter, Write as _};
use std::path::Path;

#[path = "write_ros1.rs"]
mod write_ros1;

pub use write_ros1::Written;

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

/// A ROS 1 bag.
pub fn ros1(path: &Path, messages: &[Written], by: &str) {
    let pack = |records: &[u8]| match by {
        "bz2" => {
            let mut encoder = bzip2::write::BzEncoder::new(Vec::new(), bzip2::Compression::fast());
            encoder.write_all(records).unwrap();
            encoder.finish().unwrap()
        }
        "lz4" => {
            let mut encoder = lz4::EncoderBuilder::new().build(Vec::new()).unwrap();
            encoder.write_all(records).unwrap();
            encoder.finish().0
        }
        _ => records.to_vec(),
    };
    fs::write(path, write_ros1::bag(messages, by, pack)).unwrap();
}
