//! The types of the benchmark and their messages in CDR: little endian, with the encapsulation header of four bytes.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use anyhow::Result;
use bytes::Bytes;
use ros::bus::RosVersion;
use ros::schema::Registry;

/// Type names in the form that rosbridge clients use.
pub(crate) const STRING: &str = "std_msgs/msg/String";
pub(crate) const IMAGE: &str = "sensor_msgs/msg/Image";
pub(crate) const CALL: &str = "std_srvs/srv/SetBool";
pub(crate) const GOAL: &str = "test_msgs/action/Fibonacci";

/// Definitions exactly as in the ROS packages, without comments: types are identified by a hash of them.
const DEFINITIONS: [(&str, &str); 6] = [
    (STRING, "string data\n"),
    ("builtin_interfaces/msg/Time", "int32 sec\nuint32 nanosec\n"),
    ("std_msgs/msg/Header", "builtin_interfaces/Time stamp\nstring frame_id\n"),
    (
        IMAGE,
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 \
         step\nuint8[] data\n",
    ),
    (CALL, "bool data\n---\nbool success\nstring message\n"),
    (GOAL, "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n"),
];

/// Returns a registry of all definitions, as a daemon gets it from an image.
pub(crate) fn registry() -> Result<Registry> {
    let known = Registry::for_version(RosVersion::Two);
    for (name, text) in DEFINITIONS {
        known.insert(name, text)?;
    }
    Ok(known)
}

/// Text of a `std_msgs/String` where the content does not matter.
pub(crate) const TEXT: &str = "a message of a usual size";

const HEADER: [u8; 4] = [0, 1, 0, 0];

/// Width and height of an image of three bytes per pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Size {
    pub(crate) width: u32,
    pub(crate) height: u32,
}

impl Size {
    pub(crate) const SMALL: Self = Self { width: 640, height: 480 };
    pub(crate) const LARGE: Self = Self { width: 1920, height: 1080 };

    pub(crate) fn byte_count(self) -> u32 {
        self.width * self.height * 3
    }
}

fn pad(out: &mut Vec<u8>) {
    out.resize(out.len().next_multiple_of(4), 0);
}

fn put_u32(out: &mut Vec<u8>, word: u32) {
    pad(out);
    out.extend(word.to_le_bytes());
}

fn put_string(out: &mut Vec<u8>, text: &str) {
    put_u32(out, text.len() as u32 + 1);
    out.extend(text.as_bytes());
    out.push(0);
}

/// Serializes a `std_msgs/String`.
pub(crate) fn string(value: &str) -> Bytes {
    let mut out = HEADER.to_vec();
    put_string(&mut out, value);
    pad(&mut out);
    out.into()
}

/// Serializes a request of `std_srvs/SetBool` with `true`.
pub(crate) fn set_bool_request() -> Bytes {
    Bytes::from_static(&[0, 1, 0, 0, 1, 0, 0, 0])
}

/// Serializes the response to a request, with the value of the request as `success`.
pub(crate) fn set_bool_response(request: &[u8]) -> Bytes {
    let mut out = HEADER.to_vec();
    out.push(request.get(4).copied().unwrap_or(0));
    put_string(&mut out, "");
    pad(&mut out);
    out.into()
}

/// Serializes a goal of `test_msgs/Fibonacci`.
pub(crate) fn fibonacci_goal() -> Bytes {
    Bytes::from_static(&[0, 1, 0, 0, 2, 0, 0, 0])
}

/// Serializes a feedback or result of `test_msgs/Fibonacci`: two numbers.
pub(crate) fn fibonacci_sequence() -> Bytes {
    Bytes::from_static(&[0, 1, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0])
}

/// Serializes a `sensor_msgs/Image` whose frame id is its number and whose stamp is the current time.
pub(crate) fn picture(number: u32, size: Size) -> Bytes {
    let mut out = Vec::with_capacity(size.byte_count() as usize + 96);
    let now = unix_time();
    out.extend(HEADER);
    put_u32(&mut out, now.as_secs() as u32);
    put_u32(&mut out, now.subsec_nanos());
    put_string(&mut out, &number.to_string());
    put_u32(&mut out, size.height);
    put_u32(&mut out, size.width);
    put_string(&mut out, "rgb8");
    out.push(0);
    put_u32(&mut out, size.width * 3);
    put_u32(&mut out, size.byte_count());
    out.resize(out.len() + size.byte_count() as usize, number as u8);
    pad(&mut out);
    out.into()
}

/// Returns the number of an image and its age; `None` if the payload is not such an image.
pub(crate) fn parse_picture(payload: &[u8]) -> Option<(u32, Duration)> {
    let word = |at: usize| Some(u32::from_le_bytes(*payload.get(at..)?.first_chunk()?));
    let length = word(12)? as usize;
    let frame = payload.get(16..)?.get(..length.checked_sub(1)?)?;
    let number = std::str::from_utf8(frame).ok()?.parse().ok()?;
    let made = Duration::new(u64::from(word(4)?), word(8)?);
    Some((number, unix_time().saturating_sub(made)))
}

fn unix_time() -> Duration {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_tells_its_number_and_is_as_long_as_its_fields() {
        let picture = picture(1234, Size::SMALL);
        let (number, age) = parse_picture(&picture).expect("a picture");
        assert_eq!(number, 1234);
        assert!(age < Duration::from_secs(10));
        // Header, stamp, frame id, height and width, encoding, byte order, step, length, pixels, with padding.
        assert_eq!(picture.len(), 4 + 8 + (4 + 5 + 3) + 8 + (4 + 5 + 1 + 2) + 4 + 4 + 921_600);
        assert!(parse_picture(&picture[..17]).is_none());
    }

    #[test]
    fn a_response_repeats_the_request() {
        assert_eq!(&set_bool_response(&set_bool_request())[..], [0, 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0]);
    }
}
