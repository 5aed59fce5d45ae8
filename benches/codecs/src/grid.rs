//! Occupancy grids: small ones, large ones, and a sequence of grids while a map is being built.

use crate::contest::{CodecComparison, find_result, print_results, report_columns};
use crate::{messages, recorded, samples, world};
use anyhow::{Result, ensure};
use bench_report::{BenchReport, Target};
use codec::{Codec, Decoder, Encoder, Schema};

const SIZE: usize = 4000;

pub fn measure_grids(report: &mut BenchReport) -> Result<()> {
    let office = samples::office_map()?;
    let small = [messages::grid(office.width, office.height, &office.data)];
    let outcomes = CodecComparison { schema: Schema::OccupancyGrid, messages: &small, rounds: 15 }
        .run(&[Codec::Grid], &[1, 3, 19])?;
    print_results("grid, 566×608", &outcomes);
    report_columns(report, "grid 566×608", &outcomes, "grid")?;
    let (ours, zstd) = (find_result(&outcomes, "grid")?, find_result(&outcomes, "zstd 19")?);
    report
        .figure("grid 566×608: saved", "%", ours.saved)
        .relative_to("zstd 19", zstd.saved)
        .require(Target::AboveFloor);

    let large = [messages::grid(SIZE, SIZE, &samples::centre_in_grid(&office, SIZE))];
    let outcomes =
        CodecComparison { schema: Schema::OccupancyGrid, messages: &large, rounds: 5 }.run(&[Codec::Grid], &[1, 3])?;
    print_results("grid, 4000×4000", &outcomes);
    report_columns(report, "grid 4000×4000", &outcomes, "grid")?;
    let (ours, zstd, copy) =
        (find_result(&outcomes, "grid")?, find_result(&outcomes, "zstd 1")?, find_result(&outcomes, "memcpy")?);
    let figure = report.figure("grid 4000×4000: saved", "%", ours.saved).relative_to("zstd 1", zstd.saved);
    figure.require(Target::AtLeast(99.9));
    let figure = report.figure("grid 4000×4000: encoding", "MB/s", ours.encode).relative_to("memcpy", copy.encode);
    figure.require(Target::RatioAtLeast(0.3));
    report.figure("grid 4000×4000: decoding", "MB/s", ours.decode).relative_to("memcpy", copy.decode);
    if recorded::is_installed("recorded maps", report) {
        for (title, name) in [("grid of a hall", recorded::HALL_MAP), ("grid of a campus", recorded::CAMPUS_MAP)] {
            let map = recorded::occupancy_map(name)?;
            let messages = [messages::grid(map.width, map.height, &map.data)];
            let comparison = CodecComparison { schema: Schema::OccupancyGrid, messages: &messages, rounds: 7 };
            let outcomes = comparison.run(&[Codec::Grid], &[1, 3])?;
            print_results(title, &outcomes);
            report_columns(report, title, &outcomes, "grid")?;
        }
    }
    measure_mapping(report, &office)
}

/// Measures a map that is being built: the size of each of its grids, all of which are sent in full.
fn measure_mapping(report: &mut BenchReport, office: &samples::Picture) -> Result<()> {
    let messages: Vec<_> =
        world::maps_in_progress(office, SIZE, 24).iter().map(|cells| messages::grid(SIZE, SIZE, cells)).collect();
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
        figure.relative_to(name, mean(size)).require(Target::RatioAtMost(1.0));
    }
    Ok(())
}
