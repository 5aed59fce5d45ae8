//! Properties that hold for every message and every frame.

use codec::{Codec, Decoder, Encoder, Error, JpegOptions, Schema, VideoOptions};
use proptest::collection::vec;
use proptest::prelude::*;

const CODECS: [Codec; 9] = [
    Codec::Raw,
    Codec::Zlib(1),
    Codec::Deflate(9),
    Codec::Zstd(-3),
    Codec::Image,
    Codec::Grid,
    Codec::Scan,
    Codec::Cloud,
    Codec::Zstd(9),
];
const SCHEMAS: [Schema; 5] =
    [Schema::Image, Schema::OccupancyGrid, Schema::LaserScan, Schema::PointCloud2, Schema::Other];
const LIMIT: usize = 1 << 22;

/// Serialization format of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Format {
    Ros1,
    /// Little endian.
    Cdr,
}

fn format() -> impl Strategy<Value = Format> {
    prop::sample::select(vec![Format::Ros1, Format::Cdr])
}

/// Builder of a ROS message, field by field.
struct Message {
    bytes: Vec<u8>,
    format: Format,
}

impl Message {
    /// Starts with a header whose frame name has this length.
    fn new(format: Format, name: usize) -> Self {
        let first = match format {
            Format::Ros1 => [1, 0, 0, 0],
            Format::Cdr => [0, 1, 0, 0],
        };
        let bytes = first.to_vec();
        let name = "f".repeat(name);
        Self { bytes, format }.u32(2).u32(3).string(&name)
    }

    fn raw(mut self, bytes: &[u8]) -> Self {
        self.bytes.extend_from_slice(bytes);
        self
    }

    fn align(mut self, size: usize) -> Self {
        while self.format == Format::Cdr && (self.bytes.len() - 4) % size != 0 {
            self.bytes.push(0);
        }
        self
    }

    fn u32(self, value: u32) -> Self {
        self.align(4).raw(&value.to_le_bytes())
    }

    fn f64(self, value: f64) -> Self {
        self.align(8).raw(&value.to_le_bytes())
    }

    fn bytes(self, bytes: &[u8]) -> Self {
        self.u32(bytes.len() as u32).raw(bytes)
    }

    fn string(self, text: &str) -> Self {
        let zero = &b"\0"[..usize::from(self.format == Format::Cdr)];
        self.bytes(&[text.as_bytes(), zero].concat())
    }

    /// Pads the message to whole words, as on the wire.
    fn finish(self) -> Vec<u8> {
        self.align(4).bytes
    }
}

/// Returns bytes that look like samples: smooth, with noise of some size.
fn samples(count: usize, seed: u64, noise: u8) -> Vec<u8> {
    let mut state = seed | 1;
    (0..count)
        .map(|index| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            ((index / 7) as u8).wrapping_add((state >> 24) as u8 & noise)
        })
        .collect()
}

fn image() -> impl Strategy<Value = Vec<u8>> {
    let encodings = prop::sample::select(vec![
        "rgb8",
        "bgr8",
        "rgba8",
        "bgra8",
        "mono8",
        "8UC2",
        "bayer_rggb8",
        "bayer_gbrg8",
        "mono16",
        "16UC1",
        "32FC1",
        "32SC1",
        "bayer_rggb16",
        "yuv422",
        "64FC1",
        "rgb16",
    ]);
    let noise = prop::sample::select(vec![0u8, 1, 3, 0x7f, 0xff]);
    (encodings, 1usize..70, 1usize..70, 0usize..9, any::<bool>(), any::<u64>(), noise, (format(), 0usize..9)).prop_map(
        |(encoding, width, height, padding, big_endian, seed, noise, (format, name))| {
            let pixel = match encoding {
                "rgb8" | "bgr8" => 3,
                "rgba8" | "bgra8" | "32FC1" | "32SC1" => 4,
                "mono16" | "16UC1" | "bayer_rggb16" | "8UC2" | "yuv422" => 2,
                "64FC1" => 8,
                "rgb16" => 6,
                _ => 1,
            };
            let step = width * pixel + padding;
            let message = Message::new(format, name).u32(height as u32).u32(width as u32).string(encoding);
            let message = message.raw(&[big_endian.into()]).u32(step as u32);
            message.bytes(&samples(step * height, seed, noise)).finish()
        },
    )
}

fn grid() -> impl Strategy<Value = Vec<u8>> {
    let format = (format(), 0usize..9);
    (1usize..150, 1usize..150, any::<u64>(), 0u32..5, 0u8..5, format).prop_map(
        |(width, height, seed, shift, kind, (format, name))| {
            let cells: Vec<u8> = samples(width * height, seed, if kind == 3 { 0xff } else { 7 })
                .iter()
                .map(|&value| match kind {
                    0 => [255, 0, 100][usize::from(value % 3)],
                    1 => [255, 255, 255, 255, 255, 255, 0, 100][usize::from(value % 8)],
                    4 => [255, 0, 1, 2, 4, 8, 13, 22, 35, 100][usize::from(value % 10)],
                    _ => value,
                })
                .collect();
            let origin = f64::from(shift) * 0.5;
            let message = Message::new(format, name).u32(0).u32(0);
            let message = message.u32(0.5f32.to_bits()).u32(width as u32).u32(height as u32).f64(origin).raw(&[0; 48]);
            message.bytes(&cells).finish()
        },
    )
}

/// Floats of many kinds: measured in millimetres, rough, missing.
fn float() -> impl Strategy<Value = f32> {
    prop_oneof![
        8 => (0u32..30_000).prop_map(|count| count as f32 * 0.001),
        1 => any::<f32>(),
        1 => prop::sample::select(vec![f32::NAN, f32::INFINITY, 0.0, -0.0, f32::from_bits(0x7fc0_0001)]),
    ]
}

fn scan() -> impl Strategy<Value = Vec<u8>> {
    let parts = (vec(float(), 0..1500), vec(any::<f32>(), 0..1500), format(), 0usize..9);
    parts.prop_map(|(ranges, intensities, format, name)| {
        let floats = |message: Message, values: &[f32]| {
            values.iter().fold(message.u32(values.len() as u32), |message, value| message.raw(&value.to_le_bytes()))
        };
        let message = Message::new(format, name).align(4).raw(&[1; 28]);
        floats(floats(message, &ranges), &intensities).finish()
    })
}

fn cloud() -> impl Strategy<Value = Vec<u8>> {
    let names = prop::sample::select(vec!["x", "y", "z", "rgb", "ring", "intensity", "normal"]);
    let field = (names, 1u8..9, 0usize..4, 0u32..3);
    (
        vec(field, 0..7),
        1usize..40,
        1usize..40,
        0usize..5,
        0usize..5,
        any::<u64>(),
        vec(float(), 1..60),
        (format(), 0usize..9),
    )
        .prop_map(|(fields, width, height, tail, padding, seed, floats, (format, name))| {
            let mut offset = 0;
            let mut message = Message::new(format, name).u32(height as u32).u32(width as u32).u32(fields.len() as u32);
            let mut float_offsets = Vec::new();
            for (name, number, gap, count) in fields {
                offset += gap;
                message = message.string(name).u32(offset as u32).raw(&[number]).u32(count);
                if number == 7 && count == 1 {
                    float_offsets.push(offset);
                }
                offset += [0, 1, 1, 2, 2, 4, 4, 4, 8][usize::from(number)] * count as usize;
            }
            let step = offset + tail + 1;
            let row = step * width + padding;
            let mut data = samples(row * height, seed, 0x0f);
            for y in 0..height {
                for x in 0..width {
                    for (index, &offset) in float_offsets.iter().enumerate() {
                        let value = floats[(x + y + index) % floats.len()] * (x + 1) as f32;
                        data[y * row + x * step + offset..][..4].copy_from_slice(&value.to_le_bytes());
                    }
                }
            }
            message.raw(&[0]).u32(step as u32).u32(row as u32).bytes(&data).raw(&[1]).finish()
        })
}

fn any_message() -> impl Strategy<Value = (Schema, Vec<u8>)> {
    prop_oneof![
        image().prop_map(|message| (Schema::Image, message)),
        grid().prop_map(|message| (Schema::OccupancyGrid, message)),
        scan().prop_map(|message| (Schema::LaserScan, message)),
        cloud().prop_map(|message| (Schema::PointCloud2, message)),
        (prop::sample::select(SCHEMAS.to_vec()), vec(any::<u8>(), 0..300)),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    /// For any message and codec, the message is restored bit by bit, and a frame is hardly larger than the message.
    #[test]
    fn every_message_comes_back_from_every_codec((schema, message) in any_message()) {
        for codec in CODECS {
            let mut frame = b"kept".to_vec();
            let encoded = Encoder::new(schema).encode(codec, &message, &mut frame);
            prop_assert_eq!(encoded.bytes, frame.len() - 4);
            prop_assert!(encoded.bytes <= message.len() + 600);
            let mut back = b"kept".to_vec();
            let decoded = Decoder::new(message.len()).decode(&frame[4..], &mut back).unwrap();
            prop_assert_eq!(&back[4..], &message[..]);
            prop_assert_eq!(decoded.codec.name(), encoded.codec.name());
            prop_assert_eq!(codec::peek(&frame[4..]).unwrap(), decoded);
            if !message.is_empty() {
                let too_large = Decoder::new(message.len() - 1).decode(&frame[4..], &mut Vec::new());
                let refused = matches!(too_large, Err(Error::TooLarge { .. }));
                prop_assert!(refused);
            }
        }
    }

    /// A message with a wrong byte fits no codec of its own, or is restored all the same.
    #[test]
    fn a_damaged_message_comes_back(
        (schema, mut message) in any_message(), at in any::<prop::sample::Index>(), bit in 0u8..8
    ) {
        if !message.is_empty() {
            let at = at.index(message.len().min(200));
            message[at] ^= 1 << bit;
        }
        let mut frame = Vec::new();
        Encoder::new(schema).encode(Codec::for_schema(schema), &message, &mut frame);
        let mut back = Vec::new();
        Decoder::new(LIMIT).decode(&frame, &mut back).unwrap();
        prop_assert_eq!(back, message);
    }

    /// A damaged frame is an error or a message of the declared size, never a panic.
    #[test]
    fn a_damaged_frame_does_no_harm(
        (schema, message) in any_message(), damage in vec((any::<prop::sample::Index>(), any::<u8>()), 1..4)
    ) {
        let mut frame = Vec::new();
        Encoder::new(schema).encode(Codec::for_schema(schema), &message, &mut frame);
        for (at, byte) in damage {
            let at = at.index(frame.len());
            frame[at] = byte;
        }
        let mut back = Vec::new();
        match Decoder::new(LIMIT).decode(&frame, &mut back) {
            Ok(decoded) => prop_assert_eq!(back.len(), decoded.bytes),
            Err(_) => prop_assert!(back.is_empty()),
        }
    }
}

/// Returns a picture of a moving scene of 64×48 pixels.
fn scene(encoding: &str, channels: usize, round: usize) -> Vec<u8> {
    scene_in(Format::Ros1, encoding, channels, round)
}

fn scene_in(format: Format, encoding: &str, channels: usize, round: usize) -> Vec<u8> {
    let (width, height, padding) = (64, 48, 5);
    let mut data = Vec::new();
    for y in 0..height {
        for x in 0..width {
            let colour = [(x * 3 + round) as u8, (y * 4) as u8, (x + y) as u8, (x ^ y) as u8];
            data.extend_from_slice(&colour[..channels]);
        }
        data.extend_from_slice(&[round as u8; 5]);
    }
    let message = Message::new(format, 5).u32(height as u32).u32(width as u32).string(encoding);
    message.raw(&[0]).u32((width * channels + padding) as u32).bytes(&data).finish()
}

/// Messages as nodes send them use the codec of their type, in both formats and with any padding.
#[test]
fn each_schema_is_told_by_its_own_codec_in_both_formats() {
    for format in [Format::Ros1, Format::Cdr] {
        for length in 0..8 {
            let message = || Message::new(format, length);
            let cells = samples(21 * (3 + length), 7, 0);
            let image = message().u32(3 + length as u32).u32(7).string("rgb8").raw(&[0]).u32(21).bytes(&cells);
            let grid = message().u32(1).u32(2).u32(3).u32(21);
            let grid = grid.u32(3 + length as u32).f64(1.0).raw(&[0; 48]);
            let scan = message().align(4).raw(&[1; 28]);
            let scan = scan.u32(64).raw(&samples(256, 3, 0)).u32(0);
            let field = |message: Message, name, offset| message.string(name).u32(offset).raw(&[7]).u32(1);
            let cloud = field(field(message().u32(1).u32(32).u32(2), "x", 0), "y", 4);
            let cloud = cloud.raw(&[0]).u32(8).u32(256).bytes(&samples(256, 5, 0));
            for (schema, message) in [
                (Schema::Image, image),
                (Schema::OccupancyGrid, grid.bytes(&cells)),
                (Schema::LaserScan, scan),
                (Schema::PointCloud2, cloud.raw(&[1])),
            ] {
                let (message, mut frame) = (message.finish(), Vec::new());
                let made = Codec::for_schema(schema);
                let encoded = Encoder::new(schema).encode(made, &message, &mut frame);
                assert_eq!(encoded.codec, made, "{format:?}, {schema:?}, {length}");
                let mut back = Vec::new();
                Decoder::new(LIMIT).decode(&frame, &mut back).unwrap();
                assert_eq!(back, message, "{format:?}, {schema:?}, {length}");
            }
        }
    }
}

#[test]
fn what_is_lossy_is_never_used_unless_allowed() {
    let message = scene("rgb8", 3, 0);
    for codec in [Codec::Video, Codec::Jpeg] {
        let mut frame = Vec::new();
        let encoded = Encoder::new(Schema::Image).encode(codec, &message, &mut frame);
        assert_eq!(encoded.codec, Codec::Zstd(3));
        let mut back = Vec::new();
        Decoder::new(LIMIT).decode(&frame, &mut back).unwrap();
        assert_eq!(back, message);
    }
}

/// Checks a decoded scene: everything but the colours is unchanged, and those differ by less than `most`.
fn assert_lossy(back: &[u8], message: &[u8], channels: usize, most: u8) {
    let colours = channels.min(3);
    assert_eq!(back.len(), message.len());
    let head = message.len() - 48 * (64 * channels + 5);
    assert_eq!(back[..head], message[..head]);
    let lines = |bytes: &[u8]| bytes[head..].chunks(64 * channels + 5).map(<[u8]>::to_vec).collect::<Vec<_>>();
    for (new, old) in lines(back).iter().zip(lines(message)) {
        assert_eq!(new[64 * channels..], old[64 * channels..], "padding");
        for (new, old) in new[..64 * channels].chunks(channels).zip(old.chunks(channels)) {
            assert_eq!(new[colours..], old[colours..], "alpha");
            let near = |(new, old): (&u8, &u8)| new.abs_diff(*old) < most;
            assert!(new[..colours].iter().zip(&old[..colours]).all(near), "{new:?} {old:?}");
        }
    }
}

#[test]
fn jpeg_keeps_all_but_the_colours_and_each_picture_stands_alone() {
    for (format, encoding, channels) in [
        (Format::Ros1, "mono8", 1),
        (Format::Ros1, "rgb8", 3),
        (Format::Ros1, "bgr8", 3),
        (Format::Ros1, "rgba8", 4),
        (Format::Ros1, "bgra8", 4),
        (Format::Cdr, "mono8", 1),
        (Format::Cdr, "bgr8", 3),
        (Format::Cdr, "rgba8", 4),
    ] {
        let mut before = usize::MAX;
        for (quality, most) in [(95, 30), (80, 60), (30, 120)] {
            let mut encoder = Encoder::new(Schema::Image).allow_jpeg(JpegOptions { quality });
            let message = scene_in(format, encoding, channels, 3);
            let mut frame = Vec::new();
            let encoded = encoder.encode(Codec::Jpeg, &message, &mut frame);
            assert_eq!(encoded.codec, Codec::Jpeg, "{format:?} {encoding}");
            assert!(frame.len() < before, "a lower quality is smaller");
            before = frame.len();
            let mut back = Vec::new();
            Decoder::new(LIMIT).decode(&frame, &mut back).unwrap();
            assert_lossy(&back, &message, channels, most);
        }
    }
}

#[test]
fn what_may_not_be_a_picture_is_never_told_as_jpeg() {
    for (encoding, channels) in [("8UC1", 1), ("8UC3", 3), ("bayer_rggb8", 1)] {
        let mut encoder = Encoder::new(Schema::Image).allow_jpeg(JpegOptions::default());
        let message = scene(encoding, channels, 0);
        let mut frame = Vec::new();
        let encoded = encoder.encode(Codec::Jpeg, &message, &mut frame);
        assert_eq!(encoded.codec, Codec::Zstd(3), "{encoding}");
        let mut back = Vec::new();
        Decoder::new(LIMIT).decode(&frame, &mut back).unwrap();
        assert_eq!(back, message);
    }
}

#[test]
fn a_jpeg_that_is_cut_changed_or_of_another_size_is_refused_or_a_picture() {
    let mut encoder = Encoder::new(Schema::Image).allow_jpeg(JpegOptions::default());
    let message = scene("rgb8", 3, 0);
    let mut frame = Vec::new();
    encoder.encode(Codec::Jpeg, &message, &mut frame);
    for at in 0..frame.len() {
        let mut out = Vec::new();
        assert!(Decoder::new(LIMIT).decode(&frame[..at], &mut out).is_err());
        for flipped in [0x01, 0x80, 0xff] {
            let mut damaged = frame.clone();
            damaged[at] ^= flipped;
            match Decoder::new(LIMIT).decode(&damaged, &mut out) {
                Ok(decoded) => assert_eq!(out.len(), decoded.bytes),
                Err(_) => assert!(out.is_empty()),
            }
            out.clear();
        }
    }
    // A stream that declares a far larger picture: the library never sees it.
    let at = frame.windows(2).position(|pair| pair == [0xff, 0xc0]);
    let size = at.unwrap() + 5;
    frame[size..size + 4].copy_from_slice(&[0xff; 4]);
    let refused = Decoder::new(LIMIT).decode(&frame, &mut Vec::new());
    assert_eq!(refused.err(), Some(Error::Corrupt("a JPEG of another size than declared")));
}

#[cfg(feature = "video")]
#[test]
fn video_keeps_all_but_the_colours_and_recovers_from_loss() {
    for (format, encoding, channels) in [
        (Format::Ros1, "rgb8", 3),
        (Format::Ros1, "bgr8", 3),
        (Format::Ros1, "rgba8", 4),
        (Format::Ros1, "bgra8", 4),
        (Format::Cdr, "rgb8", 3),
        (Format::Cdr, "bgra8", 4),
    ] {
        let mut encoder = Encoder::new(Schema::Image).allow_video(VideoOptions::default());
        let mut decoder = Decoder::new(LIMIT);
        for round in 0..12 {
            let message = scene_in(format, encoding, channels, round);
            let mut frame = Vec::new();
            let encoded = encoder.encode(Codec::Video, &message, &mut frame);
            assert_eq!(encoded.codec, Codec::Video);
            let mut back = Vec::new();
            if round == 5 {
                continue;
            }
            let decoded = decoder.decode(&frame, &mut back);
            if round == 6 {
                assert!(decoded.as_ref().is_err_and(Error::wants_keyframe));
                encoder.request_keyframe();
                continue;
            }
            decoded.unwrap();
            assert_lossy(&back, &message, channels, 40);
        }
    }
}

#[cfg(not(feature = "video"))]
#[test]
fn a_build_without_video_falls_back() {
    let message = scene("rgb8", 3, 0);
    let mut encoder = Encoder::new(Schema::Image).allow_video(VideoOptions::default());
    assert!(!Codec::Video.is_available());
    assert_eq!(encoder.encode(Codec::Video, &message, &mut Vec::new()).codec, Codec::Zstd(3));
}
