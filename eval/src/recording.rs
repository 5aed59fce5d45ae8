//! Recorded inputs that a robot plays: the messages of one topic are its requests, all others accompany them.

use std::path::Path;

use anyhow::{Context, Result, ensure};
use bytes::{Buf, Bytes};
use ros::bag::{self, BagMessage};

use crate::stream;

const SECOND: u64 = 1_000_000_000;

/// A recording in memory.
#[derive(Debug, Clone)]
pub struct Recording {
    messages: Vec<BagMessage>,
}

/// A request, and the other messages recorded since the previous request.
pub struct RecordedStep<'a> {
    pub before: Vec<&'a BagMessage>,
    pub request: &'a BagMessage,
    /// Seconds since the first message of the recording.
    pub at: f64,
}

impl Recording {
    /// Reads an uncompressed rosbag file, or a file of [`stream`].
    pub fn read(path: &Path) -> Result<Self> {
        let named = || path.display().to_string();
        let file = Bytes::from(std::fs::read(path).with_context(named)?);
        let is_stream = path.extension().is_some_and(|ending| ending == stream::EXTENSION);
        let read = if is_stream { stream::read(&file) } else { bag::read(&file, usize::MAX).map_err(Into::into) };
        let mut messages = read.with_context(named)?;
        messages.sort_by_key(|message| message.time);
        ensure!(!messages.is_empty(), "{}: no message is in it", named());
        Ok(Self { messages })
    }

    /// Returns one message of each topic, for its type, except for the topics `without`.
    pub fn topics(&self, without: &[String]) -> Vec<&BagMessage> {
        let mut topics: Vec<&BagMessage> = Vec::new();
        for message in &self.messages {
            let known = topics.iter().any(|one| one.topic == message.topic);
            if !known && !without.iter().any(|name| **name == *message.topic) {
                topics.push(message);
            }
        }
        topics
    }

    /// Returns the messages of `topic` as requests; messages after the last one are omitted.
    pub fn steps(&self, topic: &str) -> Vec<RecordedStep<'_>> {
        let first = self.messages[0].time;
        let mut steps = Vec::new();
        let mut before = Vec::new();
        for message in &self.messages {
            if *message.topic != *topic {
                before.push(message);
                continue;
            }
            steps.push(RecordedStep {
                before: std::mem::take(&mut before),
                request: message,
                at: (message.time - first) as f64 / 1e9,
            });
        }
        steps
    }

    /// Returns the recorded positions of a topic of `geometry_msgs/PoseStamped`: seconds, x and y in metres.
    pub fn positions(&self, topic: &str) -> Vec<(f64, f64, f64)> {
        let first = self.messages[0].time;
        let of = self.messages.iter().filter(|one| *one.topic == *topic);
        let position = |one: &BagMessage| {
            let at = (one.time - first) as f64 / 1e9;
            read_pose(&one.bytes).map(|[x, y, _]| (at, x, y))
        };
        of.filter_map(position).collect()
    }
}

/// The `std_msgs/Header` at the beginning of a serialized message.
#[derive(Debug, PartialEq, Eq)]
pub struct Header {
    /// Seconds and nanoseconds.
    pub stamp: (u32, u32),
    pub end: usize,
}

/// Reads the header; `None` if the message is too short.
pub fn read_header(bytes: &[u8]) -> Option<Header> {
    let word = |at: usize| {
        let bytes = bytes.get(at..at + 4)?;
        Some(u32::from_le_bytes(bytes.try_into().ok()?))
    };
    let end = 16 + word(12)? as usize;
    (end <= bytes.len()).then_some(Header { stamp: (word(4)?, word(8)?), end })
}

/// Reads x, y (metres) and heading (radians) of a `geometry_msgs/PoseStamped` or a message with the same beginning.
pub fn read_pose(bytes: &[u8]) -> Option<[f64; 3]> {
    let numbers = read_floats(bytes, read_header(bytes)?.end, 7)?;
    let [x, y, _, qx, qy, qz, qw] = numbers[..] else {
        return None;
    };
    let heading = f64::atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz));
    Some([x, y, heading])
}

/// Reads `count` float64 values from an offset.
pub fn read_floats(bytes: &[u8], from: usize, count: usize) -> Option<Vec<f64>> {
    let mut rest = bytes.get(from..from + count * 8)?;
    Some((0..count).map(|_| rest.get_f64_le()).collect())
}

/// Sets the stamp of a message's header to `number` seconds, which identifies its answer.
pub fn with_stamp(bytes: &Bytes, number: u32) -> Option<Bytes> {
    set_stamp(bytes, (number, 0))
}

/// Stamps a message that was recorded before a request, relative to the stamp `number` of that request, because nodes
/// match the two by their stamps. Messages without a header are unchanged.
pub fn with_relative_stamp(message: &BagMessage, request: &BagMessage, number: u32) -> Bytes {
    let begins = |line: &str| matches!(line.trim(), "Header header" | "std_msgs/Header header");
    let fields = message.wire_type.definition.lines().map(str::trim);
    let first = fields.clone().find(|line| !line.is_empty() && !line.starts_with('#'));
    if !first.is_some_and(begins) {
        return message.bytes.clone();
    }
    let earlier = request.time.saturating_sub(message.time);
    let stamp = (u64::from(number) * SECOND).saturating_sub(earlier);
    let stamp = ((stamp / SECOND) as u32, (stamp % SECOND) as u32);
    set_stamp(&message.bytes, stamp).unwrap_or_else(|| message.bytes.clone())
}

fn set_stamp(bytes: &Bytes, (seconds, nanoseconds): (u32, u32)) -> Option<Bytes> {
    read_header(bytes)?;
    let mut message = bytes.to_vec();
    message[4..8].copy_from_slice(&seconds.to_le_bytes());
    message[8..12].copy_from_slice(&nanoseconds.to_le_bytes());
    Some(message.into())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    fn test_message(topic: &str, seconds: u64, bytes: &[u8]) -> BagMessage {
        let wire_type = Arc::new(ros::bus::WireType::any());
        BagMessage { topic: Arc::from(topic), wire_type, time: seconds * SECOND, bytes: Bytes::copy_from_slice(bytes) }
    }

    fn stamped_bytes(number: u32, rest: &[f64]) -> Vec<u8> {
        let mut bytes = Vec::new();
        for word in [7, number, 5, 3] {
            bytes.extend(u32::to_le_bytes(word));
        }
        bytes.extend(b"map");
        rest.iter().for_each(|number| bytes.extend(number.to_le_bytes()));
        bytes
    }

    #[test]
    fn a_header_is_read_up_to_its_end() {
        let bytes = stamped_bytes(42, &[1.0]);
        let header = read_header(&bytes).expect("a header");
        assert_eq!((header.stamp, header.end), ((42, 5), 19));
        assert_eq!(super::read_header(&bytes[..18]), None);
        assert_eq!(read_floats(&bytes, header.end, 1), Some(vec![1.0]));
        assert_eq!(read_floats(&bytes, header.end, 2), None);
    }

    #[test]
    fn a_pose_is_a_position_and_a_heading() {
        // A quarter turn about the vertical axis.
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let bytes = stamped_bytes(1, &[1.0, 2.0, 3.0, 0.0, 0.0, half, half]);
        let [x, y, heading] = read_pose(&bytes).expect("a pose");
        assert_eq!((x, y), (1.0, 2.0));
        assert!((heading - std::f64::consts::FRAC_PI_2).abs() < 1e-9);
    }

    #[test]
    fn requests_have_what_was_recorded_before_them() {
        let all = [("/odom", 10), ("/scan", 11), ("/odom", 12), ("/odom", 13), ("/scan", 14), ("/odom", 15)];
        let recording = Recording { messages: all.map(|(topic, at)| test_message(topic, at, b"")).to_vec() };
        let steps = recording.steps("/scan");
        let told: Vec<_> = steps.iter().map(|step| (step.before.len(), step.at)).collect();
        assert_eq!(told, [(1, 1.0), (2, 4.0)]);
        assert_eq!(recording.topics(&["/odom".to_owned()]).len(), 1);
    }

    #[test]
    fn an_answer_is_told_by_the_stamp() {
        let bytes = Bytes::from(stamped_bytes(42, &[]));
        let again = with_stamp(&bytes, 1001).expect("it has a header");
        assert_eq!(read_header(&again).map(|header| header.stamp), Some((1001, 0)));
        assert_eq!(with_stamp(&Bytes::from_static(b"short"), 1), None);
    }

    #[test]
    fn what_comes_before_a_request_stays_as_much_before_it() {
        let typed = |definition: &str, time: u64| BagMessage {
            wire_type: Arc::new(ros::bus::WireType::new("a/B", "0", definition)),
            time,
            ..test_message("/odom", 0, &stamped_bytes(42, &[]))
        };
        let request = test_message("/scan", 100, b"");
        let before = typed("# where it is\n\nHeader header\nfloat64 x", 99_999_000_000);
        let again = with_relative_stamp(&before, &request, 7);
        let stamp = read_header(&again).map(|header| header.stamp);
        assert_eq!(stamp, Some((6, 999_000_000)));
        let plain = typed("float64 x\nHeader header", 99_999_000_000);
        assert_eq!(with_relative_stamp(&plain, &request, 7), plain.bytes);
    }
}
