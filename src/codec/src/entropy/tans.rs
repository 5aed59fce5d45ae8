//! Tabled asymmetric numeral systems, several lanes at a time.
//!
//! A *lane* is a run of symbols with a state and a bit stream of its own; the tables are shared. Lanes are coded in
//! lockstep because one lane alone waits for its own last symbol most of the time: three or four hide each other's
//! latency. Encoding runs from the last symbol to the first and the decoder reads the bits from the end, so both
//! visit every bit once.
//!
//! A symbol travels as `context << 8 | symbol`.

use super::bits::{BitReader, BitWriter};
use super::counts::{self, CONTEXTS, Counts, MAX_LOG, Order, SYMBOLS};
use crate::Error;

/// Keys `context << 8 | symbol` are below this.
pub(crate) const KEYS: usize = CONTEXTS * SYMBOLS;
/// Entries of the tables of all contexts together.
const STATES: usize = CONTEXTS << MAX_LOG;

/// How often each key occurs.
pub(crate) struct Histogram(Box<[u32; KEYS]>);

impl Histogram {
    pub(crate) fn new() -> Self {
        Self(boxed())
    }

    #[inline]
    pub(crate) fn add(&mut self, keys: &[u16]) {
        for &key in keys {
            self.0[usize::from(key) & (KEYS - 1)] += 1;
        }
    }
}

/// An array that is never on the stack.
fn boxed<T: Copy + Default, const N: usize>() -> Box<[T; N]> {
    match vec![T::default(); N].into_boxed_slice().try_into() {
        Ok(array) => array,
        Err(_) => unreachable!("the vector has N elements"),
    }
}

/// Which symbol each state of one context belongs to, every symbol's states spread evenly.
fn spread(counts: &Counts, log: u32) -> [u8; 1 << MAX_LOG] {
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

/// Everything the encoder needs of a model, made from the counts of its symbols.
pub(crate) struct Encoder {
    log: u32,
    /// Per key: what to add to the state so that its high half is the number of bits to shed; where its states begin.
    shed: Box<[(u32, i32); KEYS]>,
    /// The state after, by context and position.
    next: Box<[u16; STATES]>,
}

impl Encoder {
    /// Builds the tables and writes their description to `out`.
    pub(crate) fn new(
        histogram: &Histogram,
        contexts: usize,
        order: Order,
        out: &mut Vec<u8>,
    ) -> Self {
        let total: usize = histogram.0.iter().map(|&count| count as usize).sum();
        let log = counts::log_for(total);
        let mut description = BitWriter::default();
        description.put(log - 8, 2);
        let mut this = Self {
            log,
            shed: boxed(),
            next: boxed(),
        };
        for context in 0..contexts {
            let keys = context * SYMBOLS..(context + 1) * SYMBOLS;
            let counts = counts::normalise(&histogram.0[keys], log);
            counts::write(&counts, order, log, &mut description);
            this.fill(context, &counts);
        }
        out.extend_from_slice(&description.finish());
        this
    }

    fn fill(&mut self, context: usize, counts: &Counts) {
        let size = 1usize << self.log;
        let base = context << self.log;
        let mut starts = [0usize; SYMBOLS];
        let mut start = base;
        for (symbol, &count) in counts.iter().enumerate().filter(|&(_, &count)| count > 0) {
            // A state sheds `most` or `most - 1` bits to land in count..2·count.
            let most = if count == 1 {
                self.log
            } else {
                self.log - (count - 1).ilog2()
            };
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
        let length = lanes[0].len();
        let lanes = lanes.map(|lane| &lane[..length]);
        let mut state = [1u32 << self.log; N];
        let mut pending = [0u64; N];
        let mut count = [0u32; N];
        let mut written = [0usize; N];
        let mut out: [Vec<u8>; N] = std::array::from_fn(|_| vec![0; length / 2 + 64]);
        let mut left = length;
        while left > 0 {
            // Four symbols shed at most 44 bits, which the 64 hold beside the 7 left over.
            let batch = left.min(4);
            for index in (left - batch..left).rev() {
                for lane in 0..N {
                    let (adder, start) = self.shed[usize::from(lanes[lane][index]) & (KEYS - 1)];
                    let bits = state[lane].wrapping_add(adder) >> 16;
                    pending[lane] |= u64::from(state[lane] & !(u32::MAX << bits)) << count[lane];
                    count[lane] += bits;
                    let position = ((state[lane] >> bits) as i32).wrapping_add(start) as usize;
                    state[lane] = u32::from(self.next[position & (STATES - 1)]);
                }
            }
            left -= batch;
            for lane in 0..N {
                if written[lane] + 8 > out[lane].len() {
                    grow(&mut out[lane]);
                }
                out[lane][written[lane]..written[lane] + 8]
                    .copy_from_slice(&pending[lane].to_le_bytes());
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

#[cold]
fn grow(out: &mut Vec<u8>) {
    let length = out.len();
    out.resize(length + length / 2 + 64, 0);
}

/// The decoder's tables. An entry holds `next state << 12 | bits << 8 | symbol`.
pub(crate) struct Decoder {
    pub(crate) log: u32,
    contexts: usize,
    entries: Box<[u32; STATES]>,
}

impl Decoder {
    /// Reads the description of a model of `contexts` contexts; returns how many bytes it took.
    pub(crate) fn read(
        bytes: &[u8],
        contexts: usize,
        order: Order,
    ) -> Result<(Self, usize), Error> {
        let mut input = BitReader::new(bytes);
        let log = input.take(2) + 8;
        let mut this = Self {
            log,
            contexts,
            entries: boxed(),
        };
        for context in 0..contexts {
            let counts = counts::read(order, log, &mut input)?;
            this.fill(context, &counts);
        }
        if input.overran() {
            return Err(Error::Truncated);
        }
        Ok((this, input.used()))
    }

    fn fill(&mut self, context: usize, counts: &Counts) {
        if counts.iter().all(|&count| count == 0) {
            // Never used by an honest encoder: the zeros here decode to symbol 0 without bits.
            return;
        }
        let base = context << self.log;
        let mut rank: [u32; SYMBOLS] = std::array::from_fn(|symbol| u32::from(counts[symbol]));
        for (position, &symbol) in spread(counts, self.log)[..1 << self.log].iter().enumerate() {
            let rank = &mut rank[usize::from(symbol)];
            let bits = self.log - rank.ilog2();
            let after = (*rank << bits) - (1 << self.log);
            *rank += 1;
            self.entries[base + position] = after << 12 | bits << 8 | u32::from(symbol);
        }
    }

    /// Where a context's entries begin, ready to be or-ed with a state.
    pub(crate) fn base(&self, context: usize) -> u16 {
        debug_assert!(context < self.contexts);
        ((context << self.log) & (STATES - 1)) as u16
    }

    /// Decodes one symbol of `lane` in the context that begins at `base`.
    #[inline(always)]
    pub(crate) fn symbol(&self, base: u16, lane: &mut Lane<'_>) -> u8 {
        let entry = self.entries[usize::from(base) | (lane.state as usize & ((1 << MAX_LOG) - 1))];
        let bits = (entry >> 8) & 15;
        lane.state = (entry >> 12) + lane.take(bits);
        entry as u8
    }
}

/// One lane's bits, read from the end, and its state.
pub(crate) struct Lane<'a> {
    bytes: &'a [u8],
    state: u32,
    /// The next bits, top bit first.
    window: u64,
    /// How many bits of the window are left.
    filled: u32,
    /// Where the window's lowest bit lies in `bytes`; negative when the window reaches beyond the front.
    below: isize,
}

impl<'a> Lane<'a> {
    pub(crate) fn new(bytes: &'a [u8], log: u32) -> Result<Self, Error> {
        let last = *bytes.last().ok_or(Error::Truncated)?;
        if last == 0 {
            return Err(Error::Corrupt("a lane without its end mark"));
        }
        let below = ((bytes.len() - 1) * 8 + last.ilog2() as usize) as isize;
        let mut lane = Self {
            bytes,
            state: 0,
            window: 0,
            filled: 0,
            below,
        };
        lane.state = lane.take(log);
        Ok(lane)
    }

    #[inline(always)]
    fn take(&mut self, bits: u32) -> u32 {
        if self.filled < bits {
            self.refill();
        }
        let value = ((self.window >> 1) >> (63 - bits)) as u32;
        self.window <<= bits;
        self.filled -= bits;
        value
    }

    /// Loads the eight bytes that hold the highest unread bits.
    #[inline]
    fn refill(&mut self) {
        let end = self.below + self.filled as isize;
        let last = (end + 7) >> 3;
        let mut word = [0u8; 8];
        if last >= 8 {
            word.copy_from_slice(&self.bytes[last as usize - 8..last as usize]);
        } else if last > 0 {
            // Beyond the front there are zeros; `finish` tells whether they were used.
            word[8 - last as usize..].copy_from_slice(&self.bytes[..last as usize]);
        }
        let spare = (last * 8 - end) as u32;
        self.window = u64::from_le_bytes(word) << spare;
        self.filled = 64 - spare;
        self.below = last * 8 - 64;
    }

    /// Whether the lane ended where its encoder began, every bit read and none invented.
    pub(crate) fn finish(&self) -> Result<(), Error> {
        if self.state == 0 && self.below + self.filled as isize == 0 {
            Ok(())
        } else {
            Err(Error::Corrupt("a lane that does not end well"))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn round_trip(lanes: [&[u16]; 3], contexts: usize, order: Order) -> usize {
        let mut histogram = Histogram::new();
        lanes.iter().for_each(|lane| histogram.add(lane));
        let mut table = Vec::new();
        let encoder = Encoder::new(&histogram, contexts, order, &mut table);
        let streams = encoder.encode(lanes);
        let (decoder, used) = Decoder::read(&table, contexts, order).unwrap();
        assert_eq!(used, table.len());
        for (symbols, stream) in lanes.iter().zip(&streams) {
            let mut lane = Lane::new(stream, decoder.log).unwrap();
            for &key in *symbols {
                assert_eq!(
                    u16::from(decoder.symbol(decoder.base(usize::from(key >> 8)), &mut lane)),
                    key & 0xff
                );
            }
            lane.finish().unwrap();
        }
        table.len() + streams.iter().map(Vec::len).sum::<usize>()
    }

    /// Numbers that are small more often than not.
    fn skewed(count: usize, seed: u64) -> Vec<u16> {
        let mut state = seed;
        (0..count)
            .map(|index| {
                state = state
                    .wrapping_mul(6_364_136_223_846_793_005)
                    .wrapping_add(1_442_695_040_888_963_407);
                let context = (index % 5) as u16;
                context << 8 | ((state >> 33).trailing_zeros() as u16)
            })
            .collect()
    }

    #[test]
    fn lanes_come_back() {
        for count in [0, 1, 2, 3, 100, 5000, 40_000] {
            let lanes = [skewed(count, 1), skewed(count, 2), skewed(count, 3)];
            let size = round_trip([&lanes[0], &lanes[1], &lanes[2]], 5, Order::Natural);
            // The numbers hold two bits each.
            assert!(
                size < 3 * count / 4 + count / 50 + 300,
                "{count} symbols took {size} bytes"
            );
        }
    }

    #[test]
    fn one_symbol_only_costs_nothing() {
        let lane = vec![0x01ff; 10_000];
        assert!(round_trip([&lane, &lane, &lane], 2, Order::Signed) < 16);
    }

    #[test]
    fn all_symbols_of_all_contexts() {
        let lane: Vec<u16> = (0..KEYS as u16).collect();
        round_trip([&lane, &lane, &lane], CONTEXTS, Order::Signed);
    }

    #[test]
    fn a_lane_cut_short_is_noticed() {
        let lane = skewed(1000, 4);
        let mut histogram = Histogram::new();
        histogram.add(&lane);
        let mut table = Vec::new();
        let [stream] = Encoder::new(&histogram, 5, Order::Natural, &mut table).encode([&lane]);
        let (decoder, _) = Decoder::read(&table, 5, Order::Natural).unwrap();
        let mut reader = Lane::new(&stream[10..], decoder.log).unwrap();
        for &key in &lane {
            decoder.symbol(decoder.base(usize::from(key >> 8)), &mut reader);
        }
        assert!(reader.finish().is_err());
        assert!(Lane::new(&[], 8).is_err());
        assert!(Lane::new(&[1, 0], 8).is_err());
        assert!(Decoder::read(&table[..3], 5, Order::Natural).is_err());
    }
}
