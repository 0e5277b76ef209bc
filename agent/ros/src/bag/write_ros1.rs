//! A writer of small ROS 1 bags, for tests.

use std::collections::BTreeMap;

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

/// A ROS 1 bag, in chunks of ten messages that are packed `by` this, without an index.
pub fn bag(messages: &[Written], by: &str, pack: impl Fn(&[u8]) -> Vec<u8>) -> Vec<u8> {
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
        let packed = pack(&records);
        let size = (records.len() as u32).to_le_bytes();
        bag.extend(record(&[("op", &[5]), ("compression", by.as_bytes()), ("size", &size)], &packed));
    }
    bag
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
