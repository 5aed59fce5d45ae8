//! An adaptive binary range coder, for few decisions; no tables are sent.
//!
//! Each decision has an [`AdaptiveBit`] that learns its probability at two speeds; the range is split by their mean.

use crate::Error;

/// The probability, in 1/65536, that a decision is a zero, as a fast and a slow estimate.
///
/// Both start as plain averages (the n-th decision weighs about 1/n) until they have reached their own speed.
#[derive(Clone, Copy)]
pub(crate) struct AdaptiveBit {
    fast: u16,
    slow: u16,
    seen: u8,
}

const FAST: u32 = 5;
const SLOW: u32 = 7;

impl Default for AdaptiveBit {
    fn default() -> Self {
        Self { fast: 1 << 15, slow: 1 << 15, seen: 0 }
    }
}

impl AdaptiveBit {
    /// Returns the probability of a zero in 1/65536, never 0 or 1.
    #[inline]
    fn zero_probability(self) -> u32 {
        ((u32::from(self.fast) + u32::from(self.slow)) >> 1).clamp(24, 65_536 - 24)
    }

    #[inline]
    fn update(&mut self, one: bool) {
        let speed = (u32::from(self.seen) + 2).ilog2();
        self.seen += u8::from(self.seen < (1 << SLOW) - 2);
        let (fast, slow) = (speed.min(FAST), speed.min(SLOW));
        if one {
            self.fast -= self.fast >> fast;
            self.slow -= self.slow >> slow;
        } else {
            self.fast += (u16::MAX - self.fast) >> fast;
            self.slow += (u16::MAX - self.slow) >> slow;
        }
    }
}

/// Encodes decisions. Carries propagate into bytes already written, so the output is kept until the end.
pub(crate) struct BinaryEncoder {
    low: u64,
    range: u32,
    out: Vec<u8>,
}

impl BinaryEncoder {
    pub(crate) fn new() -> Self {
        Self { low: 0, range: u32::MAX, out: Vec::new() }
    }

    #[inline]
    pub(crate) fn put(&mut self, bit: &mut AdaptiveBit, one: bool) {
        let split = ((u64::from(self.range) * u64::from(bit.zero_probability())) >> 16) as u32;
        bit.update(one);
        self.narrow(split, one);
    }

    #[inline]
    fn narrow(&mut self, split: u32, one: bool) {
        if one {
            self.low += u64::from(split);
            self.range -= split;
        } else {
            self.range = split;
        }
        while self.range < 1 << 24 {
            self.shift_out();
        }
    }

    fn shift_out(&mut self) {
        if self.low >> 32 != 0 {
            for byte in self.out.iter_mut().rev() {
                *byte = byte.wrapping_add(1);
                if *byte != 0 {
                    break;
                }
            }
        }
        self.out.push((self.low >> 24) as u8);
        self.low = (self.low & 0x00ff_ffff) << 8;
        self.range <<= 8;
    }

    pub(crate) fn finish(mut self) -> Vec<u8> {
        // Any number in low..low + range ends the stream; take the one with the most trailing zeros, and drop those.
        let top = (self.low + u64::from(self.range) - 1) & !0x00ff_ffff;
        if top >= self.low {
            self.low = top;
        }
        for _ in 0..4 {
            self.shift_out();
        }
        while self.out.last() == Some(&0) {
            self.out.pop();
        }
        self.out
    }
}

/// Decodes what [`BinaryEncoder`] wrote; zeros follow the end.
pub(crate) struct BinaryDecoder<'a> {
    code: u32,
    range: u32,
    bytes: &'a [u8],
    missing: usize,
}

impl<'a> BinaryDecoder<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        let mut this = Self { code: 0, range: u32::MAX, bytes, missing: 0 };
        for _ in 0..4 {
            this.code = this.code << 8 | this.next_byte();
        }
        this
    }

    #[inline]
    fn next_byte(&mut self) -> u32 {
        match self.bytes.split_first() {
            Some((&first, rest)) => {
                self.bytes = rest;
                u32::from(first)
            }
            None => {
                self.missing += 1;
                0
            }
        }
    }

    #[inline]
    pub(crate) fn get(&mut self, bit: &mut AdaptiveBit) -> bool {
        let split = ((u64::from(self.range) * u64::from(bit.zero_probability())) >> 16) as u32;
        let one = self.narrow(split);
        bit.update(one);
        one
    }

    #[inline]
    fn narrow(&mut self, split: u32) -> bool {
        let one = self.code >= split;
        if one {
            self.code -= split;
            self.range -= split;
        } else {
            self.range = split;
        }
        while self.range < 1 << 24 {
            self.range <<= 8;
            self.code = self.code << 8 | self.next_byte();
        }
        one
    }

    pub(crate) fn finish(self) -> Result<(), Error> {
        if self.bytes.is_empty() { Ok(()) } else { Err(Error::Corrupt("bytes after the last decision")) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decisions_come_back_and_likely_ones_are_cheap() {
        let decision = |index: u32| index.wrapping_mul(2_654_435_761) >> 25 == 0;
        let mut encoder = BinaryEncoder::new();
        let (mut bit, mut other) = (AdaptiveBit::default(), AdaptiveBit::default());
        for index in 0..100_000 {
            encoder.put(&mut bit, decision(index));
            if index % 100 == 0 {
                encoder.put(&mut other, true);
            }
        }
        let bytes = encoder.finish();
        // One in 128: 0.066 bits each by Shannon.
        assert!(bytes.len() < 100_000 * 75 / 8000 + 20, "{}", bytes.len());
        let mut decoder = BinaryDecoder::new(&bytes);
        let (mut bit, mut other) = (AdaptiveBit::default(), AdaptiveBit::default());
        for index in 0..100_000 {
            assert_eq!(decoder.get(&mut bit), decision(index), "{index}");
            if index % 100 == 0 {
                assert!(decoder.get(&mut other));
            }
        }
        decoder.finish().unwrap();
    }

    #[test]
    fn nothing_takes_nothing() {
        assert!(BinaryEncoder::new().finish().len() <= 1);
        BinaryDecoder::new(&[]).finish().unwrap();
    }
}
