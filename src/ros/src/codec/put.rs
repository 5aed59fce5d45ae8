//! A message of ROS 2 written value by value, for the few that are made here rather than passed on.

use bytes::Bytes;

use crate::codec::cdr::HEADER;

/// A message so far: little endian.
pub(crate) struct Put {
    out: Vec<u8>,
}

impl Put {
    /// Without any value.
    pub(crate) fn new() -> Self {
        Self {
            out: HEADER.to_vec(),
        }
    }

    /// A number, or a bool: its bytes, little endian.
    pub(crate) fn number<const N: usize>(&mut self, little_endian: [u8; N]) {
        let length = self.out.len() - HEADER.len();
        let padded = self.out.len() + length.next_multiple_of(N) - length;
        self.out.resize(padded, 0);
        self.out.extend_from_slice(&little_endian);
    }

    /// One byte.
    pub(crate) fn byte(&mut self, byte: u8) {
        self.out.push(byte);
    }

    /// Bytes as they are: an array of a fixed length.
    pub(crate) fn bytes(&mut self, bytes: &[u8]) {
        self.out.extend_from_slice(bytes);
    }

    /// How many elements of a list follow. More than 2^32 do not fit into memory that is given to messages.
    pub(crate) fn length(&mut self, length: usize) {
        self.number((length as u32).to_le_bytes());
    }

    /// A string.
    pub(crate) fn text(&mut self, text: &str) {
        self.length(text.len() + 1);
        self.out.extend_from_slice(text.as_bytes());
        self.out.push(0);
    }

    /// The whole message. One without values has a byte all the same.
    pub(crate) fn end(mut self) -> Bytes {
        if self.out.len() == HEADER.len() {
            self.out.push(0);
        }
        self.out.into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::RosVersion;
    use crate::codec::from_json;
    use crate::schema::Registry;

    #[test]
    fn it_writes_what_the_codec_does() {
        let registry = Registry::of(RosVersion::Two);
        let text = "bool a\nfloat64 b\nstring c\nint16[2] d\nuint8[3] e\nint64[] f";
        registry.insert("x/msg/All", text).unwrap();
        let mut expected = Vec::new();
        let json = br#"{"a":true,"b":0.5,"c":"abc","d":[1,-2],"e":"AQID","f":[7]}"#;
        let all = registry.message("x/All").unwrap();
        from_json(&all, json, &mut expected, &Default::default()).unwrap();
        let mut put = Put::new();
        put.byte(1);
        put.number(0.5f64.to_le_bytes());
        put.text("abc");
        put.number(1i16.to_le_bytes());
        put.number((-2i16).to_le_bytes());
        put.bytes(&[1, 2, 3]);
        put.length(1);
        put.number(7i64.to_le_bytes());
        assert_eq!(put.end(), expected);
        assert_eq!(Put::new().end()[..], [0, 1, 0, 0, 0]);
    }
}
