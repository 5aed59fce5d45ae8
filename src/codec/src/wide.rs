//! Codec for planes and sequences of 16- or 32-bit samples, some of which may be missing.
//!
//! A difference is coded as a *token*, its size to about two bits, in a context of its surroundings; the bits below
//! follow uncoded, since they are noise. A missing sample (no echo, NaN) has a token of its own: it takes the value to
//! its left, so that prediction continues undisturbed beyond it.
//!
//! Layout: `predictor · tables`, then per lane `tokens · plain bits`, each preceded by its length.

mod decode;

use crate::entropy::bits::BitWriter;
use crate::entropy::counts::{CONTEXTS, SymbolOrder};
use crate::entropy::tans::{Histogram, TansEncoder};
use crate::padded::{Lanes, Padded};
use crate::predict::{EASE, Kind, PlaneSample, Predictor, scaled_log, with_predictor};
use crate::wire::put_block;

/// Token of a missing sample.
const MISSING: u8 = LAST_TOKEN as u8 + 1;
/// Differences below this are their own token; above it there are four tokens per octave.
const EXACT: u32 = 16;
/// Token of the largest difference.
const LAST_TOKEN: usize = 16 + 27 * 4 + 3;

/// Per token: the smallest difference, and the number of plain bits for the rest.
const RESIDUALS: [(u32, u32); 256] = {
    let mut residuals = [(0, 0); 256];
    let mut token = 0;
    while token <= LAST_TOKEN {
        residuals[token] = if token < EXACT as usize {
            (token as u32, 0)
        } else {
            let octave = (token as u32 - 16) / 4 + 4;
            ((4 + token as u32 % 4) << (octave - 2), octave - 2)
        };
        token += 1;
    }
    residuals
};

/// Returns a difference's token, and the number of its low bits that follow plainly, in arithmetic that the vectoriser
/// can use.
#[inline(always)]
fn tokenise(residual: u32) -> (u32, u32) {
    let log = scaled_log(residual, 2);
    if residual < EXACT { (residual, 0) } else { (log, (log >> 2) - 2) }
}

/// Shift that merges all contexts into one.
const ALL: u32 = CONTEXTS.ilog2();

/// Returns how many neighbouring contexts are merged into one (as a shift): tables cost bytes and time.
fn merge_shift(samples: usize) -> u32 {
    match samples {
        0..0x800 => ALL,
        0x800..0x1000 => 3,
        0x1000..0x2000 => 2,
        0x2000..0x8000 => 1,
        _ => 0,
    }
}

/// The samples of one column or plane. `missing`, of the same shape, is not zero where there is no sample.
pub(crate) struct Wide<T> {
    pub(crate) samples: Lanes<T>,
    pub(crate) missing: Option<Lanes<u8>>,
}

impl<T: PlaneSample> Wide<T> {
    /// Gives every missing sample the value to its left.
    fn bridge(&mut self) {
        let Some(missing) = &mut self.missing else {
            return;
        };
        missing.close();
        for (plane, gaps) in self.samples.lanes.iter_mut().zip(&missing.lanes) {
            for y in 0..plane.height {
                plane.open_row(y);
                let mut last = plane.samples[plane.start(y) - 1];
                for (sample, &gap) in plane.row_mut(y).iter_mut().zip(gaps.row(y)) {
                    last = if gap != 0 { last } else { *sample };
                    *sample = last;
                }
            }
        }
    }

    /// Encodes with the best predictor of `kinds`.
    pub(crate) fn encode(&mut self, kinds: &[Kind], out: &mut Vec<u8>) {
        self.bridge();
        self.samples.close();
        let kind = self.choose_predictor(kinds);
        let shift = merge_shift(self.samples.count());
        out.push(kind as u8);
        let mut histogram = Histogram::new(CONTEXTS >> shift);
        let mut keys = Vec::with_capacity(self.samples.lanes.len());
        let mut plain = Vec::with_capacity(self.samples.lanes.len());
        for (index, plane) in self.samples.lanes.iter().enumerate() {
            let gaps = self.missing.as_ref().map(|missing| &missing.lanes[index]);
            let mut lane = vec![0u16; plane.width * plane.height];
            let mut bits = BitWriter::with_capacity(lane.len() / 2);
            for (y, keys) in lane.chunks_exact_mut(plane.width.max(1)).enumerate() {
                let kind = row_kind(kind, y, plane.height);
                with_predictor!(kind, row_keys::<T>(plane, gaps, y, shift, keys, &mut bits));
                histogram.add(keys);
            }
            keys.push(lane);
            plain.push(bits.finish());
        }
        let encoder = TansEncoder::new(histogram, SymbolOrder::Natural, out);
        for group in self.samples.groups() {
            let first = group.start;
            let mut put = |lanes: &[Vec<u8>]| {
                for (index, lane) in lanes.iter().enumerate() {
                    put_block(out, lane);
                    put_block(out, &plain[first + index]);
                }
            };
            match keys[group] {
                [ref a] => put(&encoder.encode([a])),
                [ref a, ref b, ref c, ref d] => put(&encoder.encode([a, b, c, d])),
                _ => unreachable!("one plane makes one lane or four"),
            }
        }
    }

    /// Returns the predictor whose differences take the fewest bits on some rows of a picture, or at the start of a
    /// sequence.
    fn choose_predictor(&self, kinds: &[Kind]) -> Kind {
        /// Number of samples of a row to look at.
        const SAMPLES_PER_ROW: usize = 40;
        if let [only] = kinds {
            return *only;
        }
        let rows: usize = self.samples.lanes.iter().map(|plane| plane.height).sum();
        let step = (rows / 32).clamp(1, 16);
        let sequence = self.samples.lanes.first().is_some_and(Padded::is_sequence);
        let some = if sequence { SAMPLES_PER_ROW } else { usize::MAX };
        let cost = |kind: Kind| -> u64 {
            let mut cost = 0;
            for plane in &self.samples.lanes {
                for y in (usize::from(plane.height > 1)..plane.height).step_by(step) {
                    cost += with_predictor!(kind, row_cost::<T>(plane, y, some));
                }
            }
            cost
        };
        kinds.iter().copied().min_by_key(|&kind| cost(kind)).unwrap_or(Kind::West)
    }
}

/// Returns the predictor for a row: in the first row of a picture there is nothing above to predict from.
fn row_kind(kind: Kind, y: usize, height: usize) -> Kind {
    if y == 0 && height > 1 && kind != Kind::Zero { Kind::West } else { kind }
}

fn row_cost<P: Predictor, T: PlaneSample>(plane: &Padded<T>, y: usize, some: usize) -> u64 {
    let length = plane.width.min(some);
    let [a, b, c, d, v] = plane.neighbours(y).map(|row| &row[..length]);
    let mut sum = 0u32;
    for x in 0..length {
        let residual = v[x].residual::<P>(a[x], b[x], c[x], d[x]) & T::RESIDUAL;
        sum += if residual == 0 { 0 } else { scaled_log(residual, 0) + 1 };
    }
    sum.into()
}

/// Returns the context if the neighbour left (1) or above (2) is missing, or both.
#[inline(always)]
fn gap_context(left: u8, above: u8) -> u16 {
    EASE - 1 + u16::from(left != 0) + 2 * u16::from(above != 0)
}

#[inline(never)]
fn row_keys<P: Predictor, T: PlaneSample>(
    plane: &Padded<T>,
    gaps: Option<&Padded<u8>>,
    y: usize,
    shift: u32,
    keys: &mut [u16],
    plain: &mut BitWriter,
) {
    /// Number of samples processed at a time: first the part for the vectoriser, then the rest.
    const CHUNK: usize = 64;
    let width = keys.len();
    let rows = plane.neighbours(y).map(|row| &row[..width]);
    let gaps = gaps.map(|gaps| gaps.neighbours(y).map(|row| &row[..width]));
    let mut residuals = [0u32; CHUNK];
    let mut contexts = [0u16; CHUNK];
    let mut tokens = [0u16; CHUNK];
    let mut counts = [0u8; CHUNK];
    for (index, keys) in keys.chunks_mut(CHUNK).enumerate() {
        let range = index * CHUNK..index * CHUNK + keys.len();
        let [a, b, c, d, v] = rows.map(|row| &row[range.clone()]);
        let length = keys.len().min(CHUNK);
        for x in 0..length {
            residuals[x] = v[x].residual::<P>(a[x], b[x], c[x], d[x]) & T::RESIDUAL;
        }
        if shift != ALL {
            for x in 0..length {
                let unease = T::unease::<P>(T::ease::<P>(b[x], c[x], d[x]), a[x], c[x]);
                contexts[x] = T::branchless_context(unease);
            }
        }
        for x in 0..length {
            let (token, count) = tokenise(residuals[x]);
            (tokens[x], counts[x]) = (token as u16, count as u8);
        }
        if let Some(gaps) = gaps {
            let [left, above, _, _, here] = gaps.map(|row| &row[range.clone()]);
            // Gaps are unpredictable, so there is no branch on them.
            let mask = |yes: bool| 0u16.wrapping_sub(yes.into());
            for x in 0..length {
                let gap = mask(here[x] != 0);
                tokens[x] = tokens[x] & !gap | u16::from(MISSING) & gap;
                counts[x] &= !gap as u8;
            }
            if shift != ALL {
                for x in 0..length {
                    let near = mask(left[x] | above[x] != 0);
                    contexts[x] = contexts[x] & !near | gap_context(left[x], above[x]) & near;
                }
            }
        }
        for x in 0..length {
            keys[x] = (contexts[x] >> shift) << 8 | tokens[x];
        }
        plain.put_low(&residuals[..length], &counts[..length]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::FrameCursor;

    const PICTURE: [Kind; 6] = [Kind::West, Kind::North, Kind::Slope, Kind::Plane, Kind::Median, Kind::Middle];
    const SEQUENCE: [Kind; 2] = [Kind::West, Kind::Line];

    /// Returns the token of a difference.
    fn token_of(residual: u32) -> u8 {
        if residual < EXACT {
            return residual as u8;
        }
        let octave = residual.ilog2();
        (16 + (octave - 4) * 4 + ((residual >> (octave - 2)) & 3)) as u8
    }

    #[test]
    fn tokens_name_every_residual() {
        for residual in (0..70_000).chain([1 << 20, 1 << 31, u32::MAX]) {
            let (token, count) = tokenise(residual);
            let (smallest, bits) = RESIDUALS[token as usize];
            assert!(token as usize <= LAST_TOKEN && token == u32::from(token_of(residual)));
            assert_eq!(bits, count);
            assert!((smallest..=smallest + ((1u32 << bits) - 1)).contains(&residual));
            // The bits that follow are the lowest ones, unchanged.
            assert_eq!(smallest & ((1 << bits) - 1), 0);
        }
    }

    fn round_trip<T: PlaneSample + std::fmt::Debug>(
        shape: impl Fn() -> Lanes<T>,
        gaps: impl Fn() -> Option<Lanes<u8>>,
        kinds: &[Kind],
        sample: impl Fn(usize) -> Option<T>,
    ) -> usize {
        let mut wide = Wide { samples: shape(), missing: gaps() };
        let mut index = 0;
        for lane in 0..wide.samples.lanes.len() {
            for y in 0..wide.samples.lanes[lane].height {
                for x in 0..wide.samples.lanes[lane].width {
                    let value = sample(index);
                    wide.samples.lanes[lane].row_mut(y)[x] = value.unwrap_or_default();
                    if let Some(missing) = &mut wide.missing {
                        missing.lanes[lane].row_mut(y)[x] = u8::from(value.is_none());
                    }
                    index += 1;
                }
            }
        }
        let mut bytes = Vec::new();
        wide.encode(kinds, &mut bytes);
        let mut back = Wide { samples: shape(), missing: gaps() };
        let mut input = FrameCursor::new(&bytes);
        back.decode(&mut input).unwrap();
        input.finish().unwrap();
        let gaps: Vec<u8> = back.missing.iter().flat_map(Lanes::rows).flatten().copied().collect();
        for (index, &value) in back.samples.rows().flatten().enumerate() {
            if gaps.get(index).is_some_and(|&gap| gap != 0) {
                assert_eq!(sample(index), None);
            } else {
                assert_eq!(Some(value), sample(index).or(Some(T::default())), "{index}");
            }
        }
        bytes.len()
    }

    #[test]
    fn planes_of_all_shapes_come_back() {
        for (width, height) in [(1, 1), (1, 40), (40, 1), (31, 33), (64, 67)] {
            for kind in PICTURE {
                let size = width * height;
                let noise = |index: usize| (index as u32).wrapping_mul(2_654_435_761);
                round_trip(
                    || Lanes::pictures(1, width, height),
                    || None,
                    &[kind],
                    |index| Some((noise(index) >> 20) as u16 + index as u16),
                );
                round_trip(|| Lanes::pictures(1, width, height), || None, &[kind], |index| Some(noise(index)));
                round_trip(
                    || Lanes::pictures(1, width, height),
                    || Some(Lanes::pictures(1, width, height)),
                    &[kind],
                    |index| (noise(index) >> 30 != 0).then(|| noise(index) >> 3),
                );
                round_trip(
                    || Lanes::sequence(size),
                    || Some(Lanes::sequence(size)),
                    &SEQUENCE,
                    |index| (index % 7 != 0).then_some(index as u16),
                );
            }
        }
    }

    #[test]
    fn a_tilted_plane_with_holes_is_nearly_free() {
        let size = round_trip(
            || Lanes::pictures(1, 640, 480),
            || Some(Lanes::pictures(1, 640, 480)),
            &PICTURE,
            |index| {
                let (x, y) = (index % 640, index / 640);
                (!(200..300).contains(&x) || !(100..200).contains(&y)).then_some((3 * x + 5 * y) as u16)
            },
        );
        assert!(size < 5000, "{size}");
    }

    #[test]
    fn a_cut_stream_is_an_error() {
        let mut wide = Wide { samples: Lanes::pictures(1, 40, 40), missing: None };
        for y in 0..40 {
            wide.samples.row_mut(0, y).iter_mut().enumerate().for_each(|(x, slot)| *slot = (x * y * y) as u16);
        }
        let mut bytes = Vec::new();
        wide.encode(&PICTURE, &mut bytes);
        for length in 0..bytes.len() {
            let mut back = Wide { samples: Lanes::<u16>::pictures(1, 40, 40), missing: None };
            assert!(back.decode(&mut FrameCursor::new(&bytes[..length])).is_err(), "{length}");
        }
    }
}
