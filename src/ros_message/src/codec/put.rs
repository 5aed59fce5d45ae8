//! Writer for ROS 2 messages, for the few messages that are created here rather than forwarded.

use bytes::Bytes;

use crate::codec::cdr::HEADER;

/// A message under construction, little endian.
pub struct CdrWriter {
    out: Vec<u8>,
}

impl Default for CdrWriter {
    fn default() -> Self {
        Self::new()
    }
}

impl CdrWriter {
    /// Creates a message without values.
    pub fn new() -> Self {
        Self { out: HEADER.to_vec() }
    }

    /// Writes a number or a bool, given as little-endian bytes.
    pub fn number<const N: usize>(&mut self, little_endian: [u8; N]) {
        let length = self.out.len() - HEADER.len();
        let padded = self.out.len() + length.next_multiple_of(N) - length;
        self.out.resize(padded, 0);
        self.out.extend_from_slice(&little_endian);
    }

    /// Writes one byte.
    pub fn byte(&mut self, byte: u8) {
        self.out.push(byte);
    }

    /// Writes bytes without a length: an array of fixed length.
    pub fn bytes(&mut self, bytes: &[u8]) {
        self.out.extend_from_slice(bytes);
    }

    /// Writes the length of a list. Lengths beyond 2^32 do not fit into the memory allowed for messages.
    pub fn length(&mut self, length: usize) {
        self.number((length as u32).to_le_bytes());
    }

    /// Writes a string.
    pub fn text(&mut self, text: &str) {
        self.length(text.len() + 1);
        self.out.extend_from_slice(text.as_bytes());
        self.out.push(0);
    }

    /// Returns the finished message. A message without values consists of one byte.
    pub fn finish(mut self) -> Bytes {
        if self.out.len() == HEADER.len() {
            self.out.push(0);
        }
        self.out.into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::RosVersion;
    use crate::codec::from_json;
    use crate::schema::Registry;

    #[test]
    fn it_writes_what_the_codec_does() {
        let registry = Registry::for_version(RosVersion::Two);
        let text = "bool a\nfloat64 b\nstring c\nint16[2] d\nuint8[3] e\nint64[] f";
        registry.insert("x/msg/All", text).unwrap();
        let mut expected = Vec::new();
        let json = br#"{"a":true,"b":0.5,"c":"abc","d":[1,-2],"e":"AQID","f":[7]}"#;
        let all = registry.message("x/All").unwrap();
        from_json(&all, json, &mut expected, &Default::default()).unwrap();
        let mut put = CdrWriter::new();
        put.byte(1);
        put.number(0.5f64.to_le_bytes());
        put.text("abc");
        put.number(1i16.to_le_bytes());
        put.number((-2i16).to_le_bytes());
        put.bytes(&[1, 2, 3]);
        put.length(1);
        put.number(7i64.to_le_bytes());
        assert_eq!(put.finish(), expected);
        assert_eq!(CdrWriter::new().finish()[..], [0, 1, 0, 0, 0]);
    }
}
