//! Samples in fragments: how they are cut, and how they are put together again (8.3.8.3, 8.4.14.1).

use std::collections::BTreeMap;
use std::time::Instant;

use budget::Permit;
use bytes::Bytes;

use crate::sequence::{FragmentNumber, FragmentSet, SPAN};
use crate::{SampleIdentity, time::WireTime};

/// Bytes of a sample in one datagram of ours. With all headers such a datagram just fits into the kernel's 16 KiB of memory
/// for packets: a byte more, and it would count twice as much in its receiver's buffer.
pub(crate) const FRAGMENT: usize = 15_872;

/// How many fragments a sample of so many bytes has.
pub(crate) fn count(length: usize) -> FragmentNumber {
    FragmentNumber::try_from(length.div_ceil(FRAGMENT)).unwrap_or(FragmentNumber::MAX)
}

/// Fragments that came before the ones before them: at most so many are kept aside.
const MOST_ASIDE: usize = 4096;
/// What it takes to keep one of them, beside its bytes.
const KEEPING: usize = 128;
/// A shorter fragment that is kept aside is copied: it would keep its whole datagram, which may be so much longer.
const COPIED: usize = 32 << 10;

/// A sample that is not whole yet. What it holds grows with the bytes that have come, not with what was announced, and all of it
/// counts.
#[derive(Debug)]
pub(crate) struct Assembly {
    size: usize,
    fragment: usize,
    total: FragmentNumber,
    /// The first fragments, without a hole.
    whole: Vec<u8>,
    /// The one that is to come next.
    next: FragmentNumber,
    aside: BTreeMap<FragmentNumber, Bytes>,
    /// What `aside` takes.
    held_aside: usize,
    /// Counts `aside`, and the room that `whole` has.
    permit: Permit,
    /// When the last fragment came.
    pub heard: Instant,
    pub related: Option<SampleIdentity>,
    pub written: Option<WireTime>,
}

/// What became of fragments.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Progress {
    /// Some are missing yet.
    Missing,
    /// The sample is whole.
    Whole,
    /// They do not fit to what was said of the sample, or into the budget.
    Refused,
}

impl Assembly {
    /// Of a sample with so many bytes in fragments of that size; none where that cannot be.
    pub fn new(
        size: u32,
        fragment: u16,
        most: usize,
        permit: Permit,
        now: Instant,
    ) -> Option<Self> {
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

    /// Takes `count` fragments from number `first` on.
    pub fn take(
        &mut self,
        first: FragmentNumber,
        count: u16,
        payload: &Bytes,
        now: Instant,
    ) -> Progress {
        for index in 0..FragmentNumber::from(count) {
            let Some(number) = first
                .checked_add(index)
                .filter(|number| (1..=self.total).contains(number))
            else {
                return Progress::Refused;
            };
            let start = index as usize * self.fragment;
            let length = if number == self.total {
                self.size - (self.total as usize - 1) * self.fragment
            } else {
                self.fragment
            };
            // The last fragment may be padded.
            let Some(end) = start
                .checked_add(length)
                .filter(|end| *end <= payload.len())
            else {
                return Progress::Refused;
            };
            if !self.keep(number, payload.slice(start..end)) {
                return Progress::Refused;
            }
        }
        self.heard = now;
        if self.next > self.total {
            Progress::Whole
        } else {
            Progress::Missing
        }
    }

    fn keep(&mut self, number: FragmentNumber, bytes: Bytes) -> bool {
        if number < self.next || self.aside.contains_key(&number) {
            return true;
        }
        if number > self.next {
            return self.keep_aside(number, bytes);
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

    fn keep_aside(&mut self, number: FragmentNumber, bytes: Bytes) -> bool {
        let held = bytes.len() + KEEPING;
        if self.aside.len() >= MOST_ASIDE || !self.count(self.whole.capacity(), held) {
            return false;
        }
        self.held_aside += held;
        let bytes = match bytes.len() < COPIED {
            true => Bytes::copy_from_slice(&bytes),
            false => bytes,
        };
        self.aside.insert(number, bytes);
        true
    }

    /// Counts so much room for the first fragments, and so much more aside; whether it fits.
    fn count(&mut self, whole: usize, more: usize) -> bool {
        self.permit.resize(whole + self.held_aside + more).is_ok()
    }

    fn append(&mut self, bytes: &[u8]) -> bool {
        if self.whole.capacity() - self.whole.len() < bytes.len() {
            // Twice what has come, at most the whole.
            let most = self.size - self.whole.len();
            let more = self.whole.len().max(bytes.len()).min(most);
            if !self.count(self.whole.len() + more, 0) {
                return false;
            }
            self.whole.reserve_exact(more);
        }
        self.whole.extend_from_slice(bytes);
        self.next += 1;
        true
    }

    /// Which fragments are missing among the first 256 from the first missing one on; all that are up to `last`.
    pub fn missing(&self, last: FragmentNumber) -> FragmentSet {
        let mut set = FragmentSet::empty(self.next);
        let until = last.min(self.total).min(self.next.saturating_add(SPAN - 1));
        for number in self.next..=until {
            if !self.aside.contains_key(&number) {
                set.insert(number);
            }
        }
        set
    }

    /// The whole sample, which counts in its budget until it is dropped.
    pub fn into_bytes(self) -> Bytes {
        let Self {
            whole, mut permit, ..
        } = self;
        // Less than before, if anything: it cannot be refused.
        let _ = permit.resize(whole.capacity());
        permit.around(whole)
    }
}

#[cfg(test)]
mod tests {
    use budget::Budget;

    use super::*;

    fn assembly(size: u32, fragment: u16) -> Option<Assembly> {
        Assembly::new(
            size,
            fragment,
            1 << 20,
            Budget::unlimited().permit(),
            Instant::now(),
        )
    }

    #[test]
    fn fragments_in_any_order_make_the_sample() {
        let sample: Vec<u8> = (0..25).collect();
        let mut assembly = assembly(25, 10).expect("a size that fits");
        let now = Instant::now();
        let part = |range: std::ops::Range<usize>| Bytes::copy_from_slice(&sample[range]);
        assert_eq!(assembly.take(3, 1, &part(20..25), now), Progress::Missing);
        assert_eq!(
            assembly.missing(u32::MAX).iter().collect::<Vec<_>>(),
            [1, 2]
        );
        assert_eq!(assembly.take(1, 1, &part(0..10), now), Progress::Missing);
        assert_eq!(assembly.take(1, 1, &part(0..10), now), Progress::Missing);
        assert_eq!(assembly.missing(u32::MAX).iter().collect::<Vec<_>>(), [2]);
        assert_eq!(assembly.take(2, 1, &part(10..20), now), Progress::Whole);
        assert_eq!(assembly.into_bytes(), sample);
    }

    #[test]
    fn several_fragments_may_come_at_once() {
        let sample: Vec<u8> = (0..25).collect();
        let mut assembly = assembly(25, 10).expect("a size that fits");
        assert_eq!(
            assembly.take(1, 3, &Bytes::from(sample.clone()), Instant::now()),
            Progress::Whole
        );
        assert_eq!(assembly.into_bytes(), sample);
    }

    #[test]
    fn what_cannot_be_is_refused() {
        assert!(assembly(10, 0).is_none());
        assert!(assembly(0, 10).is_none());
        assert!(assembly(2 << 20, 1000).is_none());
        let mut assembly = assembly(25, 10).expect("a size that fits");
        let now = Instant::now();
        assert_eq!(
            assembly.take(0, 1, &Bytes::from_static(&[0; 10]), now),
            Progress::Refused
        );
        assert_eq!(
            assembly.take(4, 1, &Bytes::from_static(&[0; 10]), now),
            Progress::Refused
        );
        assert_eq!(
            assembly.take(1, 1, &Bytes::from_static(&[0; 9]), now),
            Progress::Refused
        );
        assert_eq!(
            assembly.take(3, 1, &Bytes::from_static(&[0; 8]), now),
            Progress::Missing
        );
    }

    #[test]
    fn an_announced_size_costs_nothing_until_bytes_come() {
        let budget = Budget::new("test", 1000);
        let mut assembly = Assembly::new(1 << 20, 600, 1 << 20, budget.permit(), Instant::now())
            .expect("a size that fits");
        assert_eq!(budget.used(), 0);
        let now = Instant::now();
        assert_eq!(
            assembly.take(1, 1, &Bytes::from_static(&[0; 600]), now),
            Progress::Missing
        );
        assert_eq!(
            assembly.take(2, 1, &Bytes::from_static(&[0; 600]), now),
            Progress::Refused
        );
        drop(assembly);
        assert_eq!(budget.used(), 0);
    }

    #[test]
    fn what_is_kept_of_short_fragments_counts_as_what_it_takes() {
        let budget = Budget::new("test", 1 << 20);
        let mut assembly = Assembly::new(1 << 16, 1, 1 << 20, budget.permit(), Instant::now())
            .expect("a size that fits");
        let now = Instant::now();
        let datagram = Bytes::from(vec![0; 60_000]);
        for number in 2..2 + MOST_ASIDE as u32 {
            assert_eq!(assembly.take(number, 1, &datagram, now), Progress::Missing);
        }
        assert!(datagram.is_unique(), "a byte keeps its datagram");
        assert_eq!(budget.used(), MOST_ASIDE * (1 + KEEPING));
        assert_eq!(assembly.take(1, 1, &datagram, now), Progress::Missing);
        assert_eq!(assembly.next, 2 + MOST_ASIDE as u32);
        assert!(assembly.whole.capacity() <= budget.used());
        drop(assembly);
        assert_eq!(budget.used(), 0);
    }

    #[test]
    fn a_whole_sample_counts_as_its_bytes() {
        let budget = Budget::new("test", 1 << 20);
        let mut assembly = Assembly::new(3000, 1000, 1 << 20, budget.permit(), Instant::now())
            .expect("a size that fits");
        let now = Instant::now();
        for number in [3, 2, 1] {
            assembly.take(number, 1, &Bytes::from(vec![0; 1000]), now);
        }
        let whole = assembly.into_bytes();
        assert_eq!((whole.len(), budget.used()), (3000, 3000));
        drop(whole);
        assert_eq!(budget.used(), 0);
    }
}
