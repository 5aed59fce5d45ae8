//! Recordings: rosbag files of version 2.0, read sequentially (<http://wiki.ros.org/Bags/Format/2.0>).
//!
//! Reads only what replaying needs: messages with their topics, types and times. Indexes are skipped. Chunks must not
//! be compressed; `rosbag decompress` converts a file.

use std::collections::HashMap;
use std::sync::Arc;

use bytes::Bytes;

use crate::bus::WireType;

const MAGIC: &[u8] = b"#ROSBAG V2.0\n";
const OLDER: &[u8] = b"#ROSBAG V1";
const MESSAGE: u8 = 0x02;
const CHUNK: u8 = 0x05;
const CONNECTION: u8 = 0x07;

/// Error reading a recording. Positions are byte offsets in the file.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum BagError {
    /// The file is empty.
    #[error("the file is empty")]
    Empty,
    /// The file is not a rosbag.
    #[error("not a rosbag file; record one with: rosbag record TOPIC")]
    Other,
    /// The file has an older format version.
    #[error("this is a rosbag file of an older version than 2.0; convert it with: rosbag fix")]
    Version,
    /// The file is truncated, or a length in it is wrong.
    #[error("the recording is cut off or damaged at byte {0}; try: rosbag reindex")]
    Damaged(usize),
    /// A chunk is compressed.
    #[error("the recording is compressed ({0}); unpack it first: rosbag decompress FILE")]
    Compressed(String),
}

/// One recorded message.
#[derive(Debug, Clone)]
pub struct BagMessage {
    /// Topic on which it was recorded.
    pub topic: Arc<str>,
    /// Type of the message, with the full definition.
    pub wire_type: Arc<WireType>,
    /// Time of reception, in nanoseconds since 1970.
    pub time: u64,
    /// The serialized message.
    pub bytes: Bytes,
}

/// Reads at most the first `limit` messages of a recording, in file order.
pub fn read(file: &Bytes, limit: usize) -> Result<Vec<BagMessage>, BagError> {
    if !file.starts_with(MAGIC) {
        return Err(match &file[..] {
            [] => BagError::Empty,
            older if older.starts_with(OLDER) => BagError::Version,
            _ => BagError::Other,
        });
    }
    let mut reader = BagReader { connections: HashMap::new(), messages: Vec::new(), limit };
    reader.read_records(file, MAGIC.len(), file.len(), true)?;
    Ok(reader.messages)
}

struct BagReader {
    connections: HashMap<u32, (Arc<str>, Arc<WireType>)>,
    messages: Vec<BagMessage>,
    limit: usize,
}

impl BagReader {
    /// Reads the records between two positions; chunks are not nested.
    fn read_records(&mut self, file: &Bytes, mut at: usize, end: usize, chunks: bool) -> Result<(), BagError> {
        while at < end && self.messages.len() < self.limit {
            let began = at;
            let damaged = BagError::Damaged(began);
            let header = take_block(file, &mut at, end).ok_or(damaged.clone())?;
            let data = take_block(file, &mut at, end).ok_or(damaged.clone())?;
            let fields = parse_fields(&file[header]).ok_or(damaged.clone())?;
            let op = fields.get("op").and_then(|value| value.first()).copied();
            match op {
                Some(CHUNK) if chunks => {
                    let compression = text_field(&fields, "compression");
                    if compression != "none" {
                        return Err(BagError::Compressed(compression));
                    }
                    self.read_records(file, data.start, data.end, false)?;
                }
                Some(CONNECTION) => {
                    let number = number_field(&fields, "conn").ok_or(damaged.clone())?;
                    let about = self::parse_fields(&file[data]).ok_or(damaged)?;
                    let wire_type = WireType::new(
                        text_field(&about, "type"),
                        text_field(&about, "md5sum"),
                        text_field(&about, "message_definition"),
                    );
                    // The topic as subscribed to; the connection's own header may have another name from before
                    // remapping.
                    let topic = text_field(&fields, "topic").into();
                    self.connections.insert(number, (topic, Arc::new(wire_type)));
                }
                Some(MESSAGE) => {
                    let number = number_field(&fields, "conn").ok_or(damaged.clone())?;
                    let (topic, wire_type) = self.connections.get(&number).ok_or(damaged.clone())?;
                    let time: [u8; 8] = fields.get("time").and_then(|value| (*value).try_into().ok()).ok_or(damaged)?;
                    let [a, b, c, d, e, f, g, h] = time;
                    let seconds = u64::from(u32::from_le_bytes([a, b, c, d]));
                    let nanoseconds = u64::from(u32::from_le_bytes([e, f, g, h]));
                    self.messages.push(BagMessage {
                        topic: Arc::clone(topic),
                        wire_type: Arc::clone(wire_type),
                        time: seconds * 1_000_000_000 + nanoseconds,
                        bytes: file.slice(data),
                    });
                }
                _ => {}
            }
        }
        Ok(())
    }
}

/// Returns the range of the length-prefixed block at `at`, and advances `at` past it.
fn take_block(file: &[u8], at: &mut usize, end: usize) -> Option<std::ops::Range<usize>> {
    let length: [u8; 4] = file.get(*at..at.checked_add(4)?)?.try_into().ok()?;
    let start = *at + 4;
    let stop = start.checked_add(u32::from_le_bytes(length) as usize)?;
    if stop > end {
        return None;
    }
    *at = stop;
    Some(start..stop)
}

/// Parses length-prefixed `name=value` pairs.
fn parse_fields(header: &[u8]) -> Option<HashMap<&str, &[u8]>> {
    let mut fields = HashMap::new();
    let mut at = 0;
    while at < header.len() {
        let field = &header[take_block(header, &mut at, header.len())?];
        let equals = field.iter().position(|byte| *byte == b'=')?;
        fields.insert(std::str::from_utf8(&field[..equals]).ok()?, &field[equals + 1..]);
    }
    Some(fields)
}

fn number_field(fields: &HashMap<&str, &[u8]>, name: &str) -> Option<u32> {
    let bytes: [u8; 4] = (*fields.get(name)?).try_into().ok()?;
    Some(u32::from_le_bytes(bytes))
}

fn text_field(fields: &HashMap<&str, &[u8]>, name: &str) -> String {
    let bytes = fields.get(name).copied().unwrap_or_default();
    String::from_utf8_lossy(bytes).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(fields: &[(&str, &[u8])]) -> Vec<u8> {
        let mut out = Vec::new();
        for (name, value) in fields {
            let length = (name.len() + 1 + value.len()) as u32;
            out.extend_from_slice(&length.to_le_bytes());
            out.extend_from_slice(name.as_bytes());
            out.push(b'=');
            out.extend_from_slice(value);
        }
        out
    }

    fn record(fields: &[(&str, &[u8])], data: &[u8]) -> Vec<u8> {
        let head = header(fields);
        let mut out = (head.len() as u32).to_le_bytes().to_vec();
        out.extend_from_slice(&head);
        out.extend_from_slice(&(data.len() as u32).to_le_bytes());
        out.extend_from_slice(data);
        out
    }

    fn bag(compression: &str) -> Vec<u8> {
        let about = header(&[
            ("topic", b"/before"),
            ("type", b"std_msgs/String"),
            ("md5sum", b"992ce8a1687cec8c8bd883ec73ca41d1"),
            ("message_definition", b"string data\n"),
        ]);
        let mut time = 5u32.to_le_bytes().to_vec();
        time.extend_from_slice(&7u32.to_le_bytes());
        let conn = 3u32.to_le_bytes();
        let mut chunk = record(&[("op", &[CONNECTION]), ("conn", &conn), ("topic", b"/chatter")], &about);
        for text in ["\x01\0\0\0a", "\x01\0\0\0b"] {
            chunk.extend(record(&[("op", &[MESSAGE]), ("conn", &conn), ("time", &time)], text.as_bytes()));
        }
        let mut file = MAGIC.to_vec();
        file.extend(record(&[("op", &[3])], b"    padding"));
        file.extend(record(&[("op", &[CHUNK]), ("compression", compression.as_bytes())], &chunk));
        file.extend(record(&[("op", &[4])], b"an index"));
        file
    }

    #[test]
    fn messages_come_with_topic_type_and_time() {
        let file = Bytes::from(bag("none"));
        let messages = read(&file, 10).expect("a bag");
        assert_eq!(messages.len(), 2);
        assert_eq!(&*messages[0].topic, "/chatter");
        assert_eq!(messages[0].wire_type.name, "std_msgs/String");
        assert_eq!(messages[0].time, 5_000_000_007);
        assert_eq!(&messages[1].bytes[..], b"\x01\0\0\0b");
        assert_eq!(read(&file, 1).expect("a bag").len(), 1);
    }

    #[test]
    fn what_cannot_be_read_is_told() {
        for (file, why) in [
            (&b"#ROSBAG V1.2\n"[..], BagError::Version),
            (b"", BagError::Empty),
            (b"RIFF\0\0\0\0AVI ", BagError::Other),
        ] {
            assert_eq!(read(&Bytes::from_static(file), 1).err(), Some(why));
        }
        let text = BagError::Other.to_string();
        assert!(!text.contains("rosbag fix"), "{text}");
        let compressed = read(&Bytes::from(bag("bz2")), 1).expect_err("compressed");
        assert!(compressed.to_string().contains("rosbag decompress"), "{compressed}");
    }

    #[test]
    fn a_bag_that_is_cut_anywhere_is_an_error_or_shorter() {
        let whole = bag("none");
        for length in 0..whole.len() {
            let cut = Bytes::copy_from_slice(&whole[..length]);
            if let Ok(messages) = read(&cut, 10) {
                assert!(messages.len() <= 2);
            }
        }
        // Every byte changed as well: nothing may panic.
        for at in MAGIC.len()..whole.len() {
            let mut changed = whole.clone();
            changed[at] ^= 0xff;
            let _ = read(&Bytes::from(changed), 10);
        }
    }
}
