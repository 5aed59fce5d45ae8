//! Fragmentation and reassembly of samples (8.3.8.3, 8.4.14.1).

use std::collections::BTreeMap;
use std::time::Instant;

use budget::Permit;
use bytes::Bytes;

use crate::sequence::{FragmentNumber, FragmentSet, SPAN};
use crate::{SampleIdentity, time::WireTime};

/// Payload bytes of a fragment. With all headers such a datagram just fits into the kernel's 16 KiB of packet memory;
/// one byte more would count twice as much in the receiver's buffer.
pub(crate) const FRAGMENT: usize = 15_872;

/// Returns the number of fragments of a sample of this length.
pub(crate) fn fragment_count(length: usize) -> FragmentNumber {
    FragmentNumber::try_from(length.div_ceil(FRAGMENT)).unwrap_or(FragmentNumber::MAX)
}

/// Maximum number of out-of-order fragments that are kept.
const MOST_ASIDE: usize = 4096;
/// Overhead of a kept fragment in bytes.
const KEEPING: usize = 128;
/// Length below which an out-of-order fragment is copied; otherwise it would keep its whole datagram, which may be much
/// longer.
const MAX_COPIED: usize = 32 << 10;

/// An incomplete sample. Its memory grows with the bytes received, not with the announced size, and is charged to the
/// budget.
#[derive(Debug)]
pub(crate) struct Assembly {
    size: usize,
    fragment: usize,
    total: FragmentNumber,
    /// The first fragments without a gap.
    whole: Vec<u8>,
    /// Number of the next fragment in order.
    next: FragmentNumber,
    aside: BTreeMap<FragmentNumber, Bytes>,
    /// Memory of `aside`.
    held_aside: usize,
    /// Permit for `aside` and the capacity of `whole`.
    permit: Permit,
    /// Time at which the last fragment was received.
    pub heard: Instant,
    pub related: Option<SampleIdentity>,
    pub written: Option<WireTime>,
}

/// Result of adding fragments.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Progress {
    /// Fragments are still missing.
    Missing,
    /// The sample is complete.
    Whole,
    /// The fragments are inconsistent with the sample, or exceed the budget.
    Refused,
}

impl Assembly {
    /// Creates the assembly of a sample of `size` bytes in fragments of `fragment` bytes; `None` if the sizes are
    /// invalid.
    pub fn new(size: u32, fragment: u16, most: usize, permit: Permit, now: Instant) -> Option<Self> {
        let (size, fragment) = (usize::try_from(size).ok()?, usize::from(fragment));
        if fragment == 0 || size == 0 || size > most {
            return None;
        }
        let total = FragmentNumber::try_from(size.div_ceil(fragment)).ok()?;
        Some(Self {
            size,
            fragment,
            total,
            whole: Vec::new(),
            next: 1,
            aside: BTreeMap::new(),
            held_aside: 0,
            permit,
            heard: now,
            related: None,
            written: None,
        })
    }

    /// Adds `count` fragments from number `first` on.
    pub fn add_fragments(&mut self, first: FragmentNumber, count: u16, payload: &Bytes, now: Instant) -> Progress {
        for index in 0..FragmentNumber::from(count) {
            let Some(number) = first.checked_add(index).filter(|number| (1..=self.total).contains(number)) else {
                return Progress::Refused;
            };
            let start = index as usize * self.fragment;
            let length = if number == self.total {
                self.size - (self.total as usize - 1) * self.fragment
            } else {
                self.fragment
            };
            // The last fragment may be padded.
            let Some(end) = start.checked_add(length).filter(|end| *end <= payload.len()) else {
                return Progress::Refused;
            };
            if !self.store(number, payload.slice(start..end)) {
                return Progress::Refused;
            }
        }
        self.heard = now;
        if self.next > self.total { Progress::Whole } else { Progress::Missing }
    }

    fn store(&mut self, number: FragmentNumber, bytes: Bytes) -> bool {
        if number < self.next || self.aside.contains_key(&number) {
            return true;
        }
        if number > self.next {
            return self.store_out_of_order(number, bytes);
        }
        if !self.append(&bytes) {
            return false;
        }
        while let Some(bytes) = self.aside.remove(&self.next) {
            self.held_aside -= bytes.len() + KEEPING;
            if !self.append(&bytes) {
                return false;
            }
        }
        true
    }

    fn store_out_of_order(&mut self, number: FragmentNumber, bytes: Bytes) -> bool {
        let held = bytes.len() + KEEPING;
        if self.aside.len() >= MOST_ASIDE || !self.charge(self.whole.capacity(), held) {
            return false;
        }
        self.held_aside += held;
        let bytes = if bytes.len() < MAX_COPIED { Bytes::copy_from_slice(&bytes) } else { bytes };
        self.aside.insert(number, bytes);
        true
    }

    /// Charges the capacity for the first fragments and additional out-of-order memory; returns whether it fits.
    fn charge(&mut self, whole: usize, more: usize) -> bool {
        self.permit.resize(whole + self.held_aside + more).is_ok()
    }

    fn append(&mut self, bytes: &[u8]) -> bool {
        if self.whole.capacity() - self.whole.len() < bytes.len() {
            // Doubles the capacity, up to the size of the sample.
            let most = self.size - self.whole.len();
            let more = self.whole.len().max(bytes.len()).min(most);
            if !self.charge(self.whole.len() + more, 0) {
                return false;
            }
            self.whole.reserve_exact(more);
        }
        self.whole.extend_from_slice(bytes);
        self.next += 1;
        true
    }

    /// Returns the missing fragments up to `last`, among the 256 from the first missing one on.
    pub fn missing_fragments(&self, last: FragmentNumber) -> FragmentSet {
        let mut set = FragmentSet::empty(self.next);
        let until = last.min(self.total).min(self.next.saturating_add(SPAN - 1));
        for number in self.next..=until {
            if !self.aside.contains_key(&number) {
                set.insert(number);
            }
        }
        set
    }

    /// Returns the complete sample, which is charged to its budget until it is dropped.
    pub fn into_bytes(self) -> Bytes {
        let Self { whole, mut permit, .. } = self;
        // It shrinks if anything, so it cannot be refused.
        let _ = permit.resize(whole.capacity());
        permit.wrap_bytes(whole)
    }
}

#[cfg(test)]
mod tests {
    use budget::Budget;

    use super::*;

    fn assembly(size: u32, fragment: u16) -> Option<Assembly> {
        Assembly::new(size, fragment, 1 << 20, Budget::without_limit().permit(), Instant::now())
    }

    #[test]
    fn fragments_in_any_order_make_the_sample() {
        let sample: Vec<u8> = (0..25).collect();
        let mut assembly = assembly(25, 10).expect("a size that fits");
        let now = Instant::now();
        let part = |range: std::ops::Range<usize>| Bytes::copy_from_slice(&sample[range]);
        assert_eq!(assembly.add_fragments(3, 1, &part(20..25), now), Progress::Missing);
        assert_eq!(assembly.missing_fragments(u32::MAX).iter().collect::<Vec<_>>(), [1, 2]);
        assert_eq!(assembly.add_fragments(1, 1, &part(0..10), now), Progress::Missing);
        assert_eq!(assembly.add_fragments(1, 1, &part(0..10), now), Progress::Missing);
        assert_eq!(assembly.missing_fragments(u32::MAX).iter().collect::<Vec<_>>(), [2]);
        assert_eq!(assembly.add_fragments(2, 1, &part(10..20), now), Progress::Whole);
        assert_eq!(assembly.into_bytes(), sample);
    }

    #[test]
    fn several_fragments_may_come_at_once() {
        let sample: Vec<u8> = (0..25).collect();
        let mut assembly = assembly(25, 10).expect("a size that fits");
        assert_eq!(assembly.add_fragments(1, 3, &Bytes::from(sample.clone()), Instant::now()), Progress::Whole);
        assert_eq!(assembly.into_bytes(), sample);
    }

    #[test]
    fn impossible_fragments_are_refused() {
        assert!(assembly(10, 0).is_none());
        assert!(assembly(0, 10).is_none());
        assert!(assembly(2 << 20, 1000).is_none());
        let mut assembly = assembly(25, 10).expect("a size that fits");
        let now = Instant::now();
        assert_eq!(assembly.add_fragments(0, 1, &Bytes::from_static(&[0; 10]), now), Progress::Refused);
        assert_eq!(assembly.add_fragments(4, 1, &Bytes::from_static(&[0; 10]), now), Progress::Refused);
        assert_eq!(assembly.add_fragments(1, 1, &Bytes::from_static(&[0; 9]), now), Progress::Refused);
        assert_eq!(assembly.add_fragments(3, 1, &Bytes::from_static(&[0; 8]), now), Progress::Missing);
    }

    #[test]
    fn an_announced_size_costs_nothing_until_bytes_come() {
        let budget = Budget::new("test", 1000);
        let mut assembly =
            Assembly::new(1 << 20, 600, 1 << 20, budget.permit(), Instant::now()).expect("a size that fits");
        assert_eq!(budget.used_bytes(), 0);
        let now = Instant::now();
        assert_eq!(assembly.add_fragments(1, 1, &Bytes::from_static(&[0; 600]), now), Progress::Missing);
        assert_eq!(assembly.add_fragments(2, 1, &Bytes::from_static(&[0; 600]), now), Progress::Refused);
        drop(assembly);
        assert_eq!(budget.used_bytes(), 0);
    }

    #[test]
    fn stored_short_fragments_are_charged_with_their_overhead() {
        let budget = Budget::new("test", 1 << 20);
        let mut assembly =
            Assembly::new(1 << 16, 1, 1 << 20, budget.permit(), Instant::now()).expect("a size that fits");
        let now = Instant::now();
        let datagram = Bytes::from(vec![0; 60_000]);
        for number in 2..2 + MOST_ASIDE as u32 {
            assert_eq!(assembly.add_fragments(number, 1, &datagram, now), Progress::Missing);
        }
        assert!(datagram.is_unique(), "a byte keeps its datagram");
        assert_eq!(budget.used_bytes(), MOST_ASIDE * (1 + KEEPING));
        assert_eq!(assembly.add_fragments(1, 1, &datagram, now), Progress::Missing);
        assert_eq!(assembly.next, 2 + MOST_ASIDE as u32);
        assert!(assembly.whole.capacity() <= budget.used_bytes());
        drop(assembly);
        assert_eq!(budget.used_bytes(), 0);
    }

    #[test]
    fn a_whole_sample_counts_as_its_bytes() {
        let budget = Budget::new("test", 1 << 20);
        let mut assembly =
            Assembly::new(3000, 1000, 1 << 20, budget.permit(), Instant::now()).expect("a size that fits");
        let now = Instant::now();
        for number in [3, 2, 1] {
            assembly.add_fragments(number, 1, &Bytes::from(vec![0; 1000]), now);
        }
        let whole = assembly.into_bytes();
        assert_eq!((whole.len(), budget.used_bytes()), (3000, 3000));
        drop(whole);
        assert_eq!(budget.used_bytes(), 0);
    }
}
