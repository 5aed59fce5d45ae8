//! Codec for `nav_msgs/OccupancyGrid`: every grid is coded whole, as the differences from its most common cell.
//!
//! Each frame is decoded independently, so neither end keeps earlier grids (see docs/adr/040).
//!
//! Body: `head · mode · background · cells`.

mod cells;
mod classes;
mod ladder;

use crate::Error;
use crate::generic::{ZstdCompressor, unzstd};
use crate::layout::{GridLayout, take_ends};
use crate::padded::Lanes;
use crate::plane8;
use crate::wire::{FrameCursor, MessageEnds};
use classes::ClassModel;
use ladder::{LadderModel, LadderValues};

/// Encodings of the cells: by three values and few others, as a picture, as few values in any mixture, or by zstd.
const PLAIN: u8 = 0;
const SHADES: u8 = 2;
const LADDER: u8 = 3;
const PACKED: u8 = 4;

/// Number of three-valued cells per output byte below which zstd is tried as well.
const DEAR: usize = 20;
/// The zstd levels used elsewhere: neither always gives the smaller result.
const LEVELS: [i32; 2] = [1, 3];

/// Appends the body of `message`, which has `layout`, to `out`.
pub(crate) fn encode(message: &[u8], layout: &GridLayout, zstd: &mut ZstdCompressor, out: &mut Vec<u8>) {
    let cells = &message[layout.head..message.len() - layout.tail];
    MessageEnds::from_message(message, layout.head, layout.tail).put(out);
    let background = background(cells);
    let first = out.len();
    let dear = if classes::has_many_shades(cells, background) {
        encode_shades(cells, layout, background, out);
        true
    } else {
        out.extend_from_slice(&[PLAIN, background]);
        let told = cells::encode(cells, layout, background, ClassModel::new(), out);
        (out.len() - first) * DEAR > told
    };
    // Only zstd sees distant repetitions. It takes a fraction of the time of shades, but as long as three values.
    if dear {
        for level in LEVELS {
            let mut packed = vec![PACKED, background];
            zstd.compress(cells, level, &mut packed);
            if packed.len() < out.len() - first {
                out.truncate(first);
                out.extend_from_slice(&packed);
            }
        }
    }
}

/// Appends cells of many values.
fn encode_shades(cells: &[u8], layout: &GridLayout, background: u8, out: &mut Vec<u8>) {
    let values = LadderValues::from_cells(cells, background);
    if values.count() <= ladder::MAX_VALUES {
        out.extend_from_slice(&[LADDER, background]);
        values.write(out);
        cells::encode(cells, layout, background, LadderModel::new(&values), out);
        return;
    }
    out.extend_from_slice(&[SHADES, background]);
    let mut lanes = Lanes::pictures(1, layout.width, layout.height);
    for (y, row) in cells.chunks_exact(layout.width).enumerate() {
        lanes.row_mut(0, y).copy_from_slice(row);
    }
    plane8::encode(&mut lanes, 1, out);
}

/// Returns the most common cell among a few thousand.
fn background(cells: &[u8]) -> u8 {
    let mut seen = [0u32; 256];
    for &cell in cells.iter().step_by((cells.len() / 4096).max(1)) {
        seen[usize::from(cell)] += 1;
    }
    (0..=255u8).max_by_key(|&cell| seen[usize::from(cell)]).unwrap_or(0)
}

/// Decodes a message of `total` bytes and appends it to `out`.
pub(crate) fn decode(input: &mut FrameCursor<'_>, total: usize, out: &mut Vec<u8>) -> Result<(), Error> {
    let (layout, ends) = take_ends(input, "a head that is not a grid's", |ends| {
        let layout = GridLayout::read(ends, total)?;
        Some((layout, layout.head, layout.tail))
    })?;
    let mode = input.byte()?;
    let background = input.byte()?;
    let count = layout.width * layout.height;
    if mode == PACKED {
        return ends.restore_with(out, |out| unzstd(input.take_rest(), count, out));
    }
    let cells = ends.restore(count, out);
    cells.fill(background);
    match mode {
        PLAIN => {
            let rest = input.take_rest();
            cells::decode(rest, &layout, background, ClassModel::new(), cells)
        }
        LADDER => {
            let tell = LadderModel::new(&LadderValues::read(input)?);
            cells::decode(input.take_rest(), &layout, background, tell, cells)
        }
        SHADES => {
            let mut lanes = Lanes::pictures(1, layout.width, layout.height);
            plane8::decode(input, &mut lanes, 1)?;
            for (y, row) in cells.chunks_exact_mut(layout.width).enumerate() {
                row.copy_from_slice(lanes.row(0, y));
            }
            Ok(())
        }
        _ => Err(Error::Corrupt("a grid told in an unknown way")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a grid message with `cells`.
    fn message(width: u32, height: u32, cells: &[u8]) -> Vec<u8> {
        let mut message = vec![7; 12];
        message.extend_from_slice(&[3, 0, 0, 0]);
        message.extend_from_slice(b"map");
        message.extend_from_slice(&[5; 8]);
        message.extend_from_slice(&0.05f32.to_le_bytes());
        message.extend_from_slice(&width.to_le_bytes());
        message.extend_from_slice(&height.to_le_bytes());
        message.extend_from_slice(&[9; 56]);
        message.extend_from_slice(&(cells.len() as u32).to_le_bytes());
        message.extend_from_slice(cells);
        message
    }

    /// Returns a room of `size` cells inside a grid of `width` by `height`, with a pillar at `pillar`.
    fn room(width: usize, height: usize, size: usize, pillar: usize) -> Vec<u8> {
        let mut cells = vec![255u8; width * height];
        for y in 0..size {
            for x in 0..size {
                let wall = x == 0 || y == 0 || x == size - 1 || y == size - 1;
                let inside = x.abs_diff(pillar) < 3 && y.abs_diff(pillar) < 3;
                cells[(y + 10) * width + x + 10] = if wall || inside { 100 } else { 0 };
            }
        }
        cells
    }

    /// Encodes and decodes the message; returns the size of the body.
    fn round_trip_size(message: &[u8]) -> usize {
        let layout = GridLayout::read(message, message.len()).unwrap();
        let (mut body, mut back) = (Vec::new(), Vec::new());
        encode(message, &layout, &mut ZstdCompressor::default(), &mut body);
        decode(&mut FrameCursor::new(&body), message.len(), &mut back).unwrap();
        assert!(back == message);
        body.len()
    }

    #[test]
    fn a_map_is_small() {
        let size = round_trip_size(&message(500, 400, &room(500, 400, 300, 40)));
        assert!(size < 700, "{size}");
        round_trip_size(&message(1, 1, &[55]));
        round_trip_size(&message(10, 10, &room(50, 50, 20, 5)[..100]));
    }

    #[test]
    fn shades_and_odd_values_come_back() {
        let mut shades: Vec<u8> = (0..120 * 100).map(|index| (index % 120 + index / 120 / 2) as u8 % 101).collect();
        round_trip_size(&message(120, 100, &shades));
        shades[500] = 77;
        shades[501..700].fill(3);
        round_trip_size(&message(120, 100, &shades));
    }

    /// Steps of log odds, as in MRPT's grids: far from where the robot was, few scans have met a cell.
    const RUNGS: [u8; 8] = [35, 22, 13, 8, 4, 2, 1, 0];

    /// Returns a grid whose known middle has the noisy shades of a mapper.
    fn noisy_cells(width: usize, height: usize, size: usize) -> Vec<u8> {
        let mut cells = vec![255u8; width * height];
        let mut state = 7u32;
        for y in 0..size {
            for x in 0..size {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let near = RUNGS.len() * (x.min(size - x) + y.min(size - y)) / (2 * size);
                let rung = (near + (state >> 29) as usize % 4).min(RUNGS.len() - 1);
                let cell = if state >> 22 & 63 == 0 { 255 } else { RUNGS[rung] };
                cells[(y + 30) * width + x + 30] = cell;
            }
        }
        cells
    }

    /// Returns the size of the message compressed by zstd.
    fn zstd_size(message: &[u8]) -> usize {
        let sizes = LEVELS.map(|level| {
            let mut packed = Vec::new();
            ZstdCompressor::default().compress(message, level, &mut packed);
            packed.len()
        });
        sizes[0].min(sizes[1])
    }

    #[test]
    fn a_map_in_noisy_shades_is_a_fifth_smaller_than_by_zstd() {
        for (width, height) in [(300, 280), (1000, 900)] {
            let message = message(width, height, &noisy_cells(width as usize, height as usize, 240));
            let (sent, packed) = (round_trip_size(&message), zstd_size(&message));
            assert!(sent * 5 < packed * 4, "{sent} and {packed}");
        }
    }

    #[test]
    fn no_map_is_larger_than_by_zstd() {
        let (width, height) = (400, 300);
        let of = |cell: &dyn Fn(usize, usize) -> u8| -> Vec<u8> {
            let all = (0..width * height).map(|at| cell(at % width, at / width));
            all.collect()
        };
        let noise = |at: usize| (at.wrapping_mul(2_654_435_761) >> 13) as u8;
        // The same rows of noise repeated: in three values, in a ladder's, and in all.
        let repeated = [
            of(&|x, y| [255, 0, 100][usize::from(noise(x + y % 5 * 977)) % 3]),
            of(&|x, y| RUNGS[usize::from(noise(x + y % 5 * 977)) % 8]),
            of(&|x, y| noise(x + y % 5 * 977)),
        ];
        for cells in repeated {
            let message = message(width as u32, height as u32, &cells);
            let (sent, packed) = (round_trip_size(&message), zstd_size(&message));
            assert!(sent < packed + 120, "{sent} and {packed}");
        }
    }
}
