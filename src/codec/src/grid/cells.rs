//! The cells of a grid that differ from its background, by an adaptive binary coder.
//!
//! The grid is cut into tiles of 64×64 cells and those into blocks of 8×8. A tile, then a block, is either background
//! or not; a block that is not may be of one value throughout. Only in the remaining blocks cells are told one by
//! one, row by row across all blocks of a band, each in the context of its neighbours.
//!
//! Maps hold three values (unknown, free, occupied): others are told in full.

use crate::Error;
use crate::entropy::binary::{BinaryDecoder, BinaryEncoder, Bit};
use crate::layout::Grid;
use std::ops::Range;

const TILE: usize = 64;
const BLOCK: usize = 8;

/// Unknown, free, occupied.
const KNOWN: [u8; 3] = [255, 0, 100];
/// The class of every other value.
const OTHER: u8 = 3;

/// Whether a grid has so many values besides the known three that it is better told as a picture.
pub(super) fn shaded(cells: &[u8], background: u8) -> bool {
    let (mut others, mut told) = (0usize, 0usize);
    for pair in cells.windows(2).step_by((cells.len() / 16_384).max(1)) {
        if pair != [background; 2] {
            told += 1;
            others += usize::from(pair[0] != pair[1] && CLASSES[usize::from(pair[1])] == OTHER);
        }
    }
    others * 8 > told
}

const CLASSES: [u8; 256] = {
    let mut classes = [OTHER; 256];
    let mut class = 0;
    while class < KNOWN.len() {
        classes[KNOWN[class] as usize] = class as u8;
        class += 1;
    }
    classes
};

/// Contexts of a cell: six neighbours' classes.
const CONTEXTS: usize = 1 << 12;

/// The decisions' probabilities.
struct Model {
    tiles: [Bit; 4],
    blocks: [Bit; 4],
    uniform: [Bit; 4],
    uniform_value: [Bit; 4],
    /// Per context: is it another value than guessed? One outside the known three? Which?
    cells: Vec<[Bit; 4]>,
    /// A value in full, bit by bit, each in the context of those before.
    values: Vec<Bit>,
}

impl Model {
    fn new() -> Self {
        Self {
            tiles: Default::default(),
            blocks: Default::default(),
            uniform: Default::default(),
            uniform_value: Default::default(),
            cells: vec![Default::default(); CONTEXTS],
            values: vec![Bit::default(); 256],
        }
    }
}

/// An encoder or a decoder. One walk over the grid serves both: where it asks for what it codes, the encoder looks at
/// its cells and the decoder at its bits.
trait Side {
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

/// Appends `cells` as they differ from `background`.
pub(super) fn encode(cells: &[u8], layout: &Grid, background: u8, out: &mut Vec<u8>) {
    let side = Encoding {
        coder: BinaryEncoder::new(),
        cells,
    };
    out.extend_from_slice(&walk(side, layout, background).coder.finish());
}

/// Turns `cells`, which are all `background`, into what was encoded.
pub(super) fn decode(
    bytes: &[u8],
    layout: &Grid,
    background: u8,
    cells: &mut [u8],
) -> Result<(), Error> {
    let side = Decoding {
        coder: BinaryDecoder::new(bytes),
        cells,
    };
    walk(side, layout, background).coder.finish()
}

fn walk<S: Side>(side: S, layout: &Grid, background: u8) -> S {
    let (width, height) = (layout.width, layout.height);
    let mut walk = Walk {
        side,
        model: Model::new(),
        background,
        width,
        plain: vec![background; width],
        tiles: vec![false; width.div_ceil(TILE)],
        blocks: vec![State::Same; width.div_ceil(BLOCK)],
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
    walk.side
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

struct Walk<S> {
    side: S,
    model: Model,
    background: u8,
    width: usize,
    /// A row of background.
    plain: Vec<u8>,
    /// Which tiles of the band are not all background.
    tiles: Vec<bool>,
    blocks: Vec<State>,
}

impl<S: Side> Walk<S> {
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
            left = self.side.bit(&mut self.model.tiles[context], changed);
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
            .bit(&mut self.model.blocks[context(State::Same)], differs)
        {
            return State::Same;
        }
        if !self
            .side
            .bit(&mut self.model.uniform[context(State::Uniform)], uniform)
        {
            return State::Mixed;
        }
        // The cells of a mixed block to the left are told only later.
        let guess = match (left, rows.start) {
            (State::Uniform, _) => self.side.cells()[at - 1],
            (_, 1..) => self.side.cells()[at - self.width],
            _ => KNOWN[0],
        };
        let known = self.side.cells()[at];
        let value = value(
            &mut self.side,
            &mut self.model.uniform_value,
            &mut self.model.values,
            guess,
            known,
        );
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

    /// The cell `left` columns left of and `up` rows above (x, y); outside of the grid, background.
    #[inline(always)]
    fn near(&self, x: usize, y: usize, left: isize, up: usize) -> u8 {
        let column = x.wrapping_add_signed(-left);
        if column < self.width && up <= y {
            self.side.cells()[(y - up) * self.width + column]
        } else {
            self.background
        }
    }

    #[inline(always)]
    fn cell(&mut self, x: usize, y: usize) {
        let at = y * self.width + x;
        let west = self.near(x, y, 1, 0);
        let context = context([
            west,
            self.near(x, y, 0, 1),
            self.near(x, y, 1, 1),
            self.near(x, y, -1, 1),
            self.near(x, y, 2, 0),
            self.near(x, y, 0, 2),
        ]);
        let known = self.side.cells()[at];
        let bits = &mut self.model.cells[context];
        let coded = value(&mut self.side, bits, &mut self.model.values, west, known);
        self.side.set(at..at + 1, coded);
    }
}

#[inline(always)]
fn context<const N: usize>(neighbours: [u8; N]) -> usize {
    neighbours.into_iter().fold(0, |context, cell| {
        context << 2 | usize::from(CLASSES[usize::from(cell)])
    })
}

/// Codes a cell: as guessed, one of the known values, or any other.
#[inline(always)]
fn value<S: Side>(
    side: &mut S,
    bits: &mut [Bit; 4],
    values: &mut [Bit],
    guess: u8,
    known: u8,
) -> u8 {
    if !side.bit(&mut bits[0], known != guess) {
        return guess;
    }
    if side.bit(&mut bits[1], CLASSES[usize::from(known)] == OTHER) {
        return full(side, values, known);
    }
    let mut candidates = KNOWN.into_iter().filter(|&value| value != guess);
    let (first, second) = (
        candidates.next().unwrap_or(0),
        candidates.next().unwrap_or(0),
    );
    if !side.bit(&mut bits[2], known != first) {
        return first;
    }
    match candidates.next() {
        Some(third) if side.bit(&mut bits[3], known == third) => third,
        _ => second,
    }
}

#[cold]
fn full<S: Side>(side: &mut S, values: &mut [Bit], known: u8) -> u8 {
    let mut node = 1usize;
    for shift in (0..8).rev() {
        let one = side.bit(&mut values[node], (known >> shift) & 1 != 0);
        node = node << 1 | usize::from(one);
    }
    node as u8
}
