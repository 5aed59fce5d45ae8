//! Where things lie in the serialized messages the codecs know: in the ROS 1 wire format (little endian, strings and
//! arrays preceded by a 32-bit length), and in CDR as ROS 2 has it (see [`Fields`]).
//!
//! A layout is read from the *head* of a message, all bytes before its big array, and the message's length. It is
//! `None` unless every byte of the message is accounted for, so that a codec which accepts a layout can restore the
//! message from it. The decoder reads the very same layout from the head it was sent; so nobody has to be told which of the two formats a
//! message is in.

mod fields;

use crate::Error;
use crate::wire::{Cursor, Ends};
use fields::{Fields, in_either};

/// The message types with a codec of their own, told by name and md5 or type hash (which fix the layout).
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
    /// Any other: bytes.
    Other,
}

/// By name; the md5 of ROS 1, and the hash (REP-2016) of ROS 2 as Jazzy has it.
const KNOWN: [(&str, [&str; 2], Schema); 4] = [
    (
        "sensor_msgs/Image",
        [
            "060021388200f6f0f447d0fcd9c64743",
            "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
        ],
        Schema::Image,
    ),
    (
        "nav_msgs/OccupancyGrid",
        [
            "3381f2d731d4076ec5c71b0759edbe4e",
            "RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7",
        ],
        Schema::OccupancyGrid,
    ),
    (
        "sensor_msgs/LaserScan",
        [
            "90c7ef2dc6895d81024acba2ac42f369",
            "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828",
        ],
        Schema::LaserScan,
    ),
    (
        "sensor_msgs/PointCloud2",
        [
            "1158d486dd51d683ce2f1be655c3c181",
            "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
        ],
        Schema::PointCloud2,
    ),
];

impl Schema {
    /// Looks a type up, by its name (`pkg/Type` or `pkg/msg/Type`) and its md5 or hash; a known name with another one is `Other`.
    pub fn of(name: &str, digest: &str) -> Self {
        let name = name.replacen("/msg/", "/", 1);
        KNOWN
            .iter()
            .find(|(known, digests, _)| *known == name && digests.contains(&digest))
            .map_or(Self::Other, |&(.., schema)| schema)
    }
}

/// What a picture's samples are.
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
    fn of(encoding: &[u8]) -> Option<Self> {
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
pub(crate) struct Image {
    /// Where the data begins.
    pub(crate) head: usize,
    /// Bytes behind the data, which fill the last word.
    pub(crate) tail: usize,
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) step: usize,
    pub(crate) big_endian: bool,
    pub(crate) pixel: Pixel,
    /// Whether the channels are red first (or unknown) rather than blue first.
    pub(crate) red_first: bool,
    /// Whether the samples are known to be what a camera saw, rather than labels or other numbers.
    pub(crate) seen: bool,
}

impl Image {
    pub(crate) fn read(head: &[u8], total: usize) -> Option<Self> {
        in_either(head, |input| Self::read_fields(input, total))
    }

    fn read_fields(mut input: Fields<'_>, total: usize) -> Option<Self> {
        input.header()?;
        let height = input.size()?;
        let width = input.size()?;
        let encoding = input.string()?;
        let pixel = Pixel::of(encoding)?;
        let big_endian = input.byte()? != 0;
        let step = input.size()?;
        let data = input.size()?;
        let head = input.taken();
        let tail = input.tail(data, total)?;
        let fits = width > 0
            && height > 0
            && width.checked_mul(pixel.bytes())? <= step
            && step.checked_mul(height)? == data;
        let red_first = !encoding.starts_with(b"bgr");
        let seen = [&b"mono8"[..], b"rgb8", b"bgr8", b"rgba8", b"bgra8"].contains(&encoding);
        fits.then_some(Self {
            head,
            tail,
            width,
            height,
            step,
            big_endian,
            pixel,
            red_first,
            seen,
        })
    }

    /// Reads what a frame tells of an image's ends.
    pub(crate) fn take<'a>(
        input: &mut Cursor<'a>,
        total: usize,
    ) -> Result<(Self, Ends<'a>), Error> {
        let ends = input.block()?;
        let layout = Self::read(ends, total)
            .filter(|layout| layout.head + layout.tail == ends.len())
            .ok_or(Error::Corrupt("a head that is not an image's"))?;
        Ok((layout, Ends::of(ends, layout.head)))
    }

    /// Its samples, and what is between their rows.
    pub(crate) fn data<'a>(&self, message: &'a [u8]) -> &'a [u8] {
        &message[self.head..message.len() - self.tail]
    }

    /// Bytes of a row that are samples; the rest of `step` is padding.
    pub(crate) fn row(&self) -> usize {
        self.width * self.pixel.bytes()
    }
}

/// `nav_msgs/OccupancyGrid`; the cells are the end of the message.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Grid {
    /// Where the cells begin.
    pub(crate) head: usize,
    /// Bytes behind them, which fill the last word.
    pub(crate) tail: usize,
    pub(crate) width: usize,
    pub(crate) height: usize,
}

impl Grid {
    pub(crate) fn read(head: &[u8], total: usize) -> Option<Self> {
        in_either(head, |input| Self::read_fields(input, total))
    }

    fn read_fields(mut input: Fields<'_>, total: usize) -> Option<Self> {
        input.header()?;
        // When the map was loaded, and metres per cell.
        input.words(3)?;
        let width = input.size()?;
        let height = input.size()?;
        // Where cell (0, 0) lies.
        input.doubles(7)?;
        let cells = input.size()?;
        let head = input.taken();
        let tail = input.tail(cells, total)?;
        let fits = width > 0 && height > 0 && width.checked_mul(height)? == cells;
        fits.then_some(Self {
            head,
            tail,
            width,
            height,
        })
    }
}

/// `sensor_msgs/LaserScan`: ranges, then intensities.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Scan {
    /// Where the ranges begin.
    pub(crate) head: usize,
    pub(crate) ranges: usize,
    pub(crate) intensities: usize,
}

impl Scan {
    /// The number of intensities follows from the message's length.
    pub(crate) fn read(head: &[u8], total: usize) -> Option<Self> {
        in_either(head, |input| Self::read_fields(input, total))
    }

    fn read_fields(mut input: Fields<'_>, total: usize) -> Option<Self> {
        input.header()?;
        input.words(7)?;
        let ranges = input.size()?;
        let head = input.taken();
        let rest = total
            .checked_sub(head)?
            .checked_sub(ranges.checked_mul(4)?)?
            .checked_sub(4)?;
        (rest % 4 == 0).then_some(Self {
            head,
            ranges,
            intensities: rest / 4,
        })
    }

    /// Where the intensities' length lies.
    pub(crate) fn middle(&self) -> usize {
        self.head + self.ranges * 4
    }
}

/// The numbers of a point field, by the constants of `sensor_msgs/PointField`.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Number {
    Byte,
    Short,
    Word,
    Float,
    Double,
}

impl Number {
    pub(crate) fn bytes(self) -> usize {
        match self {
            Self::Byte => 1,
            Self::Short => 2,
            Self::Word | Self::Float => 4,
            Self::Double => 8,
        }
    }
}

/// What a field's name says about its numbers.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Meaning {
    X,
    Y,
    Z,
    /// Four bytes: blue, green, red, alpha.
    Colour,
    /// Which laser measured the point.
    Ring,
    Plain,
}

/// One number of every point.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) struct Field {
    pub(crate) offset: usize,
    pub(crate) number: Number,
    pub(crate) meaning: Meaning,
}

/// `sensor_msgs/PointCloud2`; one byte, `is_dense`, follows the data.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) struct Cloud {
    /// Where the data begins.
    pub(crate) head: usize,
    /// Bytes behind `is_dense`, which fill the last word.
    pub(crate) tail: usize,
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) point_step: usize,
    pub(crate) row_step: usize,
    /// By offset, without overlap.
    pub(crate) fields: Vec<Field>,
}

/// No known sensor has more; a bound on what a head can make the codec do.
const MAX_FIELDS: usize = 64;

impl Cloud {
    pub(crate) fn read(head: &[u8], total: usize) -> Option<Self> {
        in_either(head, |input| Self::read_fields(input, total))
    }

    fn read_fields(mut input: Fields<'_>, total: usize) -> Option<Self> {
        input.header()?;
        let height = input.size()?;
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
        let head = input.taken();
        let tail = input.tail(data.checked_add(1)?, total)?;
        fields.sort_by_key(|field| field.offset);
        let apart = fields
            .windows(2)
            .all(|pair| pair[0].offset + pair[0].number.bytes() <= pair[1].offset);
        let inside = fields
            .last()
            .is_none_or(|last| last.offset + last.number.bytes() <= point_step);
        let fits = !big_endian
            && apart
            && inside
            && width > 0
            && height > 0
            && point_step > 0
            && width.checked_mul(point_step)? <= row_step
            && row_step.checked_mul(height)? == data;
        fits.then_some(Self {
            head,
            tail,
            width,
            height,
            point_step,
            row_step,
            fields,
        })
    }

    fn read_field(input: &mut Fields<'_>, fields: &mut Vec<Field>) -> Option<()> {
        let name = input.string()?;
        let offset = input.size()?;
        let number = match input.byte()? {
            1 | 2 => Number::Byte,
            3 | 4 => Number::Short,
            5 | 6 => Number::Word,
            7 => Number::Float,
            8 => Number::Double,
            _ => return None,
        };
        let count = input.size()?;
        let meaning = match (name, number, count) {
            (b"x", Number::Float, 1) => Meaning::X,
            (b"y", Number::Float, 1) => Meaning::Y,
            (b"z", Number::Float, 1) => Meaning::Z,
            (b"rgb" | b"rgba", Number::Float | Number::Word, 1) => Meaning::Colour,
            (b"ring" | b"channel" | b"line", Number::Byte | Number::Short, 1) => Meaning::Ring,
            _ => Meaning::Plain,
        };
        for index in 0..count {
            if fields.len() >= MAX_FIELDS {
                return None;
            }
            let offset = offset.checked_add(index * number.bytes())?;
            fields.push(Field {
                offset,
                number,
                meaning,
            });
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
        assert_eq!(Schema::of("sensor_msgs/Image", md5), Schema::Image);
        assert_eq!(Schema::of("sensor_msgs/msg/Image", hash), Schema::Image);
        assert_eq!(Schema::of("sensor_msgs/LaserScan", md5), Schema::Other);
        assert_eq!(
            Schema::of("sensor_msgs/msg/Image", &hash[1..]),
            Schema::Other
        );
        assert_eq!(Schema::of("my_msgs/msg/Image", hash), Schema::Other);
    }
}
