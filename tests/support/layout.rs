//! Messages written by hand in the format of either ROS.

use bytes::{BufMut, Bytes, BytesMut};
use ros::bus::{RosVersion, WireFormat};

/// A message that is being written.
pub struct Layout {
    format: WireFormat,
    out: BytesMut,
}

/// In CDR, numbers are aligned from behind this header (little endian).
const HEADER: [u8; 4] = [0, 1, 0, 0];

impl Layout {
    /// Of this ROS, empty.
    pub fn of(version: RosVersion) -> Self {
        let format = WireFormat::of(version);
        let mut out = BytesMut::new();
        if format == WireFormat::Cdr {
            out.put_slice(&HEADER);
        }
        Self { format, out }
    }

    fn align(&mut self, to: usize) {
        if self.format == WireFormat::Cdr {
            let written = self.out.len() - HEADER.len();
            self.out
                .put_bytes(0, written.next_multiple_of(to) - written);
        }
    }

    /// A byte.
    pub fn u8(&mut self, value: u8) -> &mut Self {
        self.out.put_u8(value);
        self
    }

    /// Four bytes.
    pub fn u32(&mut self, value: u32) -> &mut Self {
        self.align(4);
        self.out.put_u32_le(value);
        self
    }

    /// A float of four bytes.
    pub fn f32(&mut self, value: f32) -> &mut Self {
        self.align(4);
        self.out.put_f32_le(value);
        self
    }

    /// A float of eight bytes.
    pub fn f64(&mut self, value: f64) -> &mut Self {
        self.align(8);
        self.out.put_f64_le(value);
        self
    }

    /// A text.
    pub fn text(&mut self, text: &str) -> &mut Self {
        let end = usize::from(self.format == WireFormat::Cdr);
        self.u32(length(text.len() + end));
        self.out.put_slice(text.as_bytes());
        self.out.put_bytes(0, end);
        self
    }

    /// Bytes of which the number is told.
    pub fn bytes(&mut self, bytes: &[u8]) -> &mut Self {
        self.u32(length(bytes.len()));
        self.out.put_slice(bytes);
        self
    }

    /// A std_msgs/Header that is stamped with a number, in seconds.
    pub fn header(&mut self, number: u32, frame: &str) -> &mut Self {
        if self.format == WireFormat::Ros1 {
            self.u32(number);
        }
        self.u32(number).u32(0).text(frame)
    }

    /// A moment, in nanoseconds since 1970.
    pub fn time(&mut self, at: i64) -> &mut Self {
        let part = |part: i64| u32::try_from(part).unwrap_or(0);
        self.u32(part(at / 1_000_000_000))
            .u32(part(at % 1_000_000_000))
    }

    /// A std_msgs/Header of that moment.
    pub fn header_of(&mut self, at: i64, frame: &str) -> &mut Self {
        if self.format == WireFormat::Ros1 {
            self.u32(0);
        }
        self.time(at).text(frame)
    }

    /// What was written.
    pub fn finish(&mut self) -> Bytes {
        std::mem::take(&mut self.out).freeze()
    }
}

fn length(bytes: usize) -> u32 {
    u32::try_from(bytes).unwrap_or(u32::MAX)
}
