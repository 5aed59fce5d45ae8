//! The stored corpus, and random modifications of it.

use std::fs;
use std::path::Path;

/// A deterministic pseudorandom generator (xorshift64).
#[derive(Debug)]
pub struct Dice(u64);

impl Default for Dice {
    fn default() -> Self {
        Self(0x9e37_79b9_7f4a_7c15)
    }
}

impl Dice {
    fn next_below(&mut self, limit: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 % limit.max(1) as u64) as usize
    }

    fn byte(&mut self) -> u8 {
        const LIKELY: &[u8] = b"{}[]\",:\\u0-1.eE+tfn \x00\x01\x1f\x7f\x80\xbf\xc3\xff\x5b\x7b\x9b\xbb\x9f\xd8\xf9";
        match self.next_below(3) {
            0 => self.next_below(256) as u8,
            _ => LIKELY[self.next_below(LIKELY.len())],
        }
    }

    /// Changes, removes, repeats, inserts or swaps a few bytes.
    pub fn damage(&mut self, bytes: &mut Vec<u8>, other: &[u8]) {
        for _ in 0..=self.next_below(4) {
            let at = self.next_below(bytes.len() + 1);
            let piece = |dice: &mut Self, from: &[u8]| {
                let begin = dice.next_below(from.len() + 1);
                from[begin..(begin + dice.next_below(24)).min(from.len())].to_vec()
            };
            match self.next_below(6) {
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
                4 if self.next_below(8) == 0 => bytes.truncate(at),
                _ => bytes.insert(at, self.byte()),
            }
        }
    }

    /// Repeats a few bytes in place until the length is `size`.
    pub fn repeat(&mut self, bytes: &mut Vec<u8>, size: usize) {
        let begin = self.next_below(bytes.len());
        let end = (begin + 1 + self.next_below(24)).min(bytes.len());
        let piece = bytes[begin..end].to_vec();
        if piece.is_empty() {
            return;
        }
        let count = size.saturating_sub(bytes.len()) / piece.len();
        bytes.splice(end..end, piece.repeat(count));
    }
}

/// Returns the seeds of a target.
///
/// # Panics
/// If there are no seeds, or if they cannot be read.
pub fn load_corpus(name: &str) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus").join(name);
    let entries = fs::read_dir(&folder).unwrap_or_else(|error| panic!("{folder:?}: {error}"));
    let mut files: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
    files.sort();
    let seeds: Vec<_> = files.iter().map(|file| fs::read(file).unwrap()).collect();
    assert!(!seeds.is_empty(), "{name} has no seeds");
    seeds
}
