//! The kept corpus, whole and damaged, through every target: what the fuzzer once found stays found, and a little more
//! is tried on every run. `FUZZ_ROUNDS` sets how many damaged inputs each target is given.

use std::fs;
use std::path::Path;

use fuzz::{TARGETS, Target};

/// Numbers that look random and are the same every time (xorshift64).
struct Dice(u64);

impl Dice {
    fn below(&mut self, limit: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 % limit.max(1) as u64) as usize
    }

    fn byte(&mut self) -> u8 {
        const LIKELY: &[u8] =
            b"{}[]\",:\\u0-1.eE+tfn \x00\x01\x1f\x7f\x80\xbf\xc3\xff\x5b\x7b\x9b\xbb\x9f\xd8\xf9";
        match self.below(3) {
            0 => self.below(256) as u8,
            _ => LIKELY[self.below(LIKELY.len())],
        }
    }

    /// Changes, removes, repeats, inserts or exchanges a few bytes.
    fn damage(&mut self, bytes: &mut Vec<u8>, other: &[u8]) {
        for _ in 0..=self.below(4) {
            let at = self.below(bytes.len() + 1);
            let piece = |dice: &mut Self, from: &[u8]| {
                let begin = dice.below(from.len() + 1);
                from[begin..(begin + dice.below(24)).min(from.len())].to_vec()
            };
            match self.below(6) {
                0 if at < bytes.len() => bytes[at] = self.byte(),
                1 if at < bytes.len() => drop(bytes.remove(at)),
                2 => {
                    let piece = piece(self, &bytes.clone());
                    bytes.splice(at..at, piece);
                }
                3 => {
                    let piece = piece(self, other);
                    let end = (at + piece.len()).min(bytes.len());
                    bytes.splice(at..end, piece);
                }
                4 if self.below(8) == 0 => bytes.truncate(at),
                _ => bytes.insert(at, self.byte()),
            }
        }
    }
}

fn corpus(name: &str) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("corpus")
        .join(name);
    let entries = fs::read_dir(&folder).unwrap_or_else(|error| panic!("{folder:?}: {error}"));
    let mut files: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files.iter().map(|file| fs::read(file).unwrap()).collect()
}

fn replay(name: &str, target: Target) {
    let seeds = corpus(name);
    assert!(!seeds.is_empty(), "{name} has no seeds");
    for seed in &seeds {
        target(seed);
    }
    let rounds = std::env::var("FUZZ_ROUNDS").map_or(3000, |text| text.parse().unwrap());
    let mut dice = Dice(0x9e37_79b9_7f4a_7c15);
    for round in 0..rounds {
        let mut bytes = seeds[round % seeds.len()].clone();
        dice.damage(&mut bytes, &seeds[round / seeds.len() % seeds.len()]);
        let shown = bytes.clone();
        let tried = std::panic::catch_unwind(|| target(&bytes));
        assert!(tried.is_ok(), "{name}, round {round}: {shown:02x?}");
    }
}

#[test]
fn the_corpus_whole_and_damaged_is_read_or_refused() {
    std::thread::scope(|scope| {
        for &(name, target) in TARGETS {
            scope.spawn(move || replay(name, target));
        }
    });
}
