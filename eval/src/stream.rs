//! Messages of one topic as a file, for robots that send what no recording holds: a line of JSON with the topic, its type and the messages'
//! lengths, then the messages.

use std::io::Write;
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result, ensure};
use bytes::Bytes;
use ros::bag::Recorded;
use ros::bus::WireType;
use serde::{Deserialize, Serialize};

/// Between two messages, nanoseconds.
const PERIOD: u64 = 100_000_000;

/// What the first line says.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Head {
    /// Where they are published.
    pub topic: String,
    /// `package/Type`.
    pub of: String,
    /// Of the type's definition (MD5, hexadecimal).
    pub digest: String,
    /// The type's full text.
    pub definition: String,
    /// How often all messages are sent, one round after the other.
    pub rounds: usize,
    /// Bytes of each message.
    #[serde(default)]
    lengths: Vec<usize>,
}

impl Head {
    /// Of a topic of pictures.
    pub fn of_pictures(rounds: usize) -> Self {
        Self::new("/image", &support::people::image_type(), rounds)
    }

    /// Of a topic of maps.
    pub fn of_maps(rounds: usize) -> Self {
        let of = WireType::new(
            "nav_msgs/OccupancyGrid",
            "3381f2d731d4076ec5c71b0759edbe4e",
            MAP,
        );
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

/// Writes a file that ends with `.messages`.
pub fn write(path: &Path, head: &Head, messages: &[Bytes]) -> Result<()> {
    let head = Head {
        lengths: messages.iter().map(Bytes::len).collect(),
        ..head.clone()
    };
    let mut file = std::fs::File::create(path).with_context(|| path.display().to_string())?;
    serde_json::to_writer(&mut file, &head)?;
    file.write_all(b"\n")?;
    for message in messages {
        file.write_all(message)?;
    }
    Ok(())
}

/// Reads one, ten messages a second.
pub fn read(file: &Bytes) -> Result<Vec<Recorded>> {
    let line = file.iter().position(|byte| *byte == b'\n');
    let line = line.context("the file has no first line")?;
    let head: Head = serde_json::from_slice(&file[..line])?;
    let (topic, wire_type) = (
        Arc::<str>::from(head.topic),
        Arc::new(WireType::new(
            head.of,
            head.digest.as_str(),
            head.definition,
        )),
    );
    let mut from = line + 1;
    let mut messages = Vec::new();
    for length in head.lengths {
        ensure!(
            length <= file.len() - from,
            "the file breaks off in message {}",
            messages.len() + 1
        );
        messages.push(file.slice(from..from + length));
        from += length;
    }
    let sent = messages.iter().cycle().take(messages.len() * head.rounds);
    let recorded = (0..).zip(sent).map(|(number, bytes)| Recorded {
        topic: topic.clone(),
        wire_type: wire_type.clone(),
        time: number * PERIOD,
        bytes: bytes.clone(),
    });
    Ok(recorded.collect())
}

/// `nav_msgs/OccupancyGrid`.
const MAP: &str = "std_msgs/Header header\nMapMetaData info\nint8[] data\n\
    ================================================================================\n\
    MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n\
    ================================================================================\n\
    MSG: nav_msgs/MapMetaData\ntime map_load_time\nfloat32 resolution\nuint32 width\nuint32 height\ngeometry_msgs/Pose origin\n\
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
        write(&path, &Head::of_maps(2), &messages).expect("it is written");
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
