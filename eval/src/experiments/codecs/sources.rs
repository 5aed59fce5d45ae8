//! Messages to send, and the results of codecs on them without a network.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use bytes::Bytes;
use codec::{Codec, Encoder, Schema};
use ros::bus::{RosVersion, WireType};
use serde::{Deserialize, Serialize};
use support::layout::MessageLayout;

use super::{CLASS, Kind};
use crate::cells::RunCache;
use crate::examples::{EvalFixtures, ExecutionSite, InputRecording, LASER_SLAM};
use crate::pictures;
use crate::place::NetworkProfile;
use crate::recording::Recording;
use crate::robot::RobotPlan;
use crate::stream::{self, TopicType};
use crate::trace::MapGrid;

/// Number of scans of the drive from which the map is built, and the interval between them.
const SCANS: (usize, usize) = (150, 3);
/// Cells per side of the large map, as gmapping uses them.
const LARGE: usize = 4000;
/// Maximum number of times that the messages of a file are sent.
const ROUNDS: usize = 50;
/// Bytes of a serialized map before its cells.
const HEAD: usize = 99;
/// Number of messages for codecs without a network.
const TRIED: usize = 6;

/// Sources of the messages.
pub(super) struct StreamSources<'a> {
    pub(super) cells: &'a RunCache,
    pub(super) workshop: &'a EvalFixtures<'a>,
}

/// Results of codecs in this process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct OfflineResult {
    pub(super) codecs: Vec<CodecOutput>,
    pub(super) known: Option<f64>,
}

/// Result of one codec.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct CodecOutput {
    pub(super) codec: String,
    /// True if the codec is our own.
    pub(super) ours: bool,
    pub(super) bytes: [u64; 2],
}

impl StreamSources<'_> {
    pub(super) fn recording(&self, kind: Kind, directory: &Path) -> Result<PathBuf> {
        if kind == Kind::Video {
            return self.workshop.recording(InputRecording::Pictures);
        }
        let path = directory.join("sent.messages");
        if kind == Kind::Pictures {
            pictures::write_pictures(&path, &pictures::photographs()?, ROUNDS)?;
            return Ok(path);
        }
        let map = self.source_map()?;
        let map = if kind == Kind::LargeMap { centre_in_grid(&map, LARGE)? } else { map };
        let of = WireType::new("nav_msgs/OccupancyGrid", "3381f2d731d4076ec5c71b0759edbe4e", MAP);
        stream::write(&path, &[TopicType::new("/map", &of)], &[vec![serialize_grid(&map)?]], ROUNDS)?;
        Ok(path)
    }

    /// Returns the map that laser_slam builds from the recorded drive.
    fn source_map(&self) -> Result<MapGrid> {
        let map = self.cells.measure("codecs source map", &(CLASS, SCANS), || {
            let (at, robot) = (ExecutionSite::Outsourced, (CLASS, NetworkProfile::Lan));
            let adapt = |plan: &mut RobotPlan| (plan.most, plan.every) = SCANS;
            let (trace, _) = self.workshop.run(&LASER_SLAM, at, robot, adapt)?;
            trace.map.context("laser_slam published no map")
        })?;
        let why = || format!("there is no map to be sent: {}", map.missing.as_deref().unwrap_or_default());
        map.first().cloned().with_context(why)
    }

    /// Encodes such messages with the published codecs and with ours.
    pub(super) fn encode_offline(&self, kind: Kind) -> Result<OfflineResult> {
        let directory = self.workshop.directory()?;
        let path = self.recording(kind, directory.path())?;
        let recording = Recording::read(&path)?;
        let steps = recording.steps(kind.topic());
        let tried = if kind.is_map() { 1 } else { TRIED };
        let messages: Vec<&Bytes> = steps.iter().take(tried).map(|step| &step.request.bytes).collect();
        let (schema, made) =
            if kind.is_map() { (Schema::OccupancyGrid, Codec::Grid) } else { (Schema::Image, Codec::Image) };
        let codecs = [Codec::Deflate(6), Codec::Zlib(6), made];
        let one = |codec: &Codec| {
            let mut encoder = Encoder::new(schema);
            let mut bytes = [0, 0];
            for message in &messages {
                let mut frame = Vec::new();
                encoder.encode(*codec, message, &mut frame);
                bytes[0] += message.len() as u64;
                bytes[1] += frame.len() as u64;
            }
            CodecOutput { codec: codec.to_string(), ours: *codec == made, bytes }
        };
        Ok(OfflineResult {
            codecs: codecs.iter().map(one).collect(),
            known: messages
                .first()
                .filter(|_| kind.is_map())
                .map(|message| known_share(&message[message.len().min(HEAD)..])),
        })
    }
}

fn known_share(cells: &[u8]) -> f64 {
    let known = cells.iter().filter(|cell| **cell != u8::MAX).count();
    known as f64 / cells.len().max(1) as f64
}

/// Serializes a `nav_msgs/OccupancyGrid`.
fn serialize_grid(grid: &MapGrid) -> Result<Bytes> {
    let mut out = MessageLayout::new(RosVersion::One);
    let (width, height) = (u32::try_from(grid.width)?, u32::try_from(grid.height)?);
    out.header(1, "map").u32(0).u32(0).f32(grid.resolution as f32).u32(width).u32(height);
    let [x, y] = grid.origin;
    for number in [x, y, 0.0, 0.0, 0.0, 0.0, 1.0] {
        out.f64(number);
    }
    Ok(out.bytes(&grid.cells.iter().map(|cell| *cell as u8).collect::<Vec<_>>()).finish())
}

/// Definition of `nav_msgs/OccupancyGrid`.
const MAP: &str = "std_msgs/Header header\nMapMetaData info\nint8[] data\n\
    ================================================================================\n\
    MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n\
    ================================================================================\n\
    MSG: nav_msgs/MapMetaData\ntime map_load_time\nfloat32 resolution\nuint32 width\nuint32 height\ngeometry_msgs/Pose \
    origin\n\
    ================================================================================\n\
    MSG: geometry_msgs/Pose\nPoint position\nQuaternion orientation\n\
    ================================================================================\n\
    MSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n\
    ================================================================================\n\
    MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n";

/// Returns a map of `side` x `side` cells with `grid` at its centre; the cells around it are unknown.
fn centre_in_grid(grid: &MapGrid, side: usize) -> Result<MapGrid> {
    ensure!(
        grid.width <= side && grid.height <= side && grid.cells.len() == grid.width * grid.height,
        "a map of {} x {} cells is no part of one of {side} x {side}",
        grid.width,
        grid.height
    );
    let (left, low) = ((side - grid.width) / 2, (side - grid.height) / 2);
    let mut cells = vec![-1; side * side];
    for (row, from) in grid.cells.chunks_exact(grid.width).enumerate() {
        let at = (low + row) * side + left;
        cells[at..at + grid.width].copy_from_slice(from);
    }
    let moved = |origin: f64, by: usize| origin - by as f64 * grid.resolution;
    Ok(MapGrid {
        width: side,
        height: side,
        resolution: grid.resolution,
        origin: [moved(grid.origin[0], left), moved(grid.origin[1], low)],
        cells,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn small_grid() -> MapGrid {
        MapGrid { width: 2, height: 1, resolution: 0.5, origin: [1.0, 2.0], cells: vec![0, 100] }
    }

    #[test]
    fn a_map_stands_in_the_middle_of_a_larger_one() {
        let large = centre_in_grid(&small_grid(), 4).expect("it fits");
        assert_eq!(large.cells[4..8], [-1, 0, 100, -1]);
        assert_eq!(large.cells.iter().filter(|cell| **cell == -1).count(), 14);
        assert_eq!(large.origin, [0.5, 1.5]);
        assert!(centre_in_grid(&small_grid(), 1).is_err());
    }

    #[test]
    fn a_map_is_what_the_codec_takes_for_one() {
        let bytes = serialize_grid(&small_grid()).expect("a message");
        assert_eq!(bytes[HEAD..], [0, 100]);
        assert!((known_share(&[255, 0, 100, 255]) - 0.5).abs() < 1e-9);
        // With only two cells no frame would be smaller than the message.
        let large = centre_in_grid(&small_grid(), 64).expect("it fits");
        let bytes = serialize_grid(&large).expect("a message");
        let mut frame = Vec::new();
        let encoded = Encoder::new(Schema::OccupancyGrid).encode(Codec::Grid, &bytes, &mut frame);
        assert_eq!(encoded.codec, Codec::Grid, "it fell back");
    }
}
