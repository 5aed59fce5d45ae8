//! `nav_msgs/OccupancyGrid`: what differs from the last acknowledged grid, or from a plain one.
//!
//! ```text
//!   encoder                                        decoder
//!   encode(n)  ── key or delta to `base`, keep? ──▶ decode(n), keeps n when told
//!              ◀───────── acknowledge(n) ──────────
//!   base = n                                        a delta to n drops what is older
//! ```
//! Only an acknowledged grid is ever a base, so a lost frame costs nothing but its own content. The encoder keeps the
//! base and at most two grids that await their acknowledgement; the decoder keeps the base and the last two it was
//! told to keep, which are the same.
//!
//! Body: `head · mode · keep · [base · dx · dy] · background · cells`.

mod cells;

use crate::Error;
use crate::layout::Grid;
use crate::padded::Lanes;
use crate::plane8;
use crate::wire::{Cursor, put_block, put_varint, unzigzag, zigzag};

/// How the cells are told.
const PLAIN: u8 = 0;
const DELTA: u8 = 1;
const SHADES: u8 = 2;

/// Grids that await their acknowledgement.
const PENDING: usize = 2;
/// After so many frames without an acknowledgement a kept grid is given up for a newer one.
const PATIENCE: u64 = 8;

/// A grid that a later one can refer to.
#[derive(Debug)]
struct Kept {
    sequence: u64,
    layout: Grid,
    cells: Vec<u8>,
}

impl Kept {
    /// How many cells this grid lies right of and above `other`, when both have one raster.
    fn offset_in(&self, other: &Grid) -> Option<(i64, i64)> {
        if self.layout.resolution.to_bits() != other.resolution.to_bits() || other.resolution <= 0.0
        {
            return None;
        }
        let mut offset = [0i64; 2];
        for (axis, offset) in offset.iter_mut().enumerate() {
            let cells =
                (self.layout.origin[axis] - other.origin[axis]) / f64::from(other.resolution);
            if !cells.is_finite() || cells.abs() > 1e6 || (cells - cells.round()).abs() > 0.01 {
                return None;
            }
            *offset = cells.round() as i64;
        }
        Some((offset[0], offset[1]))
    }

    /// Whether the cells can be compared as they lie.
    fn covers(&self, layout: &Grid, offset: (i64, i64)) -> bool {
        offset == (0, 0) && (self.layout.width, self.layout.height) == (layout.width, layout.height)
    }

    /// The cells as seen from `layout`: moved, cut, the rest `background`.
    fn moved(&self, layout: &Grid, (dx, dy): (i64, i64), background: u8) -> Vec<u8> {
        let mut cells = vec![background; layout.width * layout.height];
        let from = (-dx).max(0);
        let to = (layout.width as i64 - dx).min(self.layout.width as i64);
        if from >= to {
            return cells;
        }
        for (y, row) in self.cells.chunks_exact(self.layout.width).enumerate() {
            let target = y as i64 + dy;
            if (0..layout.height as i64).contains(&target) {
                let start = target as usize * layout.width + (from + dx) as usize;
                cells[start..start + (to - from) as usize]
                    .copy_from_slice(&row[from as usize..to as usize]);
            }
        }
        cells
    }
}

/// The encoder's memory.
#[derive(Debug, Default)]
pub(crate) struct GridEncoder {
    base: Option<Kept>,
    pending: Vec<Kept>,
    /// A buffer to reuse: grids are large.
    spare: Vec<u8>,
}

impl GridEncoder {
    /// Appends the body of `message`, which has `layout`, to `out`.
    pub(crate) fn encode(
        &mut self,
        message: &[u8],
        layout: &Grid,
        sequence: u64,
        out: &mut Vec<u8>,
    ) {
        let (head, cells) = message.split_at(layout.head);
        put_block(out, head);
        let keep = self.keeps(sequence);
        let background = background(cells);
        let base = self
            .base
            .as_ref()
            .and_then(|base| Some((base, base.offset_in(layout)?)));
        if let Some((base, offset)) = base {
            out.extend_from_slice(&[DELTA, keep.into()]);
            put_varint(out, base.sequence);
            put_varint(out, zigzag(offset.0));
            put_varint(out, zigzag(offset.1));
            out.push(background);
            if base.covers(layout, offset) {
                cells::encode(cells, layout, cells::Base::Grid(&base.cells), out);
            } else {
                let moved = base.moved(layout, offset, background);
                cells::encode(cells, layout, cells::Base::Grid(&moved), out);
            }
        } else if cells::shaded(cells, background) {
            out.extend_from_slice(&[SHADES, keep.into(), background]);
            let mut lanes = Lanes::pictures(1, layout.width, layout.height);
            for (y, row) in cells.chunks_exact(layout.width).enumerate() {
                lanes.row_mut(0, y).copy_from_slice(row);
            }
            plane8::encode(&mut lanes, 1, out);
        } else {
            out.extend_from_slice(&[PLAIN, keep.into(), background]);
            cells::encode(cells, layout, cells::Base::Plain(background), out);
        }
        if keep {
            let mut copy = std::mem::take(&mut self.spare);
            copy.clear();
            copy.extend_from_slice(cells);
            self.pending.push(Kept {
                sequence,
                layout: *layout,
                cells: copy,
            });
        }
    }

    /// Makes room for one more pending grid when that is worth it.
    fn keeps(&mut self, sequence: u64) -> bool {
        if self.pending.len() < PENDING {
            return true;
        }
        if self
            .pending
            .iter()
            .all(|kept| kept.sequence + PATIENCE <= sequence)
        {
            self.spare = self.pending.remove(0).cells;
            return true;
        }
        false
    }

    /// The peer has decoded the grid `sequence`.
    pub(crate) fn acknowledge(&mut self, sequence: u64) {
        let Some(position) = self
            .pending
            .iter()
            .position(|kept| kept.sequence == sequence)
        else {
            return;
        };
        let mut done = self.pending.drain(..=position);
        let base = done.next_back();
        if let Some(older) = done.next() {
            self.spare = older.cells;
        }
        drop(done);
        if let Some(older) = std::mem::replace(&mut self.base, base) {
            self.spare = older.cells;
        }
    }

    /// The next grid refers to none.
    pub(crate) fn forget(&mut self) {
        *self = Self::default();
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

/// The decoder's memory.
#[derive(Debug, Default)]
pub(crate) struct GridDecoder {
    kept: Vec<Kept>,
}

impl GridDecoder {
    /// Appends a message of `total` bytes to `out`.
    pub(crate) fn decode(
        &mut self,
        input: &mut Cursor<'_>,
        sequence: u64,
        total: usize,
        out: &mut Vec<u8>,
    ) -> Result<(), Error> {
        let head = input.block()?;
        let layout = Grid::read(head, total)
            .filter(|layout| layout.head == head.len())
            .ok_or(Error::Corrupt("a head that is not a grid's"))?;
        let mode = input.byte()?;
        let keep = input.byte()? != 0;
        let size = layout.width * layout.height;
        let first = out.len() + head.len();
        match mode {
            PLAIN | SHADES => {
                let background = input.byte()?;
                out.extend_from_slice(head);
                out.resize(first + size, background);
                let cells = &mut out[first..];
                if mode == PLAIN {
                    cells::decode(
                        input.take_rest(),
                        &layout,
                        cells::Base::Plain(background),
                        cells,
                    )?;
                } else {
                    let mut lanes = Lanes::pictures(1, layout.width, layout.height);
                    plane8::decode(input, &mut lanes, 1)?;
                    for (y, row) in cells.chunks_exact_mut(layout.width).enumerate() {
                        row.copy_from_slice(lanes.row(0, y));
                    }
                }
            }
            DELTA => {
                let base = input.varint()?;
                let mut offset = || input.varint().map(unzigzag);
                let offset = (offset()?, offset()?);
                if offset.0.unsigned_abs() > 1 << 32 || offset.1.unsigned_abs() > 1 << 32 {
                    return Err(Error::Corrupt("a grid that moved out of sight"));
                }
                let background = input.byte()?;
                let kept = self.kept.iter().find(|kept| kept.sequence == base);
                let kept = kept.ok_or(Error::MissingReference(base))?;
                out.extend_from_slice(head);
                if kept.covers(&layout, offset) {
                    out.extend_from_slice(&kept.cells);
                    cells::decode(
                        input.take_rest(),
                        &layout,
                        cells::Base::Grid(&kept.cells),
                        &mut out[first..],
                    )?;
                } else {
                    let moved = kept.moved(&layout, offset, background);
                    out.extend_from_slice(&moved);
                    cells::decode(
                        input.take_rest(),
                        &layout,
                        cells::Base::Grid(&moved),
                        &mut out[first..],
                    )?;
                }
                self.kept.retain(|kept| kept.sequence >= base);
            }
            _ => return Err(Error::Corrupt("a grid told in an unknown way")),
        }
        if keep {
            self.keep(Kept {
                sequence,
                layout,
                cells: out[first..].to_vec(),
            });
        }
        Ok(())
    }

    /// Keeps the base (the oldest) and the newest two.
    fn keep(&mut self, kept: Kept) {
        if self.kept.len() > PENDING {
            self.kept.remove(1);
        }
        self.kept.push(kept);
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A grid message with `cells` and its origin in metres.
    pub(crate) fn message(width: u32, height: u32, origin: [f64; 2], cells: &[u8]) -> Vec<u8> {
        let mut message = vec![7; 12];
        message.extend_from_slice(&[3, 0, 0, 0]);
        message.extend_from_slice(b"map");
        message.extend_from_slice(&[5; 8]);
        message.extend_from_slice(&0.05f32.to_le_bytes());
        message.extend_from_slice(&width.to_le_bytes());
        message.extend_from_slice(&height.to_le_bytes());
        origin
            .iter()
            .for_each(|number| message.extend_from_slice(&number.to_le_bytes()));
        message.extend_from_slice(&[9; 40]);
        message.extend_from_slice(&(cells.len() as u32).to_le_bytes());
        message.extend_from_slice(cells);
        message
    }

    /// A room of `size` cells inside a grid of `width` by `height`, with a pillar at `pillar`.
    pub(crate) fn room(width: usize, height: usize, size: usize, pillar: usize) -> Vec<u8> {
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

    struct Link {
        encoder: GridEncoder,
        decoder: GridDecoder,
        sequence: u64,
    }

    impl Link {
        fn new() -> Self {
            Self {
                encoder: GridEncoder::default(),
                decoder: GridDecoder::default(),
                sequence: 0,
            }
        }

        fn encode(&mut self, message: &[u8]) -> Vec<u8> {
            self.sequence += 1;
            let mut body = Vec::new();
            let layout = Grid::read(message, message.len()).unwrap();
            self.encoder
                .encode(message, &layout, self.sequence, &mut body);
            body
        }

        fn send(&mut self, message: &[u8]) -> usize {
            let body = self.encode(message);
            let mut back = Vec::new();
            self.decoder
                .decode(
                    &mut Cursor::new(&body),
                    self.sequence,
                    message.len(),
                    &mut back,
                )
                .unwrap();
            assert!(back == message);
            body.len()
        }
    }

    #[test]
    fn a_successor_of_an_acknowledged_grid_is_small() {
        let mut link = Link::new();
        let first = link.send(&message(500, 400, [0.0, 0.0], &room(500, 400, 300, 40)));
        assert!(first < 700, "{first}");
        link.encoder.acknowledge(1);
        let second = link.send(&message(500, 400, [0.0, 0.0], &room(500, 400, 300, 41)));
        assert!(second < 180, "{second}");
        // Nothing changed: little more than the head.
        link.encoder.acknowledge(2);
        assert!(link.send(&message(500, 400, [0.0, 0.0], &room(500, 400, 300, 41))) < 125);
    }

    #[test]
    fn lost_frames_and_late_acknowledgements_do_no_harm() {
        let mut link = Link::new();
        for round in 0..40usize {
            let message = message(100, 90, [0.0, 0.0], &room(100, 90, 60, 10 + round));
            if round % 3 == 1 {
                link.encode(&message);
            } else {
                link.send(&message);
            }
            if round >= 5 && (round - 5) % 3 != 1 {
                link.encoder.acknowledge(round as u64 - 4);
            }
        }
        assert!(link.encoder.base.is_some());
    }

    #[test]
    fn a_grid_that_grows_or_moves_refers_to_the_old_one() {
        let mut link = Link::new();
        link.send(&message(200, 200, [0.0, 0.0], &room(200, 200, 150, 60)));
        link.encoder.acknowledge(1);
        let old = room(200, 200, 150, 60);
        let mut grown = vec![255u8; 300 * 260];
        for y in 0..200 {
            grown[(y + 20) * 300 + 40..(y + 20) * 300 + 240]
                .copy_from_slice(&old[y * 200..(y + 1) * 200]);
        }
        assert!(link.send(&message(300, 260, [-2.0, -1.0], &grown)) < 140);
        link.encoder.acknowledge(2);
        assert!(link.send(&message(200, 200, [0.0, 0.0], &old)) < 140);
        // Another raster: a key.
        link.send(&message(200, 200, [0.01, 0.0], &old));
        link.send(&message(10, 10, [100.0, 0.0], &room(50, 50, 20, 5)[..100]));
    }

    #[test]
    fn shades_and_odd_values_come_back() {
        let mut link = Link::new();
        let shades: Vec<u8> = (0..120 * 100)
            .map(|index| (index % 120 + index / 120 / 2) as u8 % 101)
            .collect();
        link.send(&message(120, 100, [0.0, 0.0], &shades));
        link.encoder.acknowledge(1);
        let mut changed = shades.clone();
        changed[500] = 77;
        changed[501..700].fill(3);
        let size = link.send(&message(120, 100, [0.0, 0.0], &changed));
        assert!(size < 300, "{size}");
        link.encoder.forget();
        link.send(&message(120, 100, [0.0, 0.0], &changed));
    }

    #[test]
    fn a_delta_to_nothing_asks_for_a_key() {
        let mut link = Link::new();
        let grid = message(50, 50, [0.0, 0.0], &room(50, 50, 20, 5));
        link.send(&grid);
        link.encoder.acknowledge(1);
        let delta = link.encode(&grid);
        let mut fresh = GridDecoder::default();
        let error = fresh.decode(&mut Cursor::new(&delta), 2, grid.len(), &mut Vec::new());
        assert_eq!(error, Err(Error::MissingReference(1)));
    }
}
