//! Bit streams, written and read from the front.

/// Writes bits, least significant first.
#[derive(Default)]
pub(crate) struct BitWriter {
    bytes: Vec<u8>,
    pending: u64,
    count: u32,
}

impl BitWriter {
    /// Creates a writer with capacity for `bytes` bytes.
    pub(crate) fn with_capacity(bytes: usize) -> Self {
        Self { bytes: Vec::with_capacity(bytes), ..Self::default() }
    }

    /// Appends the low `count` bits of `value`, at most 32; the rest of `value` must be zero.
    #[inline(always)]
    pub(crate) fn put(&mut self, value: u32, count: u32) {
        debug_assert!(count <= 32 && (count == 32 || value >> count == 0));
        self.pending |= u64::from(value) << self.count;
        self.count += count;
        if self.count >= 32 {
            self.bytes.extend_from_slice(&(self.pending as u32).to_le_bytes());
            self.pending >>= 32;
            self.count -= 32;
        }
    }

    /// Appends the low bits of every value, at most 32 of each, like [`BitWriter::put`] but without branches.
    #[inline]
    pub(crate) fn put_low(&mut self, values: &[u32], counts: &[u8]) {
        const BATCH: usize = 64;
        let (mut pending, mut count) = (self.pending, self.count);
        for (values, counts) in values.chunks(BATCH).zip(counts.chunks(BATCH)) {
            let mut buffer = [0u8; BATCH * 4 + 16];
            let mut written = 0;
            let mut put = |value: u64, bits: u32| {
                pending |= value << count;
                count += bits;
                buffer[written..written + 8].copy_from_slice(&pending.to_le_bytes());
                written += (count >> 3) as usize;
                pending >>= count & 0x38;
                count &= 7;
            };
            let low = |value: u32, bits: u8| u64::from(value) & ((1 << (bits & 63)) - 1);
            // Each depends on the one before, so two are written as one where they fit.
            let mut done = 0;
            if counts.iter().copied().max().unwrap_or(0) <= 16 {
                for (values, counts) in values.chunks_exact(2).zip(counts.chunks_exact(2)) {
                    let both = low(values[0], counts[0]) | low(values[1], counts[1]) << counts[0];
                    put(both, u32::from(counts[0]) + u32::from(counts[1]));
                }
                done = values.len() & !1;
            }
            for (&value, &bits) in values[done..].iter().zip(&counts[done..]) {
                put(low(value, bits), bits.into());
            }
            self.bytes.extend_from_slice(&buffer[..written]);
        }
        (self.pending, self.count) = (pending, count);
    }

    /// Appends the Elias gamma code of a number ≥ 1.
    pub(crate) fn put_gamma(&mut self, value: u32) {
        let length = 31 - value.leading_zeros();
        self.put(0, length);
        self.put(1, 1);
        self.put(value & !(1 << length), length);
    }

    /// Appends the Rice code of `value`: `value >> k` in unary, then the low `k` bits.
    pub(crate) fn put_rice(&mut self, value: u32, k: u32) {
        let mut unary = value >> k;
        while unary > 30 {
            self.put(0, 31);
            unary -= 31;
        }
        self.put(1 << unary, unary + 1);
        self.put(value & ((1 << k) - 1), k);
    }

    pub(crate) fn finish(mut self) -> Vec<u8> {
        let left = self.count.div_ceil(8) as usize;
        self.bytes.extend_from_slice(&self.pending.to_le_bytes()[..left]);
        self.bytes
    }
}

/// Reads what [`BitWriter`] wrote. Zeros follow the end, and [`BitReader::has_overrun`] reports reading past it.
#[derive(Clone, Copy, Default)]
pub(crate) struct BitReader<'a> {
    bytes: &'a [u8],
    next: usize,
    pending: u64,
    count: u32,
    missing: u32,
}

impl<'a> BitReader<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, ..Self::default() }
    }

    #[inline]
    fn refill(&mut self) {
        if let Some(word) = self.bytes.get(self.next..self.next + 4) {
            let word = u32::from_le_bytes([word[0], word[1], word[2], word[3]]);
            self.pending |= u64::from(word) << self.count;
            self.next += 4;
            self.count += 32;
        } else {
            self.refill_tail();
        }
    }

    #[cold]
    fn refill_tail(&mut self) {
        while self.count <= 32 {
            match self.bytes.get(self.next) {
                Some(&byte) => {
                    self.pending |= u64::from(byte) << self.count;
                    self.next += 1;
                }
                None => self.missing = self.missing.saturating_add(8),
            }
            self.count += 8;
        }
    }

    /// Returns the next `count` bits, at most 32.
    #[inline]
    pub(crate) fn take(&mut self, count: u32) -> u32 {
        if self.count < count {
            self.refill();
        }
        let value = (self.pending & ((1u64 << count) - 1)) as u32;
        self.pending >>= count;
        self.count -= count;
        value
    }

    /// Returns true if more bits were read than there were.
    pub(crate) fn has_overrun(&self) -> bool {
        self.missing > self.count
    }

    /// Reads what [`BitWriter::put_gamma`] wrote; `None` if it is longer than any number.
    pub(crate) fn take_gamma(&mut self) -> Option<u32> {
        let mut length = 0;
        while self.take(1) == 0 {
            length += 1;
            if length > 31 || self.has_overrun() {
                return None;
            }
        }
        Some((1 << length) | self.take(length))
    }

    /// Reads what [`BitWriter::put_rice`] wrote; `None` if the unary part exceeds `limit`.
    pub(crate) fn take_rice(&mut self, k: u32, limit: u32) -> Option<u32> {
        let mut high = 0;
        while self.take(1) == 0 {
            high += 1;
            if high > limit >> k || self.has_overrun() {
                return None;
            }
        }
        Some((high << k) | self.take(k))
    }

    /// Returns the number of bytes read, rounded up: the start of the next block.
    pub(crate) fn bytes_used(&self) -> usize {
        self.next - (self.count.saturating_sub(self.missing) / 8) as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bits_come_back() {
        let mut writer = BitWriter::default();
        for i in 0..200u32 {
            writer.put(i & ((1 << (i % 20)) - 1), i % 20);
            writer.put_gamma(i + 1);
            writer.put_rice(i, 4);
        }
        writer.put(u32::MAX, 32);
        let mut bytes = writer.finish();
        let length = bytes.len();
        bytes.push(0xff);
        let mut reader = BitReader::new(&bytes);
        for i in 0..200u32 {
            assert_eq!(reader.take(i % 20), i & ((1 << (i % 20)) - 1));
            assert_eq!(reader.take_gamma(), Some(i + 1));
            assert_eq!(reader.take_rice(4, 200), Some(i));
        }
        assert_eq!(reader.take(32), u32::MAX);
        assert_eq!(reader.bytes_used(), length);
        assert!(!reader.has_overrun());
    }

    #[test]
    fn many_at_once_are_as_one_by_one() {
        let values: Vec<u32> = (0..500u32).map(|i| i.wrapping_mul(2_654_435_761)).collect();
        let most = |i: usize| if i < 250 { 33 } else { 15 };
        let counts: Vec<u8> = (0..500).map(|i| (i * 7 % most(i)) as u8).collect();
        let (mut single, mut many) = (BitWriter::default(), BitWriter::default());
        for writer in [&mut single, &mut many] {
            writer.put(0x3fff_ffff, 31);
        }
        for (&value, &count) in values.iter().zip(&counts) {
            let mask = (1u64 << count) - 1;
            single.put((u64::from(value) & mask) as u32, count.into());
        }
        many.put_low(&values, &counts);
        assert_eq!(single.finish(), many.finish());
    }

    #[test]
    fn reading_past_the_end_is_noticed() {
        let mut reader = BitReader::new(&[0xff]);
        assert_eq!(reader.take(8), 0xff);
        assert!(!reader.has_overrun());
        assert_eq!(reader.take(1), 0);
        assert!(reader.has_overrun());
        assert_eq!(BitReader::new(&[]).take_gamma(), None);
    }
}
