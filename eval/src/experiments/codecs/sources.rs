//! Messages to send, and the results of codecs on them without a network.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use bytes::Bytes;
use codec::{Codec, Encoder, Schema};
use serde::{Deserialize, Serialize};
use support::people::picture;

use super::{CLASS, Kind};
use crate::cells::{CachedResult, RunCache};
use crate::deadline;
use crate::examples::{EvalFixtures, ExecutionSite, InputRecording, LASER_SLAM};
use crate::place::NetworkProfile;
use crate::recording::Recording;
use crate::robot::RobotPlan;
use crate::stream::{self, StreamHeader};
use crate::trace::MapGrid;

/// Colour photographs of Debian's opencv-doc.
const PHOTOGRAPHS: [&str; 6] = ["aloeL.jpg", "baboon.jpg", "board.jpg", "fruits.jpg", "home.jpg", "building.jpg"];
const PLACE: &str = "/usr/share/doc/opencv-doc/examples/data";
const SIZE: (u32, u32) = (640, 480);
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

/// Maximum time to scale one photograph.
const LONGEST: Duration = Duration::from_secs(60);

/// Sources of the messages.
pub(super) struct StreamSources<'a> {
    pub(super) cells: &'a RunCache,
    pub(super) workshop: &'a EvalFixtures<'a>,
}

/// Results of codecs in this process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct OfflineResult {
    pub(super) codecs: Vec<CodecOutput>,
    /// Fraction of a map's cells that are known.
    pub(super) known: Option<f64>,
}

/// Result of one codec.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct CodecOutput {
    pub(super) codec: String,
    /// True if the codec is our own.
    pub(super) ours: bool,
    /// Bytes of messages and of frames.
    pub(super) bytes: [u64; 2],
}

impl StreamSources<'_> {
    /// Writes a file of messages of this kind.
    pub(super) fn recording(&self, kind: Kind, directory: &Path) -> Result<PathBuf> {
        if kind == Kind::Video {
            return self.workshop.recording(InputRecording::Pictures);
        }
        let path = directory.join("sent.messages");
        match kind {
            Kind::Video | Kind::Pictures => {
                stream::write(&path, &StreamHeader::for_pictures(ROUNDS), &photographs()?)?;
            }
            Kind::Map => {
                stream::write(&path, &StreamHeader::for_maps(ROUNDS), &[serialize_grid(&self.source_map()?)?])?
            }
            Kind::LargeMap => {
                let large = centre_in_grid(&self.source_map()?, LARGE)?;
                stream::write(&path, &StreamHeader::for_maps(ROUNDS), &[serialize_grid(&large)?])?;
            }
        }
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
        match map {
            CachedResult::Done(map) => Ok(map),
            CachedResult::Missing(why) => anyhow::bail!("there is no map to be sent: {why}"),
        }
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

/// Returns unrelated photographs.
fn photographs() -> Result<Vec<Bytes>> {
    let read = |name: &&str| {
        let path = Path::new(PLACE).join(name);
        ensure!(path.exists(), "{} is missing; it comes with Debian's opencv-doc: make deps", path.display());
        let mut command = Command::new("ffmpeg");
        command
            .args(["-v", "error", "-i"])
            .arg(&path)
            .args(["-vf", "scale=640:480", "-frames:v", "1", "-pix_fmt"])
            .args(["bgr24", "-f", "rawvideo", "-"]);
        let output = deadline::output(&mut command, LONGEST)?;
        let size = (SIZE.0 * SIZE.1 * 3) as usize;
        ensure!(
            output.status.success() && output.stdout.len() == size,
            "ffmpeg made {} bytes of {}: {}",
            output.stdout.len(),
            path.display(),
            String::from_utf8_lossy(&output.stderr).trim()
        );
        Ok(picture(1, SIZE, &output.stdout))
    };
    PHOTOGRAPHS.iter().map(read).collect()
}

/// Returns the fraction of known cells.
fn known_share(cells: &[u8]) -> f64 {
    let known = cells.iter().filter(|cell| **cell != u8::MAX).count();
    known as f64 / cells.len().max(1) as f64
}

/// Serializes a `nav_msgs/OccupancyGrid`.
fn serialize_grid(grid: &MapGrid) -> Result<Bytes> {
    let mut bytes = Vec::with_capacity(grid.cells.len() + 100);
    let words = |bytes: &mut Vec<u8>, words: &[u32]| {
        words.iter().for_each(|word| bytes.extend(word.to_le_bytes()));
    };
    words(&mut bytes, &[1, 1, 0, 3]);
    bytes.extend(b"map");
    words(&mut bytes, &[0, 0]);
    bytes.extend((grid.resolution as f32).to_le_bytes());
    words(&mut bytes, &[u32::try_from(grid.width)?, u32::try_from(grid.height)?]);
    let [x, y] = grid.origin;
    for number in [x, y, 0.0, 0.0, 0.0, 0.0, 1.0] {
        bytes.extend(number.to_le_bytes());
    }
    words(&mut bytes, &[u32::try_from(grid.cells.len())?]);
    bytes.extend(grid.cells.iter().map(|cell| *cell as u8));
    Ok(bytes.into())
}

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
