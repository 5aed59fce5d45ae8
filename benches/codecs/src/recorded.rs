//! Recordings of real robots from Debian's `mrpt-common`: laser scans, a depth camera, a spinning laser, maps.
//!
//! The files hold MRPT's serialized objects: `length of the name | 0x80 · name · version · fields · 0x88`, little
//! endian. Only the fields in front of the measurements are read, in the versions that the package has.

use crate::columns::Fields;
use crate::samples::Picture;
use anyhow::{Context, Result, bail, ensure};
use bench_report::BenchReport;
use std::io::Read;
use std::path::PathBuf;

/// Scans of a drive through one floor of a faculty building, by a SICK LMS.
pub const DRIVE: &str = "2006-01ENE-21-SENA_Telecom Faculty_one_loop_only.rawlog";
/// Scans of another drive, by a SICK LMS.
pub const BEACONS: &str = "uwb_ro-localization_demo.rawlog";
/// Map of a campus, 1888×2738 cells in shades.
pub const CAMPUS_MAP: &str = "2006-MalagaCampus.gridmap.gz";
/// Map of one hall, 700×650 cells in shades.
pub const HALL_MAP: &str = "uwb_ro-localization_demo_map.gridmap.gz";
const KINECT: &str = "tests_rgbd.rawlog";
const VELODYNE: &str = "test_velodyne_VLP16.rawlog";

/// Number of bytes per packet of a Velodyne laser.
pub const PACKET: usize = 1206;

/// Directory of the recordings: `CLOUDROID_MRPT_DATASETS`, or where the package has them; `None` without either.
fn datasets_directory() -> Option<PathBuf> {
    let path = std::env::var_os("CLOUDROID_MRPT_DATASETS");
    let path = path.map_or_else(|| PathBuf::from("/usr/share/mrpt/datasets"), PathBuf::from);
    path.join(DRIVE).exists().then_some(path)
}

/// Returns true if the recordings are installed; otherwise records in the report that `what` is left out.
pub fn is_installed(what: &str, report: &mut BenchReport) -> bool {
    let found = datasets_directory().is_some();
    if !found {
        report.skip(what, "Debian's mrpt-common is not installed");
    }
    found
}

fn load(name: &str) -> Result<Vec<u8>> {
    let path = datasets_directory().context("mrpt-common is not installed")?.join(name);
    let bytes = std::fs::read(&path).with_context(|| path.display().to_string())?;
    if !bytes.starts_with(&[0x1f, 0x8b]) {
        return Ok(bytes);
    }
    let mut unpacked = Vec::new();
    flate2::read::GzDecoder::new(&bytes[..]).read_to_end(&mut unpacked)?;
    Ok(unpacked)
}

/// Starts behind the version of the object whose class name begins at `at`.
fn open_object<'a>(bytes: &'a [u8], at: usize, name: &str) -> Fields<'a> {
    Fields { bytes, at: at + name.len() + 1 }
}

fn skip_pose(fields: &mut Fields<'_>) -> Result<()> {
    let name = usize::from(fields.take(1)?[0] & 0x7f);
    fields.take(name)?;
    let bytes = match fields.take(1)?[0] {
        // A matrix of 4×4, an object of its own.
        1 => 1 + "CMatrixD".len() + 1 + 8 + 16 * 8 + 1,
        2 => 7 * 8,
        3 => 12 * 8,
        version => bail!("a pose of version {version}"),
    };
    fields.take(bytes)?;
    ensure!(fields.take(1)? == [0x88], "a pose without its end");
    Ok(())
}

/// Returns the offsets of all objects of a class.
fn find_objects(file: &[u8], name: &str) -> Vec<usize> {
    let windows = file.windows(name.len()).enumerate();
    windows.filter(|(_, window)| *window == name.as_bytes()).map(|(at, _)| at).collect()
}

fn find_object(file: &[u8], name: &str) -> Result<usize> {
    find_objects(file, name).first().copied().with_context(|| format!("no {name} in a recording"))
}

/// Returns the ranges of all scans of a recording, in metres.
pub fn laser_ranges(name: &str) -> Result<Vec<Vec<f32>>> {
    const CLASS: &str = "CObservation2DRangeScan";
    let file = load(name)?;
    let mut scans = Vec::new();
    for at in find_objects(&file, CLASS) {
        let mut fields = open_object(&file, at, CLASS);
        // Aperture, direction, longest range.
        fields.take(9)?;
        skip_pose(&mut fields)?;
        let count = fields.size()?;
        let ranges = fields.take(count * 4)?.chunks_exact(4);
        scans.push(ranges.map(|bytes| f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])).collect());
    }
    Ok(scans)
}

/// Returns a map as an occupancy grid, with the probabilities of MRPT's log odds in percent, as its bridge does.
pub fn occupancy_map(name: &str) -> Result<Picture> {
    const CLASS: &str = "COccupancyGridMap2D";
    let file = load(name)?;
    let mut fields = open_object(&file, find_object(&file, CLASS)?, CLASS);
    ensure!(fields.take(1)? == [8], "cells of another size than a byte");
    let (width, height) = (fields.size()?, fields.size()?);
    // Borders and resolution.
    fields.take(20)?;
    let percent = |&cell: &u8| match cell as i8 {
        0 => 255,
        odds => (100.0 / (1.0 + (f32::from(odds) / 16.0).exp())).round() as u8,
    };
    let data = fields.take(width * height)?.iter().map(percent).collect();
    Ok(Picture { width, height, depth: 1, data })
}

/// Returns the colour and the depth, in millimetres, of a Kinect's frame.
pub fn kinect_frame() -> Result<(Picture, Picture)> {
    const CLASS: &str = "CObservation3DRangeScan";
    const IMAGE: &str = "mrpt::img::CImage";
    let file = load(KINECT)?;
    let mut fields = open_object(&file, find_object(&file, CLASS)?, CLASS);
    // Longest range.
    fields.take(4)?;
    skip_pose(&mut fields)?;
    ensure!(fields.take(1)? == [1], "a frame without points");
    let points = fields.size()?;
    // Three coordinates and two indices of each; then a flag and the unit of the depth.
    fields.take(points * 16 + 5)?;
    let (height, width) = (fields.size()?, fields.size()?);
    let depth = Picture { width, height, depth: 2, data: fields.take(width * height * 2)?.to_vec() };
    let rest = &file[fields.at..];
    let mut fields = open_object(rest, find_object(rest, IMAGE)?, IMAGE);
    // Two flags, and the size again.
    fields.take(10)?;
    let pixels = fields.take(width * height * 3)?.chunks_exact(3);
    let data = pixels.flat_map(|pixel| [pixel[2], pixel[1], pixel[0]]).collect();
    Ok((Picture { width, height, depth: 3, data }, depth))
}

/// Returns the packets of one revolution of a Velodyne VLP-16.
pub fn velodyne_packets() -> Result<Vec<u8>> {
    const CLASS: &str = "CObservationVelodyneScan";
    let file = load(VELODYNE)?;
    let mut fields = open_object(&file, find_object(&file, CLASS)?, CLASS);
    // Time, label, shortest and longest range.
    fields.take(8)?;
    fields.text()?;
    fields.take(16)?;
    skip_pose(&mut fields)?;
    let count = fields.size()?;
    Ok(fields.take(count * PACKET)?.to_vec())
}
