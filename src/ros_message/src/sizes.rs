//! Sizes of messages at a servant's inputs: bytes, and width and height where the type has them.

mod extent;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use parking_lot::Mutex;

use crate::schema::MessageType;
pub use extent::Extent;

/// Maximum number of inputs tracked, because clients choose topic names.
const MAX_INPUTS: usize = 64;
/// Number of size classes per power of two.
const PARTS: usize = 4;

/// Size statistics of one input.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct SizeSummary {
    /// Number of messages.
    pub count: u64,
    /// Size of the largest message in bytes.
    pub largest: u64,
    /// Approximate median size in bytes, rounded up by less than a quarter.
    pub typical: u64,
    /// Greatest width in pixels, cells or points; `None` if the type has no width.
    pub width: Option<u64>,
    /// Greatest height; `None` if the type has no height.
    pub height: Option<u64>,
}

/// Size counters of one input; lock-free.
#[derive(Debug)]
pub struct SizeCounters {
    extent: Option<Extent>,
    largest: AtomicU64,
    width: AtomicU64,
    height: AtomicU64,
    classes: [AtomicU64; 64 * PARTS],
}

impl SizeCounters {
    /// Creates counters for messages of this type.
    pub fn for_type(message: Option<&MessageType>) -> SizeCounters {
        SizeCounters {
            extent: message.and_then(Extent::for_type),
            largest: AtomicU64::new(0),
            width: AtomicU64::new(0),
            height: AtomicU64::new(0),
            classes: [const { AtomicU64::new(0) }; 64 * PARTS],
        }
    }

    /// Records a message.
    pub fn record(&self, message: &[u8]) {
        let bytes = message.len() as u64;
        self.classes[size_class(bytes)].fetch_add(1, Ordering::Relaxed);
        raise_maximum(&self.largest, bytes);
        let extent = self.extent.as_ref().and_then(|extent| extent.find(message));
        if let Some((width, height)) = extent {
            raise_maximum(&self.width, width);
            raise_maximum(&self.height, height);
        }
    }

    /// Returns the statistics so far.
    pub fn summary(&self) -> SizeSummary {
        let counts = self.classes.each_ref();
        let counts = counts.map(|count| count.load(Ordering::Relaxed));
        let count: u64 = counts.iter().sum();
        let largest = self.largest.load(Ordering::Relaxed);
        let mut passed = 0;
        let half = counts.iter().position(|more| {
            passed += more;
            passed >= count.div_ceil(2)
        });
        let typical = half.map_or(0, class_limit).min(largest);
        let side = |side: &AtomicU64| Some(side.load(Ordering::Relaxed)).filter(|side| *side > 0);
        SizeSummary { count, largest, typical, width: side(&self.width), height: side(&self.height) }
    }
}

/// Raises a maximum. Most messages are no larger than an earlier one, and a load costs less than a store.
fn raise_maximum(most: &AtomicU64, to: u64) {
    if most.load(Ordering::Relaxed) < to {
        most.fetch_max(to, Ordering::Relaxed);
    }
}

/// Returns the size class; sizes within a class differ by less than a quarter.
fn size_class(bytes: u64) -> usize {
    let bytes = bytes.max(PARTS as u64);
    let power = bytes.ilog2() as usize;
    power * PARTS + (bytes >> (power - 2)) as usize % PARTS
}

/// Returns the largest size in a class.
fn class_limit(class: usize) -> u64 {
    let (power, part) = (class / PARTS, (class % PARTS) as u128);
    let next = ((PARTS as u128 + part + 1) << power) / PARTS as u128;
    u64::try_from(next - 1).unwrap_or(u64::MAX)
}

/// The size counters of one servant's inputs, by topic or service.
#[derive(Debug, Default)]
pub struct InputSizes {
    by_name: Mutex<BTreeMap<String, (String, Arc<SizeCounters>)>>,
}

impl InputSizes {
    /// Returns the counters for an input. Beyond the maximum number of inputs, the counters are returned but not kept.
    pub fn for_input(&self, name: &str, message: Option<&MessageType>) -> Arc<SizeCounters> {
        let digest = message.map_or("", MessageType::md5);
        let mut by_name = self.by_name.lock();
        if let Some((known, sizes)) = by_name.get(name) {
            if known == digest {
                return Arc::clone(sizes);
            }
        }
        let sizes = Arc::new(SizeCounters::for_type(message));
        if by_name.len() < MAX_INPUTS || by_name.contains_key(name) {
            let entry = (digest.to_owned(), Arc::clone(&sizes));
            by_name.insert(name.to_owned(), entry);
        }
        sizes
    }

    /// Returns the statistics of all inputs.
    pub fn summaries(&self) -> Vec<(String, SizeSummary)> {
        let by_name = self.by_name.lock();
        let seen = by_name.iter();
        seen.map(|(name, (_, sizes))| (name.clone(), sizes.summary())).collect()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::schema::Registry;

    #[test]
    fn what_passed_is_told_by_input() {
        let registry = Registry::new();
        registry.insert("a/Grid", "uint8 x\nint32 width\nuint16 height\nuint8[] data").expect("valid");
        let grid = registry.message("a/Grid").expect("known");
        let inputs = InputSizes::default();
        let sizes = inputs.for_input("/map", Some(&grid));
        let message = |width: i32, height: u16, data: usize| {
            let mut bytes = vec![7];
            bytes.extend(width.to_le_bytes());
            bytes.extend(height.to_le_bytes());
            bytes.extend((data as u32).to_le_bytes());
            bytes.resize(bytes.len() + data, 0);
            bytes
        };
        for (width, height) in [(30, 20), (10, 50), (-1, 9000)] {
            sizes.record(&message(width, height, 89));
        }
        sizes.record(&message(1, 1, 9989));
        inputs.for_input("/text", None).record(b"1234");
        let seen = inputs.summaries();
        let map = SizeSummary { count: 4, largest: 10_000, typical: 111, width: Some(30), height: Some(50) };
        let text = SizeSummary { count: 1, largest: 4, typical: 4, width: None, height: None };
        assert_eq!(seen, [("/map".to_owned(), map), ("/text".to_owned(), text)]);
        assert!(Arc::ptr_eq(&inputs.for_input("/map", Some(&grid)), &sizes));
        // A new type starts with empty statistics.
        let other = inputs.for_input("/map", None);
        assert_eq!(other.summary(), SizeSummary::default());
    }

    #[test]
    fn clients_cannot_make_it_grow() {
        let inputs = InputSizes::default();
        for number in 0..2 * MAX_INPUTS {
            inputs.for_input(&format!("/topic{number}"), None).record(b"");
        }
        assert_eq!(inputs.summaries().len(), MAX_INPUTS);
        let late = inputs.for_input("/topic0", None);
        late.record(b"");
        assert_eq!(inputs.summaries()[0].1.count, 2, "those there are go on");
    }

    proptest! {
        #[test]
        fn half_of_all_are_as_typical_says(mut sizes in prop::collection::vec(0usize..100_000, 1..60)) {
            let seen = SizeCounters::for_type(None);
            for size in &sizes {
                seen.record(&vec![0; *size]);
            }
            sizes.sort_unstable();
            let (median, largest) = (sizes[(sizes.len() - 1) / 2] as u64, sizes[sizes.len() - 1] as u64);
            let SizeSummary { typical, largest: told, count, .. } = seen.summary();
            prop_assert_eq!((told, count), (largest, sizes.len() as u64));
            prop_assert!(typical >= median && typical <= largest);
            prop_assert!(typical <= median + median / 4 + 4, "{} {}", typical, median);
        }

        #[test]
        fn classes_follow_each_other(bytes in 4u64..u64::MAX / 2) {
            let of = size_class(bytes);
            prop_assert!(class_limit(of) >= bytes && (of == 2 * PARTS || class_limit(of - 1) < bytes));
        }
    }
}
