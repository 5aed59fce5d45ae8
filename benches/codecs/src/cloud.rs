//! Laser scans and point clouds: smaller than zstd 19 makes them, as fast as zstd 3.

use crate::contest::{Contest, find, print};
use crate::{samples, world};
use anyhow::Result;
use bench_report::{Report, Target};
use codec::{Codec, Schema};

fn figures(report: &mut Report, title: &str, schema: Schema, messages: &[Vec<u8>]) -> Result<()> {
    // Scans are small and clouds are large.
    let rounds = if schema == Schema::LaserScan { 40 } else { 7 };
    let ours = Codec::made_for(schema);
    let outcomes = Contest {
        schema,
        messages,
        rounds,
    }
    .run(&[ours], &[1, 3, 19])?;
    print(title, &outcomes);
    let (ours, fast, best) = (
        find(&outcomes, ours.name())?,
        find(&outcomes, "zstd 3")?,
        find(&outcomes, "zstd 19")?,
    );
    report
        .figure(format!("{title}: saved"), "%", ours.saved)
        .beside("zstd 19", best.saved)
        .reach(Target::AboveFloor);
    let figure = report
        .figure(format!("{title}: encoding"), "MB/s", ours.encode)
        .beside("zstd 3", fast.encode);
    figure.reach(Target::RatioAtLeast(1.0));
    report
        .figure(format!("{title}: decoding"), "MB/s", ours.decode)
        .beside("zstd 3", fast.decode);
    Ok(())
}

pub fn scans(report: &mut Report) -> Result<()> {
    let office = samples::office()?;
    let millimetres = |metres: f64| {
        if metres.is_finite() {
            (metres * 1000.0).round() as f32 / 1000.0
        } else {
            0.0
        }
    };
    let quarters = |metres: f64| {
        if metres.is_finite() {
            (metres * 4000.0).round() as f32 / 4.0 / 1000.0
        } else {
            f32::INFINITY
        }
    };
    let rough = |metres: f64| {
        if metres.is_finite() {
            metres as f32
        } else {
            f32::INFINITY
        }
    };
    let cases = [
        ("scan in mm", world::scanner(&office, millimetres, false)),
        (
            "scan in mm with intensities",
            world::scanner(&office, millimetres, true),
        ),
        ("scan in 1/4 mm", world::scanner(&office, quarters, false)),
        (
            "scan, simulated floats",
            world::scanner(&office, rough, false),
        ),
        (
            "scan from a depth camera",
            world::camera_scans(&samples::depths()?),
        ),
    ];
    for (title, messages) in &cases {
        figures(report, title, Schema::LaserScan, messages)?;
    }
    Ok(())
}

pub fn clouds(report: &mut Report) -> Result<()> {
    let (colours, depths) = (samples::colours()?, samples::depths()?);
    let cases = [
        (
            "cloud of a depth camera, 32 B",
            world::camera_clouds(&colours, &depths, 32, true),
        ),
        (
            "cloud of a depth camera, 16 B",
            world::camera_clouds(&colours, &depths, 16, true),
        ),
        (
            "cloud without its picture",
            world::camera_clouds(&colours, &depths, 16, false),
        ),
        (
            "cloud of a spinning laser",
            world::spinning_clouds(&samples::office()?),
        ),
    ];
    for (title, messages) in cases.iter().filter(|(_, messages)| !messages.is_empty()) {
        figures(report, title, Schema::PointCloud2, messages)?;
    }
    Ok(())
}
