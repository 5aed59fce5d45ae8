//! Sequence and fragment numbers, and sets of them (8.3.5.4 to 8.3.5.7).

use std::fmt;

/// Sequence number of a sample of a writer, starting at 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default)]
pub struct SequenceNumber(pub i64);

impl SequenceNumber {
    /// Unknown: used in a request whose sender does not know its number.
    pub const UNKNOWN: Self = Self(-1 << 32);

    /// Returns the next number.
    pub fn next(self) -> Self {
        Self(self.0.saturating_add(1))
    }
}

impl fmt::Display for SequenceNumber {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(formatter)
    }
}

/// Number of a fragment of a sample, starting at 1.
pub type FragmentNumber = u32;

/// Maximum number of bits of a set.
pub const SPAN: u32 = 256;

/// A set of numbers from `base` on, at most 256: bit `i` (bit 0 is the highest bit of the first word) represents `base
/// + i`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NumberSet<N> {
    /// Number represented by bit 0. In an acknowledgement, all numbers before it have been received.
    pub base: N,
    /// Number of bits.
    pub bits: u32,
    words: [u32; 8],
}

/// Set of sequence numbers.
pub type SequenceSet = NumberSet<SequenceNumber>;
/// Set of fragment numbers.
pub type FragmentSet = NumberSet<FragmentNumber>;

impl<N: Copy> NumberSet<N> {
    /// Creates an empty set with this base.
    pub fn empty(base: N) -> Self {
        Self { base, bits: 0, words: [0; 8] }
    }

    /// Creates a set from its wire format; `None` if `bits` and the number of words do not match.
    pub(crate) fn from_words(base: N, bits: u32, words: &[u32]) -> Option<Self> {
        if bits > SPAN || words.len() != bits.div_ceil(32) as usize {
            return None;
        }
        let mut set = Self { base, bits, words: [0; 8] };
        set.words[..words.len()].copy_from_slice(words);
        Some(set)
    }

    /// Returns the words that contain its bits.
    pub(crate) fn words(&self) -> &[u32] {
        &self.words[..self.bits.div_ceil(32) as usize]
    }

    /// Returns whether the set is empty.
    pub fn is_empty(&self) -> bool {
        self.offsets().next().is_none()
    }

    fn set(&mut self, offset: u32) {
        self.words[(offset / 32) as usize] |= 1 << (31 - offset % 32);
        self.bits = self.bits.max(offset + 1);
    }

    fn offsets(&self) -> impl Iterator<Item = u32> + '_ {
        (0..self.bits).filter(|offset| self.words[(offset / 32) as usize] >> (31 - offset % 32) & 1 == 1)
    }
}

impl SequenceSet {
    /// Inserts a number; returns `false` if it is too far from the base.
    pub fn insert(&mut self, number: SequenceNumber) -> bool {
        let offset = number.0.saturating_sub(self.base.0);
        let fits = (0..i64::from(SPAN)).contains(&offset);
        if fits {
            self.set(offset as u32);
        }
        fits
    }

    /// Returns the numbers in ascending order.
    pub fn iter(&self) -> impl Iterator<Item = SequenceNumber> + '_ {
        self.offsets().map(|offset| SequenceNumber(self.base.0.saturating_add(i64::from(offset))))
    }
}

impl FragmentSet {
    /// Inserts a number; returns `false` if it is too far from the base.
    pub fn insert(&mut self, number: FragmentNumber) -> bool {
        let fits = number >= self.base && number - self.base < SPAN;
        if fits {
            self.set(number - self.base);
        }
        fits
    }

    /// Returns the numbers in ascending order.
    pub fn iter(&self) -> impl Iterator<Item = FragmentNumber> + '_ {
        self.offsets().map(|offset| self.base.saturating_add(offset))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_set_holds_what_was_put_in_and_no_more_than_it_can_span() {
        let mut set = SequenceSet::empty(SequenceNumber(10));
        for number in [10, 12, 45, 265] {
            assert!(set.insert(SequenceNumber(number)));
        }
        assert!(!set.insert(SequenceNumber(9)));
        assert!(!set.insert(SequenceNumber(266)));
        let held: Vec<i64> = set.iter().map(|number| number.0).collect();
        assert_eq!(held, [10, 12, 45, 265]);
        assert_eq!((set.bits, set.words().len()), (256, 8));
        assert_eq!(set.words()[0], 0b1010 << 28);
    }

    #[test]
    fn words_that_do_not_fit_their_bits_are_no_set() {
        assert!(FragmentSet::from_words(1, 257, &[0; 9]).is_none());
        assert!(FragmentSet::from_words(1, 33, &[0; 1]).is_none());
        assert!(FragmentSet::from_words(1, 0, &[]).is_some_and(|set| set.is_empty()));
    }
}
