//! Occupancy grids: the first, and successors.

use crate::contest::{Contest, find, print};
use crate::{messages, samples, world};
use anyhow::{Result, ensure};
use bench_report::{Race, Report, Target};
use codec::{Codec, Decoder, Encoder, Schema};
use std::hint::black_box;

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
    room(report, &office)?;
    successors(report, &office)
}

/// A room that becomes known all at once: the place of the changed cells costs next to nothing, so that the cells alone
/// are what there is to tell.
fn room(report: &mut Report, office: &samples::Picture) -> Result<()> {
    let mut noise = samples::Noise(21);
    let (mut ours, mut fast, mut best) = (0usize, 0usize, 0usize);
    let (mut count, mut changes) = (0usize, 0usize);
    for side in [40usize, 100, 250] {
        for _ in 0..8 {
            let left = noise.next() as usize % (office.width - side);
            let top = noise.next() as usize % (office.height - side);
            let mut cells = vec![255u8; SIZE * SIZE];
            let before = messages::grid(SIZE, SIZE, &cells);
            let mut changed = Vec::new();
            for y in 0..side {
                let row = &office.data[(top + y) * office.width + left..][..side];
                cells[(1000 + top + y) * SIZE + 1000 + left..][..side].copy_from_slice(row);
                changed.extend_from_slice(row);
            }
            let after = messages::grid(SIZE, SIZE, &cells);
            let mut encoder = Encoder::new(Schema::OccupancyGrid);
            let mut decoder = Decoder::new(after.len());
            let (mut frame, mut back) = (Vec::new(), Vec::new());
            let encoded = encoder.encode(Codec::Grid, &before, &mut frame);
            decoder.decode(&frame, &mut back)?;
            encoder.acknowledge(encoded.sequence);
            frame.clear();
            back.clear();
            encoder.encode(Codec::Grid, &after, &mut frame);
            decoder.decode(&frame, &mut back)?;
            ensure!(back == after, "a room changed");
            ours += frame.len() - (after.len() - SIZE * SIZE);
            fast += zstd::bulk::compress(&changed, 3)?.len();
            best += zstd::bulk::compress(&changed, 19)?.len();
            changes += changed.len();
            count += 1;
        }
    }
    let mean = |sum: usize| sum as f64 / count as f64;
    println!(
        "grid, a room at once: {:.0} cells, {:.0} bytes; zstd 3 of the cells {:.0}, zstd 19 {:.0}",
        mean(changes),
        mean(ours),
        mean(fast),
        mean(best)
    );
    for (name, size) in [("zstd 3", fast), ("zstd 19", best)] {
        let figure = report.figure("grid successor, a room: size", "B", mean(ours));
        figure.beside(format!("{name} of the changed cells"), mean(size));
        figure.reach(Target::RatioAtMost(1.2));
    }
    Ok(())
}

/// A map being made, every grid acknowledged before the next.
fn successors(report: &mut Report, office: &samples::Picture) -> Result<()> {
    let grids = world::mapping(office, SIZE, 24);
    let messages: Vec<_> = grids
        .iter()
        .map(|cells| messages::grid(SIZE, SIZE, cells))
        .collect();
    let head = messages[0].len() - SIZE * SIZE;
    let mut encoder = Encoder::new(Schema::OccupancyGrid);
    let mut decoder = Decoder::new(messages[0].len());
    let (mut ours, mut values_only, mut placed, mut changes) = (0usize, 0usize, 0usize, 0usize);
    let mut worst: f64 = 0.0;
    for (index, message) in messages.iter().enumerate() {
        let mut frame = Vec::new();
        let encoded = encoder.encode(Codec::Grid, message, &mut frame);
        let mut back = Vec::new();
        decoder.decode(&frame, &mut back)?;
        ensure!(back == *message, "a successor changed");
        encoder.acknowledge(encoded.sequence);
        if index > 0 {
            let changed: Vec<usize> = (0..SIZE * SIZE)
                .filter(|&at| grids[index][at] != grids[index - 1][at])
                .collect();
            let values: Vec<u8> = changed.iter().map(|&at| grids[index][at]).collect();
            // Where they are, as distances from one to the next.
            let mut places = Vec::new();
            let mut last = 0;
            for &at in &changed {
                places.extend_from_slice(&((at - last) as u32).to_le_bytes());
                last = at;
            }
            let values = zstd::bulk::compress(&values, 3)?.len();
            let places = zstd::bulk::compress(&places, 3)?.len();
            // The head is the message's own, not a cell.
            let cells = frame.len() - head;
            changes += changed.len();
            ours += cells;
            values_only += values;
            placed += values + places;
            worst = worst.max(cells as f64 / values as f64);
        }
    }
    let count = (messages.len() - 1) as f64;
    println!(
        "grid successors: {:.0} cells change, {:.0} bytes; zstd 3 of their values {:.0}, with their places {:.0}; worst {worst:.2}",
        changes as f64 / count,
        ours as f64 / count,
        values_only as f64 / count,
        placed as f64 / count
    );
    let figure = report.figure("grid successor, rays: size", "B", ours as f64 / count);
    figure.beside(
        "zstd 3 of the changed cells, values and places",
        placed as f64 / count,
    );
    figure.reach(Target::RatioAtMost(1.2));
    let figure = report.figure("grid successor, rays: size", "B", ours as f64 / count);
    figure.beside("zstd 3 of their values", values_only as f64 / count);
    figure.note("which do not tell where they are");

    let (first, second) = (&messages[10], &messages[11]);
    let mut buffer = vec![0u8; second.len()];
    let mut encoder = Encoder::new(Schema::OccupancyGrid);
    let mut frame = Vec::new();
    let encoded = encoder.encode(Codec::Grid, first, &mut frame);
    encoder.acknowledge(encoded.sequence);
    let mut race = Race::new(15);
    race.add("memcpy", || {
        black_box(&mut buffer[..]).copy_from_slice(second)
    });
    race.add("grid", || {
        frame.clear();
        encoder.encode(Codec::Grid, second, &mut frame);
        black_box(&frame);
    });
    let times = race.run();
    let figure = report.figure(
        "grid successor: encoding",
        "MB/s",
        times[1].megabytes_per_second(second.len()),
    );
    figure
        .beside("memcpy", times[0].megabytes_per_second(second.len()))
        .reach(Target::RatioAtLeast(0.3));
    Ok(())
}
