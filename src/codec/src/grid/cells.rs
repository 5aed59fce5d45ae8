//! The cells of a grid that differ from its background, by an adaptive binary coder.
//!
//! The grid is cut into tiles of 64×64 cells and those into blocks of 8×8. A tile, then a block, is either background
//! or not; a block that is not may be of one value throughout. Only in the remaining blocks cells are told one by
//! one, row by row across all blocks of a band, each in the context of its neighbours: how, is for a [`Tell`].

use crate::Error;
use crate::entropy::binary::{BinaryDecoder, BinaryEncoder, Bit};
use crate::layout::Grid;
use std::ops::Range;

const TILE: usize = 64;
const BLOCK: usize = 8;
/// What a block of one value is guessed to be where nothing is known.
const UNKNOWN: u8 = 255;

/// How values are told: by their class, or by their rank among many.
pub(super) trait Tell {
    /// The value of a block of one value.
    fn uniform<S: Side>(&mut self, side: &mut S, guess: u8, known: u8) -> u8;
    /// The cell at `place`.
    fn cell<S: Side>(&mut self, side: &mut S, place: Place, known: u8) -> u8;
}

/// Where a cell is.
#[derive(Clone, Copy)]
pub(super) struct Place {
    pub(super) x: usize,
    pub(super) y: usize,
    width: usize,
    background: u8,
}

impl Place {
    /// The cell `left` columns to the left and `up` rows above; outside of the grid, background.
    #[inline(always)]
    pub(super) fn near(self, cells: &[u8], left: isize, up: usize) -> u8 {
        let column = self.x.wrapping_add_signed(-left);
        if column < self.width && up <= self.y {
            cells[(self.y - up) * self.width + column]
        } else {
            self.background
        }
    }
}

/// The decisions' probabilities that are of blocks.
#[derive(Default)]
struct Blocks {
    tiles: [Bit; 4],
    differs: [Bit; 4],
    uniform: [Bit; 4],
}

/// An encoder or a decoder. One walk over the grid serves both: where it asks for what it codes, the encoder looks at
/// its cells and the decoder at its bits.
pub(super) trait Side {
    const ENCODES: bool;
    /// Codes a decision; `known` is what it is, if this side encodes.
    fn bit(&mut self, bit: &mut Bit, known: bool) -> bool;
    fn cells(&self) -> &[u8];
    /// Sets cells to what was coded.
    fn set(&mut self, cells: Range<usize>, value: u8);
}

struct Encoding<'a> {
    coder: BinaryEncoder,
    cells: &'a [u8],
}

impl Side for Encoding<'_> {
    const ENCODES: bool = true;

    #[inline(always)]
    fn bit(&mut self, bit: &mut Bit, known: bool) -> bool {
        self.coder.put(bit, known);
        known
    }

    #[inline(always)]
    fn cells(&self) -> &[u8] {
        self.cells
    }

    #[inline(always)]
    fn set(&mut self, _: Range<usize>, _: u8) {}
}

struct Decoding<'a> {
    coder: BinaryDecoder<'a>,
    cells: &'a mut [u8],
}

impl Side for Decoding<'_> {
    const ENCODES: bool = false;

    #[inline(always)]
    fn bit(&mut self, bit: &mut Bit, _: bool) -> bool {
        self.coder.get(bit)
    }

    #[inline(always)]
    fn cells(&self) -> &[u8] {
        self.cells
    }

    #[inline(always)]
    fn set(&mut self, cells: Range<usize>, value: u8) {
        self.cells[cells].fill(value);
    }
}

/// Appends `cells` as they differ from `background`; tells how many are in blocks that do.
pub(super) fn encode<T: Tell>(
    cells: &[u8],
    layout: &Grid,
    background: u8,
    tell: T,
    out: &mut Vec<u8>,
) -> usize {
    let side = Encoding {
        coder: BinaryEncoder::new(),
        cells,
    };
    let walk = walk(side, layout, background, tell);
    out.extend_from_slice(&walk.side.coder.finish());
    walk.told
}

/// Turns `cells`, which are all `background`, into what was encoded.
pub(super) fn decode<T: Tell>(
    bytes: &[u8],
    layout: &Grid,
    background: u8,
    tell: T,
    cells: &mut [u8],
) -> Result<(), Error> {
    let side = Decoding {
        coder: BinaryDecoder::new(bytes),
        cells,
    };
    walk(side, layout, background, tell).side.coder.finish()
}

fn walk<S: Side, T: Tell>(side: S, layout: &Grid, background: u8, tell: T) -> Walk<S, T> {
    let (width, height) = (layout.width, layout.height);
    let mut walk = Walk {
        side,
        tell,
        bits: Blocks::default(),
        background,
        width,
        plain: vec![background; width],
        tiles: vec![false; width.div_ceil(TILE)],
        blocks: vec![State::Same; width.div_ceil(BLOCK)],
        told: 0,
    };
    for top in (0..height).step_by(TILE) {
        let bottom = (top + TILE).min(height);
        walk.tiles(top..bottom);
        for first in (top..bottom).step_by(BLOCK) {
            let band = first..(first + BLOCK).min(bottom);
            if walk.tiles.contains(&true) {
                walk.blocks(band.clone());
                for y in band {
                    walk.row(y);
                }
            } else {
                walk.blocks.fill(State::Same);
            }
        }
    }
    walk
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum State {
    /// Background throughout.
    Same,
    /// Of one value.
    Uniform,
    /// Told cell by cell.
    Mixed,
}

struct Walk<S, T> {
    side: S,
    tell: T,
    bits: Blocks,
    background: u8,
    width: usize,
    /// A row of background.
    plain: Vec<u8>,
    /// Which tiles of the band are not all background.
    tiles: Vec<bool>,
    blocks: Vec<State>,
    /// Cells in blocks that differ.
    told: usize,
}

impl<S: Side, T: Tell> Walk<S, T> {
    fn row_of(&self, y: usize) -> &[u8] {
        &self.side.cells()[y * self.width..(y + 1) * self.width]
    }

    fn tiles(&mut self, rows: Range<usize>) {
        let mut changed = vec![false; self.tiles.len()];
        if S::ENCODES {
            for y in rows {
                let (new, old) = (self.row_of(y), &self.plain[..]);
                if new != old {
                    for (tile, (new, old)) in changed
                        .iter_mut()
                        .zip(new.chunks(TILE).zip(old.chunks(TILE)))
                    {
                        *tile = *tile || new != old;
                    }
                }
            }
        }
        let mut left = false;
        for (tile, changed) in self.tiles.iter_mut().zip(changed) {
            let context = usize::from(left) + 2 * usize::from(*tile);
            left = self.side.bit(&mut self.bits.tiles[context], changed);
            *tile = left;
        }
    }

    /// Codes which blocks of a band differ, and fills those of one value.
    fn blocks(&mut self, rows: Range<usize>) {
        let mut left = State::Same;
        for block in 0..self.blocks.len() {
            let above = self.blocks[block];
            let mut state = State::Same;
            if self.tiles[block * BLOCK / TILE] {
                let columns = block * BLOCK..((block + 1) * BLOCK).min(self.width);
                state = self.block(columns, rows.clone(), left, above);
            }
            self.blocks[block] = state;
            left = state;
        }
    }

    fn block(
        &mut self,
        columns: Range<usize>,
        rows: Range<usize>,
        left: State,
        above: State,
    ) -> State {
        let at = rows.start * self.width + columns.start;
        let (mut differs, mut uniform) = (false, true);
        if S::ENCODES {
            let first = self.side.cells()[at];
            for y in rows.clone() {
                let new = &self.row_of(y)[columns.clone()];
                differs |= new != &self.plain[columns.clone()];
                uniform &= new.iter().all(|&cell| cell == first);
            }
        }
        let context = |state: State| usize::from(left == state) + 2 * usize::from(above == state);
        if !self
            .side
            .bit(&mut self.bits.differs[context(State::Same)], differs)
        {
            return State::Same;
        }
        self.told += columns.len() * rows.len();
        if !self
            .side
            .bit(&mut self.bits.uniform[context(State::Uniform)], uniform)
        {
            return State::Mixed;
        }
        // The cells of a mixed block to the left are told only later.
        let guess = match (left, rows.start) {
            (State::Uniform, _) => self.side.cells()[at - 1],
            (_, 1..) => self.side.cells()[at - self.width],
            _ => UNKNOWN,
        };
        let known = self.side.cells()[at];
        let value = self.tell.uniform(&mut self.side, guess, known);
        for y in rows {
            self.side.set(
                y * self.width + columns.start..y * self.width + columns.end,
                value,
            );
        }
        State::Uniform
    }

    /// Codes the cells of row `y` in mixed blocks.
    fn row(&mut self, y: usize) {
        for block in 0..self.blocks.len() {
            if self.blocks[block] == State::Mixed {
                let columns = block * BLOCK..((block + 1) * BLOCK).min(self.width);
                columns.for_each(|x| self.cell(x, y));
            }
        }
    }

    #[inline(always)]
    fn cell(&mut self, x: usize, y: usize) {
        let at = y * self.width + x;
        let place = Place {
            x,
            y,
            width: self.width,
            background: self.background,
        };
        let known = self.side.cells()[at];
        let value = self.tell.cell(&mut self.side, place, known);
        self.side.set(at..at + 1, value);
    }
}
