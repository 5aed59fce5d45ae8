//! Recordings that are made here: a line of JSON with the types of the topics and the lengths of the messages, then the
//! messages, ten moments per second with one message of each topic.

use std::io::Write;
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result, ensure};
use bytes::Bytes;
use ros::bag::BagMessage;
use ros::bus::WireType;
use serde::{Deserialize, Serialize};

/// Extension of the files.
pub const EXTENSION: &str = "messages";
/// Interval between two moments, in nanoseconds.
const PERIOD: u64 = 100_000_000;

/// A topic and its type: name, MD5 in hexadecimal, and the full text of the definition.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct TopicType {
    topic: String,
    name: String,
    digest: String,
    definition: String,
}

impl TopicType {
    pub fn new(topic: &str, of: &WireType) -> Self {
        let (name, definition) = (of.name.clone(), of.definition.clone());
        Self { topic: topic.to_owned(), name, digest: of.digest.to_string(), definition }
    }
}

/// Content of the first line.
#[derive(Debug, Serialize, Deserialize)]
struct StreamHeader {
    topics: Vec<TopicType>,
    rounds: usize,
    /// Length of each message in bytes, moment by moment.
    lengths: Vec<usize>,
}

/// Writes moments, each with one message of each topic.
pub fn write(path: &Path, topics: &[TopicType], moments: &[Vec<Bytes>], rounds: usize) -> Result<()> {
    let messages = || moments.iter().flatten();
    let head = StreamHeader { topics: topics.to_vec(), rounds, lengths: messages().map(Bytes::len).collect() };
    let file = std::fs::File::create(path).with_context(|| path.display().to_string())?;
    let mut file = std::io::BufWriter::new(file);
    serde_json::to_writer(&mut file, &head)?;
    file.write_all(b"\n")?;
    messages().try_for_each(|message| file.write_all(message))?;
    Ok(file.flush()?)
}

pub fn read(file: &Bytes) -> Result<Vec<BagMessage>> {
    let line = file.iter().position(|byte| *byte == b'\n').context("the file has no first line")?;
    let head: StreamHeader = serde_json::from_slice(&file[..line])?;
    let topic = |of: TopicType| {
        let wire_type = WireType::new(of.name, of.digest.as_str(), of.definition);
        (Arc::<str>::from(of.topic), Arc::new(wire_type))
    };
    let topics: Vec<(Arc<str>, Arc<WireType>)> = head.topics.into_iter().map(topic).collect();
    let mut from = line + 1;
    let mut messages = Vec::new();
    for length in head.lengths {
        ensure!(length <= file.len() - from, "the file breaks off in message {}", messages.len() + 1);
        messages.push(file.slice(from..from + length));
        from += length;
    }
    let sent = messages.iter().cycle().take(messages.len() * head.rounds).enumerate();
    let recorded = sent.map(|(number, bytes)| {
        let (topic, wire_type) = topics[number % topics.len()].clone();
        BagMessage { topic, wire_type, time: (number / topics.len()) as u64 * PERIOD, bytes: bytes.clone() }
    });
    Ok(recorded.collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_come_back_round_after_round() {
        let place = tempfile::tempdir().expect("a directory");
        let path = place.path().join("a.messages");
        let topics = ["/a", "/b"].map(|topic| TopicType::new(topic, &WireType::new("a/B", "0", "int32 x")));
        let moments = [vec![Bytes::from_static(b"one\n"), Bytes::new()], vec![Bytes::from_static(b"2"), Bytes::new()]];
        write(&path, &topics, &moments, 2).expect("it is written");
        let file = Bytes::from(std::fs::read(&path).expect("a file"));
        let back = read(&file).expect("messages");
        let told: Vec<(&str, u64, &[u8])> =
            back.iter().map(|one| (&*one.topic, one.time / PERIOD, &one.bytes[..])).collect();
        assert_eq!(told[..3], [("/a", 0, &b"one\n"[..]), ("/b", 0, &b""[..]), ("/a", 1, &b"2"[..])]);
        assert_eq!((told.len(), told[6], &*back[0].wire_type.name), (8, ("/a", 3, &b"2"[..]), "a/B"));
        assert!(read(&file.slice(..file.len() - 1)).is_err());
        assert!(read(&Bytes::from_static(b"no line")).is_err());
    }
}
