//! `nav_msgs/OccupancyGrid`: every grid whole, as what differs from its most common cell.
//!
//! Each frame can be decoded alone, so neither end keeps earlier grids (see docs/adr/040).
//!
//! Body: `head · mode · background · cells`.

mod cells;

use crate::Error;
use crate::layout::Grid;
use crate::padded::Lanes;
use crate::plane8;
use crate::wire::{Cursor, put_block};

/// How the cells are told.
const PLAIN: u8 = 0;
const SHADES: u8 = 2;

/// Appends the body of `message`, which has `layout`, to `out`.
pub(crate) fn encode(message: &[u8], layout: &Grid, out: &mut Vec<u8>) {
    let (head, cells) = message.split_at(layout.head);
    put_block(out, head);
    let background = background(cells);
    if cells::shaded(cells, background) {
        out.extend_from_slice(&[SHADES, background]);
        let mut lanes = Lanes::pictures(1, layout.width, layout.height);
        for (y, row) in cells.chunks_exact(layout.width).enumerate() {
            lanes.row_mut(0, y).copy_from_slice(row);
        }
        plane8::encode(&mut lanes, 1, out);
    } else {
        out.extend_from_slice(&[PLAIN, background]);
        cells::encode(cells, layout, background, out);
    }
}

/// The most common cell among a few thousand.
fn background(cells: &[u8]) -> u8 {
    let mut seen = [0u32; 256];
    for &cell in cells.iter().step_by((cells.len() / 4096).max(1)) {
        seen[usize::from(cell)] += 1;
    }
    (0..=255u8)
        .max_by_key(|&cell| seen[usize::from(cell)])
        .unwrap_or(0)
}

/// Appends a message of `total` bytes to `out`.
pub(crate) fn decode(input: &mut Cursor<'_>, total: usize, out: &mut Vec<u8>) -> Result<(), Error> {
    let head = input.block()?;
    let layout = Grid::read(head, total)
        .filter(|layout| layout.head == head.len())
        .ok_or(Error::Corrupt("a head that is not a grid's"))?;
    let mode = input.byte()?;
    let background = input.byte()?;
    let first = out.len() + head.len();
    out.extend_from_slice(head);
    out.resize(first + layout.width * layout.height, background);
    let cells = &mut out[first..];
    match mode {
        PLAIN => cells::decode(input.take_rest(), &layout, background, cells),
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

    /// A grid message with `cells`.
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

    /// A room of `size` cells inside a grid of `width` by `height`, with a pillar at `pillar`.
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

    /// Encodes and decodes; the body's size.
    fn sent(message: &[u8]) -> usize {
        let layout = Grid::read(message, message.len()).unwrap();
        let (mut body, mut back) = (Vec::new(), Vec::new());
        encode(message, &layout, &mut body);
        decode(&mut Cursor::new(&body), message.len(), &mut back).unwrap();
        assert!(back == message);
        body.len()
    }

    #[test]
    fn a_map_is_small() {
        let size = sent(&message(500, 400, &room(500, 400, 300, 40)));
        assert!(size < 700, "{size}");
        sent(&message(1, 1, &[55]));
        sent(&message(10, 10, &room(50, 50, 20, 5)[..100]));
    }

    #[test]
    fn shades_and_odd_values_come_back() {
        let mut shades: Vec<u8> = (0..120 * 100)
            .map(|index| (index % 120 + index / 120 / 2) as u8 % 101)
            .collect();
        sent(&message(120, 100, &shades));
        shades[500] = 77;
        shades[501..700].fill(3);
        sent(&message(120, 100, &shades));
    }
}
