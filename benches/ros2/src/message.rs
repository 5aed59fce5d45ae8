//! The few messages that are measured with, in CDR: little endian, with its header of four bytes.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use bytes::Bytes;

pub(crate) const STRING: &str = "std_msgs::msg::dds_::String_";
pub(crate) const IMAGE: &str = "sensor_msgs::msg::dds_::Image_";
pub(crate) const REQUEST: &str = "std_srvs::srv::dds_::SetBool_Request_";
pub(crate) const RESPONSE: &str = "std_srvs::srv::dds_::SetBool_Response_";

/// What `std_msgs/String` says where its text does not matter.
pub(crate) const TEXT: &str = "a message of a usual size";

const HEADER: [u8; 4] = [0, 1, 0, 0];

/// Widths and heights of the pictures; three bytes each pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Size {
    pub(crate) width: u32,
    pub(crate) height: u32,
}

impl Size {
    pub(crate) const SMALL: Self = Self {
        width: 640,
        height: 480,
    };
    pub(crate) const LARGE: Self = Self {
        width: 1920,
        height: 1080,
    };

    pub(crate) fn bytes(self) -> u32 {
        self.width * self.height * 3
    }
}

fn align(out: &mut Vec<u8>) {
    out.resize(out.len().next_multiple_of(4), 0);
}

fn word(out: &mut Vec<u8>, word: u32) {
    align(out);
    out.extend(word.to_le_bytes());
}

fn text(out: &mut Vec<u8>, text: &str) {
    word(out, text.len() as u32 + 1);
    out.extend(text.as_bytes());
    out.push(0);
}

/// A `std_msgs/String`.
pub(crate) fn string(value: &str) -> Bytes {
    let mut out = HEADER.to_vec();
    text(&mut out, value);
    align(&mut out);
    out.into()
}

/// A request of `std_srvs/SetBool`.
pub(crate) fn request(data: bool) -> Bytes {
    [HEADER, [u8::from(data), 0, 0, 0]].concat().into()
}

/// The response that says what was asked.
pub(crate) fn response(request: &[u8]) -> Bytes {
    let mut out = HEADER.to_vec();
    out.push(request.get(4).copied().unwrap_or(0));
    text(&mut out, "");
    align(&mut out);
    out.into()
}

/// A goal of `test_msgs/Fibonacci`.
pub(crate) fn order() -> Bytes {
    Bytes::from_static(&[0, 1, 0, 0, 2, 0, 0, 0])
}

/// A feedback or result of it: two numbers.
pub(crate) fn numbers() -> Bytes {
    Bytes::from_static(&[0, 1, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0])
}

/// A `sensor_msgs/Image` whose frame is its number and whose stamp is the time.
pub(crate) fn picture(number: u32, size: Size) -> Bytes {
    let mut out = Vec::with_capacity(size.bytes() as usize + 96);
    let now = since_1970();
    out.extend(HEADER);
    word(&mut out, now.as_secs() as u32);
    word(&mut out, now.subsec_nanos());
    text(&mut out, &number.to_string());
    word(&mut out, size.height);
    word(&mut out, size.width);
    text(&mut out, "rgb8");
    out.push(0);
    word(&mut out, size.width * 3);
    word(&mut out, size.bytes());
    out.resize(out.len() + size.bytes() as usize, number as u8);
    align(&mut out);
    out.into()
}

/// A picture's number, and how long ago it was made; none of what is no picture.
pub(crate) fn of_picture(payload: &[u8]) -> Option<(u32, Duration)> {
    let word = |at: usize| Some(u32::from_le_bytes(*payload.get(at..)?.first_chunk()?));
    let length = word(12)? as usize;
    let frame = payload.get(16..)?.get(..length.checked_sub(1)?)?;
    let number = std::str::from_utf8(frame).ok()?.parse().ok()?;
    let made = Duration::new(u64::from(word(4)?), word(8)?);
    Some((number, since_1970().saturating_sub(made)))
}

fn since_1970() -> Duration {
    SystemTime::now()
        .duration_since(UNIX_EPOCH)
        .unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_tells_its_number_and_is_as_long_as_its_fields() {
        let picture = picture(1234, Size::SMALL);
        let (number, age) = of_picture(&picture).expect("a picture");
        assert_eq!(number, 1234);
        assert!(age < Duration::from_secs(10));
        // Header, stamp, frame, height and width, encoding, order of bytes, step, length, pixels: each at its place.
        assert_eq!(
            picture.len(),
            4 + 8 + (4 + 5 + 3) + 8 + (4 + 5 + 1 + 2) + 4 + 4 + 921_600
        );
        assert!(of_picture(&picture[..17]).is_none());
    }

    #[test]
    fn a_response_repeats_the_request() {
        assert_eq!(
            &response(&request(true))[..],
            [0, 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0]
        );
    }
}
