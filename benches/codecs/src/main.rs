//! `make bench ONLY=codecs`: the link codecs beside zlib, zstd, PNG, JPEG, x264 and memcpy, in turns, on one core.
//!
//! Arguments name the parts to run (colour, depth, grid, scan, cloud, video, corners, published); none means all.

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
use bench_report::Report;

/// One part of the bench.
type Part = fn(&mut Report) -> Result<()>;

fn main() -> Result<()> {
    let parts: [(&str, Part); 8] = [
        ("colour", picture::colours),
        ("depth", picture::depths),
        ("grid", grid::grids),
        ("scan", cloud::scans),
        ("cloud", cloud::clouds),
        ("video", video::videos),
        ("corners", picture::corners),
        ("published", published::table),
    ];
    let wanted: Vec<String> = std::env::args().skip(1).collect();
    let mut report = Report::new("codecs");
    for (name, part) in parts {
        if wanted.is_empty() || wanted.iter().any(|wanted| wanted == name) {
            part(&mut report)?;
        }
    }
    report.finish()?;
    Ok(())
}
