//! How large the messages of inputs are, as they pass: bytes, and width and height where their types say them.

mod extent;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use parking_lot::Mutex;

use crate::schema::MessageType;
pub use extent::Extent;

/// Inputs of which the sizes are kept; clients name topics as they like.
const MOST: usize = 64;
/// Of each power of two, so many classes of sizes.
const PARTS: usize = 4;

/// What was seen of one input.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Seen {
    /// Messages.
    pub count: u64,
    /// Bytes of the largest.
    pub largest: u64,
    /// Half of them have at most so many bytes, a quarter more at most.
    pub typical: u64,
    /// The greatest width, in pixels, cells or points; none where the type has none.
    pub width: Option<u64>,
    /// The greatest height.
    pub height: Option<u64>,
}

/// What is counted of one input. Never locks.
#[derive(Debug)]
pub struct Sizes {
    extent: Option<Extent>,
    largest: AtomicU64,
    width: AtomicU64,
    height: AtomicU64,
    classes: [AtomicU64; 64 * PARTS],
}

impl Sizes {
    /// Of messages of this type.
    pub fn of(message: Option<&MessageType>) -> Sizes {
        Sizes {
            extent: message.and_then(Extent::of),
            largest: AtomicU64::new(0),
            width: AtomicU64::new(0),
            height: AtomicU64::new(0),
            classes: [const { AtomicU64::new(0) }; 64 * PARTS],
        }
    }

    /// A message has passed.
    pub fn note(&self, message: &[u8]) {
        let bytes = message.len() as u64;
        self.classes[class(bytes)].fetch_add(1, Ordering::Relaxed);
        raise(&self.largest, bytes);
        let extent = self.extent.as_ref().and_then(|extent| extent.find(message));
        if let Some((width, height)) = extent {
            raise(&self.width, width);
            raise(&self.height, height);
        }
    }

    /// What was seen so far.
    pub fn seen(&self) -> Seen {
        let counts = self.classes.each_ref();
        let counts = counts.map(|count| count.load(Ordering::Relaxed));
        let count: u64 = counts.iter().sum();
        let largest = self.largest.load(Ordering::Relaxed);
        let mut passed = 0;
        let half = counts.iter().position(|more| {
            passed += more;
            passed >= count.div_ceil(2)
        });
        let typical = half.map_or(0, bound).min(largest);
        let side = |side: &AtomicU64| Some(side.load(Ordering::Relaxed)).filter(|side| *side > 0);
        Seen {
            count,
            largest,
            typical,
            width: side(&self.width),
            height: side(&self.height),
        }
    }
}

/// Most messages are no larger than one before; looking costs less than writing.
fn raise(most: &AtomicU64, to: u64) {
    if most.load(Ordering::Relaxed) < to {
        most.fetch_max(to, Ordering::Relaxed);
    }
}

/// Sizes of one class differ by less than a quarter.
fn class(bytes: u64) -> usize {
    let bytes = bytes.max(PARTS as u64);
    let power = bytes.ilog2() as usize;
    power * PARTS + (bytes >> (power - 2)) as usize % PARTS
}

/// The largest size of a class.
fn bound(class: usize) -> u64 {
    let (power, part) = (class / PARTS, (class % PARTS) as u128);
    let next = ((PARTS as u128 + part + 1) << power) / PARTS as u128;
    u64::try_from(next - 1).unwrap_or(u64::MAX)
}

/// The inputs of one servant, by topic or service.
#[derive(Debug, Default)]
pub struct Inputs {
    by_name: Mutex<BTreeMap<String, (String, Arc<Sizes>)>>,
}

impl Inputs {
    /// Where the sizes of this input's messages are noted. Of more inputs than are kept it is not looked at.
    pub fn of(&self, name: &str, message: Option<&MessageType>) -> Arc<Sizes> {
        let digest = message.map_or("", MessageType::md5);
        let mut by_name = self.by_name.lock();
        if let Some((known, sizes)) = by_name.get(name) {
            if known == digest {
                return Arc::clone(sizes);
            }
        }
        let sizes = Arc::new(Sizes::of(message));
        if by_name.len() < MOST || by_name.contains_key(name) {
            let entry = (digest.to_owned(), Arc::clone(&sizes));
            by_name.insert(name.to_owned(), entry);
        }
        sizes
    }

    /// What was seen of each.
    pub fn seen(&self) -> Vec<(String, Seen)> {
        let by_name = self.by_name.lock();
        let seen = by_name.iter();
        seen.map(|(name, (_, sizes))| (name.clone(), sizes.seen()))
            .collect()
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
        registry
            .insert(
                "a/Grid",
                "uint8 x\nint32 width\nuint16 height\nuint8[] data",
            )
            .expect("valid");
        let grid = registry.message("a/Grid").expect("known");
        let inputs = Inputs::default();
        let sizes = inputs.of("/map", Some(&grid));
        let message = |width: i32, height: u16, data: usize| {
            let mut bytes = vec![7];
            bytes.extend(width.to_le_bytes());
            bytes.extend(height.to_le_bytes());
            bytes.extend((data as u32).to_le_bytes());
            bytes.resize(bytes.len() + data, 0);
            bytes
        };
        for (width, height) in [(30, 20), (10, 50), (-1, 9000)] {
            sizes.note(&message(width, height, 89));
        }
        sizes.note(&message(1, 1, 9989));
        inputs.of("/text", None).note(b"1234");
        let seen = inputs.seen();
        let map = Seen {
            count: 4,
            largest: 10_000,
            typical: 111,
            width: Some(30),
            height: Some(50),
        };
        let text = Seen {
            count: 1,
            largest: 4,
            typical: 4,
            width: None,
            height: None,
        };
        assert_eq!(seen, [("/map".to_owned(), map), ("/text".to_owned(), text)]);
        assert!(Arc::ptr_eq(&inputs.of("/map", Some(&grid)), &sizes));
        // Of another type nothing is known yet.
        let other = inputs.of("/map", None);
        assert_eq!(other.seen(), Seen::default());
    }

    #[test]
    fn clients_cannot_make_it_grow() {
        let inputs = Inputs::default();
        for number in 0..2 * MOST {
            inputs.of(&format!("/topic{number}"), None).note(b"");
        }
        assert_eq!(inputs.seen().len(), MOST);
        let late = inputs.of("/topic0", None);
        late.note(b"");
        assert_eq!(inputs.seen()[0].1.count, 2, "those there are go on");
    }

    proptest! {
        #[test]
        fn half_of_all_are_as_typical_says(mut sizes in prop::collection::vec(0usize..100_000, 1..60)) {
            let seen = Sizes::of(None);
            for size in &sizes {
                seen.note(&vec![0; *size]);
            }
            sizes.sort_unstable();
            let (median, largest) = (sizes[(sizes.len() - 1) / 2] as u64, sizes[sizes.len() - 1] as u64);
            let Seen { typical, largest: told, count, .. } = seen.seen();
            prop_assert_eq!((told, count), (largest, sizes.len() as u64));
            prop_assert!(typical >= median && typical <= largest);
            prop_assert!(typical <= median + median / 4 + 4, "{} {}", typical, median);
        }

        #[test]
        fn classes_follow_each_other(bytes in 4u64..u64::MAX / 2) {
            let of = class(bytes);
            prop_assert!(bound(of) >= bytes && (of == 2 * PARTS || bound(of - 1) < bytes));
        }
    }
}
