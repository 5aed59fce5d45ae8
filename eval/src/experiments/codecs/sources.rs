//! What is sent, and what the published codecs alone make of it.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use bytes::Bytes;
use codec::{Codec, Encoder, Schema};
use serde::{Deserialize, Serialize};
use support::people::picture;

use super::{CLASS, Kind};
use crate::cells::{Cells, Measured};
use crate::deadline;
use crate::examples::{Input, LASER_SLAM, Where, Workshop};
use crate::place::{Network, Place};
use crate::recording::Recording;
use crate::stream::{self, Head};
use crate::trace::Grid;

/// Photographs of Debian's opencv-doc, in colour.
const PHOTOGRAPHS: [&str; 6] = [
    "aloeL.jpg",
    "baboon.jpg",
    "board.jpg",
    "fruits.jpg",
    "home.jpg",
    "building.jpg",
];
const PLACE: &str = "/usr/share/doc/opencv-doc/examples/data";
const SIZE: (u32, u32) = (640, 480);
/// Scans of the drive from which the map is made, and every how manieth.
const SCANS: (usize, usize) = (150, 3);
/// Cells of the large map's side, as gmapping has them.
const LARGE: usize = 4000;
/// How often a file's messages are sent at the most.
const ROUNDS: usize = 50;
/// Bytes of a serialized map before its cells.
const HEAD: usize = 99;
/// Messages that codecs alone are tried with.
const TRIED: usize = 6;

/// For scaling one photograph.
const LONGEST: Duration = Duration::from_secs(60);

/// Where messages come from.
pub(super) struct Sources<'a> {
    pub(super) cells: &'a Cells,
    pub(super) workshop: &'a Workshop<'a>,
}

/// What codecs made of messages, in this process.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Alone {
    pub(super) codecs: Vec<Made>,
    /// The share of a map's cells that is known.
    pub(super) known: Option<f64>,
}

/// What one codec made of them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Made {
    pub(super) codec: String,
    /// Nobody else has it.
    pub(super) ours: bool,
    /// Bytes of messages and of frames.
    pub(super) bytes: [u64; 2],
}

impl Sources<'_> {
    /// A file of messages of this kind.
    pub(super) fn recording(&self, kind: Kind, directory: &Path) -> Result<PathBuf> {
        if kind == Kind::Video {
            return self.workshop.recording(Input::Pictures);
        }
        let path = directory.join("sent.messages");
        match kind {
            Kind::Video | Kind::Pictures => {
                stream::write(&path, &Head::of_pictures(ROUNDS), &photographs()?)?;
            }
            Kind::Map => {
                stream::write(&path, &Head::of_maps(ROUNDS), &[serialized(&self.map()?)?])?
            }
            Kind::LargeMap => {
                let large = in_the_middle(&self.map()?, LARGE)?;
                stream::write(&path, &Head::of_maps(ROUNDS), &[serialized(&large)?])?;
            }
        }
        Ok(path)
    }

    /// The map that laser_slam makes of the recorded drive.
    fn map(&self) -> Result<Grid> {
        let map = self
            .cells
            .measure("codecs source map", &(CLASS, SCANS), || {
                self.workshop.publishes(&LASER_SLAM)?;
                let directory = self.workshop.directory()?;
                let mut plan =
                    self.workshop
                        .plan(&LASER_SLAM, Where::Outsourced, directory.path())?;
                (plan.most, plan.every) = SCANS;
                let place = Place::new(&self.workshop.daemon.address, CLASS, Network::Lan)?;
                let (trace, _) = place.runs(&plan, directory.path())?;
                trace.map.context("laser_slam published no map")
            })?;
        match map {
            Measured::Done(map) => Ok(map),
            Measured::Missing(why) => anyhow::bail!("there is no map to be sent: {why}"),
        }
    }

    /// What the published codecs alone, and ours, make of such messages.
    pub(super) fn alone(&self, kind: Kind) -> Result<Alone> {
        let directory = self.workshop.directory()?;
        let path = self.recording(kind, directory.path())?;
        let recording = Recording::read(&path)?;
        let steps = recording.steps(kind.topic());
        let tried = if kind.is_map() { 1 } else { TRIED };
        let messages: Vec<&Bytes> = steps
            .iter()
            .take(tried)
            .map(|step| &step.request.bytes)
            .collect();
        let (schema, made) = if kind.is_map() {
            (Schema::OccupancyGrid, Codec::Grid)
        } else {
            (Schema::Image, Codec::Image)
        };
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
            Made {
                codec: codec.to_string(),
                ours: *codec == made,
                bytes,
            }
        };
        Ok(Alone {
            codecs: codecs.iter().map(one).collect(),
            known: messages
                .first()
                .filter(|_| kind.is_map())
                .map(|message| known(&message[message.len().min(HEAD)..])),
        })
    }
}

/// Pictures that have nothing to do with one another.
fn photographs() -> Result<Vec<Bytes>> {
    let read = |name: &&str| {
        let path = Path::new(PLACE).join(name);
        ensure!(
            path.exists(),
            "{} is missing; it comes with Debian's opencv-doc: make deps",
            path.display()
        );
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

/// The share of cells that are known.
fn known(cells: &[u8]) -> f64 {
    let known = cells.iter().filter(|cell| **cell != u8::MAX).count();
    known as f64 / cells.len().max(1) as f64
}

/// `nav_msgs/OccupancyGrid`.
fn serialized(grid: &Grid) -> Result<Bytes> {
    let mut bytes = Vec::with_capacity(grid.cells.len() + 100);
    let words = |bytes: &mut Vec<u8>, words: &[u32]| {
        words
            .iter()
            .for_each(|word| bytes.extend(word.to_le_bytes()));
    };
    words(&mut bytes, &[1, 1, 0, 3]);
    bytes.extend(b"map");
    words(&mut bytes, &[0, 0]);
    bytes.extend((grid.resolution as f32).to_le_bytes());
    words(
        &mut bytes,
        &[u32::try_from(grid.width)?, u32::try_from(grid.height)?],
    );
    let [x, y] = grid.origin;
    for number in [x, y, 0.0, 0.0, 0.0, 0.0, 1.0] {
        bytes.extend(number.to_le_bytes());
    }
    words(&mut bytes, &[u32::try_from(grid.cells.len())?]);
    bytes.extend(grid.cells.iter().map(|cell| *cell as u8));
    Ok(bytes.into())
}

/// A map of `side` x `side` cells with this one in its middle; what is around it is unknown.
fn in_the_middle(grid: &Grid, side: usize) -> Result<Grid> {
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
    Ok(Grid {
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

    fn small() -> Grid {
        Grid {
            width: 2,
            height: 1,
            resolution: 0.5,
            origin: [1.0, 2.0],
            cells: vec![0, 100],
        }
    }

    #[test]
    fn a_map_stands_in_the_middle_of_a_larger_one() {
        let large = in_the_middle(&small(), 4).expect("it fits");
        assert_eq!(large.cells[4..8], [-1, 0, 100, -1]);
        assert_eq!(large.cells.iter().filter(|cell| **cell == -1).count(), 14);
        assert_eq!(large.origin, [0.5, 1.5]);
        assert!(in_the_middle(&small(), 1).is_err());
    }

    #[test]
    fn a_map_is_what_the_codec_takes_for_one() {
        let bytes = serialized(&small()).expect("a message");
        assert_eq!(bytes[HEAD..], [0, 100]);
        assert!((known(&[255, 0, 100, 255]) - 0.5).abs() < 1e-9);
        // Of two cells no frame is smaller than the message.
        let large = in_the_middle(&small(), 64).expect("it fits");
        let bytes = serialized(&large).expect("a message");
        let mut frame = Vec::new();
        let encoded = Encoder::new(Schema::OccupancyGrid).encode(Codec::Grid, &bytes, &mut frame);
        assert_eq!(encoded.codec, Codec::Grid, "it fell back");
    }
}
