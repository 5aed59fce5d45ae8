//! `make bench ONLY=codecs`: the link's codecs compared with zlib, zstd, PNG, JPEG, x264 and memcpy, in turns, on one
//! core.
//!
//! The arguments name the parts to run (colour, depth, grid, scan, cloud, video, corners, published); without arguments
//! all parts run.

mod cloud;
mod contest;
mod grid;
mod messages;
mod picture;
mod psnr;
mod published;
mod samples;
mod video;
mod world;
mod zlib;

use anyhow::Result;
use bench_report::BenchReport;

/// A part of the benchmark.
type Part = fn(&mut BenchReport) -> Result<()>;

fn main() -> Result<()> {
    let parts: [(&str, Part); 8] = [
        ("colour", picture::measure_colour),
        ("depth", picture::measure_depth),
        ("grid", grid::measure_grids),
        ("scan", cloud::measure_scans),
        ("cloud", cloud::measure_clouds),
        ("video", video::measure_video),
        ("corners", picture::measure_corner_cases),
        ("published", published::measure_published_table),
    ];
    let wanted: Vec<String> = std::env::args().skip(1).collect();
    let mut report = BenchReport::new("codecs");
    for (name, part) in parts {
        if wanted.is_empty() || wanted.iter().any(|wanted| wanted == name) {
            part(&mut report)?;
        }
    }
    report.finish()?;
    Ok(())
}
