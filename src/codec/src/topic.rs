//! Encoder and decoder of one topic: their state, and the frame around every body.
//!
//! Frame: `tag · version · sequence · length of the message · [checksum] · body`, the two numbers in base 128; the
//! checksum is the message's CRC-32, little endian, if [`Codec::has_checksum`].

use crate::codec::Codec;
use crate::generic::{self, ZstdCompressor};
use crate::jpeg::{self, JpegOptions};
use crate::layout::{CloudLayout, GridLayout, ImageLayout, ScanLayout, Schema};
use crate::video::{VideoDecoder, VideoEncoder, VideoOptions};
use crate::wire::{FrameCursor, put_varint};
use crate::{Error, cloud, grid, image, scan};

/// Description of an encoded frame.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct EncodedFrame {
    /// The codec used: the requested one, or its fallback.
    pub codec: Codec,
    /// Sequence number of the frame.
    pub sequence: u64,
    /// Size of the frame in bytes.
    pub bytes: usize,
}

/// Encodes the messages of one topic, in order.
///
/// Every message can be encoded with any codec at any time: a frame names its own. A message that does not fit a codec
/// (another type, an unusual layout) falls back to zstd, and what does not get smaller is sent unchanged.
#[derive(Debug)]
pub struct Encoder {
    schema: Schema,
    sequence: u64,
    zstd: ZstdCompressor,
    jpeg: Option<JpegOptions>,
    video: Option<VideoEncoder>,
}

impl Encoder {
    /// Creates an encoder for messages of `schema`. Lossy codecs fall back until they are allowed.
    pub fn new(schema: Schema) -> Self {
        Self { schema, sequence: 0, zstd: ZstdCompressor::default(), jpeg: None, video: None }
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

    /// Returns the schema of the messages.
    pub fn schema(&self) -> Schema {
        self.schema
    }

    /// Appends the frame of `message` to `out`.
    pub fn encode(&mut self, codec: Codec, message: &[u8], out: &mut Vec<u8>) -> EncodedFrame {
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
        // A later frame of a video refers to this one, so it must arrive unchanged.
        if grown && !matches!(used, Codec::Raw | Codec::Video) {
            used = Codec::Raw;
            out.truncate(first);
            self.put_header(used, message, out);
            out.extend_from_slice(message);
        }
        EncodedFrame { codec: used, sequence: self.sequence, bytes: out.len() - first }
    }

    fn put_header(&self, codec: Codec, message: &[u8], out: &mut Vec<u8>) {
        out.extend_from_slice(&[codec.tag(), codec.version()]);
        put_varint(out, self.sequence);
        put_varint(out, message.len() as u64);
        if codec.has_checksum() {
            out.extend_from_slice(&crc32fast::hash(message).to_le_bytes());
        }
    }

    /// Appends the body; `None` if the message does not fit the codec, with `out` undefined.
    fn put_body(&mut self, codec: Codec, message: &[u8], out: &mut Vec<u8>) -> Option<()> {
        let total = message.len();
        match (codec, self.schema) {
            (Codec::Raw, _) => out.extend_from_slice(message),
            (Codec::Zlib(level), _) => generic::deflate(message, level.into(), true, out),
            (Codec::Deflate(level), _) => generic::deflate(message, level.into(), false, out),
            (Codec::Zstd(level), _) => self.zstd.compress(message, level.into(), out),
            (Codec::Image, Schema::Image) => image::encode(message, &ImageLayout::read(message, total)?, out),
            (Codec::Grid, Schema::OccupancyGrid) => {
                grid::encode(message, &GridLayout::read(message, total)?, &mut self.zstd, out);
            }
            (Codec::Scan, Schema::LaserScan) => scan::encode(message, &ScanLayout::read(message, total)?, out)?,
            (Codec::Cloud, Schema::PointCloud2) => cloud::encode(message, &CloudLayout::read(message, total)?, out),
            (Codec::Jpeg, Schema::Image) => {
                jpeg::encode(message, &ImageLayout::read(message, total)?, self.jpeg?, out)?;
            }
            (Codec::Video, Schema::Image) => {
                self.video.as_mut()?.encode(message, &ImageLayout::read(message, total)?, out)?;
            }
            _ => return None,
        }
        Some(())
    }

    /// Requests a keyframe, because the peer lost a frame: the next frame refers to none before it.
    pub fn request_keyframe(&mut self) {
        if let Some(video) = &mut self.video {
            video.request_keyframe();
        }
    }
}

fn varint_size(value: u64) -> usize {
    (64 - (value | 1).leading_zeros() as usize).div_ceil(7)
}

/// Description of a decoded frame.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct DecodedFrame {
    /// The codec; its level is not on the wire.
    pub codec: Codec,
    /// Sequence number of the frame.
    pub sequence: u64,
    /// Size of the message in bytes.
    pub bytes: usize,
}

/// Decodes the frames of one topic, in order.
///
/// No frame may declare a message of more bytes than the limit, and none causes allocations of more than sixteen times
/// the declared size (two to four, usually) and two MiB of tables. A message with a wrong checksum is an error. After
/// an error that asks for a keyframe (see [`Error::wants_keyframe`]) call the sender's [`Encoder::request_keyframe`];
/// after one that wants another codec (see [`Error::wants_another_codec`]) use another codec.
#[derive(Debug)]
pub struct Decoder {
    limit: usize,
    video: VideoDecoder,
}

impl Decoder {
    /// Creates a decoder for messages of at most `limit` bytes.
    pub fn new(limit: usize) -> Self {
        Self { limit, video: VideoDecoder::default() }
    }

    /// Appends the message of `frame` to `out`; on an error `out` is unchanged.
    pub fn decode(&mut self, frame: &[u8], out: &mut Vec<u8>) -> Result<DecodedFrame, Error> {
        let first = out.len();
        let result = self.decode_frame(frame, out);
        if result.is_err() {
            out.truncate(first);
        }
        result
    }

    fn decode_frame(&mut self, frame: &[u8], out: &mut Vec<u8>) -> Result<DecodedFrame, Error> {
        let mut input = FrameCursor::new(frame);
        let (decoded, version) = read_header(&mut input)?;
        let (codec, total) = (decoded.codec, decoded.bytes);
        if version != codec.version() {
            return Err(Error::Version { codec: codec.name(), version, known: codec.version() });
        }
        if total > self.limit {
            return Err(Error::TooLarge { declared: total as u64, limit: self.limit });
        }
        let first = out.len();
        let checksum = if codec.has_checksum() { Some(input.u32()?) } else { None };
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
            Some(sent) if crc32fast::hash(&out[first..]) != sent => Err(Error::Checksum { codec: codec.name() }),
            _ => Ok(decoded),
        }
    }
}

/// Returns a frame's codec, number and message size without decoding it, for queues.
pub fn peek(frame: &[u8]) -> Result<DecodedFrame, Error> {
    read_header(&mut FrameCursor::new(frame)).map(|(decoded, _)| decoded)
}

/// Reads a frame's header; returns its description and version.
fn read_header(input: &mut FrameCursor<'_>) -> Result<(DecodedFrame, u8), Error> {
    let tag = input.byte()?;
    let codec = Codec::from_tag(tag).ok_or(Error::UnknownTag(tag))?;
    let version = input.byte()?;
    let sequence = input.varint()?;
    let bytes = usize::try_from(input.varint()?).unwrap_or(usize::MAX);
    Ok((DecodedFrame { codec, sequence, bytes }, version))
}
