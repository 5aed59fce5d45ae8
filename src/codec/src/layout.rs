//! Where things lie in the serialized messages the codecs know, in the ROS 1 wire format (little endian, strings and
//! arrays preceded by a 32-bit length).
//!
//! A layout is read from the *head* of a message, all bytes before its big array, and the message's length. It is
//! `None` unless every byte of the message is accounted for, so that a codec which accepts a layout can restore the
//! message from it. The decoder reads the very same layout from the head it was sent.

use crate::wire::Cursor;

/// The message types with a codec of their own, told by name and md5 (the md5 fixes the layout).
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

impl Schema {
    /// Looks a type up, as named in a publisher's header; a known name with another md5 is `Other`.
    pub fn of(datatype: &str, md5: &str) -> Self {
        match (datatype, md5) {
            ("sensor_msgs/Image", "060021388200f6f0f447d0fcd9c64743") => Self::Image,
            ("nav_msgs/OccupancyGrid", "3381f2d731d4076ec5c71b0759edbe4e") => Self::OccupancyGrid,
            ("sensor_msgs/LaserScan", "90c7ef2dc6895d81024acba2ac42f369") => Self::LaserScan,
            ("sensor_msgs/PointCloud2", "1158d486dd51d683ce2f1be655c3c181") => Self::PointCloud2,
            _ => Self::Other,
        }
    }
}

/// Skips `std_msgs/Header`.
fn skip_header(input: &mut Cursor<'_>) -> Option<()> {
    input.take(12).ok()?;
    string(input)?;
    Some(())
}

fn string<'a>(input: &mut Cursor<'a>) -> Option<&'a [u8]> {
    let length = input.u32().ok()? as usize;
    input.take(length).ok()
}

fn size(input: &mut Cursor<'_>) -> Option<usize> {
    usize::try_from(input.u32().ok()?).ok()
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
        let mut input = Cursor::new(head);
        skip_header(&mut input)?;
        let height = size(&mut input)?;
        let width = size(&mut input)?;
        let encoding = string(&mut input)?;
        let pixel = Pixel::of(encoding)?;
        let big_endian = input.byte().ok()? != 0;
        let step = size(&mut input)?;
        let data = size(&mut input)?;
        let head = head.len() - input.remaining();
        let fits = width > 0
            && height > 0
            && width.checked_mul(pixel.bytes())? <= step
            && step.checked_mul(height)? == data
            && head.checked_add(data)? == total;
        let red_first = !encoding.starts_with(b"bgr");
        let seen = [&b"mono8"[..], b"rgb8", b"bgr8", b"rgba8", b"bgra8"].contains(&encoding);
        fits.then_some(Self {
            head,
            width,
            height,
            step,
            big_endian,
            pixel,
            red_first,
            seen,
        })
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
    pub(crate) width: usize,
    pub(crate) height: usize,
}

impl Grid {
    pub(crate) fn read(head: &[u8], total: usize) -> Option<Self> {
        let mut input = Cursor::new(head);
        skip_header(&mut input)?;
        // When the map was loaded, and metres per cell.
        input.take(8 + 4).ok()?;
        let width = size(&mut input)?;
        let height = size(&mut input)?;
        // Where cell (0, 0) lies.
        input.take(56).ok()?;
        let cells = size(&mut input)?;
        let head = head.len() - input.remaining();
        let fits = width > 0
            && height > 0
            && width.checked_mul(height)? == cells
            && head.checked_add(cells)? == total;
        fits.then_some(Self {
            head,
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
        let mut input = Cursor::new(head);
        skip_header(&mut input)?;
        input.take(7 * 4).ok()?;
        let ranges = size(&mut input)?;
        let head = head.len() - input.remaining();
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
        let mut input = Cursor::new(head);
        skip_header(&mut input)?;
        let height = size(&mut input)?;
        let width = size(&mut input)?;
        let count = size(&mut input)?;
        let mut fields = Vec::new();
        for _ in 0..count {
            Self::read_field(&mut input, &mut fields)?;
        }
        let big_endian = input.byte().ok()? != 0;
        let point_step = size(&mut input)?;
        let row_step = size(&mut input)?;
        let data = size(&mut input)?;
        let head = head.len() - input.remaining();
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
            && row_step.checked_mul(height)? == data
            && head.checked_add(data)?.checked_add(1)? == total;
        fits.then_some(Self {
            head,
            width,
            height,
            point_step,
            row_step,
            fields,
        })
    }

    fn read_field(input: &mut Cursor<'_>, fields: &mut Vec<Field>) -> Option<()> {
        let name = string(input)?;
        let offset = size(input)?;
        let number = match input.byte().ok()? {
            1 | 2 => Number::Byte,
            3 | 4 => Number::Short,
            5 | 6 => Number::Word,
            7 => Number::Float,
            8 => Number::Double,
            _ => return None,
        };
        let count = size(input)?;
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
