//! Messages as columns of numbers: one per field or channel of their big arrays, and the few bytes around them. This
//! gives general-purpose codecs the same knowledge of the layout as the link's codecs have.

use anyhow::{Context, Result, ensure};
use codec::Schema;

/// Position and type of one column within a message.
#[derive(Clone, Copy, Debug)]
pub struct Column {
    /// Offset of the first number.
    pub offset: usize,
    /// Number of bytes from one number to the next.
    pub stride: usize,
    pub count: usize,
    /// Number of bytes per number.
    pub bytes: usize,
    /// The numbers are floats of 32 bits.
    pub is_float: bool,
    /// Length of a picture's rows; zero for a sequence.
    pub row: usize,
}

impl Column {
    /// Returns the numbers, little endian, one behind the other.
    pub fn read(&self, message: &[u8]) -> Vec<u8> {
        let mut out = Vec::with_capacity(self.count * self.bytes);
        for number in message[self.offset..].chunks(self.stride).take(self.count) {
            out.extend_from_slice(&number[..self.bytes]);
        }
        out
    }

    /// Writes what [`Column::read`] returned.
    pub fn write(&self, numbers: &[u8], message: &mut [u8]) {
        let places = message[self.offset..].chunks_mut(self.stride);
        for (place, number) in places.zip(numbers.chunks_exact(self.bytes)) {
            place[..self.bytes].copy_from_slice(number);
        }
    }
}

/// The columns of a message, and the ranges of its big arrays.
#[derive(Clone, Debug, Default)]
pub struct ColumnLayout {
    pub columns: Vec<Column>,
    arrays: Vec<(usize, usize)>,
}

impl ColumnLayout {
    /// Reads the layout of a message in the format of ROS 1, which the messages of this benchmark have.
    pub fn read(schema: Schema, message: &[u8]) -> Result<Self> {
        let mut input = Fields { bytes: message, at: 12 };
        input.text()?;
        let mut layout = Self::default();
        match schema {
            Schema::Image => layout.read_image(input)?,
            Schema::OccupancyGrid => {
                input.at += 12;
                let (width, _) = (input.size()?, input.size()?);
                input.at += 56;
                let count = input.size()?;
                layout.add_array(input.at, count, 1, 1, false, width);
            }
            Schema::LaserScan => {
                input.at += 28;
                for _ in 0..2 {
                    let count = input.size()?;
                    layout.add_array(input.at, count, 1, 4, true, 0);
                    input.at += count * 4;
                }
            }
            Schema::PointCloud2 => layout.read_cloud(input)?,
            Schema::Other => {}
        }
        let end = layout.arrays.last().map_or(0, |array| array.1);
        ensure!(end <= message.len(), "a message of {} bytes has an array up to {end}", message.len());
        Ok(layout)
    }

    /// Adds an array of `count` elements, each of `channels` numbers of `bytes` bytes.
    fn add_array(&mut self, offset: usize, count: usize, channels: usize, bytes: usize, is_float: bool, row: usize) {
        let stride = channels * bytes;
        for channel in 0..channels {
            self.columns.push(Column { offset: offset + channel * bytes, stride, count, bytes, is_float, row });
        }
        self.arrays.push((offset, offset + count * stride));
    }

    fn read_image(&mut self, mut input: Fields<'_>) -> Result<()> {
        let (height, width) = (input.size()?, input.size()?);
        let encoding = input.text()?;
        input.at += 1;
        let (step, length) = (input.size()?, input.size()?);
        let (channels, bytes) = match encoding {
            b"16UC1" | b"mono16" => (1, 2),
            b"32FC1" => (1, 4),
            _ => (step / width, 1),
        };
        ensure!(width * channels * bytes == step && step * height == length, "rows are padded");
        self.add_array(input.at, width * height, channels, bytes, encoding == b"32FC1", width);
        Ok(())
    }

    fn read_cloud(&mut self, mut input: Fields<'_>) -> Result<()> {
        let (height, width, fields) = (input.size()?, input.size()?, input.size()?);
        let mut places = Vec::new();
        for _ in 0..fields {
            let name = input.text()?;
            let offset = input.size()?;
            let is_float = input.bytes.get(input.at) == Some(&7);
            input.at += 1;
            input.size()?;
            match name {
                b"rgb" => places.extend((0..4).map(|channel| (offset + channel, 1, false))),
                _ => places.push((offset, if is_float { 4 } else { 2 }, is_float)),
            }
        }
        input.at += 1;
        let (step, _, length) = (input.size()?, input.size()?, input.size()?);
        // Padding is words of zeros.
        for offset in (0..step).step_by(4) {
            if places.iter().all(|&(place, bytes, _)| place + bytes <= offset || place >= offset + 4) {
                places.push((offset, 4, false));
            }
        }
        let row = if height > 1 { width } else { 0 };
        for (offset, bytes, is_float) in places {
            let offset = input.at + offset;
            self.columns.push(Column { offset, stride: step, count: width * height, bytes, is_float, row });
        }
        self.arrays.push((input.at, input.at + length));
        Ok(())
    }

    /// Returns the bytes outside of the arrays.
    pub fn surroundings(&self, message: &[u8]) -> Vec<u8> {
        let mut out = Vec::new();
        let mut at = 0;
        for &(start, end) in &self.arrays {
            out.extend_from_slice(&message[at..start]);
            at = end;
        }
        out.extend_from_slice(&message[at..]);
        out
    }

    /// Returns a message of `length` bytes with these surroundings and zeros in its arrays.
    pub fn restore(&self, surroundings: &[u8], length: usize) -> Vec<u8> {
        let mut message = vec![0; length];
        let (mut at, mut rest) = (0, surroundings);
        for &(start, end) in self.arrays.iter().chain([&(length, length)]) {
            let (part, after) = rest.split_at(start - at);
            message[at..start].copy_from_slice(part);
            (at, rest) = (end, after);
        }
        message
    }
}

/// Reads little-endian fields one after the other.
pub struct Fields<'a> {
    pub bytes: &'a [u8],
    /// Offset of the next field.
    pub at: usize,
}

impl<'a> Fields<'a> {
    pub fn take(&mut self, count: usize) -> Result<&'a [u8]> {
        let taken = self.bytes.get(self.at..self.at + count).context("it ends within a field")?;
        self.at += count;
        Ok(taken)
    }

    pub fn size(&mut self) -> Result<usize> {
        Ok(u32::from_le_bytes(self.take(4)?.try_into()?) as usize)
    }

    /// Reads bytes behind their number.
    pub fn text(&mut self) -> Result<&'a [u8]> {
        let length = self.size()?;
        self.take(length)
    }
}
