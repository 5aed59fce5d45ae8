//! The codec table of the publication beside our results on recordings of the same kinds.

use crate::messages::{grid, image};
use crate::samples;
use anyhow::{Result, ensure};
use bench_report::{BenchReport, Psnr, Target};
use codec::{Codec, Decoder, Encoder, JpegOptions, Schema, VideoOptions};

/// Number of frames of the video.
const FRAMES: usize = 100;
/// Cells per side of a map, as gmapping uses them.
const SIZE: usize = 4000;
/// JPEG qualities to show; the second one is the default.
const QUALITIES: [u8; 3] = [90, 80, 60];

/// Result of one codec for a list of messages.
struct CompressionResult {
    /// Space saved, in percent.
    saved: f64,
    /// Peak signal-to-noise ratio in dB; `None` if nothing was lost.
    psnr: Option<f64>,
}

/// Encodes and decodes all messages, in order.
fn encode_and_decode(mut encoder: Encoder, codec: Codec, messages: &[Vec<u8>]) -> Result<CompressionResult> {
    let mut decoder = Decoder::new(messages.iter().map(Vec::len).max().unwrap_or(0));
    let (mut frames, mut whole) = (0usize, 0usize);
    let mut psnr = Psnr::default();
    let mut exact = true;
    for message in messages {
        let (mut frame, mut back) = (Vec::new(), Vec::new());
        let encoded = encoder.encode(codec, message, &mut frame);
        ensure!(encoded.codec == codec, "{codec} fell back to {}", encoded.codec);
        decoder.decode(&frame, &mut back)?;
        exact &= back == *message;
        // Header included: it is exact, but only a few bytes of a million.
        psnr.add(&back, message);
        frames += frame.len();
        whole += message.len();
    }
    ensure!(exact || !codec.is_lossless(), "{codec} changed a message");
    Ok(CompressionResult {
        saved: 100.0 * (1.0 - frames as f64 / whole as f64),
        psnr: (!exact).then(|| psnr.decibels()),
    })
}

pub fn measure_published_table(report: &mut BenchReport) -> Result<()> {
    let mut row = |kind: &str, published: f64, how: &str, outcome: &CompressionResult, target: bool| {
        let psnr = outcome.psnr.map_or_else(|| "lossless".to_owned(), |psnr| format!("{psnr:.1} dB"));
        let figure = report
            .figure(format!("published {kind}: saved by {how}"), "%", outcome.saved)
            .relative_to("published", published)
            .note(psnr);
        if target {
            figure.require(Target::AtLeast(published));
        }
    };
    let (width, height, pixels) = samples::decode_video(FRAMES)?;
    let frames: Vec<_> =
        pixels.chunks_exact(width * height * 3).map(|frame| image("bgr8", width, height, frame)).collect();
    let pictures: Vec<_> = samples::colour_frames()?
        .iter()
        .map(|picture| image("rgb8", picture.width, picture.height, &picture.data))
        .collect();
    let image = || Encoder::new(Schema::Image);
    for (kind, published, messages) in [("video", 75.4, &frames), ("image", 96.1, &pictures)] {
        if kind == "video" && Codec::Video.is_available() {
            let encoder = image().allow_video(VideoOptions::default());
            let outcome = encode_and_decode(encoder, Codec::Video, messages)?;
            row(kind, published, "H.264 (option)", &outcome, true);
        }
        for quality in QUALITIES {
            let encoder = image().allow_jpeg(JpegOptions { quality });
            let outcome = encode_and_decode(encoder, Codec::Jpeg, messages)?;
            let usual = quality == JpegOptions::default().quality;
            let how = format!("JPEG {quality}{}", if usual { " (usual)" } else { "" });
            row(kind, published, &how, &outcome, usual);
        }
        let outcome = encode_and_decode(image(), Codec::Image, messages)?;
        row(kind, published, "image", &outcome, false);
    }
    let office = samples::office_map()?;
    let map = [grid(SIZE, SIZE, &samples::centre_in_grid(&office, SIZE))];
    let outcome = encode_and_decode(Encoder::new(Schema::OccupancyGrid), Codec::Grid, &map)?;
    row("grid map", 99.9, "grid, 4000×4000", &outcome, true);
    let map = [grid(office.width, office.height, &office.data)];
    let outcome = encode_and_decode(Encoder::new(Schema::OccupancyGrid), Codec::Grid, &map)?;
    row("grid map", 99.9, "grid, only what is known", &outcome, false);
    Ok(())
}
