//! Writes the seeds of the codec targets into `corpus/`: run it when a frame's layout has changed.
//!
//!     cargo run -p fuzz --example codec_seeds

use codec::{Codec, Encoder, JpegOptions, Schema, VideoOptions};
use std::fs;
use std::path::Path;

/// A serialized message, field by field.
#[derive(Default)]
struct Message(Vec<u8>);

impl Message {
    fn stamped() -> Self {
        Self::default().u32(1).u32(2).u32(3).bytes(b"map")
    }

    fn raw(mut self, bytes: &[u8]) -> Self {
        self.0.extend_from_slice(bytes);
        self
    }

    fn u32(self, value: u32) -> Self {
        self.raw(&value.to_le_bytes())
    }

    fn bytes(self, bytes: &[u8]) -> Self {
        self.u32(bytes.len() as u32).raw(bytes)
    }

    fn floats(self, values: &[f32]) -> Self {
        values
            .iter()
            .fold(self.u32(values.len() as u32), |message, value| {
                message.raw(&value.to_le_bytes())
            })
    }
}

fn image(encoding: &str, width: u32, height: u32, step: u32, data: &[u8]) -> Vec<u8> {
    let message = Message::stamped()
        .u32(height)
        .u32(width)
        .bytes(encoding.as_bytes());
    message.raw(&[0]).u32(step).bytes(data).0
}

/// A slope with some noise.
fn samples(count: usize) -> Vec<u8> {
    (0..count)
        .map(|index| (index / 5 + ((index * 7919) >> 4) % 3) as u8)
        .collect()
}

fn images() -> Vec<Vec<u8>> {
    let depths: Vec<u8> = (0..40 * 36u16)
        .map(|at| if at % 11 == 0 { 0 } else { 900 + at % 40 * 3 })
        .flat_map(u16::to_le_bytes)
        .collect();
    let metres: Vec<u8> = (0..24 * 24)
        .map(|at| {
            if at % 13 == 0 {
                f32::NAN
            } else {
                (1000 + at) as f32 * 0.001
            }
        })
        .flat_map(f32::to_le_bytes)
        .collect();
    vec![
        image("rgb8", 20, 18, 60, &samples(60 * 18)),
        image("bgra8", 8, 8, 35, &samples(35 * 8)),
        image("mono8", 30, 40, 33, &samples(33 * 40)),
        image("bayer_rggb8", 17, 15, 17, &samples(17 * 15)),
        image("16UC1", 40, 36, 80, &depths),
        image("32FC1", 24, 24, 96, &metres),
    ]
}

fn grid(shift: u32, extra: usize) -> Vec<u8> {
    let cells: Vec<u8> = (0..70 * 70)
        .map(|at| match (at % 70 + extra, at / 70) {
            (x, 30) if x > 20 => 100,
            (x, y) if x > 20 && y > 30 && y < 60 => 0,
            _ => 255,
        })
        .collect();
    let message = Message::stamped().raw(&[0; 8]).raw(&0.5f32.to_le_bytes());
    let origin = f64::from(shift) * 0.5;
    let message = message
        .u32(70)
        .u32(70)
        .raw(&origin.to_le_bytes())
        .raw(&[0; 48]);
    message.bytes(&cells).0
}

fn shaded() -> Vec<u8> {
    let message = Message::stamped().raw(&[0; 8]).raw(&0.5f32.to_le_bytes());
    let message = message.u32(40).u32(40).raw(&[0; 56]);
    message.bytes(&samples(1600)).0
}

/// In the few shades that a mapper leaves.
fn laddered() -> Vec<u8> {
    let cells: Vec<u8> = (0..60 * 60usize)
        .map(|at| match (at % 60, at / 60) {
            (x, y) if x < 20 || y < 10 => 255,
            (x, y) => [35, 22, 13, 8, 4, 2, 1, 0][(x + y) / 20 + ((at * 7919) >> 4) % 3],
        })
        .collect();
    let message = Message::stamped().raw(&[0; 8]).raw(&0.5f32.to_le_bytes());
    let message = message.u32(60).u32(60).raw(&[0; 56]);
    message.bytes(&cells).0
}

fn scan(rough: bool) -> Vec<u8> {
    let ranges: Vec<f32> = (0..300)
        .map(|beam| match beam % 23 {
            0 => f32::INFINITY,
            _ if rough => (beam as f32 * 0.01).sin() + 2.0,
            _ => (1000 + beam * 3) as f32 * 0.001,
        })
        .collect();
    let echoes: Vec<f32> = (0..300).map(|beam| (beam % 50) as f32).collect();
    Message::stamped()
        .raw(&[0; 28])
        .floats(&ranges)
        .floats(&echoes)
        .0
}

/// Fields of a cloud: name, offset, number.
fn cloud(
    width: u32,
    height: u32,
    step: u32,
    fields: &[(&str, u32, u8)],
    padding: u32,
    data: &[u8],
) -> Vec<u8> {
    let message = Message::stamped()
        .u32(height)
        .u32(width)
        .u32(fields.len() as u32);
    let message = fields.iter().fold(message, |message, &(name, at, number)| {
        message.bytes(name.as_bytes()).u32(at).raw(&[number]).u32(1)
    });
    let message = message
        .raw(&[0])
        .u32(step)
        .u32(step * width + padding)
        .bytes(data);
    message.raw(&[1]).0
}

fn clouds() -> Vec<Vec<u8>> {
    let mut camera = Vec::new();
    let mut laser = Vec::new();
    for v in 0..12 {
        for u in 0..16 {
            let z = 1.0 + (u * v) as f32 * 0.002;
            let (x, y) = (
                (u as f32 - 8.0) * z * (1.0 / 525.0),
                (v as f32 - 6.0) * z * (1.0 / 525.0),
            );
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
        cloud(
            16,
            12,
            18,
            &[&xyz[..], &[("rgb", 12, 7)]].concat(),
            3,
            &camera,
        ),
        cloud(
            160,
            1,
            27,
            &[
                &xyz[..],
                &[("ring", 12, 4), ("time", 14, 8), ("t", 22, 6), ("i", 26, 2)],
            ]
            .concat(),
            0,
            &laser,
        ),
    ]
}

/// Frames as a list, each without its first `cut` bytes.
fn list(frames: &[Vec<u8>], cut: usize) -> Vec<u8> {
    let mut bytes = Vec::new();
    for frame in frames {
        bytes.extend_from_slice(&((frame.len() - cut) as u16).to_le_bytes());
        bytes.extend_from_slice(&frame[cut..]);
    }
    bytes
}

/// The frames of messages of one topic.
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
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("corpus")
        .join(target);
    fs::create_dir_all(&folder).expect("the corpus can be written");
    fs::write(folder.join(name), bytes).expect("the corpus can be written");
}

fn main() {
    let text = samples(700);
    for (target, codec) in [
        ("zlib", Codec::Zlib(6)),
        ("deflate", Codec::Deflate(9)),
        ("zstd", Codec::Zstd(3)),
    ] {
        let frames = frames(Schema::Other, codec, &[text.clone(), vec![0; 5000]]);
        write(&format!("codec_{target}"), "two", &list(&frames, 2));
    }
    let grids = [grid(0, 0), grid(0, 3), grid(4, 5)];
    let rgb: Vec<_> = (0..4)
        .map(|round| {
            image(
                "rgb8",
                32,
                24,
                96,
                &samples(96 * 24 + round * 5)[round * 5..],
            )
        })
        .collect();
    let kinds = [
        (Schema::Image, images()),
        (
            Schema::OccupancyGrid,
            vec![grids[0].clone(), shaded(), laddered()],
        ),
        (Schema::LaserScan, vec![scan(false), scan(true)]),
        (Schema::PointCloud2, clouds()),
        (Schema::Other, vec![text]),
    ];
    let mut mixed = Vec::new();
    for (number, (schema, messages)) in kinds.iter().enumerate() {
        let codec = Codec::made_for(*schema);
        for (index, message) in messages.iter().enumerate() {
            let frames = frames(*schema, codec, std::slice::from_ref(message));
            if *schema != Schema::Other {
                let target = format!("codec_{}", codec.name());
                write(&target, &format!("kind{index}"), &list(&frames, 2));
            }
            if index == 0 {
                mixed.extend(frames);
            }
            let message = [&[number as u8], &message[..]].concat();
            write(
                "codec_message",
                &format!("{}{index}", codec.name()),
                &message,
            );
        }
    }
    let made = frames(Schema::OccupancyGrid, Codec::Grid, &grids);
    write("codec_grid", "successors", &list(&made, 2));
    let made = frames(Schema::Image, Codec::Video, &rgb);
    write("codec_video", "moving", &list(&made, 2));
    mixed.extend(made);
    let grey = image("mono8", 33, 25, 40, &samples(40 * 25));
    let made = [
        frames(Schema::Image, Codec::Jpeg, &rgb[..1]),
        frames(Schema::Image, Codec::Jpeg, &[grey]),
    ];
    write("codec_jpeg", "kinds", &list(&made.concat(), 2));
    mixed.extend(made.concat());
    write("codec_frame", "all", &list(&mixed, 0));
}
