//! Layouts of the serialized messages that the codecs know: in the ROS 1 wire format (little endian, strings and arrays
//! preceded by a 32-bit length), and in the CDR of ROS 2 (see [`FieldReader`]).
//!
//! A layout is read from the *head* of a message, all bytes before its big array, and the message's length. It is
//! `None` unless every byte of the message is accounted for, so that a codec which accepts a layout can restore the
//! message from it. The decoder reads the same layout from the head it received, so the format of a message need not be
//! transmitted.

mod fields;

use crate::Error;
use crate::wire::{FrameCursor, MessageEnds};
use fields::{FieldReader, read_in_either_format};

/// The message types with a codec of their own, identified by name and md5 or type hash (which fix the layout).
#[derive(Clone, Copy, PartialEq, Eq, Debug, Hash)]
pub enum Schema {
    /// `sensor_msgs/Image`
    Image,
    /// `nav_msgs/OccupancyGrid`
    OccupancyGrid,
    /// `sensor_msgs/LaserScan`
    LaserScan,
    /// `sensor_msgs/PointCloud2`
    PointCloud2,
    /// Any other type: plain bytes.
    Other,
}

/// Known types by name, with the md5 of ROS 1 and the type hash (REP-2016) of ROS 2 Jazzy and Kilted.
const KNOWN_TYPES: [(&str, [&str; 2], Schema); 4] = [
    (
        "sensor_msgs/Image",
        ["060021388200f6f0f447d0fcd9c64743", "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"],
        Schema::Image,
    ),
    (
        "nav_msgs/OccupancyGrid",
        ["3381f2d731d4076ec5c71b0759edbe4e", "RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7"],
        Schema::OccupancyGrid,
    ),
    (
        "sensor_msgs/LaserScan",
        ["90c7ef2dc6895d81024acba2ac42f369", "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828"],
        Schema::LaserScan,
    ),
    (
        "sensor_msgs/PointCloud2",
        ["1158d486dd51d683ce2f1be655c3c181", "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"],
        Schema::PointCloud2,
    ),
];

impl Schema {
    /// Returns the schema of a type, by its name (`pkg/Type` or `pkg/msg/Type`) and its md5 or type hash; a known name
    /// with another digest is `Other`.
    pub fn for_type(name: &str, digest: &str) -> Self {
        let name = name.replacen("/msg/", "/", 1);
        KNOWN_TYPES
            .iter()
            .find(|(known, digests, _)| *known == name && digests.contains(&digest))
            .map_or(Self::Other, |&(.., schema)| schema)
    }
}

/// Format of a picture's samples.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Pixel {
    /// Interleaved 8-bit channels: one to four.
    Bytes(usize),
    /// 8-bit colour filter array of two by two.
    Bayer,
    /// One 16-bit channel.
    Short,
    /// One 32-bit integer channel.
    Word,
    /// One 32-bit float channel.
    Float,
}

impl Pixel {
    fn from_encoding(encoding: &[u8]) -> Option<Self> {
        Some(match encoding {
            b"mono8" | b"8UC1" | b"8SC1" => Self::Bytes(1),
            b"8UC2" | b"8SC2" => Self::Bytes(2),
            b"rgb8" | b"bgr8" | b"8UC3" | b"8SC3" => Self::Bytes(3),
            b"rgba8" | b"bgra8" | b"8UC4" | b"8SC4" => Self::Bytes(4),
            b"bayer_rggb8" | b"bayer_bggr8" | b"bayer_gbrg8" | b"bayer_grbg8" => Self::Bayer,
            b"mono16" | b"16UC1" | b"16SC1" => Self::Short,
            b"bayer_rggb16" | b"bayer_bggr16" | b"bayer_gbrg16" | b"bayer_grbg16" => Self::Short,
            b"32SC1" => Self::Word,
            b"32FC1" => Self::Float,
            _ => return None,
        })
    }

    pub(crate) fn bytes(self) -> usize {
        match self {
            Self::Bytes(channels) => channels,
            Self::Bayer => 1,
            Self::Short => 2,
            Self::Word | Self::Float => 4,
        }
    }
}

/// `sensor_msgs/Image`; the data is the end of the message.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct ImageLayout {
    /// Offset of the data.
    pub(crate) head: usize,
    /// Number of padding bytes behind the data, which fill the last word.
    pub(crate) tail: usize,
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) step: usize,
    pub(crate) big_endian: bool,
    pub(crate) pixel: Pixel,
    /// The channels are red first (or unknown) rather than blue first.
    pub(crate) red_first: bool,
    /// The samples are known to come from a camera, rather than being labels or other numbers.
    pub(crate) seen: bool,
}

impl ImageLayout {
    pub(crate) fn read(head: &[u8], total: usize) -> Option<Self> {
        read_in_either_format(head, |input| Self::read_fields(input, total))
    }

    fn read_fields(mut input: FieldReader<'_>, total: usize) -> Option<Self> {
        input.skip_header()?;
        let height = input.size()?;
        let width = input.size()?;
        let encoding = input.string()?;
        let pixel = Pixel::from_encoding(encoding)?;
        let big_endian = input.byte()? != 0;
        let step = input.size()?;
        let data = input.size()?;
        let head = input.bytes_read();
        let tail = input.tail_length(data, total)?;
        let fits =
            width > 0 && height > 0 && width.checked_mul(pixel.bytes())? <= step && step.checked_mul(height)? == data;
        let red_first = !encoding.starts_with(b"bgr");
        let seen = [&b"mono8"[..], b"rgb8", b"bgr8", b"rgba8", b"bgra8"].contains(&encoding);
        fits.then_some(Self { head, tail, width, height, step, big_endian, pixel, red_first, seen })
    }

    /// Reads the head and tail of an image from a frame.
    pub(crate) fn take<'a>(input: &mut FrameCursor<'a>, total: usize) -> Result<(Self, MessageEnds<'a>), Error> {
        take_ends(input, "a head that is not an image's", |ends| {
            let layout = Self::read(ends, total)?;
            Some((layout, layout.head, layout.tail))
        })
    }

    /// Returns the samples with the padding between their rows.
    pub(crate) fn data<'a>(&self, message: &'a [u8]) -> &'a [u8] {
        &message[self.head..message.len() - self.tail]
    }

    /// Returns the number of bytes of a row that are samples; the rest of `step` is padding.
    pub(crate) fn row_bytes(&self) -> usize {
        self.width * self.pixel.bytes()
    }
}

/// Reads the head and tail of a message from a frame. `read` returns the layout that they describe, with the lengths of
/// both; `wrong` is the error if it cannot.
pub(crate) fn take_ends<'a, L>(
    input: &mut FrameCursor<'a>,
    wrong: &'static str,
    read: impl FnOnce(&[u8]) -> Option<(L, usize, usize)>,
) -> Result<(L, MessageEnds<'a>), Error> {
    let ends = input.block()?;
    let (layout, head, _) =
        read(ends).filter(|(_, head, tail)| head + tail == ends.len()).ok_or(Error::Corrupt(wrong))?;
    Ok((layout, MessageEnds::from_joined(ends, head)))
}

/// `nav_msgs/OccupancyGrid`; the cells are the end of the message.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct GridLayout {
    /// Offset of the cells.
    pub(crate) head: usize,
    /// Number of padding bytes behind the cells, which fill the last word.
    pub(crate) tail: usize,
    pub(crate) width: usize,
    pub(crate) height: usize,
}

impl GridLayout {
    pub(crate) fn read(head: &[u8], total: usize) -> Option<Self> {
        read_in_either_format(head, |input| Self::read_fields(input, total))
    }

    fn read_fields(mut input: FieldReader<'_>, total: usize) -> Option<Self> {
        input.skip_header()?;
        // Time of loading, and metres per cell.
        input.skip_words(3)?;
        let width = input.size()?;
        let height = input.size()?;
        // Pose of cell (0, 0).
        input.skip_doubles(7)?;
        let cells = input.size()?;
        let head = input.bytes_read();
        let tail = input.tail_length(cells, total)?;
        let fits = width > 0 && height > 0 && width.checked_mul(height)? == cells;
        fits.then_some(Self { head, tail, width, height })
    }
}

/// `sensor_msgs/LaserScan`: ranges, then intensities.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct ScanLayout {
    /// Offset of the ranges.
    pub(crate) head: usize,
    pub(crate) ranges: usize,
    pub(crate) intensities: usize,
}

impl ScanLayout {
    /// Reads the layout; the number of intensities follows from the message's length.
    pub(crate) fn read(head: &[u8], total: usize) -> Option<Self> {
        read_in_either_format(head, |input| Self::read_fields(input, total))
    }

    fn read_fields(mut input: FieldReader<'_>, total: usize) -> Option<Self> {
        input.skip_header()?;
        input.skip_words(7)?;
        let ranges = input.size()?;
        let head = input.bytes_read();
        let rest = total.checked_sub(head)?.checked_sub(ranges.checked_mul(4)?)?.checked_sub(4)?;
        (rest % 4 == 0).then_some(Self { head, ranges, intensities: rest / 4 })
    }

    /// Returns the offset of the intensities' length.
    pub(crate) fn intensity_length_offset(&self) -> usize {
        self.head + self.ranges * 4
    }
}

/// Type of a point field's numbers, by the constants of `sensor_msgs/PointField`.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum NumberType {
    Byte,
    Short,
    Word,
    Float,
    Double,
}

impl NumberType {
    pub(crate) fn bytes(self) -> usize {
        match self {
            Self::Byte => 1,
            Self::Short => 2,
            Self::Word | Self::Float => 4,
            Self::Double => 8,
        }
    }
}

/// Meaning of a field, derived from its name.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum FieldMeaning {
    X,
    Y,
    Z,
    /// Four bytes: blue, green, red, alpha.
    Colour,
    /// Index of the laser that measured the point.
    Ring,
    Plain,
}

/// One number of every point.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct PointField {
    pub(crate) offset: usize,
    pub(crate) number: NumberType,
    pub(crate) meaning: FieldMeaning,
}

/// `sensor_msgs/PointCloud2`; one byte, `is_dense`, follows the data.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) struct CloudLayout {
    /// Offset of the data.
    pub(crate) head: usize,
    /// Number of padding bytes behind `is_dense`, which fill the last word.
    pub(crate) tail: usize,
    /// Offset of the height, which the width follows.
    pub(crate) size_at: usize,
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) point_step: usize,
    pub(crate) row_step: usize,
    /// Sorted by offset, without overlap.
    pub(crate) fields: Vec<PointField>,
}

/// Maximum number of fields: no known sensor has more, and it bounds the work that a head can cause.
const MAX_FIELDS: usize = 64;

impl CloudLayout {
    pub(crate) fn read(head: &[u8], total: usize) -> Option<Self> {
        read_in_either_format(head, |input| Self::read_fields(input, total))
    }

    fn read_fields(mut input: FieldReader<'_>, total: usize) -> Option<Self> {
        input.skip_header()?;
        let height = input.size()?;
        let size_at = input.bytes_read() - 4;
        let width = input.size()?;
        let count = input.size()?;
        let mut fields = Vec::new();
        for _ in 0..count {
            Self::read_field(&mut input, &mut fields)?;
        }
        let big_endian = input.byte()? != 0;
        let point_step = input.size()?;
        let row_step = input.size()?;
        let data = input.size()?;
        let head = input.bytes_read();
        let tail = input.tail_length(data.checked_add(1)?, total)?;
        fields.sort_by_key(|field| field.offset);
        let apart = fields.windows(2).all(|pair| pair[0].offset + pair[0].number.bytes() <= pair[1].offset);
        let inside = fields.last().is_none_or(|last| last.offset + last.number.bytes() <= point_step);
        let fits = !big_endian
            && apart
            && inside
            && width > 0
            && height > 0
            && point_step > 0
            && width.checked_mul(point_step)? <= row_step
            && row_step.checked_mul(height)? == data;
        fits.then_some(Self { head, tail, size_at, width, height, point_step, row_step, fields })
    }

    fn read_field(input: &mut FieldReader<'_>, fields: &mut Vec<PointField>) -> Option<()> {
        let name = input.string()?;
        let offset = input.size()?;
        let number = match input.byte()? {
            1 | 2 => NumberType::Byte,
            3 | 4 => NumberType::Short,
            5 | 6 => NumberType::Word,
            7 => NumberType::Float,
            8 => NumberType::Double,
            _ => return None,
        };
        let count = input.size()?;
        let meaning = match (name, number, count) {
            (b"x", NumberType::Float, 1) => FieldMeaning::X,
            (b"y", NumberType::Float, 1) => FieldMeaning::Y,
            (b"z", NumberType::Float, 1) => FieldMeaning::Z,
            (b"rgb" | b"rgba", NumberType::Float | NumberType::Word, 1) => FieldMeaning::Colour,
            (b"ring" | b"channel" | b"line", NumberType::Byte | NumberType::Short, 1) => FieldMeaning::Ring,
            _ => FieldMeaning::Plain,
        };
        for index in 0..count {
            if fields.len() >= MAX_FIELDS {
                return None;
            }
            let offset = offset.checked_add(index * number.bytes())?;
            fields.push(PointField { offset, number, meaning });
        }
        Some(())
    }

    pub(crate) fn points(&self) -> usize {
        self.width * self.height
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_type_is_known_by_its_name_and_what_fixes_its_layout() {
        let md5 = "060021388200f6f0f447d0fcd9c64743";
        let hash = "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47";
        assert_eq!(Schema::for_type("sensor_msgs/Image", md5), Schema::Image);
        assert_eq!(Schema::for_type("sensor_msgs/msg/Image", hash), Schema::Image);
        assert_eq!(Schema::for_type("sensor_msgs/LaserScan", md5), Schema::Other);
        assert_eq!(Schema::for_type("sensor_msgs/msg/Image", &hash[1..]), Schema::Other);
        assert_eq!(Schema::for_type("my_msgs/msg/Image", hash), Schema::Other);
    }
}
