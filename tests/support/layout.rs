//! Messages serialized by hand in the format of either version of ROS.

use bytes::{BufMut, Bytes, BytesMut};
use ros::bus::{RosVersion, WireFormat};

/// A message under construction.
pub struct MessageLayout {
    format: WireFormat,
    out: BytesMut,
}

/// CDR aligns numbers relative to the end of this header (little endian).
const HEADER: [u8; 4] = [0, 1, 0, 0];

impl MessageLayout {
    /// Creates an empty message for this version of ROS.
    pub fn new(version: RosVersion) -> Self {
        let format = WireFormat::for_version(version);
        let mut out = BytesMut::new();
        if format == WireFormat::Cdr {
            out.put_slice(&HEADER);
        }
        Self { format, out }
    }

    fn align(&mut self, to: usize) {
        if self.format == WireFormat::Cdr {
            let written = self.out.len() - HEADER.len();
            self.out.put_bytes(0, written.next_multiple_of(to) - written);
        }
    }

    /// Appends a byte.
    pub fn u8(&mut self, value: u8) -> &mut Self {
        self.out.put_u8(value);
        self
    }

    /// Appends a 32-bit integer.
    pub fn u32(&mut self, value: u32) -> &mut Self {
        self.align(4);
        self.out.put_u32_le(value);
        self
    }

    /// Appends a 32-bit float.
    pub fn f32(&mut self, value: f32) -> &mut Self {
        self.align(4);
        self.out.put_f32_le(value);
        self
    }

    /// Appends a 64-bit float.
    pub fn f64(&mut self, value: f64) -> &mut Self {
        self.align(8);
        self.out.put_f64_le(value);
        self
    }

    /// Appends a string.
    pub fn text(&mut self, text: &str) -> &mut Self {
        let end = usize::from(self.format == WireFormat::Cdr);
        self.u32(length(text.len() + end));
        self.out.put_slice(text.as_bytes());
        self.out.put_bytes(0, end);
        self
    }

    /// Appends bytes, preceded by their number.
    pub fn bytes(&mut self, bytes: &[u8]) -> &mut Self {
        self.u32(length(bytes.len()));
        self.out.put_slice(bytes);
        self
    }

    /// Appends a std_msgs/Header whose stamp is `number` seconds.
    pub fn header(&mut self, number: u32, frame: &str) -> &mut Self {
        if self.format == WireFormat::Ros1 {
            self.u32(number);
        }
        self.u32(number).u32(0).text(frame)
    }

    /// Appends a time, given in nanoseconds since 1970.
    pub fn time(&mut self, at: i64) -> &mut Self {
        let part = |part: i64| u32::try_from(part).unwrap_or(0);
        self.u32(part(at / 1_000_000_000)).u32(part(at % 1_000_000_000))
    }

    /// Appends a std_msgs/Header with this time.
    pub fn header_at(&mut self, at: i64, frame: &str) -> &mut Self {
        if self.format == WireFormat::Ros1 {
            self.u32(0);
        }
        self.time(at).text(frame)
    }

    /// Returns the message.
    pub fn finish(&mut self) -> Bytes {
        std::mem::take(&mut self.out).freeze()
    }
}

fn length(bytes: usize) -> u32 {
    u32::try_from(bytes).unwrap_or(u32::MAX)
}
