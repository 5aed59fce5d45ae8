//! Laser scans and point clouds: the link's codecs should produce less data than zstd 19, at the speed of zstd 3.

use crate::contest::{CodecComparison, find_result, print_results, report_columns};
use crate::{messages, recorded, samples, world};
use anyhow::Result;
use bench_report::{BenchReport, Target};
use codec::{Codec, Schema};

fn report_figures(report: &mut BenchReport, title: &str, schema: Schema, messages: &[Vec<u8>]) -> Result<()> {
    // Scans are small and clouds are large.
    let rounds = if schema == Schema::LaserScan { 40 } else { 7 };
    let codec = Codec::for_schema(schema);
    let outcomes = CodecComparison { schema, messages, rounds }.run(&[codec], &[1, 3, 19])?;
    print_results(title, &outcomes);
    report_columns(report, title, &outcomes, codec.name())?;
    let (ours, fast, best) =
        (find_result(&outcomes, codec.name())?, find_result(&outcomes, "zstd 3")?, find_result(&outcomes, "zstd 19")?);
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
    if recorded::is_installed("recorded scans", report) {
        for (title, name) in [("scan of a drive", recorded::DRIVE), ("scan of a hall", recorded::BEACONS)] {
            let scans = recorded::laser_ranges(name)?;
            let messages: Vec<_> = scans.iter().map(|ranges| messages::scan(ranges, &[])).collect();
            report_figures(report, title, Schema::LaserScan, &messages)?;
        }
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
    if recorded::is_installed("recorded clouds", report) {
        let (colour, depth) = recorded::kinect_frame()?;
        for (title, step, organised) in
            [("Kinect cloud, 32 B", 32, true), ("Kinect cloud without its picture", 16, false)]
        {
            let message = world::recorded_camera_cloud(&colour, &depth, step, organised);
            report_figures(report, title, Schema::PointCloud2, &[message])?;
        }
        let message = world::recorded_spinning_cloud(&recorded::velodyne_packets()?);
        report_figures(report, "VLP-16 cloud", Schema::PointCloud2, &[message])?;
    }
    Ok(())
}
