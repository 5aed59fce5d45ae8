//! Messages of one topic in a file, for robots that send data without a recording: a line of JSON with the topic, its
//! type and the lengths of the messages, then the messages.

use std::io::Write;
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result, ensure};
use bytes::Bytes;
use ros::bag::BagMessage;
use ros::bus::WireType;
use serde::{Deserialize, Serialize};

/// Interval between two messages, in nanoseconds.
const PERIOD: u64 = 100_000_000;

/// Content of the first line.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct StreamHeader {
    /// Topic.
    pub topic: String,
    /// Type, as `package/Type`.
    pub of: String,
    /// MD5 of the type's definition, in hexadecimal.
    pub digest: String,
    /// Full text of the type's definition.
    pub definition: String,
    /// Number of times that all messages are sent.
    pub rounds: usize,
    /// Length of each message in bytes.
    #[serde(default)]
    lengths: Vec<usize>,
}

impl StreamHeader {
    /// Header for a topic of images.
    pub fn for_pictures(rounds: usize) -> Self {
        Self::new("/image", &support::people::image_type(), rounds)
    }

    /// Header for a topic of maps.
    pub fn for_maps(rounds: usize) -> Self {
        let of = WireType::new("nav_msgs/OccupancyGrid", "3381f2d731d4076ec5c71b0759edbe4e", MAP);
        Self::new("/map", &of, rounds)
    }

    fn new(topic: &str, of: &WireType, rounds: usize) -> Self {
        Self {
            topic: topic.to_owned(),
            of: of.name.clone(),
            digest: of.digest.to_string(),
            definition: of.definition.clone(),
            rounds,
            lengths: Vec::new(),
        }
    }
}

/// Writes a file, whose name ends with `.messages`.
pub fn write(path: &Path, head: &StreamHeader, messages: &[Bytes]) -> Result<()> {
    let head = StreamHeader { lengths: messages.iter().map(Bytes::len).collect(), ..head.clone() };
    let mut file = std::fs::File::create(path).with_context(|| path.display().to_string())?;
    serde_json::to_writer(&mut file, &head)?;
    file.write_all(b"\n")?;
    for message in messages {
        file.write_all(message)?;
    }
    Ok(())
}

/// Reads a file as ten messages per second.
pub fn read(file: &Bytes) -> Result<Vec<BagMessage>> {
    let line = file.iter().position(|byte| *byte == b'\n');
    let line = line.context("the file has no first line")?;
    let head: StreamHeader = serde_json::from_slice(&file[..line])?;
    let (topic, wire_type) =
        (Arc::<str>::from(head.topic), Arc::new(WireType::new(head.of, head.digest.as_str(), head.definition)));
    let mut from = line + 1;
    let mut messages = Vec::new();
    for length in head.lengths {
        ensure!(length <= file.len() - from, "the file breaks off in message {}", messages.len() + 1);
        messages.push(file.slice(from..from + length));
        from += length;
    }
    let sent = messages.iter().cycle().take(messages.len() * head.rounds);
    let recorded = (0..).zip(sent).map(|(number, bytes)| BagMessage {
        topic: topic.clone(),
        wire_type: wire_type.clone(),
        time: number * PERIOD,
        bytes: bytes.clone(),
    });
    Ok(recorded.collect())
}

/// Definition of `nav_msgs/OccupancyGrid`.
const MAP: &str = "std_msgs/Header header\nMapMetaData info\nint8[] data\n\
    ================================================================================\n\
    MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n\
    ================================================================================\n\
    MSG: nav_msgs/MapMetaData\ntime map_load_time\nfloat32 resolution\nuint32 width\nuint32 height\ngeometry_msgs/Pose \
    origin\n\
    ================================================================================\n\
    MSG: geometry_msgs/Pose\nPoint position\nQuaternion orientation\n\
    ================================================================================\n\
    MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n\
    ================================================================================\n\
    MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_come_back_round_after_round() {
        let place = tempfile::tempdir().expect("a directory");
        let path = place.path().join("a.messages");
        let messages = [Bytes::from_static(b"one\n"), Bytes::from_static(b"")];
        write(&path, &StreamHeader::for_maps(2), &messages).expect("it is written");
        let file = Bytes::from(std::fs::read(&path).expect("a file"));
        let back = read(&file).expect("messages");
        let bytes: Vec<&[u8]> = back.iter().map(|one| &one.bytes[..]).collect();
        assert_eq!(bytes, [&b"one\n"[..], b"", b"one\n", b""]);
        assert_eq!(back[3].time, 3 * PERIOD);
        assert_eq!(back[0].wire_type.name, "nav_msgs/OccupancyGrid");
        assert!(read(&file.slice(..file.len() - 1)).is_err());
        assert!(read(&Bytes::from_static(b"no line")).is_err());
    }
}
