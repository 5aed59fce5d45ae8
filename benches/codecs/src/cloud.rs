//! Laser scans and point clouds: the link's codecs should produce less data than zstd 19, at the speed of zstd 3.

use crate::contest::{Comparison, compare};
use crate::{messages, recorded, samples, world};
use anyhow::Result;
use bench_report::{BenchReport, Target};
use codec::Schema;

const COMPARISONS: [Comparison; 3] = [
    Comparison::Saved("zstd 19", Target::AboveFloor),
    Comparison::Encoding("zstd 3", Some(Target::RatioAtLeast(1.0))),
    Comparison::Decoding("zstd 3"),
];

pub fn measure_scans(report: &mut BenchReport) -> Result<()> {
    let office = samples::office_map()?;
    let finite = |metres: f64, value: f64, otherwise| if metres.is_finite() { value as f32 } else { otherwise };
    let millimetres = |metres: f64| finite(metres, (metres * 1000.0).round(), 0.0) / 1000.0;
    let quarters = |metres: f64| finite(metres, (metres * 4000.0).round(), f32::INFINITY) / 4.0 / 1000.0;
    let rough = |metres: f64| finite(metres, metres, f32::INFINITY);
    let mut cases = vec![
        ("scan in mm", world::laser_scans(&office, millimetres, false)),
        ("scan in mm with intensities", world::laser_scans(&office, millimetres, true)),
        ("scan in 1/4 mm", world::laser_scans(&office, quarters, false)),
        ("scan, simulated floats", world::laser_scans(&office, rough, false)),
        ("scan from a depth camera", world::camera_scans(&samples::depth_frames()?)),
    ];
    if recorded::is_installed("recorded scans", report) {
        for (title, name) in [("scan of a drive", recorded::DRIVE), ("scan of a hall", recorded::BEACONS)] {
            let scans = recorded::laser_ranges(name)?;
            cases.push((title, scans.iter().map(|ranges| messages::scan(ranges, &[])).collect()));
        }
    }
    for (title, messages) in &cases {
        compare(report, title, Schema::LaserScan, messages, &COMPARISONS)?;
    }
    Ok(())
}

pub fn measure_clouds(report: &mut BenchReport) -> Result<()> {
    let (colours, depths) = (samples::colour_frames()?, samples::depth_frames()?);
    let mut cases = vec![
        ("cloud of a depth camera, 32 B", world::camera_clouds(&colours, &depths, 32, true)),
        ("cloud of a depth camera, 16 B", world::camera_clouds(&colours, &depths, 16, true)),
        ("cloud without its picture", world::camera_clouds(&colours, &depths, 16, false)),
        ("cloud of a spinning laser", world::spinning_clouds(&samples::office_map()?)),
    ];
    if recorded::is_installed("recorded clouds", report) {
        let (colour, depth) = recorded::kinect_frame()?;
        let kinect = |step, organised| vec![world::recorded_camera_cloud(&colour, &depth, step, organised)];
        cases.push(("Kinect cloud, 32 B", kinect(32, true)));
        cases.push(("Kinect cloud without its picture", kinect(16, false)));
        cases.push(("VLP-16 cloud", vec![world::recorded_spinning_cloud(&recorded::velodyne_packets()?)]));
    }
    for (title, messages) in cases.iter().filter(|(_, messages)| !messages.is_empty()) {
        compare(report, title, Schema::PointCloud2, messages, &COMPARISONS)?;
    }
    Ok(())
}
