//! Colour video compared with x264, by the processor time of one core, independent of other load.

use crate::messages::image;
use crate::samples;
use anyhow::{Context, Result, ensure};
use bench_report::{BenchReport, Psnr, Target, children_processor_time, thread_processor_time};
use codec::{Codec, Decoder, Encoder, Schema, VideoOptions};
use std::io::Write;
use std::process::{Command, Stdio};
use std::time::Duration;

const FRAMES: usize = 200;

/// BT.601 luma of blue, green, red.
fn luma(pixels: &[u8]) -> Vec<u8> {
    let luma = |p: &[u8]| (29 * u32::from(p[0]) + 150 * u32::from(p[1]) + 77 * u32::from(p[2]) + 128) >> 8;
    pixels.chunks_exact(3).map(|pixel| luma(pixel) as u8).collect()
}

pub fn measure_video(report: &mut BenchReport) -> Result<()> {
    let (width, height, pixels) = samples::decode_video(FRAMES)?;
    let frames: Vec<&[u8]> = pixels.chunks_exact(width * height * 3).collect();
    let messages: Vec<Vec<u8>> = frames.iter().map(|frame| image("bgr8", width, height, frame)).collect();
    let mut encoder = Encoder::new(Schema::Image).allow_video(VideoOptions::default());
    let mut decoder = Decoder::new(messages[0].len());
    let (mut encoding, mut decoding) = (Duration::ZERO, Duration::ZERO);
    let mut bytes = 0usize;
    let (mut colour, mut grey) = (Psnr::default(), Psnr::default());
    for (message, frame) in messages.iter().zip(&frames) {
        let mut out = Vec::new();
        let start = thread_processor_time();
        let encoded = encoder.encode(Codec::Video, message, &mut out);
        encoding += thread_processor_time() - start;
        ensure!(encoded.codec == Codec::Video, "video fell back to {}", encoded.codec);
        bytes += out.len();
        let mut back = Vec::new();
        let start = thread_processor_time();
        decoder.decode(&out, &mut back)?;
        decoding += thread_processor_time() - start;
        let head = message.len() - frame.len();
        ensure!(back[..head] == message[..head], "video changed more than the pixels");
        colour.add(&back[head..], frame);
        grey.add(&luma(&back[head..]), &luma(frame));
    }
    let count = frames.len() as f64;
    let planar = width * height * 3 / 2;
    let saved = 100.0 * (1.0 - bytes as f64 / count / planar as f64);
    let saved_of_message = 100.0 * (1.0 - bytes as f64 / count / messages[0].len() as f64);
    let peer = x264(width, height, &pixels, &frames)?;
    let speed = count / encoding.as_secs_f64();
    let figure = report.figure("video: saved", "%", saved).relative_to("x264", peer.saved);
    figure.require(Target::AtLeast(98.5)).note("of the 4:2:0 planes; of the message even more");
    report.figure("video: saved of the message", "%", saved_of_message);
    let figure = report.figure("video: PSNR of the colours", "dB", colour.decibels());
    figure.relative_to("x264", peer.colour).require(Target::AtLeast(36.0));
    report.figure("video: PSNR of luma", "dB", grey.decibels());
    let figure = report.figure("video: encoding", "frames/s", speed);
    figure.relative_to("x264", peer.speed).require(Target::AtLeast(100.0));
    report.figure("video: decoding", "frames/s", count / decoding.as_secs_f64());
    Ok(())
}

struct X264Result {
    saved: f64,
    colour: f64,
    speed: f64,
}

/// Encodes with x264 for a live link, on one thread; the time includes the colour conversion, as ours does.
fn x264(width: usize, height: usize, pixels: &[u8], frames: &[&[u8]]) -> Result<X264Result> {
    let size = format!("{width}x{height}");
    let raw = ["-f", "rawvideo", "-pix_fmt", "bgr24"];
    let start = children_processor_time();
    let stream = run_filter(
        Command::new("ffmpeg")
            .args(["-v", "error", "-threads", "1"])
            .args(raw)
            .args(["-s", &size, "-i", "-", "-c:v", "libx264", "-preset", "veryfast", "-tune", "zerolatency"])
            .args(["-crf", "23", "-threads", "1", "-pix_fmt", "yuv420p", "-f", "h264", "-"]),
        pixels,
    )?;
    let took = children_processor_time() - start;
    let back =
        run_filter(Command::new("ffmpeg").args(["-v", "error", "-f", "h264", "-i", "-"]).args(raw).arg("-"), &stream)?;
    ensure!(back.len() == pixels.len(), "x264 lost frames");
    let mut colour = Psnr::default();
    for (back, frame) in back.chunks_exact(frames[0].len()).zip(frames) {
        colour.add(back, frame);
    }
    let count = frames.len() as f64;
    let saved = 100.0 * (1.0 - stream.len() as f64 / count / (width * height * 3 / 2) as f64);
    Ok(X264Result { saved, colour: colour.decibels(), speed: count / took.as_secs_f64() })
}

/// Runs `command` as a filter: writes `input` to it and returns its output.
fn run_filter(command: &mut Command, input: &[u8]) -> Result<Vec<u8>> {
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().context("ffmpeg; install it")?;
    let mut stdin = child.stdin.take().context("a pipe")?;
    let output = std::thread::scope(|scope| {
        scope.spawn(move || stdin.write_all(input));
        child.wait_with_output()
    })?;
    ensure!(output.status.success(), "ffmpeg failed");
    Ok(output.stdout)
}
