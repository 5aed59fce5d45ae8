//! `make bench ONLY=codecs`

mod contest;
mod messages;
mod samples;
mod zlib;

use anyhow::Result;
use bench_report::{Report, Target};
use codec::{Codec, Schema};
use contest::{Contest, find, print};

const ROUNDS: usize = 7;

fn main() -> Result<()> {
    let mut report = Report::new("codecs");
    colours(&mut report)?;
    depths(&mut report)?;
    grids(&mut report)?;
    report.finish()?;
    Ok(())
}

fn colours(report: &mut Report) -> Result<()> {
    let messages: Vec<_> =
        samples::colours()?.iter().map(|p| messages::image("rgb8", p.width, p.height, &p.data)).collect();
    let outcomes = Contest { schema: Schema::Image, messages: &messages, rounds: ROUNDS }
        .run(&[Codec::Image, Codec::Zlib(6)], &[1, 3, 19])?;
    print("colour", &outcomes);
    let (ours, zstd) = (find(&outcomes, "image")?, find(&outcomes, "zstd 1")?);
    report.figure("colour: saved", "%", ours.saved).beside("zstd 1", zstd.saved).reach(Target::AtLeast(63.0));
    report.figure("colour: speed", "MB/s", ours.encode).beside("zstd 1", zstd.encode).reach(Target::RatioAtLeast(0.4));
    Ok(())
}

fn depths(report: &mut Report) -> Result<()> {
    let messages: Vec<_> =
        samples::depths()?.iter().map(|p| messages::image("16UC1", p.width, p.height, &p.data)).collect();
    let outcomes = Contest { schema: Schema::Image, messages: &messages, rounds: ROUNDS }
        .run(&[Codec::Image, Codec::Zlib(6)], &[1, 3, 19])?;
    print("depth", &outcomes);
    let (ours, zstd) = (find(&outcomes, "image")?, find(&outcomes, "zstd 1")?);
    report.figure("depth: saved", "%", ours.saved).beside("zstd 1", zstd.saved).reach(Target::AtLeast(83.0));
    report.figure("depth: speed", "MB/s", ours.encode).beside("zstd 1", zstd.encode).reach(Target::RatioAtLeast(0.4));
    Ok(())
}

fn grids(report: &mut Report) -> Result<()> {
    let office = samples::office()?;
    let messages = vec![messages::grid(office.width, office.height, &office.data)];
    let outcomes = Contest { schema: Schema::OccupancyGrid, messages: &messages, rounds: ROUNDS }
        .run(&[Codec::Grid], &[1, 3, 19])?;
    print("willow", &outcomes);
    let messages = vec![messages::grid(4000, 4000, &samples::in_the_middle(&office, 4000))];
    let outcomes = Contest { schema: Schema::OccupancyGrid, messages: &messages, rounds: ROUNDS }
        .run(&[Codec::Grid], &[1, 3])?;
    print("grid 4000", &outcomes);
    let (ours, floor) = (find(&outcomes, "grid")?, find(&outcomes, "memcpy")?);
    report.figure("grid: saved", "%", ours.saved).reach(Target::AtLeast(99.9));
    report.figure("grid: speed", "MB/s", ours.encode).beside("memcpy", floor.encode).reach(Target::RatioAtLeast(0.3));
    Ok(())
}
