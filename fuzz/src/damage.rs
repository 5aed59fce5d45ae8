//! The kept corpus, and damage that is done to it.

use std::fs;
use std::path::Path;

/// Numbers that look random and are the same every time (xorshift64).
#[derive(Debug)]
pub struct Dice(u64);

impl Default for Dice {
    fn default() -> Self {
        Self(0x9e37_79b9_7f4a_7c15)
    }
}

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
    pub fn damage(&mut self, bytes: &mut Vec<u8>, other: &[u8]) {
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

    /// Repeats a few bytes where they are, so that there are `size` bytes.
    pub fn repeat(&mut self, bytes: &mut Vec<u8>, size: usize) {
        let begin = self.below(bytes.len());
        let end = (begin + 1 + self.below(24)).min(bytes.len());
        let piece = bytes[begin..end].to_vec();
        if piece.is_empty() {
            return;
        }
        let count = size.saturating_sub(bytes.len()) / piece.len();
        bytes.splice(end..end, piece.repeat(count));
    }
}

/// Seeds of a target.
///
/// # Panics
/// There are none, or they cannot be read.
pub fn corpus(name: &str) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("corpus")
        .join(name);
    let entries = fs::read_dir(&folder).unwrap_or_else(|error| panic!("{folder:?}: {error}"));
    let mut files: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
    files.sort();
    let seeds: Vec<_> = files.iter().map(|file| fs::read(file).unwrap()).collect();
    assert!(!seeds.is_empty(), "{name} has no seeds");
    seeds
}
