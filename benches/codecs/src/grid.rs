//! Occupancy grids, small and large.

use crate::contest::{Comparison, compare};
use crate::{messages, recorded, samples};
use anyhow::Result;
use bench_report::{BenchReport, Target};
use codec::Schema;

const SIZE: usize = 4000;
const SMALL: [Comparison; 1] = [Comparison::Saved("zstd 19", Target::AboveFloor)];
const LARGE: [Comparison; 3] = [
    Comparison::Saved("zstd 1", Target::AtLeast(99.9)),
    Comparison::Encoding("memcpy", Some(Target::RatioAtLeast(0.3))),
    Comparison::Decoding("memcpy"),
];

pub fn measure_grids(report: &mut BenchReport) -> Result<()> {
    let office = samples::office_map()?;
    let large = messages::grid(SIZE, SIZE, &samples::centre_in_grid(&office, SIZE));
    let grid = |map: &samples::Picture| messages::grid(map.width, map.height, &map.data);
    let mut cases = vec![("grid 566×608", grid(&office), &SMALL[..]), ("grid 4000×4000", large, &LARGE[..])];
    if recorded::is_installed("recorded maps", report) {
        for (title, name) in [("grid of a hall", recorded::HALL_MAP), ("grid of a campus", recorded::CAMPUS_MAP)] {
            cases.push((title, grid(&recorded::occupancy_map(name)?), &[]));
        }
    }
    for (title, message, comparisons) in cases {
        compare(report, title, Schema::OccupancyGrid, &[message], comparisons)?;
    }
    Ok(())
}
