//! Recorded inputs, as a robot plays them: the messages of one topic are its requests, all others go with them.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result, ensure};
use bytes::{Buf, Bytes};
use ros::bag::{self, Recorded};

use crate::{stereo, stream};

/// Of pictures.
const SIZE: (u32, u32) = (640, 480);
/// Bytes of such a picture.
pub const PICTURE: usize = (SIZE.0 * SIZE.1 * 3) as usize;
/// Between two pictures, nanoseconds.
const PERIOD: u64 = 100_000_000;
const SECOND: u64 = 1_000_000_000;

/// A recording.
#[derive(Debug, Clone)]
pub struct Recording {
    /// In the order of their times.
    messages: Vec<Recorded>,
}

/// One request, and what was recorded before it since the one before.
pub struct Step<'a> {
    /// Other topics' messages.
    pub before: Vec<&'a Recorded>,
    /// The request.
    pub request: &'a Recorded,
    /// Seconds from the recording's first message.
    pub at: f64,
}

impl Recording {
    /// Reads a rosbag file that is not compressed, a file of [`stream`] that ends with `.messages`, one of [`stereo`] that ends with
    /// `.stereo`, or a file that ends with `.raw`: pictures of 640x480, bgr8, one after the other, ten a second.
    pub fn read(path: &Path) -> Result<Self> {
        let named = || path.display().to_string();
        let file = Bytes::from(std::fs::read(path).with_context(named)?);
        if path.extension().is_some_and(|ending| ending == "raw") {
            return Ok(pictures(&file));
        }
        if path.extension().is_some_and(|ending| ending == "messages") {
            let messages = stream::read(&file).with_context(named)?;
            return Ok(Self { messages });
        }
        if path.extension().is_some_and(|ending| ending == "stereo") {
            let messages = stereo::read(&file);
            return Ok(Self { messages });
        }
        let mut messages = bag::read(&file, usize::MAX).with_context(named)?;
        messages.sort_by_key(|message| message.time);
        ensure!(!messages.is_empty(), "{}: no message is in it", named());
        Ok(Self { messages })
    }

    /// The types of its topics, each once, but of those named.
    pub fn topics(&self, without: &[String]) -> Vec<&Recorded> {
        let mut topics: Vec<&Recorded> = Vec::new();
        for message in &self.messages {
            let known = topics.iter().any(|one| one.topic == message.topic);
            if !known && !without.iter().any(|name| **name == *message.topic) {
                topics.push(message);
            }
        }
        topics
    }

    /// The messages of `topic` as requests; what follows the last of them is left out.
    pub fn steps(&self, topic: &str) -> Vec<Step<'_>> {
        let first = self.messages[0].time;
        let mut steps = Vec::new();
        let mut before = Vec::new();
        for message in &self.messages {
            if *message.topic != *topic {
                before.push(message);
                continue;
            }
            steps.push(Step {
                before: std::mem::take(&mut before),
                request: message,
                at: (message.time - first) as f64 / 1e9,
            });
        }
        steps
    }

    /// Positions that were recorded on a topic of `geometry_msgs/PoseStamped`: seconds, x and y in metres.
    pub fn positions(&self, topic: &str) -> Vec<(f64, f64, f64)> {
        let first = self.messages[0].time;
        let of = self.messages.iter().filter(|one| *one.topic == *topic);
        let position = |one: &Recorded| {
            let at = (one.time - first) as f64 / 1e9;
            pose(&one.bytes).map(|[x, y, _]| (at, x, y))
        };
        of.filter_map(position).collect()
    }

    /// Made of these messages.
    #[cfg(test)]
    pub fn of(messages: Vec<Recorded>) -> Self {
        Self { messages }
    }
}

/// Pictures as messages.
fn pictures(file: &Bytes) -> Recording {
    let (width, height) = SIZE;
    let topic: Arc<str> = Arc::from("/image");
    let wire_type = Arc::new(support::people::image_type());
    let pictures = file.chunks_exact((width * height * 3) as usize);
    let messages = pictures.zip(0..).map(|(pixels, number)| Recorded {
        topic: topic.clone(),
        wire_type: wire_type.clone(),
        time: u64::from(number) * PERIOD,
        bytes: support::people::picture(number, SIZE, pixels),
    });
    Recording {
        messages: messages.collect(),
    }
}

/// `std_msgs/Header` at the beginning of a serialized message.
#[derive(Debug, PartialEq, Eq)]
pub struct Header {
    /// Seconds and nanoseconds.
    pub stamp: (u32, u32),
    /// Where what follows it begins, bytes.
    pub end: usize,
}

/// Reads it; none where the message is too short.
pub fn header(bytes: &[u8]) -> Option<Header> {
    let word = |at: usize| {
        let bytes = bytes.get(at..at + 4)?;
        Some(u32::from_le_bytes(bytes.try_into().ok()?))
    };
    let end = 16 + word(12)? as usize;
    (end <= bytes.len()).then_some(Header {
        stamp: (word(4)?, word(8)?),
        end,
    })
}

/// Of a `geometry_msgs/PoseStamped` or a message that begins like one: x, y (metres) and heading (radians).
pub fn pose(bytes: &[u8]) -> Option<[f64; 3]> {
    let numbers = numbers(bytes, header(bytes)?.end, 7)?;
    let [x, y, _, qx, qy, qz, qw] = numbers[..] else {
        return None;
    };
    let heading = f64::atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz));
    Some([x, y, heading])
}

/// So many float64 from there on.
pub fn numbers(bytes: &[u8], from: usize, count: usize) -> Option<Vec<f64>> {
    let mut rest = bytes.get(from..from + count * 8)?;
    Some((0..count).map(|_| rest.get_f64_le()).collect())
}

/// A message whose header's stamp is `number` seconds, so that its answer can be told from others.
pub fn restamped(bytes: &Bytes, number: u32) -> Option<Bytes> {
    stamped_at(bytes, (number, 0))
}

/// What was recorded before a request that is stamped with `number`, stamped as much earlier: what belongs to a request is told by that.
/// Messages without a header are as they were.
pub fn stamped_before(message: &Recorded, request: &Recorded, number: u32) -> Bytes {
    let begins = |line: &str| matches!(line.trim(), "Header header" | "std_msgs/Header header");
    let fields = message.wire_type.definition.lines().map(str::trim);
    let first = fields
        .clone()
        .find(|line| !line.is_empty() && !line.starts_with('#'));
    if !first.is_some_and(begins) {
        return message.bytes.clone();
    }
    let earlier = request.time.saturating_sub(message.time);
    let stamp = (u64::from(number) * SECOND).saturating_sub(earlier);
    let stamp = ((stamp / SECOND) as u32, (stamp % SECOND) as u32);
    stamped_at(&message.bytes, stamp).unwrap_or_else(|| message.bytes.clone())
}

fn stamped_at(bytes: &Bytes, (seconds, nanoseconds): (u32, u32)) -> Option<Bytes> {
    header(bytes)?;
    let mut message = bytes.to_vec();
    message[4..8].copy_from_slice(&seconds.to_le_bytes());
    message[8..12].copy_from_slice(&nanoseconds.to_le_bytes());
    Some(message.into())
}

/// One message, for tests.
#[cfg(test)]
pub fn recorded(topic: &str, seconds: u64, bytes: &[u8]) -> Recorded {
    Recorded {
        topic: Arc::from(topic),
        wire_type: Arc::new(ros::bus::WireType::any()),
        time: seconds * 1_000_000_000,
        bytes: Bytes::copy_from_slice(bytes),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stamped(number: u32, rest: &[f64]) -> Vec<u8> {
        let mut bytes = Vec::new();
        for word in [7, number, 5, 3] {
            bytes.extend(u32::to_le_bytes(word));
        }
        bytes.extend(b"map");
        rest.iter()
            .for_each(|number| bytes.extend(number.to_le_bytes()));
        bytes
    }

    #[test]
    fn a_header_is_read_up_to_its_end() {
        let bytes = stamped(42, &[1.0]);
        let header = header(&bytes).expect("a header");
        assert_eq!((header.stamp, header.end), ((42, 5), 19));
        assert_eq!(super::header(&bytes[..18]), None);
        assert_eq!(numbers(&bytes, header.end, 1), Some(vec![1.0]));
        assert_eq!(numbers(&bytes, header.end, 2), None);
    }

    #[test]
    fn a_pose_is_a_position_and_a_heading() {
        // A quarter turn about the vertical axis.
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let bytes = stamped(1, &[1.0, 2.0, 3.0, 0.0, 0.0, half, half]);
        let [x, y, heading] = pose(&bytes).expect("a pose");
        assert_eq!((x, y), (1.0, 2.0));
        assert!((heading - std::f64::consts::FRAC_PI_2).abs() < 1e-9);
    }

    #[test]
    fn requests_have_what_was_recorded_before_them() {
        let recording = Recording::of(vec![
            recorded("/odom", 10, b"a"),
            recorded("/scan", 11, b"b"),
            recorded("/odom", 12, b"c"),
            recorded("/odom", 13, b"d"),
            recorded("/scan", 14, b"e"),
            recorded("/odom", 15, b"f"),
        ]);
        let steps = recording.steps("/scan");
        let told: Vec<_> = steps
            .iter()
            .map(|step| (step.before.len(), step.at))
            .collect();
        assert_eq!(told, [(1, 1.0), (2, 4.0)]);
        assert_eq!(recording.topics(&["/odom".to_owned()]).len(), 1);
    }

    #[test]
    fn an_answer_is_told_by_the_stamp() {
        let bytes = Bytes::from(stamped(42, &[]));
        let again = restamped(&bytes, 1001).expect("it has a header");
        assert_eq!(header(&again).map(|header| header.stamp), Some((1001, 0)));
        assert_eq!(restamped(&Bytes::from_static(b"short"), 1), None);
    }

    #[test]
    fn what_comes_before_a_request_stays_as_much_before_it() {
        let typed = |definition: &str, time: u64| Recorded {
            wire_type: Arc::new(ros::bus::WireType::new("a/B", "0", definition)),
            time,
            ..recorded("/odom", 0, &stamped(42, &[]))
        };
        let request = recorded("/scan", 100, b"");
        let before = typed("# where it is\n\nHeader header\nfloat64 x", 99_999_000_000);
        let again = stamped_before(&before, &request, 7);
        let stamp = header(&again).map(|header| header.stamp);
        assert_eq!(stamp, Some((6, 999_000_000)));
        let plain = typed("float64 x\nHeader header", 99_999_000_000);
        assert_eq!(stamped_before(&plain, &request, 7), plain.bytes);
    }
}
