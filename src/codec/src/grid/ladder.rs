//! Model for cells of many shades, as left by mappers that count how often each cell was seen free or occupied: few
//! values, the rungs of a ladder, each next to others by chance.
//!
//! A cell is coded as its rank among the grid's values, in the context of its neighbours' ranks: left, above, and,
//! roughly, those beside the latter. The rank is coded by decisions down a tree in which common values are near the
//! root, and in which the values on either side of a decision are neighbours on the ladder.
//!
//! Header: `count of values · (value · weight)…`.

use super::cells::{CellCoder, CellModel, CellPosition};
use crate::Error;
use crate::entropy::binary::AdaptiveBit;
use crate::wire::FrameCursor;

/// Maximum number of values; grids with more are coded as pictures.
pub(super) const MAX_VALUES: usize = 64;
/// Maximum number of decisions of all contexts together: they take six bytes each, and a decoder has two MiB for
/// tables.
const BITS: usize = 330_000;
/// Mark of a leaf, which is a value and not a node.
const LEAF: u16 = 1 << 8;

/// The values of a grid, in ladder order, and how common each is.
pub(super) struct LadderValues(Vec<(u8, u8)>);

impl LadderValues {
    /// Returns the values of `cells`; most of the `background` is not counted.
    pub(super) fn from_cells(cells: &[u8], background: u8) -> Self {
        const STEP: usize = 64;
        let mut counts = [0u64; 256];
        counts[usize::from(background)] = 1;
        for chunk in cells.chunks(STEP) {
            if *chunk != [background; STEP][..chunk.len()] {
                chunk.iter().for_each(|&cell| counts[usize::from(cell)] += 1);
            }
        }
        let ladder = (i8::MIN..=i8::MAX).map(|value| value as u8);
        let seen = ladder.filter(|&value| counts[usize::from(value)] > 0);
        Self(seen.map(|value| (value, weight(counts[usize::from(value)]))).collect())
    }

    pub(super) fn count(&self) -> usize {
        self.0.len()
    }

    pub(super) fn write(&self, out: &mut Vec<u8>) {
        out.push(self.0.len() as u8);
        self.0.iter().for_each(|&(value, weight)| out.extend_from_slice(&[value, weight]));
    }

    pub(super) fn read(input: &mut FrameCursor<'_>) -> Result<Self, Error> {
        let count = usize::from(input.byte()?);
        if count == 0 || count > MAX_VALUES {
            return Err(Error::Corrupt("a grid of no values, or of too many"));
        }
        let pairs = input.take(2 * count)?.chunks_exact(2);
        let values: Vec<(u8, u8)> = pairs.map(|pair| (pair[0], pair[1])).collect();
        if values.is_sorted_by(|a, b| (a.0 as i8) < (b.0 as i8)) {
            Ok(Self(values))
        } else {
            Err(Error::Corrupt("values of a grid that are not in their order"))
        }
    }
}

/// Returns a count in one byte: its binary logarithm, in quarters.
fn weight(count: u64) -> u8 {
    let whole = count.ilog2();
    ((whole as u8) << 2) | (((count << 2) >> whole) & 3) as u8
}

/// Returns the count that a weight stands for, in quarters; counts beyond any grid's are all the same.
fn weight_value(weight: u8) -> u64 {
    u64::from(4 | (weight & 3)) << (weight >> 2).min(48)
}

/// A decision: whether the rank is `from` or more, and the next node for no and yes.
#[derive(Clone, Copy)]
struct TreeNode {
    from: u8,
    next: [u16; 2],
}

/// Builds the tree of the values `first` to `end`; returns its root, a node or a value.
fn build_tree(weights: &[u64], first: usize, end: usize, nodes: &mut Vec<TreeNode>) -> u16 {
    if end - first == 1 {
        return LEAF | first as u16;
    }
    let all: u64 = weights[first..end].iter().sum();
    let (mut below, mut from, mut best) = (0, first + 1, u64::MAX);
    for rank in first + 1..end {
        below += weights[rank - 1];
        let uneven = all.abs_diff(2 * below);
        if uneven < best {
            (from, best) = (rank, uneven);
        }
    }
    let node = nodes.len();
    nodes.push(TreeNode { from: from as u8, next: [0; 2] });
    let next = [(first, from), (from, end)].map(|(first, end)| build_tree(weights, first, end, nodes));
    nodes[node].next = next;
    node as u16
}

/// Probabilities of a grid's decisions.
pub(super) struct LadderModel {
    values: Vec<u8>,
    rank: [u8; 256],
    /// Rank of a value in contexts: with many values, some share one.
    rough: [u8; 256],
    roughs: usize,
    nodes: Vec<TreeNode>,
    root: u16,
    bits: Vec<AdaptiveBit>,
    uniform: AdaptiveBit,
}

/// Returns the number of contexts for this many rough ranks.
fn context_count(roughs: usize) -> usize {
    roughs * roughs * corner_count(roughs)
}

/// Returns the number of values of the two neighbours beside the one above, summed and in steps of four.
fn corner_count(roughs: usize) -> usize {
    (2 * (roughs - 1) / 4) + 1
}

impl LadderModel {
    pub(super) fn new(values: &LadderValues) -> Self {
        let count = values.count();
        let weights: Vec<u64> = values.0.iter().map(|&(_, weight)| weight_value(weight)).collect();
        let mut nodes = Vec::with_capacity(count);
        let root = build_tree(&weights, 0, count, &mut nodes);
        let mut roughs = count;
        // One more context is that of uniform blocks.
        while (context_count(roughs) + 1) * nodes.len() > BITS {
            roughs -= 1;
        }
        let (mut rank, mut rough) = ([0; 256], [0; 256]);
        for (at, &(value, _)) in values.0.iter().enumerate() {
            rank[usize::from(value)] = at as u8;
            rough[usize::from(value)] = (at * roughs / count) as u8;
        }
        Self {
            values: values.0.iter().map(|&(value, _)| value).collect(),
            rank,
            rough,
            roughs,
            bits: vec![AdaptiveBit::default(); (context_count(roughs) + 1) * nodes.len()],
            nodes,
            root,
            uniform: AdaptiveBit::default(),
        }
    }

    #[inline(always)]
    fn code_value<S: CellCoder>(&mut self, side: &mut S, context: usize, known: u8) -> u8 {
        let count = self.nodes.len();
        let bits = &mut self.bits[context * count..(context + 1) * count];
        let known = self.rank[usize::from(known)];
        let mut at = self.root;
        while at < LEAF {
            let node = self.nodes[usize::from(at)];
            let one = side.bit(&mut bits[usize::from(at)], known >= node.from);
            at = node.next[usize::from(one)];
        }
        self.values[usize::from(at - LEAF)]
    }
}

impl CellModel for LadderModel {
    fn uniform<S: CellCoder>(&mut self, side: &mut S, guess: u8, known: u8) -> u8 {
        if side.bit(&mut self.uniform, known != guess) {
            self.code_value(side, context_count(self.roughs), known)
        } else {
            guess
        }
    }

    #[inline(always)]
    fn cell<S: CellCoder>(&mut self, side: &mut S, place: CellPosition, known: u8) -> u8 {
        let cells = side.cells();
        let rough = |left, up| usize::from(self.rough[usize::from(place.neighbour(cells, left, up))]);
        let corners = (rough(1, 1) + rough(-1, 1)) / 4;
        let context = (rough(1, 0) * self.roughs + rough(0, 1)) * corner_count(self.roughs) + corners;
        self.code_value(side, context, known)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_come_back_and_common_ones_are_near_the_root() {
        let cells: Vec<u8> = (0..4096usize)
            .map(|at| match at % 16 {
                0 => 255,
                1 => 35,
                2 => 13,
                _ => 1,
            })
            .collect();
        let values = LadderValues::from_cells(&cells, 255);
        let mut bytes = Vec::new();
        values.write(&mut bytes);
        let back = LadderValues::read(&mut FrameCursor::new(&bytes)).unwrap();
        assert_eq!(back.0, values.0);
        assert_eq!(back.0.iter().map(|pair| pair.0).collect::<Vec<u8>>(), [255, 1, 13, 35]);
        let ladder = LadderModel::new(&back);
        // Unknown or above, then 1 or above, then the others.
        assert_eq!(ladder.nodes[usize::from(ladder.root)].next[0] & LEAF, 0);
        assert_eq!(ladder.nodes.len(), 3);
        bytes.swap(1, 3);
        assert!(LadderValues::read(&mut FrameCursor::new(&bytes)).is_err());
        for bad in [&[0][..], &[65], &[2, 1, 1]] {
            assert!(LadderValues::read(&mut FrameCursor::new(bad)).is_err());
        }
    }

    #[test]
    fn weights_are_near_to_the_counts() {
        for count in (1..100).chain([1000, 123_456, 16_000_000, u64::from(u32::MAX)]) {
            let (told, exact) = (weight_value(weight(count)), 4 * count);
            assert!(told <= exact && 5 * told >= 4 * exact, "{count}: {told}");
        }
        assert!((0..=255).map(weight_value).sum::<u64>() < u64::MAX / 8);
    }

    #[test]
    fn tables_stay_below_two_megabytes() {
        for count in 1..=MAX_VALUES {
            let values = LadderValues((0..count).map(|at| (at as u8, 4)).collect());
            let ladder = LadderModel::new(&values);
            assert!(ladder.bits.len() * size_of::<AdaptiveBit>() < (2 << 20) - (1 << 16), "{count}");
            assert!(ladder.roughs >= count.min(16), "{count}: {}", ladder.roughs);
        }
    }
}
