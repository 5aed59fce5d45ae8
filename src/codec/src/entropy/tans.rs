//! Tabled asymmetric numeral systems, several lanes at a time.
//!
//! A *lane* is a run of symbols with its own state and bit stream; the tables are shared. Lanes are coded in lockstep
//! because a single lane mostly waits for its own last symbol: three or four hide each other's latency. Encoding runs
//! from the last symbol to the first and the decoder reads the bits from the end, so both visit every bit once.
//!
//! A symbol is represented by its key `context << 8 | symbol`.

use super::bits::{BitReader, BitWriter};
use super::counts::{self, MAX_LOG, SYMBOLS, SymbolCounts, SymbolOrder};
use crate::Error;

/// Counts of each key.
///
/// Even and odd positions are counted separately: the same key twice in a row would wait for its own last count.
pub(crate) struct Histogram([Vec<u32>; 2]);

impl Histogram {
    pub(crate) fn new(contexts: usize) -> Self {
        Self([vec![0; contexts * SYMBOLS], vec![0; contexts * SYMBOLS]])
    }

    pub(crate) fn add(&mut self, keys: &[u16]) {
        let [even, odd] = &mut self.0;
        let pairs = keys.chunks_exact(2);
        pairs.remainder().iter().for_each(|&key| even[usize::from(key)] += 1);
        for pair in pairs {
            even[usize::from(pair[0])] += 1;
            odd[usize::from(pair[1])] += 1;
        }
    }

    fn counts(self) -> Vec<u32> {
        let [mut even, odd] = self.0;
        even.iter_mut().zip(odd).for_each(|(even, odd)| *even += odd);
        even
    }
}

/// Returns the symbol of each state of one context, with every symbol's states spread evenly.
fn spread(counts: &[u16], log: u32) -> [u8; 1 << MAX_LOG] {
    let size = 1usize << log;
    let step = (size >> 1) + (size >> 3) + 3;
    let mut symbols = [0u8; 1 << MAX_LOG];
    let mut position = 0;
    for (symbol, &count) in counts.iter().enumerate() {
        for _ in 0..count {
            symbols[position] = symbol as u8;
            position = (position + step) & (size - 1);
        }
    }
    symbols
}

/// The encoder's tables, built from the counts of the symbols.
pub(crate) struct TansEncoder {
    log: u32,
    /// Per key: the addend after which the state's high half is the number of bits to shed, and the start of its
    /// states.
    shed: Vec<(u32, i32)>,
    /// The next state, by context and position.
    next: Vec<u16>,
}

impl TansEncoder {
    /// Builds the tables and writes their description to `out`.
    pub(crate) fn new(histogram: Histogram, order: SymbolOrder, out: &mut Vec<u8>) -> Self {
        let histogram = histogram.counts();
        let total: usize = histogram.iter().map(|&count| count as usize).sum();
        let log = counts::table_log(total);
        let contexts = histogram.len() / SYMBOLS;
        let mut description = BitWriter::default();
        description.put(log - 8, 2);
        let mut this = Self { log, shed: vec![(0, 0); histogram.len()], next: vec![0; contexts << log] };
        for (context, histogram) in histogram.chunks_exact(SYMBOLS).enumerate() {
            let counts = counts::normalise(histogram, log);
            counts::write(&counts, order, log, &mut description);
            this.fill(context, &counts);
        }
        out.extend_from_slice(&description.finish());
        this
    }

    fn fill(&mut self, context: usize, counts: &SymbolCounts) {
        let size = 1usize << self.log;
        let base = context << self.log;
        let mut starts = [0usize; SYMBOLS];
        let mut start = base;
        let used = counts.iter().rposition(|&count| count > 0);
        let counts = &counts[..used.map_or(0, |last| last + 1)];
        for (symbol, &count) in counts.iter().enumerate().filter(|&(_, &count)| count > 0) {
            // A state sheds `most` or `most - 1` bits to land in count..2·count.
            let most = if count == 1 { self.log } else { self.log - (count - 1).ilog2() };
            let adder = (most << 16).wrapping_sub(u32::from(count) << most);
            self.shed[context * SYMBOLS + symbol] = (adder, start as i32 - i32::from(count));
            starts[symbol] = start;
            start += usize::from(count);
        }
        if start > base {
            for (position, &symbol) in spread(counts, self.log)[..size].iter().enumerate() {
                let slot = &mut starts[usize::from(symbol)];
                self.next[*slot] = (size + position) as u16;
                *slot += 1;
            }
        }
    }

    /// Encodes lanes of equal length, each to its own output.
    pub(crate) fn encode<const N: usize>(&self, lanes: [&[u16]; N]) -> [Vec<u8>; N] {
        /// Four symbols shed at most 44 bits, which fit into 64 beside the seven left over.
        const BATCH: usize = 4;
        let length = lanes[0].len();
        let (shed, next) = (&self.shed[..], &self.next[..]);
        let mut state = [1u32 << self.log; N];
        let mut pending = [0u64; N];
        let mut count = [0u32; N];
        let mut written = [0usize; N];
        let mut out: [Vec<u8>; N] = std::array::from_fn(|_| vec![0; length / 2 + 64]);
        let mut left = length;
        while left > 0 {
            let first = left.saturating_sub(BATCH);
            let batch: [&[u16]; N] = std::array::from_fn(|lane| &lanes[lane][first..left]);
            if left - first == BATCH {
                for index in (0..BATCH).rev() {
                    for (lane, batch) in batch.iter().enumerate() {
                        step(batch[index], shed, next, &mut state[lane], &mut pending[lane], &mut count[lane]);
                    }
                }
            } else {
                for (lane, batch) in batch.iter().enumerate() {
                    for &key in batch.iter().rev() {
                        step(key, shed, next, &mut state[lane], &mut pending[lane], &mut count[lane]);
                    }
                }
            }
            left = first;
            for lane in 0..N {
                if written[lane] + 8 > out[lane].len() {
                    grow(&mut out[lane]);
                }
                out[lane][written[lane]..written[lane] + 8].copy_from_slice(&pending[lane].to_le_bytes());
                written[lane] += (count[lane] >> 3) as usize;
                pending[lane] >>= count[lane] & !7;
                count[lane] &= 7;
            }
        }
        for lane in 0..N {
            // The last state; its top bit, always one, marks the end.
            pending[lane] |= u64::from(state[lane]) << count[lane];
            let bytes = (count[lane] + self.log + 1).div_ceil(8) as usize;
            out[lane].truncate(written[lane]);
            out[lane].extend_from_slice(&pending[lane].to_le_bytes()[..bytes]);
        }
        out
    }
}

/// Encodes one symbol into a state, shedding bits.
#[inline(always)]
fn step(key: u16, shed: &[(u32, i32)], next: &[u16], state: &mut u32, pending: &mut u64, count: &mut u32) {
    let (adder, start) = shed[usize::from(key)];
    let bits = state.wrapping_add(adder) >> 16;
    *pending |= u64::from(*state & !(u32::MAX << bits)) << *count;
    *count += bits;
    *state = u32::from(next[((*state >> bits) as i32).wrapping_add(start) as usize]);
}

#[cold]
fn grow(out: &mut Vec<u8>) {
    let length = out.len();
    out.resize(length + length / 2 + 64, 0);
}

/// The decoder's tables. An entry holds `next state << 16 | symbol << 8 | bits`.
pub(crate) struct TansDecoder {
    log: u32,
    entries: Vec<u32>,
}

impl TansDecoder {
    /// Reads the description of a model of `contexts` contexts; returns the number of bytes read as well.
    pub(crate) fn read(bytes: &[u8], contexts: usize, order: SymbolOrder) -> Result<(Self, usize), Error> {
        let mut input = BitReader::new(bytes);
        let log = input.take(2) + 8;
        let mut this = Self { log, entries: vec![0; contexts << log] };
        for context in 0..contexts {
            let counts = counts::read(order, log, &mut input)?;
            this.fill(context, &counts);
        }
        if input.has_overrun() {
            return Err(Error::Truncated);
        }
        Ok((this, input.bytes_used()))
    }

    fn fill(&mut self, context: usize, counts: &SymbolCounts) {
        if counts.iter().all(|&count| count == 0) {
            // Never used by a correct encoder: the zeros here decode to symbol 0 without bits.
            return;
        }
        let base = context << self.log;
        let mut rank: [u32; SYMBOLS] = std::array::from_fn(|symbol| u32::from(counts[symbol]));
        for (position, &symbol) in spread(counts, self.log)[..1 << self.log].iter().enumerate() {
            let rank = &mut rank[usize::from(symbol)];
            let bits = self.log - rank.ilog2();
            let after = (*rank << bits) - (1 << self.log);
            *rank += 1;
            self.entries[base + position] = after << 16 | u32::from(symbol) << 8 | bits;
        }
    }

    /// Returns the start of a context's entries, to be or-ed with a state.
    pub(crate) fn base(&self, context: usize) -> u16 {
        (context << self.log) as u16
    }

    /// Opens a lane for decoding with these tables.
    pub(crate) fn lane<'a>(&self, bytes: &'a [u8]) -> Result<LaneReader<'a>, Error> {
        LaneReader::new(bytes, self.log)
    }

    /// Decodes one symbol in the context whose entries start at `base`.
    #[inline(always)]
    pub(crate) fn symbol(&self, base: u16, bits: &mut Window) -> u8 {
        let entry = self.entries[usize::from(base) | bits.state as usize];
        let count = entry & 0xff;
        bits.state = (entry >> 16) + ((bits.bits >> 1) >> (63 - count)) as u32;
        bits.bits <<= count;
        (entry >> 8) as u8
    }
}

/// The part of a lane that inner loops keep in registers: the state and the next bits.
///
/// The bits are the topmost ones; a one marks their end.
#[derive(Clone, Copy)]
pub(crate) struct Window {
    state: u32,
    bits: u64,
}

/// Reads the bits of one lane from the end.
pub(crate) struct LaneReader<'a> {
    bytes: &'a [u8],
    /// Position of the window's lowest bit in `bytes`; negative if the window reaches beyond the front.
    below: isize,
    window: Window,
}

/// Number of symbols that may be decoded between two [`LaneReader::refill`]s: 56 bits are enough for five of eleven.
pub(crate) const BATCH: usize = 4;
/// Number of bits in a window after a refill.
const REFILLED_BITS: isize = 56;

impl<'a> LaneReader<'a> {
    fn new(bytes: &'a [u8], log: u32) -> Result<Self, Error> {
        let last = *bytes.last().ok_or(Error::Truncated)?;
        if last == 0 {
            return Err(Error::Corrupt("a lane without its end mark"));
        }
        let end = ((bytes.len() - 1) * 8 + last.ilog2() as usize) as isize;
        let mut lane = Self { bytes, below: end, window: Window { state: 0, bits: 1 << 63 } };
        let mut window = lane.refill(lane.window);
        window.state = (window.bits >> (64 - log)) as u32;
        window.bits <<= log;
        lane.window = window;
        Ok(lane)
    }

    /// Returns the window as it was last stored.
    pub(crate) fn window(&self) -> Window {
        self.window
    }

    /// Stores the window for later.
    pub(crate) fn set_window(&mut self, window: Window) {
        self.window = window;
    }

    /// Refills a window: loads the eight bytes that hold the highest unread bits.
    #[inline(always)]
    pub(crate) fn refill(&mut self, window: Window) -> Window {
        let end = self.below + 63 - window.bits.trailing_zeros() as isize;
        let last = (end + 7) >> 3;
        let word = match usize::try_from(last - 8).ok().and_then(|first| self.bytes.get(first..)?.first_chunk()) {
            Some(word) => u64::from_le_bytes(*word),
            None => self.read_front(last),
        };
        self.below = end - REFILLED_BITS;
        let spare = (last * 8 - end) as u32;
        Window { state: window.state, bits: (word << spare) & !0xff | 0x80 }
    }

    /// Reads the word at the front, padded with zeros; [`LaneReader::finish`] reports whether they were used.
    #[cold]
    fn read_front(&self, last: isize) -> u64 {
        let mut word = [0u8; 8];
        if (1..8).contains(&last) {
            word[8 - last as usize..].copy_from_slice(&self.bytes[..last as usize]);
        }
        u64::from_le_bytes(word)
    }

    /// Checks that the lane ended where its encoder began, with every bit read and none invented.
    pub(crate) fn finish(&self) -> Result<(), Error> {
        let end = self.below + 63 - self.window.bits.trailing_zeros() as isize;
        if self.window.state == 0 && end == 0 { Ok(()) } else { Err(Error::Corrupt("a lane that does not end well")) }
    }
}

#[cfg(test)]
mod tests {
    use super::super::counts::CONTEXTS;
    use super::*;

    fn histogram(lanes: &[&[u16]], contexts: usize) -> Histogram {
        let mut histogram = Histogram::new(contexts);
        lanes.iter().for_each(|lane| histogram.add(lane));
        histogram
    }

    fn decode(decoder: &TansDecoder, stream: &[u8], keys: &[u16]) -> Result<(), Error> {
        let mut lane = decoder.lane(stream)?;
        let mut window = lane.window();
        let mut same = true;
        for batch in keys.chunks(BATCH) {
            window = lane.refill(window);
            for &key in batch {
                let symbol = decoder.symbol(decoder.base(usize::from(key >> 8)), &mut window);
                same &= u16::from(symbol) == key & 0xff;
            }
        }
        lane.set_window(window);
        lane.finish()?;
        assert!(same);
        Ok(())
    }

    fn round_trip(lanes: [&[u16]; 3], contexts: usize, order: SymbolOrder) -> usize {
        let mut table = Vec::new();
        let encoder = TansEncoder::new(histogram(&lanes, contexts), order, &mut table);
        let streams = encoder.encode(lanes);
        let (decoder, used) = TansDecoder::read(&table, contexts, order).unwrap();
        assert_eq!(used, table.len());
        for (keys, stream) in lanes.iter().zip(&streams) {
            decode(&decoder, stream, keys).unwrap();
        }
        table.len() + streams.iter().map(Vec::len).sum::<usize>()
    }

    /// Returns keys whose symbols are mostly small.
    fn skewed_keys(count: usize, seed: u64) -> Vec<u16> {
        let mut state = seed;
        (0..count)
            .map(|index| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                let context = (index % 5) as u16;
                context << 8 | ((state >> 33).trailing_zeros() as u16)
            })
            .collect()
    }

    #[test]
    fn lanes_come_back() {
        for count in [0, 1, 2, 3, 100, 5000, 40_000] {
            let lanes = [skewed_keys(count, 1), skewed_keys(count, 2), skewed_keys(count, 3)];
            let size = round_trip([&lanes[0], &lanes[1], &lanes[2]], 5, SymbolOrder::Natural);
            // The symbols hold two bits each.
            assert!(size < 3 * count / 4 + count / 50 + 300, "{count} symbols took {size} bytes");
        }
    }

    #[test]
    fn one_symbol_only_costs_nothing() {
        let lane = vec![0x01ff; 10_000];
        assert!(round_trip([&lane, &lane, &lane], 2, SymbolOrder::Signed) < 16);
    }

    #[test]
    fn all_symbols_of_all_contexts() {
        let lane: Vec<u16> = (0..(CONTEXTS * SYMBOLS) as u16).collect();
        round_trip([&lane, &lane, &lane], CONTEXTS, SymbolOrder::Signed);
    }

    #[test]
    fn a_lane_cut_short_is_noticed() {
        let lane = skewed_keys(1000, 4);
        let mut table = Vec::new();
        let encoder = TansEncoder::new(histogram(&[&lane], 5), SymbolOrder::Natural, &mut table);
        let [stream] = encoder.encode([&lane]);
        let (decoder, _) = TansDecoder::read(&table, 5, SymbolOrder::Natural).unwrap();
        assert!(decode(&decoder, &stream[10..], &lane).is_err());
        assert!(decoder.lane(&[]).is_err());
        assert!(decoder.lane(&[1, 0]).is_err());
        assert!(TansDecoder::read(&table[..3], 5, SymbolOrder::Natural).is_err());
    }
}
