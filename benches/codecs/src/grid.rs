//! Occupancy grids: small, large, and while they are made.

use crate::contest::{Contest, find, print};
use crate::{messages, samples, world};
use anyhow::{Result, ensure};
use bench_report::{Report, Target};
use codec::{Codec, Decoder, Encoder, Schema};

const SIZE: usize = 4000;

pub fn grids(report: &mut Report) -> Result<()> {
    let office = samples::office()?;
    let small = [messages::grid(office.width, office.height, &office.data)];
    let outcomes = Contest {
        schema: Schema::OccupancyGrid,
        messages: &small,
        rounds: 15,
    }
    .run(&[Codec::Grid], &[1, 3, 19])?;
    print("grid, 566×608", &outcomes);
    let (ours, zstd) = (find(&outcomes, "grid")?, find(&outcomes, "zstd 19")?);
    report
        .figure("grid 566×608: saved", "%", ours.saved)
        .beside("zstd 19", zstd.saved)
        .reach(Target::AboveFloor);

    let large = [messages::grid(
        SIZE,
        SIZE,
        &samples::in_the_middle(&office, SIZE),
    )];
    let outcomes = Contest {
        schema: Schema::OccupancyGrid,
        messages: &large,
        rounds: 15,
    }
    .run(&[Codec::Grid], &[1, 3])?;
    print("grid, 4000×4000", &outcomes);
    let (ours, zstd, copy) = (
        find(&outcomes, "grid")?,
        find(&outcomes, "zstd 1")?,
        find(&outcomes, "memcpy")?,
    );
    let figure = report
        .figure("grid 4000×4000: saved", "%", ours.saved)
        .beside("zstd 1", zstd.saved);
    figure.reach(Target::AtLeast(99.9));
    let figure = report
        .figure("grid 4000×4000: encoding", "MB/s", ours.encode)
        .beside("memcpy", copy.encode);
    figure.reach(Target::RatioAtLeast(0.3));
    report
        .figure("grid 4000×4000: decoding", "MB/s", ours.decode)
        .beside("memcpy", copy.decode);
    mapping(report, &office)
}

/// A map being made: what each of its grids takes, all told whole.
fn mapping(report: &mut Report, office: &samples::Picture) -> Result<()> {
    let messages: Vec<_> = world::mapping(office, SIZE, 24)
        .iter()
        .map(|cells| messages::grid(SIZE, SIZE, cells))
        .collect();
    let mut encoder = Encoder::new(Schema::OccupancyGrid);
    let mut decoder = Decoder::new(messages[0].len());
    let (mut ours, mut fast, mut best, mut largest) = (0usize, 0usize, 0usize, 0usize);
    for message in &messages {
        let (mut frame, mut back) = (Vec::new(), Vec::new());
        encoder.encode(Codec::Grid, message, &mut frame);
        decoder.decode(&frame, &mut back)?;
        ensure!(back == *message, "a grid changed");
        ours += frame.len();
        largest = largest.max(frame.len());
        fast += zstd::bulk::compress(message, 1)?.len();
        best += zstd::bulk::compress(message, 9)?.len();
    }
    let mean = |sum: usize| sum as f64 / messages.len() as f64;
    println!(
        "grid, a map being made: {:.0} bytes each, {largest} at most; zstd 1 {:.0}, zstd 9 {:.0}",
        mean(ours),
        mean(fast),
        mean(best)
    );
    for (name, size) in [("zstd 1", fast), ("zstd 9", best)] {
        let figure = report.figure("grid, a map being made: size", "B", mean(ours));
        figure
            .beside(name, mean(size))
            .reach(Target::RatioAtMost(1.0));
    }
    Ok(())
}
