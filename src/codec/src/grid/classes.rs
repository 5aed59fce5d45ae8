//! Cells of three values: unknown, free, occupied. Others are told in full.

use super::cells::{Place, Side, Tell};
use crate::entropy::binary::Bit;

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
pub(super) struct Classes {
    uniform: [Bit; 4],
    /// Per context: is it another value than guessed? One outside the known three? Which?
    cells: Vec<[Bit; 4]>,
    /// A value in full, bit by bit, each in the context of those before.
    values: Vec<Bit>,
}

impl Classes {
    pub(super) fn new() -> Self {
        Self {
            uniform: Default::default(),
            cells: vec![Default::default(); CONTEXTS],
            values: vec![Bit::default(); 256],
        }
    }
}

impl Tell for Classes {
    fn uniform<S: Side>(&mut self, side: &mut S, guess: u8, known: u8) -> u8 {
        value(side, &mut self.uniform, &mut self.values, guess, known)
    }

    #[inline(always)]
    fn cell<S: Side>(&mut self, side: &mut S, place: Place, known: u8) -> u8 {
        let cells = side.cells();
        let west = place.near(cells, 1, 0);
        let context = context([
            west,
            place.near(cells, 0, 1),
            place.near(cells, 1, 1),
            place.near(cells, -1, 1),
            place.near(cells, 2, 0),
            place.near(cells, 0, 2),
        ]);
        let bits = &mut self.cells[context];
        value(side, bits, &mut self.values, west, known)
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
