//! Model for cells of three values: unknown, free, occupied. Others are coded in full.

use super::cells::{CellCoder, CellModel, CellPosition};
use crate::entropy::binary::AdaptiveBit;

/// Values with a class of their own: unknown, free, occupied.
const CLASS_VALUES: [u8; 3] = [255, 0, 100];
/// Class of all other values.
const OTHER_CLASS: u8 = 3;

/// Returns true if a grid has so many values besides the three known ones that it is better coded as shades.
pub(super) fn has_many_shades(cells: &[u8], background: u8) -> bool {
    let (mut others, mut told) = (0usize, 0usize);
    for pair in cells.windows(2).step_by((cells.len() / 16_384).max(1)) {
        if pair != [background; 2] {
            told += 1;
            others += usize::from(pair[0] != pair[1] && CLASSES[usize::from(pair[1])] == OTHER_CLASS);
        }
    }
    others * 8 > told
}

const CLASSES: [u8; 256] = {
    let mut classes = [OTHER_CLASS; 256];
    let mut class = 0;
    while class < CLASS_VALUES.len() {
        classes[CLASS_VALUES[class] as usize] = class as u8;
        class += 1;
    }
    classes
};

/// Number of contexts of a cell: the classes of six neighbours.
const CONTEXTS: usize = 1 << 12;

/// Probabilities of the decisions.
pub(super) struct ClassModel {
    uniform: [AdaptiveBit; 4],
    /// Per context: is it a value other than predicted? One outside the known three? Which?
    cells: Vec<[AdaptiveBit; 4]>,
    /// A value in full, bit by bit, each in the context of those before.
    values: Vec<AdaptiveBit>,
}

impl ClassModel {
    pub(super) fn new() -> Self {
        Self {
            uniform: Default::default(),
            cells: vec![Default::default(); CONTEXTS],
            values: vec![AdaptiveBit::default(); 256],
        }
    }
}

impl CellModel for ClassModel {
    fn uniform<S: CellCoder>(&mut self, side: &mut S, guess: u8, known: u8) -> u8 {
        code_value(side, &mut self.uniform, &mut self.values, guess, known)
    }

    #[inline(always)]
    fn cell<S: CellCoder>(&mut self, side: &mut S, place: CellPosition, known: u8) -> u8 {
        let cells = side.cells();
        let west = place.neighbour(cells, 1, 0);
        let context = context([
            west,
            place.neighbour(cells, 0, 1),
            place.neighbour(cells, 1, 1),
            place.neighbour(cells, -1, 1),
            place.neighbour(cells, 2, 0),
            place.neighbour(cells, 0, 2),
        ]);
        let bits = &mut self.cells[context];
        code_value(side, bits, &mut self.values, west, known)
    }
}

#[inline(always)]
fn context<const N: usize>(neighbours: [u8; N]) -> usize {
    neighbours.into_iter().fold(0, |context, cell| context << 2 | usize::from(CLASSES[usize::from(cell)]))
}

/// Codes a cell: as predicted, one of the known values, or any other.
#[inline(always)]
fn code_value<S: CellCoder>(
    side: &mut S,
    bits: &mut [AdaptiveBit; 4],
    values: &mut [AdaptiveBit],
    guess: u8,
    known: u8,
) -> u8 {
    if !side.bit(&mut bits[0], known != guess) {
        return guess;
    }
    if side.bit(&mut bits[1], CLASSES[usize::from(known)] == OTHER_CLASS) {
        return code_full_value(side, values, known);
    }
    let mut candidates = CLASS_VALUES.into_iter().filter(|&value| value != guess);
    let (first, second) = (candidates.next().unwrap_or(0), candidates.next().unwrap_or(0));
    if !side.bit(&mut bits[2], known != first) {
        return first;
    }
    match candidates.next() {
        Some(third) if side.bit(&mut bits[3], known == third) => third,
        _ => second,
    }
}

#[cold]
fn code_full_value<S: CellCoder>(side: &mut S, values: &mut [AdaptiveBit], known: u8) -> u8 {
    let mut node = 1usize;
    for shift in (0..8).rev() {
        let one = side.bit(&mut values[node], (known >> shift) & 1 != 0);
        node = node << 1 | usize::from(one);
    }
    node as u8
}
