//! Cells of many shades, as mappers leave them that count how often each cell was seen free or occupied: few values,
//! the rungs of a ladder, each next to others by chance.
//!
//! A cell is told as its rank among the grid's values, in the context of its neighbours' ranks: that to the left, that
//! above, and, roughly, those beside the latter. The rank is told by decisions down a tree in which values that are
//! common are near the root, and in which values of either side of a decision are neighbours on the ladder.
//!
//! Told in front: `count of values · (value · weight)…`.

use super::cells::{Place, Side, Tell};
use crate::Error;
use crate::entropy::binary::Bit;
use crate::wire::Cursor;

/// Grids of more values are pictures.
pub(super) const MOST: usize = 64;
/// Decisions of all contexts together, at most: they take six bytes each, and a decoder has two MiB for tables.
const BITS: usize = 330_000;
/// In a node, what is a value and no further node.
const LEAF: u16 = 1 << 8;

/// The values of a grid, in the order of the ladder, and how common each is.
pub(super) struct Values(Vec<(u8, u8)>);

impl Values {
    /// Those of `cells`; most of what is `background` does not count.
    pub(super) fn of(cells: &[u8], background: u8) -> Self {
        const STEP: usize = 64;
        let mut counts = [0u64; 256];
        counts[usize::from(background)] = 1;
        for chunk in cells.chunks(STEP) {
            if *chunk != [background; STEP][..chunk.len()] {
                chunk
                    .iter()
                    .for_each(|&cell| counts[usize::from(cell)] += 1);
            }
        }
        let ladder = (i8::MIN..=i8::MAX).map(|value| value as u8);
        let seen = ladder.filter(|&value| counts[usize::from(value)] > 0);
        Self(
            seen.map(|value| (value, weight(counts[usize::from(value)])))
                .collect(),
        )
    }

    pub(super) fn count(&self) -> usize {
        self.0.len()
    }

    pub(super) fn write(&self, out: &mut Vec<u8>) {
        out.push(self.0.len() as u8);
        self.0
            .iter()
            .for_each(|&(value, weight)| out.extend_from_slice(&[value, weight]));
    }

    pub(super) fn read(input: &mut Cursor<'_>) -> Result<Self, Error> {
        let count = usize::from(input.byte()?);
        if count == 0 || count > MOST {
            return Err(Error::Corrupt("a grid of no values, or of too many"));
        }
        let pairs = input.take(2 * count)?.chunks_exact(2);
        let values: Vec<(u8, u8)> = pairs.map(|pair| (pair[0], pair[1])).collect();
        if values.is_sorted_by(|a, b| (a.0 as i8) < (b.0 as i8)) {
            Ok(Self(values))
        } else {
            Err(Error::Corrupt(
                "values of a grid that are not in their order",
            ))
        }
    }
}

/// A count in one byte: its logarithm to the base of two, in quarters.
fn weight(count: u64) -> u8 {
    let whole = count.ilog2();
    ((whole as u8) << 2) | (((count << 2) >> whole) & 3) as u8
}

/// What a weight stands for, in quarters; that of counts beyond any grid's is as large as theirs.
fn common(weight: u8) -> u64 {
    u64::from(4 | (weight & 3)) << (weight >> 2).min(48)
}

/// A decision: whether the rank is `from` or more, and what is next if not, and if.
#[derive(Clone, Copy)]
struct Node {
    from: u8,
    next: [u16; 2],
}

/// Makes the tree of the values `first` to `end`; which node it is, or which value.
fn tree(weights: &[u64], first: usize, end: usize, nodes: &mut Vec<Node>) -> u16 {
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
    nodes.push(Node {
        from: from as u8,
        next: [0; 2],
    });
    let next = [(first, from), (from, end)].map(|(first, end)| tree(weights, first, end, nodes));
    nodes[node].next = next;
    node as u16
}

/// Probabilities of a grid's decisions.
pub(super) struct Ladder {
    values: Vec<u8>,
    rank: [u8; 256],
    /// A value's rank as contexts have it: of many values, some are alike there.
    rough: [u8; 256],
    roughs: usize,
    nodes: Vec<Node>,
    root: u16,
    bits: Vec<Bit>,
    uniform: Bit,
}

/// Contexts by the neighbours' rough ranks.
fn contexts(roughs: usize) -> usize {
    roughs * roughs * beside(roughs)
}

/// What the two neighbours beside that above can be, together and by fours.
fn beside(roughs: usize) -> usize {
    (2 * (roughs - 1) / 4) + 1
}

impl Ladder {
    pub(super) fn new(values: &Values) -> Self {
        let count = values.count();
        let weights: Vec<u64> = values.0.iter().map(|&(_, weight)| common(weight)).collect();
        let mut nodes = Vec::with_capacity(count);
        let root = tree(&weights, 0, count, &mut nodes);
        let mut roughs = count;
        // One context more is that of blocks of one value.
        while (contexts(roughs) + 1) * nodes.len() > BITS {
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
            bits: vec![Bit::default(); (contexts(roughs) + 1) * nodes.len()],
            nodes,
            root,
            uniform: Bit::default(),
        }
    }

    #[inline(always)]
    fn value<S: Side>(&mut self, side: &mut S, context: usize, known: u8) -> u8 {
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

impl Tell for Ladder {
    fn uniform<S: Side>(&mut self, side: &mut S, guess: u8, known: u8) -> u8 {
        if side.bit(&mut self.uniform, known != guess) {
            self.value(side, contexts(self.roughs), known)
        } else {
            guess
        }
    }

    #[inline(always)]
    fn cell<S: Side>(&mut self, side: &mut S, place: Place, known: u8) -> u8 {
        let cells = side.cells();
        let rough = |left, up| usize::from(self.rough[usize::from(place.near(cells, left, up))]);
        let corners = (rough(1, 1) + rough(-1, 1)) / 4;
        let context = (rough(1, 0) * self.roughs + rough(0, 1)) * beside(self.roughs) + corners;
        self.value(side, context, known)
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
        let values = Values::of(&cells, 255);
        let mut bytes = Vec::new();
        values.write(&mut bytes);
        let back = Values::read(&mut Cursor::new(&bytes)).unwrap();
        assert_eq!(back.0, values.0);
        assert_eq!(
            back.0.iter().map(|pair| pair.0).collect::<Vec<u8>>(),
            [255, 1, 13, 35]
        );
        let ladder = Ladder::new(&back);
        // Unknown or above, then 1 or above, then the others.
        assert_eq!(ladder.nodes[usize::from(ladder.root)].next[0] & LEAF, 0);
        assert_eq!(ladder.nodes.len(), 3);
        bytes.swap(1, 3);
        assert!(Values::read(&mut Cursor::new(&bytes)).is_err());
        for bad in [&[0][..], &[65], &[2, 1, 1]] {
            assert!(Values::read(&mut Cursor::new(bad)).is_err());
        }
    }

    #[test]
    fn weights_are_near_to_the_counts() {
        for count in (1..100).chain([1000, 123_456, 16_000_000, u64::from(u32::MAX)]) {
            let (told, exact) = (common(weight(count)), 4 * count);
            assert!(told <= exact && 5 * told >= 4 * exact, "{count}: {told}");
        }
        assert!((0..=255).map(common).sum::<u64>() < u64::MAX / 8);
    }

    #[test]
    fn tables_stay_below_two_megabytes() {
        for count in 1..=MOST {
            let values = Values((0..count).map(|at| (at as u8, 4)).collect());
            let ladder = Ladder::new(&values);
            assert!(
                ladder.bits.len() * size_of::<Bit>() < (2 << 20) - (1 << 16),
                "{count}"
            );
            assert!(ladder.roughs >= count.min(16), "{count}: {}", ladder.roughs);
        }
    }
}
