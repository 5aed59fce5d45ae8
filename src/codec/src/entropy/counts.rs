//! Symbol counts per context, normalised to a power of two and written compactly.

use super::bits::{BitReader, BitWriter};
use crate::Error;

/// Number of symbols of one context.
pub(crate) const SYMBOLS: usize = 256;
/// Number of contexts of one model.
pub(crate) const CONTEXTS: usize = 32;
/// Logarithm of the largest table: 2^11 states per context.
pub(crate) const MAX_LOG: u32 = 11;

/// The order in which a table lists its symbols: from likely to unlikely, so that the list ends early.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum SymbolOrder {
    /// Symbols are small numbers.
    Natural,
    /// Symbols are signed differences modulo 256: 0, -1, 1, -2, 2, …
    Signed,
}

impl SymbolOrder {
    fn symbol(self, rank: usize) -> usize {
        match self {
            Self::Natural => rank,
            Self::Signed => ((rank >> 1) ^ (0usize.wrapping_sub(rank & 1))) & 0xff,
        }
    }
}

/// Counts of one context: all zero, or with a sum of exactly 2^log.
pub(crate) type SymbolCounts = [u16; SYMBOLS];

/// Returns the logarithm of the table size that is worth its header for that many symbols.
pub(crate) fn table_log(symbols: usize) -> u32 {
    match symbols {
        0..0x800 => 8,
        0x800..0x1000 => 9,
        0x1000..0x4000 => 10,
        _ => MAX_LOG,
    }
}

/// Scales `histogram` to a sum of 2^log, keeping every symbol that occurs. An all-zero histogram stays all zero.
pub(crate) fn normalise(histogram: &[u32], log: u32) -> SymbolCounts {
    let mut counts = [0u16; SYMBOLS];
    let total: u64 = histogram.iter().map(|&count| u64::from(count)).sum();
    if total == 0 {
        return counts;
    }
    let size = 1i32 << log;
    let last = histogram.iter().rposition(|&count| count > 0).unwrap_or(0);
    let histogram = &histogram[..=last];
    // Symbols too rare for a state get one nevertheless; the others share the rest.
    let rare = (total >> (log + 1)) as u32;
    let (mut few, mut few_total) = (0i32, 0u64);
    for &count in histogram {
        let is_rare = count > 0 && count <= rare;
        few += i32::from(is_rare);
        few_total += if is_rare { u64::from(count) } else { 0 };
    }
    let scale = f64::from(size - few) / (total - few_total).max(1) as f64;
    let mut left = size;
    let (mut largest, mut most) = (0, 0);
    for (symbol, &count) in histogram.iter().enumerate() {
        let scaled = ((f64::from(count) * scale + 0.5) as u16).max(u16::from(count > 0));
        counts[symbol] = scaled;
        left -= i32::from(scaled);
        if count > most {
            (largest, most) = (symbol, count);
        }
    }
    if left + i32::from(counts[largest]) > i32::from(counts[largest]) / 2 {
        counts[largest] = (i32::from(counts[largest]) + left) as u16;
    } else {
        remove_excess(&mut counts, left);
    }
    counts
}

/// Removes the excess of rounding up where a single state matters least.
#[cold]
fn remove_excess(counts: &mut SymbolCounts, mut left: i32) {
    // From each symbol in proportion to its count above one.
    let above: i32 = counts.iter().map(|&count| i32::from(count.saturating_sub(1))).sum();
    let owed = -left;
    for count in counts.iter_mut().filter(|count| **count > 1) {
        let share = ((i32::from(*count) - 1) * owed / above.max(1)).min(-left.min(0));
        *count -= share as u16;
        left += share;
    }
    while left < 0 {
        let richest = (0..SYMBOLS).max_by_key(|&symbol| counts[symbol]).unwrap_or(0);
        counts[richest] -= 1;
        left += 1;
    }
}

/// Writes the counts of one context: Rice codes whose parameter adapts to the counts before, with runs of zeros coded
/// separately.
pub(crate) fn write(counts: &SymbolCounts, order: SymbolOrder, log: u32, out: &mut BitWriter) {
    let total: u32 = counts.iter().map(|&count| u32::from(count)).sum();
    out.put(u32::from(total > 0), 1);
    if total == 0 {
        return;
    }
    let mut left = 1u32 << log;
    let mut average = left / 4;
    let mut rank = 0;
    while left > 0 {
        let count = u32::from(counts[order.symbol(rank)]);
        out.put_rice(count, rice_parameter(average));
        average = (average + count).div_ceil(2);
        left -= count;
        rank += 1;
        if count == 0 {
            let zeros = (rank..SYMBOLS).take_while(|&rank| counts[order.symbol(rank)] == 0).count();
            out.put_gamma(zeros as u32 + 1);
            rank += zeros;
        }
    }
}

/// Reads what [`write`] wrote.
pub(crate) fn read(order: SymbolOrder, log: u32, input: &mut BitReader<'_>) -> Result<SymbolCounts, Error> {
    const BAD: Error = Error::Corrupt("a table of counts that does not add up");
    let mut counts = [0u16; SYMBOLS];
    if input.take(1) == 0 {
        return Ok(counts);
    }
    let mut left = 1u32 << log;
    let mut average = left / 4;
    let mut rank = 0;
    while left > 0 {
        if rank >= SYMBOLS || input.has_overrun() {
            return Err(BAD);
        }
        let count = input.take_rice(rice_parameter(average), left).filter(|&count| count <= left).ok_or(BAD)?;
        counts[order.symbol(rank)] = count as u16;
        average = (average + count).div_ceil(2);
        left -= count;
        rank += 1;
        if count == 0 {
            let zeros = input.take_gamma().ok_or(BAD)? as usize - 1;
            if zeros > SYMBOLS - rank {
                return Err(BAD);
            }
            rank += zeros;
        }
    }
    Ok(counts)
}

fn rice_parameter(average: u32) -> u32 {
    let half = average / 2;
    if half == 0 { 0 } else { 32 - half.leading_zeros() - 1 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn round_trip(histogram: &[u32; SYMBOLS], log: u32, order: SymbolOrder) -> SymbolCounts {
        let counts = normalise(histogram, log);
        let mut writer = BitWriter::default();
        write(&counts, order, log, &mut writer);
        let bytes = writer.finish();
        let read = read(order, log, &mut BitReader::new(&bytes)).unwrap();
        assert_eq!(read, counts);
        counts
    }

    #[test]
    fn every_symbol_that_occurs_keeps_a_state() {
        let mut histogram = [1u32; SYMBOLS];
        histogram[7] = 1_000_000;
        for log in [8, 9, 11] {
            let counts = round_trip(&histogram, log, SymbolOrder::Natural);
            assert!(counts.iter().all(|&count| count > 0));
            assert_eq!(counts.iter().map(|&count| u32::from(count)).sum::<u32>(), 1 << log);
        }
    }

    #[test]
    fn a_single_symbol_and_none_at_all() {
        let mut histogram = [0u32; SYMBOLS];
        assert_eq!(round_trip(&histogram, 9, SymbolOrder::Signed), [0; SYMBOLS]);
        histogram[255] = 3;
        assert_eq!(round_trip(&histogram, 9, SymbolOrder::Signed)[255], 512);
    }

    #[test]
    fn signed_order_is_a_permutation() {
        let mut seen = [false; SYMBOLS];
        for rank in 0..SYMBOLS {
            seen[SymbolOrder::Signed.symbol(rank)] = true;
        }
        assert!(seen.iter().all(|&seen| seen));
        assert_eq!([0, 1, 2].map(|rank| SymbolOrder::Signed.symbol(rank)), [0, 255, 1]);
    }
}
