//! Frames of the link's codecs. An input is a list of frames for one decoder, each `length (16 bits) · frame without
//! its tag and version`, so that video frames can refer to the previous one.

use ::codec::{Codec, Decoder, Encoder, Schema};

/// Maximum size of a message that a decoder may produce here.
pub const LIMIT: usize = 1 << 17;

/// Returns the next frame of the list, without tag and version; a truncated one is returned as it is.
fn next_frame<'a>(data: &mut &'a [u8]) -> Option<&'a [u8]> {
    let (length, rest) = data.split_first_chunk()?;
    let length = usize::from(u16::from_le_bytes(*length)).min(rest.len());
    let (frame, rest) = rest.split_at(length);
    *data = rest;
    Some(frame)
}

fn decode(codec: Codec, mut data: &[u8]) {
    let mut decoder = Decoder::new(LIMIT);
    while let Some(rest) = next_frame(&mut data) {
        let frame = [&[codec.tag(), codec.version()], rest].concat();
        let peeked = ::codec::peek(&frame);
        let mut out = b"before".to_vec();
        match decoder.decode(&frame, &mut out) {
            Ok(decoded) => {
                assert_eq!(out.len(), 6 + decoded.bytes, "as declared");
                assert!(decoded.bytes <= LIMIT, "as limited");
                assert_eq!(peeked.expect("what decodes can be looked at"), decoded);
            }
            Err(error) => {
                assert!(!error.to_string().is_empty());
                assert_eq!(out.len(), 6, "an error leaves nothing behind");
            }
        }
        assert!(out.starts_with(b"before"));
    }
}

/// RFC 1950.
pub fn zlib(data: &[u8]) {
    decode(Codec::Zlib(6), data);
}

/// RFC 1951.
pub fn deflate(data: &[u8]) {
    decode(Codec::Deflate(6), data);
}

/// RFC 8878.
pub fn zstd(data: &[u8]) {
    decode(Codec::Zstd(3), data);
}

/// `sensor_msgs/Image`, lossless.
pub fn image(data: &[u8]) {
    decode(Codec::Image, data);
}

/// `nav_msgs/OccupancyGrid`.
pub fn grid(data: &[u8]) {
    decode(Codec::Grid, data);
}

/// `sensor_msgs/LaserScan`.
pub fn scan(data: &[u8]) {
    decode(Codec::Scan, data);
}

/// `sensor_msgs/PointCloud2`.
pub fn cloud(data: &[u8]) {
    decode(Codec::Cloud, data);
}

/// `sensor_msgs/Image` as H.264.
pub fn video(data: &[u8]) {
    decode(Codec::Video, data);
}

/// `sensor_msgs/Image` as JPEG.
pub fn jpeg(data: &[u8]) {
    decode(Codec::Jpeg, data);
}

/// Frames of any codec, tag and version included.
pub fn frame(mut data: &[u8]) {
    let mut decoder = Decoder::new(LIMIT);
    while let Some(frame) = next_frame(&mut data) {
        let mut out = Vec::new();
        match decoder.decode(frame, &mut out) {
            Ok(decoded) => assert_eq!(out.len(), decoded.bytes),
            Err(_) => assert!(out.is_empty()),
        }
    }
}

/// Messages to be encoded: whatever their content, every codec restores them. The first byte selects the type.
pub fn message(data: &[u8]) {
    let Some((first, message)) = data.split_first() else {
        return;
    };
    let schema = match first % 5 {
        0 => Schema::Image,
        1 => Schema::OccupancyGrid,
        2 => Schema::LaserScan,
        3 => Schema::PointCloud2,
        _ => Schema::Other,
    };
    for codec in [Codec::for_schema(schema), Codec::Zlib(1), Codec::Zstd(1)] {
        let mut encoder = Encoder::new(schema);
        let mut decoder = Decoder::new(message.len());
        for _ in 0..2 {
            let mut frame = Vec::new();
            let encoded = encoder.encode(codec, message, &mut frame);
            assert_eq!(encoded.bytes, frame.len());
            let mut back = Vec::new();
            decoder.decode(&frame, &mut back).expect("what was encoded decodes");
            assert_eq!(back, message, "bit by bit");
        }
    }
}
