//! `make bench ONLY=codecs`: the link's codecs compared with zlib, zstd, pco, PNG, JPEG, x264 and memcpy, in turns, on
//! one core. Arguments name the parts to run.

mod cloud;
mod columns;
mod contest;
mod grid;
mod messages;
mod peers;
mod picture;
mod published;
mod recorded;
mod samples;
mod video;
mod world;
mod zlib;

use bench_report::{Part, run_parts};

/// All parts, in the order in which they are measured.
const PARTS: [Part; 8] = [
    ("colour", picture::measure_colour),
    ("depth", picture::measure_depth),
    ("grid", grid::measure_grids),
    ("scan", cloud::measure_scans),
    ("cloud", cloud::measure_clouds),
    ("video", video::measure_video),
    ("corners", picture::measure_corner_cases),
    ("published", published::measure_published_table),
];

fn main() -> anyhow::Result<()> {
    run_parts("codecs", &PARTS)
}
