//! Codes the cells of a grid that differ from its background, by an adaptive binary coder.
//!
//! The grid is divided into tiles of 64×64 cells and those into blocks of 8×8. A tile, then a block, is either
//! background or not; a block that is not may be uniform. Only in the remaining blocks are cells coded one by one, row
//! by row across all blocks of a band, each in the context of its neighbours; a [`CellModel`] defines how.

use crate::Error;
use crate::entropy::binary::{AdaptiveBit, BinaryDecoder, BinaryEncoder};
use crate::layout::GridLayout;
use std::ops::Range;

const TILE: usize = 64;
const BLOCK: usize = 8;
/// Prediction of a uniform block without known neighbours.
const UNKNOWN: u8 = 255;

/// A model that codes values: by their class, or by their rank among many.
pub(super) trait CellModel {
    /// Codes the value of a uniform block.
    fn uniform<S: CellCoder>(&mut self, side: &mut S, guess: u8, known: u8) -> u8;
    /// Codes the cell at `place`.
    fn cell<S: CellCoder>(&mut self, side: &mut S, place: CellPosition, known: u8) -> u8;
}

/// Position of a cell.
#[derive(Clone, Copy)]
pub(super) struct CellPosition {
    pub(super) x: usize,
    pub(super) y: usize,
    width: usize,
    background: u8,
}

impl CellPosition {
    /// Returns the cell `left` columns to the left and `up` rows above; outside the grid, the background.
    #[inline(always)]
    pub(super) fn neighbour(self, cells: &[u8], left: isize, up: usize) -> u8 {
        let column = self.x.wrapping_add_signed(-left);
        if column < self.width && up <= self.y { cells[(self.y - up) * self.width + column] } else { self.background }
    }
}

/// Probabilities of the decisions about blocks.
#[derive(Default)]
struct BlockBits {
    tiles: [AdaptiveBit; 4],
    differs: [AdaptiveBit; 4],
    uniform: [AdaptiveBit; 4],
}

/// An encoder or a decoder. One walk over the grid serves both: where it asks for a decision, the encoder looks at its
/// cells and the decoder at its bits.
pub(super) trait CellCoder {
    const ENCODES: bool;
    /// Codes a decision; `known` is its value if this side encodes.
    fn bit(&mut self, bit: &mut AdaptiveBit, known: bool) -> bool;
    fn cells(&self) -> &[u8];
    /// Sets cells to the coded value.
    fn set(&mut self, cells: Range<usize>, value: u8);
}

struct CellEncoder<'a> {
    coder: BinaryEncoder,
    cells: &'a [u8],
}

impl CellCoder for CellEncoder<'_> {
    const ENCODES: bool = true;

    #[inline(always)]
    fn bit(&mut self, bit: &mut AdaptiveBit, known: bool) -> bool {
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

struct CellDecoder<'a> {
    coder: BinaryDecoder<'a>,
    cells: &'a mut [u8],
}

impl CellCoder for CellDecoder<'_> {
    const ENCODES: bool = false;

    #[inline(always)]
    fn bit(&mut self, bit: &mut AdaptiveBit, _: bool) -> bool {
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

/// Appends the differences of `cells` from `background`; returns the number of cells in blocks that differ.
pub(super) fn encode<T: CellModel>(
    cells: &[u8],
    layout: &GridLayout,
    background: u8,
    tell: T,
    out: &mut Vec<u8>,
) -> usize {
    let side = CellEncoder { coder: BinaryEncoder::new(), cells };
    let walk = walk_grid(side, layout, background, tell);
    out.extend_from_slice(&walk.side.coder.finish());
    walk.told
}

/// Decodes into `cells`, which are all `background`.
pub(super) fn decode<T: CellModel>(
    bytes: &[u8],
    layout: &GridLayout,
    background: u8,
    tell: T,
    cells: &mut [u8],
) -> Result<(), Error> {
    let side = CellDecoder { coder: BinaryDecoder::new(bytes), cells };
    walk_grid(side, layout, background, tell).side.coder.finish()
}

fn walk_grid<S: CellCoder, T: CellModel>(side: S, layout: &GridLayout, background: u8, tell: T) -> GridWalk<S, T> {
    let (width, height) = (layout.width, layout.height);
    let mut walk = GridWalk {
        side,
        tell,
        bits: BlockBits::default(),
        background,
        width,
        plain: vec![background; width],
        tiles: vec![false; width.div_ceil(TILE)],
        blocks: vec![State::Same; width.div_ceil(BLOCK)],
        told: 0,
    };
    for top in (0..height).step_by(TILE) {
        let bottom = (top + TILE).min(height);
        walk.code_tiles(top..bottom);
        for first in (top..bottom).step_by(BLOCK) {
            let band = first..(first + BLOCK).min(bottom);
            if walk.tiles.contains(&true) {
                walk.code_blocks(band.clone());
                for y in band {
                    walk.code_row(y);
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
    /// All background.
    Same,
    /// All of one value.
    Uniform,
    /// Coded cell by cell.
    Mixed,
}

struct GridWalk<S, T> {
    side: S,
    tell: T,
    bits: BlockBits,
    background: u8,
    width: usize,
    /// A row of background.
    plain: Vec<u8>,
    /// Tiles of the band that are not all background.
    tiles: Vec<bool>,
    blocks: Vec<State>,
    /// Number of cells in blocks that differ.
    told: usize,
}

impl<S: CellCoder, T: CellModel> GridWalk<S, T> {
    fn row_cells(&self, y: usize) -> &[u8] {
        &self.side.cells()[y * self.width..(y + 1) * self.width]
    }

    fn code_tiles(&mut self, rows: Range<usize>) {
        let mut changed = vec![false; self.tiles.len()];
        if S::ENCODES {
            for y in rows {
                let (new, old) = (self.row_cells(y), &self.plain[..]);
                if new != old {
                    for (tile, (new, old)) in changed.iter_mut().zip(new.chunks(TILE).zip(old.chunks(TILE))) {
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

    /// Codes which blocks of a band differ, and fills the uniform ones.
    fn code_blocks(&mut self, rows: Range<usize>) {
        let mut left = State::Same;
        for block in 0..self.blocks.len() {
            let above = self.blocks[block];
            let mut state = State::Same;
            if self.tiles[block * BLOCK / TILE] {
                let columns = block * BLOCK..((block + 1) * BLOCK).min(self.width);
                state = self.code_block(columns, rows.clone(), left, above);
            }
            self.blocks[block] = state;
            left = state;
        }
    }

    fn code_block(&mut self, columns: Range<usize>, rows: Range<usize>, left: State, above: State) -> State {
        let at = rows.start * self.width + columns.start;
        let (mut differs, mut uniform) = (false, true);
        if S::ENCODES {
            let first = self.side.cells()[at];
            for y in rows.clone() {
                let new = &self.row_cells(y)[columns.clone()];
                differs |= new != &self.plain[columns.clone()];
                uniform &= new.iter().all(|&cell| cell == first);
            }
        }
        let context = |state: State| usize::from(left == state) + 2 * usize::from(above == state);
        if !self.side.bit(&mut self.bits.differs[context(State::Same)], differs) {
            return State::Same;
        }
        self.told += columns.len() * rows.len();
        if !self.side.bit(&mut self.bits.uniform[context(State::Uniform)], uniform) {
            return State::Mixed;
        }
        // The cells of a mixed block to the left are coded only later.
        let guess = match (left, rows.start) {
            (State::Uniform, _) => self.side.cells()[at - 1],
            (_, 1..) => self.side.cells()[at - self.width],
            _ => UNKNOWN,
        };
        let known = self.side.cells()[at];
        let value = self.tell.uniform(&mut self.side, guess, known);
        for y in rows {
            self.side.set(y * self.width + columns.start..y * self.width + columns.end, value);
        }
        State::Uniform
    }

    /// Codes the cells of row `y` in mixed blocks.
    fn code_row(&mut self, y: usize) {
        for block in 0..self.blocks.len() {
            if self.blocks[block] == State::Mixed {
                let columns = block * BLOCK..((block + 1) * BLOCK).min(self.width);
                columns.for_each(|x| self.code_cell(x, y));
            }
        }
    }

    #[inline(always)]
    fn code_cell(&mut self, x: usize, y: usize) {
        let at = y * self.width + x;
        let place = CellPosition { x, y, width: self.width, background: self.background };
        let known = self.side.cells()[at];
        let value = self.tell.cell(&mut self.side, place, known);
        self.side.set(at..at + 1, value);
    }
}
