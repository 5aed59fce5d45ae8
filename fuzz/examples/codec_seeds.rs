//! Writes the seeds of the codec targets into `corpus/`. To be run whenever the layout of a frame has changed:
//!
//!     cargo run -p fuzz --features video --example codec_seeds

use codec::{Codec, Encoder, JpegOptions, Schema, VideoOptions};
use std::fs;
use std::path::Path;

/// Serialization format: ROS 1, or ROS 2 (CDR, little endian).
#[derive(Clone, Copy, PartialEq)]
enum SeedFormat {
    Ros1,
    Cdr,
}

/// A serialized message, written field by field.
struct SeedMessage {
    bytes: Vec<u8>,
    format: SeedFormat,
}

impl SeedMessage {
    /// Starts a message with a header.
    fn with_header(format: SeedFormat) -> Self {
        // The CDR encapsulation header takes the place of `seq`; CDR aligns relative to its end.
        let seq = match format {
            SeedFormat::Ros1 => [1, 0, 0, 0],
            SeedFormat::Cdr => [0, 1, 0, 0],
        };
        let message = Self { bytes: seq.to_vec(), format };
        message.u32(2).u32(3).text("map")
    }

    fn raw(mut self, bytes: &[u8]) -> Self {
        self.bytes.extend_from_slice(bytes);
        self
    }

    fn align(mut self, size: usize) -> Self {
        if self.format == SeedFormat::Cdr {
            let filled = (self.bytes.len() - 4).next_multiple_of(size) + 4;
            self.bytes.resize(filled, 0);
        }
        self
    }

    fn u32(self, value: u32) -> Self {
        self.align(4).raw(&value.to_le_bytes())
    }

    fn f32(self, value: f32) -> Self {
        self.align(4).raw(&value.to_le_bytes())
    }

    fn doubles(self, values: &[f64]) -> Self {
        values.iter().fold(self.align(8), |message, value| message.raw(&value.to_le_bytes()))
    }

    fn bytes(self, bytes: &[u8]) -> Self {
        self.u32(bytes.len() as u32).raw(bytes)
    }

    fn text(self, text: &str) -> Self {
        match self.format {
            SeedFormat::Ros1 => self.bytes(text.as_bytes()),
            SeedFormat::Cdr => self.bytes(&[text.as_bytes(), b"\0"].concat()),
        }
    }

    fn floats(self, values: &[f32]) -> Self {
        let message = self.u32(values.len() as u32);
        values.iter().fold(message, |message, &value| message.f32(value))
    }

    /// Returns the message, padded to a multiple of four bytes.
    fn finish(self) -> Vec<u8> {
        self.align(4).bytes
    }
}

fn image(format: SeedFormat, encoding: &str, width: u32, height: u32, step: u32, data: &[u8]) -> Vec<u8> {
    let message = SeedMessage::with_header(format).u32(height).u32(width);
    message.text(encoding).raw(&[0]).u32(step).bytes(data).finish()
}

/// Returns a slope with some noise.
fn slope_samples(count: usize) -> Vec<u8> {
    (0..count).map(|index| (index / 5 + ((index * 7919) >> 4) % 3) as u8).collect()
}

fn images(format: SeedFormat) -> Vec<Vec<u8>> {
    let depths: Vec<u8> =
        (0..40 * 36u16).map(|at| if at % 11 == 0 { 0 } else { 900 + at % 40 * 3 }).flat_map(u16::to_le_bytes).collect();
    let metres: Vec<u8> = (0..24 * 24)
        .map(|at| if at % 13 == 0 { f32::NAN } else { (1000 + at) as f32 * 0.001 })
        .flat_map(f32::to_le_bytes)
        .collect();
    vec![
        image(format, "rgb8", 20, 18, 60, &slope_samples(60 * 18)),
        image(format, "bgra8", 8, 8, 35, &slope_samples(35 * 8)),
        image(format, "mono8", 30, 40, 33, &slope_samples(33 * 40)),
        image(format, "bayer_rggb8", 17, 15, 17, &slope_samples(17 * 15)),
        image(format, "16UC1", 40, 36, 80, &depths),
        image(format, "32FC1", 24, 24, 96, &metres),
    ]
}

/// A map with cells of half a metre.
fn map(format: SeedFormat, side: u32, origin: f64, cells: &[u8]) -> Vec<u8> {
    let message = SeedMessage::with_header(format).u32(0).u32(0).f32(0.5);
    let message = message.u32(side).u32(side);
    let pose = [origin, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    message.doubles(&pose).bytes(cells).finish()
}

fn grid(format: SeedFormat, shift: u32, extra: usize) -> Vec<u8> {
    let cells: Vec<u8> = (0..70 * 70)
        .map(|at| match (at % 70 + extra, at / 70) {
            (x, 30) if x > 20 => 100,
            (x, y) if x > 20 && y > 30 && y < 60 => 0,
            _ => 255,
        })
        .collect();
    map(format, 70, f64::from(shift) * 0.5, &cells)
}

fn shaded_map(format: SeedFormat) -> Vec<u8> {
    map(format, 40, 0.0, &slope_samples(1600))
}

/// A map in the few shades that a mapper produces.
fn stepped_map(format: SeedFormat) -> Vec<u8> {
    let cells: Vec<u8> = (0..60 * 60usize)
        .map(|at| match (at % 60, at / 60) {
            (x, y) if x < 20 || y < 10 => 255,
            (x, y) => [35, 22, 13, 8, 4, 2, 1, 0][(x + y) / 20 + ((at * 7919) >> 4) % 3],
        })
        .collect();
    map(format, 60, 0.0, &cells)
}

fn scan(format: SeedFormat, rough: bool) -> Vec<u8> {
    let ranges: Vec<f32> = (0..300)
        .map(|beam| match beam % 23 {
            0 => f32::INFINITY,
            _ if rough => (beam as f32 * 0.01).sin() + 2.0,
            _ => (1000 + beam * 3) as f32 * 0.001,
        })
        .collect();
    let echoes: Vec<f32> = (0..300).map(|beam| (beam % 50) as f32).collect();
    let message = SeedMessage::with_header(format);
    let message = (0..7).fold(message, |message, _| message.f32(0.0));
    message.floats(&ranges).floats(&echoes).finish()
}

/// A point cloud; `fields` are name, offset and datatype.
fn cloud(
    format: SeedFormat,
    width: u32,
    height: u32,
    step: u32,
    fields: &[(&str, u32, u8)],
    padding: u32,
    data: &[u8],
) -> Vec<u8> {
    let message = SeedMessage::with_header(format).u32(height).u32(width).u32(fields.len() as u32);
    let message =
        fields.iter().fold(message, |message, &(name, at, number)| message.text(name).u32(at).raw(&[number]).u32(1));
    let message = message.raw(&[0]).u32(step).u32(step * width + padding).bytes(data);
    message.raw(&[1]).finish()
}

fn clouds(format: SeedFormat) -> Vec<Vec<u8>> {
    let mut camera = Vec::new();
    let mut laser = Vec::new();
    for v in 0..12 {
        for u in 0..16 {
            let z = 1.0 + (u * v) as f32 * 0.002;
            let (x, y) = ((u as f32 - 8.0) * z * (1.0 / 525.0), (v as f32 - 6.0) * z * (1.0 / 525.0));
            for value in [x, y, if (u + v) % 9 == 0 { f32::NAN } else { z }] {
                camera.extend_from_slice(&value.to_le_bytes());
            }
            camera.extend_from_slice(&[u as u8, v as u8, 7, 255, 0, 0]);
        }
        camera.extend_from_slice(&[1, 2, 3]);
    }
    for shot in 0..40 {
        for ring in 0..4u16 {
            let (sin, cos) = (shot as f32 * 0.01).sin_cos();
            let range = 3.0 + 0.1 * f32::from(ring);
            for value in [range * cos, range * sin, range * 0.2 * f32::from(ring)] {
                laser.extend_from_slice(&value.to_le_bytes());
            }
            laser.extend_from_slice(&ring.to_le_bytes());
            laser.extend_from_slice(&(f64::from(shot) * 0.1).to_le_bytes());
            laser.extend_from_slice(&(shot as u32 * 1000).to_le_bytes());
            laser.push(9);
        }
    }
    let xyz = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7)];
    vec![
        cloud(format, 16, 12, 18, &[&xyz[..], &[("rgb", 12, 7)]].concat(), 3, &camera),
        cloud(
            format,
            160,
            1,
            27,
            &[&xyz[..], &[("ring", 12, 4), ("time", 14, 8), ("t", 22, 6), ("i", 26, 2)]].concat(),
            0,
            &laser,
        ),
    ]
}

/// Serializes a list of frames, each without its first `cut` bytes.
fn list(frames: &[Vec<u8>], cut: usize) -> Vec<u8> {
    let mut bytes = Vec::new();
    for frame in frames {
        bytes.extend_from_slice(&((frame.len() - cut) as u16).to_le_bytes());
        bytes.extend_from_slice(&frame[cut..]);
    }
    bytes
}

/// Encodes messages of one topic.
fn frames(schema: Schema, codec: Codec, messages: &[Vec<u8>]) -> Vec<Vec<u8>> {
    let mut encoder = Encoder::new(schema).allow_video(VideoOptions::default());
    encoder = encoder.allow_jpeg(JpegOptions::default());
    let mut frames = Vec::new();
    for message in messages {
        let mut frame = Vec::new();
        let encoded = encoder.encode(codec, message, &mut frame);
        assert_eq!(encoded.codec.name(), codec.name(), "the message must fit");
        frames.push(frame);
    }
    frames
}

fn write(target: &str, name: &str, bytes: &[u8]) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus").join(target);
    fs::create_dir_all(&folder).expect("the corpus can be written");
    fs::write(folder.join(name), bytes).expect("the corpus can be written");
}

/// Writes the seeds of all codecs that know the fields of a message.
fn write_typed_seeds(format: SeedFormat) {
    let suffix = match format {
        SeedFormat::Ros1 => "",
        SeedFormat::Cdr => "_cdr",
    };
    let grids = [grid(format, 0, 0), grid(format, 0, 3), grid(format, 4, 5)];
    let rgb: Vec<_> = (0..4)
        .map(|round| {
            let data = &slope_samples(96 * 24 + round * 5)[round * 5..];
            image(format, "rgb8", 32, 24, 96, data)
        })
        .collect();
    let maps = vec![grids[0].clone(), shaded_map(format), stepped_map(format)];
    let kinds = [
        (Schema::Image, images(format)),
        (Schema::OccupancyGrid, maps),
        (Schema::LaserScan, vec![scan(format, false), scan(format, true)]),
        (Schema::PointCloud2, clouds(format)),
    ];
    let mut mixed = Vec::new();
    for (number, (schema, messages)) in kinds.iter().enumerate() {
        let codec = Codec::for_schema(*schema);
        for (index, message) in messages.iter().enumerate() {
            let frames = frames(*schema, codec, std::slice::from_ref(message));
            let target = format!("codec_{}", codec.name());
            write(&target, &format!("kind{index}{suffix}"), &list(&frames, 2));
            if index == 0 {
                mixed.extend(frames);
            }
            let message = [&[number as u8], &message[..]].concat();
            let name = format!("{}{index}{suffix}", codec.name());
            write("codec_message", &name, &message);
        }
    }
    let other = Codec::for_schema(Schema::Other);
    mixed.extend(frames(Schema::Other, other, &[slope_samples(700)]));
    let made = frames(Schema::OccupancyGrid, Codec::Grid, &grids);
    let name = format!("successors{suffix}");
    write("codec_grid", &name, &list(&made, 2));
    let made = frames(Schema::Image, Codec::Video, &rgb);
    write("codec_video", &format!("moving{suffix}"), &list(&made, 2));
    mixed.extend(made);
    let grey = image(format, "mono8", 33, 25, 40, &slope_samples(40 * 25));
    let made = [frames(Schema::Image, Codec::Jpeg, &rgb[..1]), frames(Schema::Image, Codec::Jpeg, &[grey])];
    let name = format!("kinds{suffix}");
    write("codec_jpeg", &name, &list(&made.concat(), 2));
    mixed.extend(made.concat());
    write("codec_frame", &format!("all{suffix}"), &list(&mixed, 0));
}

fn main() {
    let text = slope_samples(700);
    for (target, codec) in [("zlib", Codec::Zlib(6)), ("deflate", Codec::Deflate(9)), ("zstd", Codec::Zstd(3))] {
        let frames = frames(Schema::Other, codec, &[text.clone(), vec![0; 5000]]);
        write(&format!("codec_{target}"), "two", &list(&frames, 2));
    }
    // Schema number 4 has no fields.
    write("codec_message", "zstd0", &[&[4], &text[..]].concat());
    write_typed_seeds(SeedFormat::Ros1);
    write_typed_seeds(SeedFormat::Cdr);
}
