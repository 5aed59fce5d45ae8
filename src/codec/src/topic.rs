//! One topic's encoder and decoder: their memory, and the frame around every body.
//!
//! Frame: `tag · version · sequence · length of the message · [checksum] · body`, the two numbers in base 128; the
//! checksum is the message's CRC-32, little endian, where [`Codec::has_checksum`].

use crate::codec::Codec;
use crate::generic::{self, Zstd};
use crate::jpeg::{self, JpegOptions};
use crate::layout::{Cloud, Grid, Image, Scan, Schema};
use crate::video::{VideoDecoder, VideoEncoder, VideoOptions};
use crate::wire::{Cursor, put_varint};
use crate::{Error, cloud, grid, image, scan};

/// What became of a message.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Encoded {
    /// The codec used: the one asked for, or what it fell back to.
    pub codec: Codec,
    /// The frame's number.
    pub sequence: u64,
    /// The frame's size in bytes.
    pub bytes: usize,
}

/// Encodes the messages of one topic, in order.
///
/// Every message can be encoded with any codec, at any time: a frame tells its own. A message that does not fit a codec
/// (another type, an unusual layout) falls back to zstd, and what does not get smaller goes as it is.
#[derive(Debug)]
pub struct Encoder {
    schema: Schema,
    sequence: u64,
    zstd: Zstd,
    jpeg: Option<JpegOptions>,
    video: Option<VideoEncoder>,
}

impl Encoder {
    /// An encoder for messages of `schema`. Lossy codecs fall back until they are allowed.
    pub fn new(schema: Schema) -> Self {
        Self {
            schema,
            sequence: 0,
            zstd: Zstd::default(),
            jpeg: None,
            video: None,
        }
    }

    /// Allows JPEG.
    #[must_use]
    pub fn allow_jpeg(mut self, options: JpegOptions) -> Self {
        self.jpeg = Some(options);
        self
    }

    /// Allows H.264. Without the cargo feature `video` it still falls back.
    #[must_use]
    pub fn allow_video(mut self, options: VideoOptions) -> Self {
        self.video = Some(VideoEncoder::new(options));
        self
    }

    /// What the messages are.
    pub fn schema(&self) -> Schema {
        self.schema
    }

    /// Appends the frame of `message` to `out`.
    pub fn encode(&mut self, codec: Codec, message: &[u8], out: &mut Vec<u8>) -> Encoded {
        self.sequence += 1;
        let first = out.len();
        let mut used = codec;
        self.put_header(used, message, out);
        if self.put_body(used, message, out).is_none() {
            used = Codec::Zstd(3);
            out.truncate(first);
            self.put_header(used, message, out);
            self.zstd.compress(message, 3, out);
        }
        let header = 2 + varint_size(self.sequence) + varint_size(message.len() as u64);
        let grown = out.len() - first - header >= message.len();
        // A later frame of a video refers to this one, so it must arrive as it is.
        if grown && !matches!(used, Codec::Raw | Codec::Video) {
            used = Codec::Raw;
            out.truncate(first);
            self.put_header(used, message, out);
            out.extend_from_slice(message);
        }
        Encoded {
            codec: used,
            sequence: self.sequence,
            bytes: out.len() - first,
        }
    }

    fn put_header(&self, codec: Codec, message: &[u8], out: &mut Vec<u8>) {
        out.extend_from_slice(&[codec.tag(), codec.version()]);
        put_varint(out, self.sequence);
        put_varint(out, message.len() as u64);
        if codec.has_checksum() {
            out.extend_from_slice(&crc32fast::hash(message).to_le_bytes());
        }
    }

    /// `None` when the message does not fit the codec; `out` may hold anything then.
    fn put_body(&mut self, codec: Codec, message: &[u8], out: &mut Vec<u8>) -> Option<()> {
        let total = message.len();
        match (codec, self.schema) {
            (Codec::Raw, _) => out.extend_from_slice(message),
            (Codec::Zlib(level), _) => generic::deflate(message, level.into(), true, out),
            (Codec::Deflate(level), _) => generic::deflate(message, level.into(), false, out),
            (Codec::Zstd(level), _) => self.zstd.compress(message, level.into(), out),
            (Codec::Image, Schema::Image) => {
                image::encode(message, &Image::read(message, total)?, out)
            }
            (Codec::Grid, Schema::OccupancyGrid) => {
                grid::encode(message, &Grid::read(message, total)?, &mut self.zstd, out);
            }
            (Codec::Scan, Schema::LaserScan) => {
                scan::encode(message, &Scan::read(message, total)?, out)?
            }
            (Codec::Cloud, Schema::PointCloud2) => {
                cloud::encode(message, &Cloud::read(message, total)?, out)
            }
            (Codec::Jpeg, Schema::Image) => {
                jpeg::encode(message, &Image::read(message, total)?, self.jpeg?, out)?;
            }
            (Codec::Video, Schema::Image) => {
                self.video
                    .as_mut()?
                    .encode(message, &Image::read(message, total)?, out)?;
            }
            _ => return None,
        }
        Some(())
    }

    /// The peer lost something: the next frame refers to none before it.
    pub fn request_keyframe(&mut self) {
        if let Some(video) = &mut self.video {
            video.request_keyframe();
        }
    }
}

fn varint_size(value: u64) -> usize {
    (64 - (value | 1).leading_zeros() as usize).div_ceil(7)
}

/// What a frame was.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Decoded {
    /// The codec; levels are not on the wire.
    pub codec: Codec,
    /// The frame's number.
    pub sequence: u64,
    /// The message's size in bytes.
    pub bytes: usize,
}

/// Decodes the frames of one topic, in order.
///
/// None may declare a message of more bytes than the limit, and none makes it allocate more than sixteen times what
/// it declares (two to four, usually) and two MiB of tables. What does not have the checksum that was sent is an error.
/// After an error that asks for a keyframe (see [`Error::wants_keyframe`]) the sender's [`Encoder::request_keyframe`]
/// puts things right; after one that wants another codec (see [`Error::wants_another_codec`]) another codec does.
#[derive(Debug)]
pub struct Decoder {
    limit: usize,
    video: VideoDecoder,
}

impl Decoder {
    /// A decoder of messages of at most `limit` bytes.
    pub fn new(limit: usize) -> Self {
        Self {
            limit,
            video: VideoDecoder::default(),
        }
    }

    /// Appends the message of `frame` to `out`; on an error `out` is as before.
    pub fn decode(&mut self, frame: &[u8], out: &mut Vec<u8>) -> Result<Decoded, Error> {
        let first = out.len();
        let result = self.decode_frame(frame, out);
        if result.is_err() {
            out.truncate(first);
        }
        result
    }

    fn decode_frame(&mut self, frame: &[u8], out: &mut Vec<u8>) -> Result<Decoded, Error> {
        let mut input = Cursor::new(frame);
        let (decoded, version) = header(&mut input)?;
        let (codec, total) = (decoded.codec, decoded.bytes);
        if version != codec.version() {
            return Err(Error::Version {
                codec: codec.name(),
                version,
                known: codec.version(),
            });
        }
        if total > self.limit {
            return Err(Error::TooLarge {
                declared: total as u64,
                limit: self.limit,
            });
        }
        let first = out.len();
        let checksum = if codec.has_checksum() {
            Some(input.u32()?)
        } else {
            None
        };
        match codec {
            Codec::Raw => out.extend_from_slice(input.take(total)?),
            Codec::Zlib(_) => generic::inflate(input.take_rest(), total, true, out)?,
            Codec::Deflate(_) => generic::inflate(input.take_rest(), total, false, out)?,
            Codec::Zstd(_) => generic::unzstd(input.take_rest(), total, out)?,
            Codec::Image => image::decode(&mut input, total, out)?,
            Codec::Grid => grid::decode(&mut input, total, out)?,
            Codec::Scan => scan::decode(&mut input, total, out)?,
            Codec::Cloud => cloud::decode(&mut input, total, out)?,
            Codec::Jpeg => jpeg::decode(&mut input, total, out)?,
            Codec::Video => self.video.decode(&mut input, total, out)?,
        }
        input.finish()?;
        if out.len() - first != total {
            return Err(Error::Corrupt("a message of another size than declared"));
        }
        match checksum {
            Some(sent) if crc32fast::hash(&out[first..]) != sent => Err(Error::Checksum {
                codec: codec.name(),
            }),
            _ => Ok(decoded),
        }
    }
}

/// A frame's codec, number and message size without decoding it: what a queue needs to know.
pub fn peek(frame: &[u8]) -> Result<Decoded, Error> {
    header(&mut Cursor::new(frame)).map(|(decoded, _)| decoded)
}

/// Reads a header: what follows, and in which version.
fn header(input: &mut Cursor<'_>) -> Result<(Decoded, u8), Error> {
    let tag = input.byte()?;
    let codec = Codec::of_tag(tag).ok_or(Error::UnknownTag(tag))?;
    let version = input.byte()?;
    let sequence = input.varint()?;
    let bytes = usize::try_from(input.varint()?).unwrap_or(usize::MAX);
    Ok((
        Decoded {
            codec,
            sequence,
            bytes,
        },
        version,
    ))
}
