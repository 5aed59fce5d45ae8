//! The codecs, and their names on the wire and in configuration.

use crate::layout::Schema;
use std::fmt;
use std::str::FromStr;

/// A codec for messages.
///
/// Text forms: `raw`, `zlib`, `zlib:9`, `deflate:1`, `zstd:3`, `image`, `grid`, `scan`, `cloud`, `video`, `jpeg`.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum Codec {
    /// The serialized message, unchanged.
    Raw,
    /// zlib (RFC 1950) at level 0 to 9.
    Zlib(u8),
    /// deflate (RFC 1951) at level 0 to 9.
    Deflate(u8),
    /// zstd (RFC 8878) at level -7 to 22.
    Zstd(i8),
    /// `sensor_msgs/Image`, lossless: 8-bit colour, grey and Bayer, 16-bit and float depth.
    Image,
    /// `nav_msgs/OccupancyGrid`, lossless.
    Grid,
    /// `sensor_msgs/LaserScan`, lossless.
    Scan,
    /// `sensor_msgs/PointCloud2`, lossless, by field layout.
    Cloud,
    /// `sensor_msgs/Image` in colour as H.264: the pixels are lossy, everything else is exact.
    Video,
    /// `sensor_msgs/Image`, grey or colour, as JPEG: the pixels are lossy, everything else is exact.
    Jpeg,
}

/// Tag, name, and codec with its default level.
const CODECS: [(u8, &str, Codec); 10] = [
    (0x00, "raw", Codec::Raw),
    (0x01, "zlib", Codec::Zlib(6)),
    (0x02, "deflate", Codec::Deflate(6)),
    (0x03, "zstd", Codec::Zstd(3)),
    (0x10, "image", Codec::Image),
    (0x11, "grid", Codec::Grid),
    (0x12, "scan", Codec::Scan),
    (0x13, "cloud", Codec::Cloud),
    (0x20, "video", Codec::Video),
    (0x21, "jpeg", Codec::Jpeg),
];

impl Codec {
    fn entry(self) -> (u8, &'static str, Self) {
        CODECS[match self {
            Self::Raw => 0,
            Self::Zlib(_) => 1,
            Self::Deflate(_) => 2,
            Self::Zstd(_) => 3,
            Self::Image => 4,
            Self::Grid => 5,
            Self::Scan => 6,
            Self::Cloud => 7,
            Self::Video => 8,
            Self::Jpeg => 9,
        }]
    }

    /// Returns the tag, the first byte of a frame.
    pub fn tag(self) -> u8 {
        self.entry().0
    }

    /// Returns the name without the level.
    pub fn name(self) -> &'static str {
        self.entry().1
    }

    /// Returns the version of the codec's frames, which is raised when they change.
    pub fn version(self) -> u8 {
        match self {
            // Since 2 with a checksum; grids are coded whole, and since 3 in shades that are not coded as a picture.
            Self::Image | Self::Scan | Self::Cloud => 2,
            Self::Grid => 3,
            _ => 1,
        }
    }

    /// Returns true if frames carry a checksum of the message: those of codecs that predict each value from earlier
    /// ones, where one wrong byte spoils all values after it.
    pub(crate) fn has_checksum(self) -> bool {
        matches!(self, Self::Image | Self::Grid | Self::Scan | Self::Cloud)
    }

    /// Returns the codec with this tag; levels are not on the wire, so it has its default level.
    pub fn from_tag(tag: u8) -> Option<Self> {
        CODECS.iter().find(|&&(known, ..)| known == tag).map(|&(.., codec)| codec)
    }

    /// Returns the lossless codec for messages of `schema`; zstd if there is no specific one.
    pub fn for_schema(schema: Schema) -> Self {
        match schema {
            Schema::Image => Self::Image,
            Schema::OccupancyGrid => Self::Grid,
            Schema::LaserScan => Self::Scan,
            Schema::PointCloud2 => Self::Cloud,
            Schema::Other => Self::Zstd(3),
        }
    }

    /// Returns true if this build includes the codec: H.264 is optional.
    pub fn is_available(self) -> bool {
        self != Self::Video || cfg!(feature = "video")
    }

    /// Returns true if the codec restores messages bit by bit.
    pub fn is_lossless(self) -> bool {
        !matches!(self, Self::Video | Self::Jpeg)
    }
}

impl fmt::Display for Codec {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Zlib(level) | Self::Deflate(level) => {
                write!(formatter, "{}:{level}", self.name())
            }
            Self::Zstd(level) => write!(formatter, "{}:{level}", self.name()),
            _ => formatter.write_str(self.name()),
        }
    }
}

/// The error of an unknown codec name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{0}` is no codec; use raw, zlib[:0-9], deflate[:0-9], zstd[:-7-22], image, grid, scan, cloud, jpeg or video")]
pub struct UnknownCodec(pub String);

impl FromStr for Codec {
    type Err = UnknownCodec;

    fn from_str(text: &str) -> Result<Self, UnknownCodec> {
        let unknown = || UnknownCodec(text.to_owned());
        let (name, level) = match text.split_once(':') {
            Some((name, level)) => (name, Some(level.parse::<i8>().map_err(|_| unknown())?)),
            None => (text, None),
        };
        let named = CODECS.iter().find(|&&(_, known, _)| known == name).ok_or_else(unknown)?.2;
        let Some(level) = level else { return Ok(named) };
        match named {
            Self::Zlib(_) if (0..=9).contains(&level) => Ok(Self::Zlib(level as u8)),
            Self::Deflate(_) if (0..=9).contains(&level) => Ok(Self::Deflate(level as u8)),
            Self::Zstd(_) if (-7..=22).contains(&level) => Ok(Self::Zstd(level)),
            _ => Err(unknown()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_tags_come_back() {
        for name in
            ["raw", "zlib:9", "deflate:0", "zstd:-7", "zstd:22", "image", "grid", "scan", "cloud", "video", "jpeg"]
        {
            let codec: Codec = name.parse().unwrap();
            assert_eq!(codec.to_string(), name);
            assert_eq!(Codec::from_tag(codec.tag()).unwrap().name(), codec.name());
        }
        assert_eq!("zlib".parse(), Ok(Codec::Zlib(6)));
        for name in ["", "gzip", "zlib:10", "zlib:-1", "zstd:23", "image:1", "zstd:x"] {
            assert_eq!(name.parse::<Codec>(), Err(UnknownCodec(name.to_owned())));
        }
        assert_eq!(Codec::from_tag(0xff), None);
    }
}
