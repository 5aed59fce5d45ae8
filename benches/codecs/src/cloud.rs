//! Laser scans and point clouds: the link's codecs should produce less data than zstd 19, at the speed of zstd 3.

use crate::contest::{CodecComparison, find_result, print_results};
use crate::{samples, world};
use anyhow::Result;
use bench_report::{BenchReport, Target};
use codec::{Codec, Schema};

fn report_figures(report: &mut BenchReport, title: &str, schema: Schema, messages: &[Vec<u8>]) -> Result<()> {
    // Scans are small and clouds are large.
    let rounds = if schema == Schema::LaserScan { 40 } else { 7 };
    let ours = Codec::for_schema(schema);
    let outcomes = CodecComparison { schema, messages, rounds }.run(&[ours], &[1, 3, 19])?;
    print_results(title, &outcomes);
    let (ours, fast, best) =
        (find_result(&outcomes, ours.name())?, find_result(&outcomes, "zstd 3")?, find_result(&outcomes, "zstd 19")?);
    report
        .figure(format!("{title}: saved"), "%", ours.saved)
        .relative_to("zstd 19", best.saved)
        .require(Target::AboveFloor);
    let figure = report.figure(format!("{title}: encoding"), "MB/s", ours.encode).relative_to("zstd 3", fast.encode);
    figure.require(Target::RatioAtLeast(1.0));
    report.figure(format!("{title}: decoding"), "MB/s", ours.decode).relative_to("zstd 3", fast.decode);
    Ok(())
}

pub fn measure_scans(report: &mut BenchReport) -> Result<()> {
    let office = samples::office_map()?;
    let millimetres = |metres: f64| {
        if metres.is_finite() { (metres * 1000.0).round() as f32 / 1000.0 } else { 0.0 }
    };
    let quarters = |metres: f64| {
        if metres.is_finite() { (metres * 4000.0).round() as f32 / 4.0 / 1000.0 } else { f32::INFINITY }
    };
    let rough = |metres: f64| {
        if metres.is_finite() { metres as f32 } else { f32::INFINITY }
    };
    let cases = [
        ("scan in mm", world::laser_scans(&office, millimetres, false)),
        ("scan in mm with intensities", world::laser_scans(&office, millimetres, true)),
        ("scan in 1/4 mm", world::laser_scans(&office, quarters, false)),
        ("scan, simulated floats", world::laser_scans(&office, rough, false)),
        ("scan from a depth camera", world::camera_scans(&samples::depth_frames()?)),
    ];
    for (title, messages) in &cases {
        report_figures(report, title, Schema::LaserScan, messages)?;
    }
    Ok(())
}

pub fn measure_clouds(report: &mut BenchReport) -> Result<()> {
    let (colours, depths) = (samples::colour_frames()?, samples::depth_frames()?);
    let cases = [
        ("cloud of a depth camera, 32 B", world::camera_clouds(&colours, &depths, 32, true)),
        ("cloud of a depth camera, 16 B", world::camera_clouds(&colours, &depths, 16, true)),
        ("cloud without its picture", world::camera_clouds(&colours, &depths, 16, false)),
        ("cloud of a spinning laser", world::spinning_clouds(&samples::office_map()?)),
    ];
    for (title, messages) in cases.iter().filter(|(_, messages)| !messages.is_empty()) {
        report_figures(report, title, Schema::PointCloud2, messages)?;
    }
    Ok(())
}
