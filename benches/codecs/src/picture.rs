//! Images: colour, grey, Bayer, depth.

use crate::contest::{Comparison, compare};
use crate::messages::image;
use crate::recorded;
use crate::samples::{self, Noise, Picture};
use anyhow::{Result, ensure};
use bench_report::{BenchReport, Race, Target};
use codec::{Codec, Decoder, Encoder, Schema};
use std::hint::black_box;

/// Serializes images, with what `data` makes of each.
fn images(encoding: &str, pictures: &[Picture], data: impl Fn(&Picture) -> Vec<u8>) -> Vec<Vec<u8>> {
    pictures.iter().map(|p| image(encoding, p.width, p.height, &data(p))).collect()
}

/// Reports the figures of a lossless image codec; some pictures have a target of their own, in percent saved.
fn report_lossless(report: &mut BenchReport, title: &str, messages: &[Vec<u8>], saved: Option<f64>) -> Result<()> {
    let comparisons = [
        Comparison::Saved("zstd 19", saved.map_or(Target::AboveFloor, Target::AtLeast)),
        Comparison::Encoding("zstd 1", saved.map(|_| Target::RatioAtLeast(0.4))),
        Comparison::Decoding("zstd 1"),
    ];
    compare(report, title, Schema::Image, messages, &comparisons)
}

/// Encodes one image as PNG, as `image_transport`'s `compressed` does.
fn png(picture: &Picture) -> Result<Vec<u8>> {
    let mut out = Vec::new();
    let mut encoder = png::Encoder::new(&mut out, picture.width as u32, picture.height as u32);
    encoder.set_color(if picture.depth == 3 { png::ColorType::Rgb } else { png::ColorType::Grayscale });
    encoder.set_depth(if picture.depth == 2 { png::BitDepth::Sixteen } else { png::BitDepth::Eight });
    encoder.set_compression(png::Compression::Balanced);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&picture.data)?;
    writer.finish()?;
    Ok(out)
}

fn jpeg(picture: &Picture) -> Result<Vec<u8>> {
    let mut out = Vec::new();
    let (width, height) = (u16::try_from(picture.width)?, u16::try_from(picture.height)?);
    jpeg_encoder::Encoder::new(&mut out, 95).encode(&picture.data, width, height, jpeg_encoder::ColorType::Rgb)?;
    Ok(out)
}

pub fn measure_colour(report: &mut BenchReport) -> Result<()> {
    let pictures = samples::colour_frames()?;
    let whole = |picture: &Picture| picture.data.clone();
    let messages = images("rgb8", &pictures, whole);
    report_lossless(report, "colour", &messages, Some(63.0))?;
    measure_peers(report, &pictures, &messages)?;

    let packaged = images("bgr8", &samples::packaged_photographs()?, whole);
    report_lossless(report, "colour, packaged photographs", &packaged, None)?;
    let grey = |p: &Picture| -> Vec<u8> { p.data.chunks_exact(3).map(|pixel| pixel[1]).collect() };
    report_lossless(report, "grey", &images("mono8", &pictures, grey), None)?;
    let bayer = images("bayer_rggb8", &pictures, to_bayer);
    report_lossless(report, "Bayer", &bayer, None)
}

/// Samples an image as a camera with a Bayer colour filter array would.
fn to_bayer(picture: &Picture) -> Vec<u8> {
    let channel = |x: usize, y: usize| [[0, 1], [1, 2]][y % 2][x % 2];
    (0..picture.width * picture.height)
        .map(|at| picture.data[at * 3 + channel(at % picture.width, at / picture.width)])
        .collect()
}

/// Measures PNG and JPEG, which encode images rather than messages.
fn measure_peers(report: &mut BenchReport, pictures: &[Picture], messages: &[Vec<u8>]) -> Result<()> {
    let bytes: usize = messages.iter().map(Vec::len).sum();
    let saved = |sizes: Vec<usize>| {
        let saved = sizes.iter().zip(pictures).map(|(&size, p)| 1.0 - size as f64 / p.data.len() as f64);
        100.0 * saved.sum::<f64>() / pictures.len() as f64
    };
    let sizes = |encode: fn(&Picture) -> Result<Vec<u8>>| -> Result<Vec<usize>> {
        pictures.iter().map(|picture| Ok(encode(picture)?.len())).collect()
    };
    let (png_saved, jpeg_saved) = (saved(sizes(png)?), saved(sizes(jpeg)?));
    let mut race = Race::new(5);
    let mut encoder = Encoder::new(Schema::Image);
    let mut out = Vec::new();
    race.add("image", move || {
        for message in messages {
            out.clear();
            encoder.encode(Codec::Image, message, &mut out);
            black_box(&out);
        }
    });
    race.add("PNG", || pictures.iter().for_each(|picture| drop(black_box(png(picture)))));
    race.add("JPEG 95", || pictures.iter().for_each(|picture| drop(black_box(jpeg(picture)))));
    let times = race.run();
    let speed: Vec<f64> = times.iter().map(|times| times.megabytes_per_second(bytes)).collect();
    let figure = report.figure("colour: encoding", "MB/s", speed[0]).relative_to("PNG", speed[1]);
    figure.require(Target::RatioAtLeast(5.0)).note(format!("PNG saves {png_saved:.1}%"));
    let figure = report.figure("colour: encoding", "MB/s", speed[0]).relative_to("JPEG 95", speed[2]);
    figure.note(format!("JPEG saves {jpeg_saved:.1}%, lossy"));
    Ok(())
}

pub fn measure_depth(report: &mut BenchReport) -> Result<()> {
    let kinect = recorded::is_installed("recorded depth", report).then(recorded::kinect_frame).transpose()?;
    let kinect = kinect.map(|(_, depth)| depth);
    let mut pictures = samples::depth_frames()?;
    if pictures.is_empty() {
        pictures.extend(kinect.clone());
    }
    ensure!(!pictures.is_empty(), "no depth image at hand: neither recordings nor mrpt-common");
    let whole = images("16UC1", &pictures, |picture| picture.data.clone());
    report_lossless(report, "depth", &whole, Some(83.0))?;
    let holes = images("16UC1", &pictures, with_holes);
    report_lossless(report, "depth with holes", &holes, None)?;
    let metres = images("32FC1", &pictures, |picture| to_metres(&with_holes(picture)));
    report_lossless(report, "float depth", &metres, None)?;
    if let Some(depth) = kinect {
        let millimetres = image("16UC1", depth.width, depth.height, &depth.data);
        report_lossless(report, "Kinect depth", &[millimetres], None)?;
        let metres = image("32FC1", depth.width, depth.height, &to_metres(&depth.data));
        report_lossless(report, "Kinect float depth", &[metres], None)?;
    }
    Ok(())
}

/// Adds missing values along depth edges, as structured light produces them; the recordings had been filled.
fn with_holes(picture: &Picture) -> Vec<u8> {
    let depth = |at: usize| u16::from_le_bytes([picture.data[at * 2], picture.data[at * 2 + 1]]);
    let mut data = picture.data.clone();
    let mut noise = Noise(5);
    for at in 12..data.len() / 2 {
        let step = depth(at).abs_diff(depth(at - 12));
        if step > 400 || (step > 100 && noise.next() % 4 == 0) {
            data[at * 2..at * 2 + 2].fill(0);
        }
    }
    data
}

/// Converts depth to metres as `depth_image_proc/convert_metric` does, with NaN where nothing was measured.
fn to_metres(millimetres: &[u8]) -> Vec<u8> {
    let metres = |pair: &[u8]| match u16::from_le_bytes([pair[0], pair[1]]) {
        0 => f32::NAN,
        depth => f32::from(depth) * 0.001,
    };
    millimetres.chunks_exact(2).map(metres).flat_map(f32::to_le_bytes).collect()
}

/// Checks synthetic corner cases: each one is decoded to the original, and none grows.
pub fn measure_corner_cases(report: &mut BenchReport) -> Result<()> {
    let mut noise = Noise(3);
    let mut random = |count: usize| -> Vec<u8> { (0..count).map(|_| noise.next() as u8).collect() };
    let cases = [
        ("flat rgb8", image("rgb8", 640, 480, &[90; 640 * 480 * 3])),
        ("noise rgb8", image("rgb8", 640, 480, &random(640 * 480 * 3))),
        ("noise 16UC1", image("16UC1", 640, 480, &random(640 * 480 * 2))),
        ("noise 32FC1", image("32FC1", 640, 480, &random(640 * 480 * 4))),
        ("one pixel", image("rgb8", 1, 1, &[1, 2, 3])),
        ("one row", image("mono8", 5000, 1, &random(5000))),
        ("one column", image("bgra8", 1, 5000, &random(20_000))),
        ("odd Bayer", image("bayer_grbg8", 641, 479, &random(641 * 479))),
        ("padded rows", image("mono8", 639, 480, &random(641 * 480))),
        ("unknown encoding", image("yuv422", 640, 480, &random(640 * 480 * 2))),
    ];
    let mut worst = f64::MIN;
    for (name, message) in &cases {
        let mut frame = Vec::new();
        Encoder::new(Schema::Image).encode(Codec::Image, message, &mut frame);
        let mut back = Vec::new();
        Decoder::new(message.len()).decode(&frame, &mut back)?;
        ensure!(back == *message, "{name} changed");
        let growth = frame.len() as f64 - message.len() as f64;
        worst = worst.max(growth);
    }
    report.figure("corner cases: growth at worst", "B", worst).require(Target::AtMost(16.0));
    Ok(())
}
