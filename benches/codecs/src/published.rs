//! The published system's table of codecs, row by row, beside ours: space saved, on the recordings of the same kinds,
//! and what pixels lose where they lose something.

use crate::messages::{grid, image};
use crate::psnr::Psnr;
use crate::samples;
use anyhow::{Result, ensure};
use bench_report::{Report, Target};
use codec::{Codec, Decoder, Encoder, JpegOptions, Schema, VideoOptions};

/// Frames of the video.
const FRAMES: usize = 100;
/// Cells of a map's side, as gmapping has them.
const SIZE: usize = 4000;
/// The qualities that are shown; the second is the usual one.
const QUALITIES: [u8; 3] = [90, 80, 60];

/// What a codec made of messages.
struct Outcome {
    /// In percent.
    saved: f64,
    /// Signal to noise in dB; none where nothing is lost.
    psnr: Option<f64>,
}

/// Encodes and decodes all, in order.
fn run(mut encoder: Encoder, codec: Codec, messages: &[Vec<u8>]) -> Result<Outcome> {
    let mut decoder = Decoder::new(messages.iter().map(Vec::len).max().unwrap_or(0));
    let (mut frames, mut whole) = (0usize, 0usize);
    let mut psnr = Psnr::default();
    let mut exact = true;
    for message in messages {
        let (mut frame, mut back) = (Vec::new(), Vec::new());
        let encoded = encoder.encode(codec, message, &mut frame);
        ensure!(
            encoded.codec == codec,
            "{codec} fell back to {}",
            encoded.codec
        );
        decoder.decode(&frame, &mut back)?;
        exact &= back == *message;
        // Head and all: what is exact in it is some bytes of a million.
        psnr.add(&back, message);
        frames += frame.len();
        whole += message.len();
    }
    ensure!(exact || !codec.is_lossless(), "{codec} changed a message");
    Ok(Outcome {
        saved: 100.0 * (1.0 - frames as f64 / whole as f64),
        psnr: (!exact).then(|| psnr.decibels()),
    })
}

pub fn table(report: &mut Report) -> Result<()> {
    println!("published table           published      ours  PSNR");
    let mut row = |kind: &str, published: f64, how: &str, outcome: &Outcome, target: bool| {
        let psnr = outcome
            .psnr
            .map_or_else(|| "lossless".to_owned(), |psnr| format!("{psnr:.1} dB"));
        println!(
            "    {kind:<10} {how:<24} {published:5.1}%  {:6.2}%  {psnr}",
            outcome.saved
        );
        let figure = report
            .figure(
                format!("published {kind}: saved by {how}"),
                "%",
                outcome.saved,
            )
            .beside("published", published)
            .note(psnr);
        if target {
            figure.reach(Target::AtLeast(published));
        }
    };
    let (width, height, pixels) = samples::video(FRAMES)?;
    let frames: Vec<_> = pixels
        .chunks_exact(width * height * 3)
        .map(|frame| image("bgr8", width, height, frame))
        .collect();
    let pictures: Vec<_> = samples::colours()?
        .iter()
        .map(|picture| image("rgb8", picture.width, picture.height, &picture.data))
        .collect();
    let image = || Encoder::new(Schema::Image);
    for (kind, published, messages) in [("video", 75.4, &frames), ("image", 96.1, &pictures)] {
        if kind == "video" && Codec::Video.is_built() {
            let encoder = image().allow_video(VideoOptions::default());
            let outcome = run(encoder, Codec::Video, messages)?;
            row(kind, published, "H.264 (option)", &outcome, true);
        }
        for quality in QUALITIES {
            let encoder = image().allow_jpeg(JpegOptions { quality });
            let outcome = run(encoder, Codec::Jpeg, messages)?;
            let usual = quality == JpegOptions::default().quality;
            let how = format!("JPEG {quality}{}", if usual { " (usual)" } else { "" });
            row(kind, published, &how, &outcome, usual);
        }
        let outcome = run(image(), Codec::Image, messages)?;
        row(kind, published, "image", &outcome, false);
    }
    let office = samples::office()?;
    let map = [grid(SIZE, SIZE, &samples::in_the_middle(&office, SIZE))];
    let outcome = run(Encoder::new(Schema::OccupancyGrid), Codec::Grid, &map)?;
    row("grid map", 99.9, "grid, 4000×4000", &outcome, true);
    let map = [grid(office.width, office.height, &office.data)];
    let outcome = run(Encoder::new(Schema::OccupancyGrid), Codec::Grid, &map)?;
    row(
        "grid map",
        99.9,
        "grid, only what is known",
        &outcome,
        false,
    );
    Ok(())
}
