//! Codec for planes of 8-bit samples: predicts each sample from its neighbours and codes the difference in a context of
//! its surroundings.
//!
//! The first half of the encoder has no dependence from one sample to the next and is written for the vectoriser; the
//! decoder has one, and hides it by decoding several lanes in lockstep.
//!
//! Layout: `predictor · tables · lane₀ · lane₁ …`, each lane preceded by its length.

use crate::Error;
use crate::entropy::counts::SymbolOrder;
use crate::entropy::tans::{BATCH, Histogram, LaneReader, TansDecoder, TansEncoder};
use crate::padded::{Lanes, Padded};
use crate::predict::{self, Kind, Predictor};
use crate::wire::{FrameCursor, put_block};

/// Number of contexts of one plane; four planes share a model.
const CONTEXTS: usize = 8;
/// Activity ("unease") at which the next context begins.
const THRESHOLDS: [u16; CONTEXTS - 1] = [1, 3, 6, 10, 17, 30, 56];

/// Returns how many neighbouring contexts a plane of that many samples merges into one (as a shift): tables cost bytes.
fn merge_shift(samples: usize) -> u32 {
    match samples {
        0..0x400 => 3,
        0x400..0x1000 => 2,
        0x1000..0x4000 => 1,
        _ => 0,
    }
}

#[inline(always)]
fn unease(a: i16, b: i16, c: i16, d: i16) -> i16 {
    (a - c).abs() + (c - b).abs() + (b - d).abs()
}

/// Encodes all samples; `planes` is the number of lanes with models of their own.
pub(crate) fn encode(lanes: &mut Lanes<u8>, planes: usize, out: &mut Vec<u8>) {
    lanes.close();
    let count = lanes.count();
    let shift = merge_shift(count / planes.max(1));
    let kind = choose_predictor(lanes);
    out.push(kind as u8);
    let mut histogram = Histogram::new(contexts(planes));
    let keys: Vec<Vec<u16>> = lanes
        .lanes
        .iter()
        .enumerate()
        .map(|(index, lane)| {
            let first = if planes > 1 { (index * CONTEXTS) as u16 } else { 0 };
            let mut keys = vec![0u16; lane.width * lane.height];
            for (y, keys) in keys.chunks_exact_mut(lane.width.max(1)).enumerate() {
                let kind = if y == 0 { Kind::West } else { kind };
                match kind {
                    Kind::Median => row_keys::<predict::Median>(lane, y, first, shift, keys),
                    Kind::Slope => row_keys::<predict::Slope>(lane, y, first, shift, keys),
                    _ => row_keys::<predict::West>(lane, y, first, shift, keys),
                }
                histogram.add(keys);
            }
            keys
        })
        .collect();
    let encoder = TansEncoder::new(histogram, SymbolOrder::Signed, out);
    for group in lanes.groups() {
        let keys = &keys[group];
        match *keys {
            [ref a] => encoder.encode([a]).iter().for_each(|lane| put_block(out, lane)),
            [ref a, ref b] => encoder.encode([a, b]).iter().for_each(|lane| put_block(out, lane)),
            [ref a, ref b, ref c] => encoder.encode([a, b, c]).iter().for_each(|lane| put_block(out, lane)),
            [ref a, ref b, ref c, ref d] => encoder.encode([a, b, c, d]).iter().for_each(|lane| put_block(out, lane)),
            _ => unreachable!("a group has one to four lanes"),
        }
    }
}

fn contexts(planes: usize) -> usize {
    CONTEXTS * planes.max(1)
}

/// Returns the predictor with the smaller differences on every eighth row.
fn choose_predictor(lanes: &Lanes<u8>) -> Kind {
    let mut costs = [0u64; 2];
    for lane in &lanes.lanes {
        for y in (1..lane.height).step_by(8) {
            costs[0] += row_cost::<predict::Median>(lane, y);
            costs[1] += row_cost::<predict::Slope>(lane, y);
        }
    }
    if costs[0] < costs[1] { Kind::Median } else { Kind::Slope }
}

fn row_cost<P: Predictor>(lane: &Padded<u8>, y: usize) -> u64 {
    let [a, b, c, d, v] = lane.neighbours(y);
    let mut sum = 0u64;
    for ((((&a, &b), &c), &d), &v) in a.iter().zip(b).zip(c).zip(d).zip(v) {
        let guess = guess::<P>(a.into(), b.into(), c.into(), d.into());
        let difference = v.wrapping_sub(guess as u8) as i8;
        sum += u64::from((u32::from(difference.unsigned_abs()) * 2 + 1).ilog2());
    }
    sum
}

#[inline(always)]
fn guess<P: Predictor>(a: i16, b: i16, c: i16, d: i16) -> i16 {
    match P::KIND {
        Kind::Median => (a + b - c).clamp(a.min(b), a.max(b)),
        Kind::Slope => ((a + b) >> 1) + ((d - c) >> 2),
        _ => a,
    }
}

/// Computes the keys of row `y`. All slices have one length, so this becomes vector code.
#[inline(never)]
fn row_keys<P: Predictor>(lane: &Padded<u8>, y: usize, first: u16, shift: u32, keys: &mut [u16]) {
    let [a, b, c, d, v] = lane.neighbours(y);
    let width = keys.len();
    let (a, b, c, d, v) = (&a[..width], &b[..width], &c[..width], &d[..width], &v[..width]);
    for x in 0..width {
        let [a, b, c, d, v] = [a[x], b[x], c[x], d[x], v[x]].map(i16::from);
        let unease = unease(a, b, c, d);
        let mut context = 0i16;
        for threshold in THRESHOLDS {
            context += i16::from(unease >= threshold as i16);
        }
        let difference = (v - guess::<P>(a, b, c, d)) & 0xff;
        keys[x] = (((context as u16) >> shift) + first) << 8 | difference as u16;
    }
}

/// Decodes into lanes of the shape they were encoded with.
pub(crate) fn decode(input: &mut FrameCursor<'_>, lanes: &mut Lanes<u8>, planes: usize) -> Result<(), Error> {
    let kind = Kind::read(input.byte()?)?;
    if !matches!(kind, Kind::Median | Kind::Slope) {
        return Err(Error::Corrupt("a predictor that 8-bit planes do not use"));
    }
    let shift = merge_shift(lanes.count() / planes.max(1));
    let mut rest = *input;
    let (tables, used) = TansDecoder::read(rest.take_rest(), contexts(planes), SymbolOrder::Signed)?;
    input.take(used)?;
    let bases: Vec<[u16; 1024]> = (0..planes.max(1))
        .map(|plane| {
            std::array::from_fn(|unease| {
                let context = THRESHOLDS.iter().filter(|&&threshold| unease >= usize::from(threshold)).count();
                tables.base(plane * CONTEXTS + (context >> shift))
            })
        })
        .collect();
    for group in lanes.groups() {
        let lanes = &mut lanes.lanes[group];
        match lanes {
            [a] => decode_group(&tables, kind, &bases, [a], input)?,
            [a, b] => decode_group(&tables, kind, &bases, [a, b], input)?,
            [a, b, c] => decode_group(&tables, kind, &bases, [a, b, c], input)?,
            [a, b, c, d] => decode_group(&tables, kind, &bases, [a, b, c, d], input)?,
            _ => unreachable!("a group has one to four lanes"),
        }
    }
    Ok(())
}

fn decode_group<const N: usize>(
    tables: &TansDecoder,
    kind: Kind,
    bases: &[[u16; 1024]],
    mut planes: [&mut Padded<u8>; N],
    input: &mut FrameCursor<'_>,
) -> Result<(), Error> {
    let mut lanes = Vec::with_capacity(N);
    for _ in 0..N {
        lanes.push(tables.lane(input.block()?)?);
    }
    let Ok(mut lanes) = <[LaneReader<'_>; N]>::try_from(lanes) else { unreachable!("N lanes were pushed") };
    let bases: [&[u16; 1024]; N] = std::array::from_fn(|index| &bases[index.min(bases.len() - 1)]);
    if planes[0].is_sequence() {
        decode_sequence(tables, bases, &mut planes, &mut lanes);
        return lanes.iter().try_for_each(LaneReader::finish);
    }
    for y in 0..planes[0].height {
        match if y == 0 { Kind::West } else { kind } {
            Kind::Median => decode_row::<predict::Median, N>(tables, bases, &mut planes, &mut lanes, y),
            Kind::Slope => decode_row::<predict::Slope, N>(tables, bases, &mut planes, &mut lanes, y),
            _ => decode_row::<predict::West, N>(tables, bases, &mut planes, &mut lanes, y),
        }
    }
    lanes.iter().try_for_each(LaneReader::finish)
}

/// Decodes sequences, in which the neighbours above are the samples just decoded.
fn decode_sequence<const N: usize>(
    tables: &TansDecoder,
    bases: [&[u16; 1024]; N],
    planes: &mut [&mut Padded<u8>; N],
    lanes: &mut [LaneReader<'_>; N],
) {
    let (width, start) = (planes[0].width, planes[0].start(0));
    let mut windows = lanes.each_ref().map(LaneReader::window);
    // The last three samples, newest first.
    let mut last = [[0i16; 3]; N];
    for at in 0..width {
        for lane in 0..N {
            if at % BATCH == 0 {
                windows[lane] = lanes[lane].refill(windows[lane]);
            }
            let [a, b, c] = last[lane];
            let base = bases[lane][unease(a, b, c, a) as usize & 1023];
            let value = (a as u8).wrapping_add(tables.symbol(base, &mut windows[lane]));
            planes[lane].samples[start + at] = value;
            last[lane] = [value.into(), a, b];
        }
    }
    for lane in 0..N {
        lanes[lane].set_window(windows[lane]);
    }
}

/// Number of samples decoded at a time: what does not depend on them is computed before, in vector code.
const CHUNK: usize = 16 * BATCH;

/// The contribution of the row above to a chunk.
#[derive(Clone, Copy)]
struct RowAbove {
    /// Activity without the sample to the left.
    ease: [i16; CHUNK],
    corner: [i16; CHUNK],
    north: [i16; CHUNK],
    /// A quarter of the slope.
    tilt: [i16; CHUNK],
}

impl RowAbove {
    const NONE: Self = Self { ease: [0; CHUNK], corner: [0; CHUNK], north: [0; CHUNK], tilt: [0; CHUNK] };

    /// Loads the row above; `row` begins one sample left of the chunk and ends one to the right.
    #[inline(always)]
    fn load(&mut self, row: &[u8]) {
        let length = (row.len() - 2).min(CHUNK);
        let (corner, north, east) = (&row[..length], &row[1..=length], &row[2..length + 2]);
        for x in 0..length {
            let [c, b, d] = [corner[x], north[x], east[x]].map(i16::from);
            self.ease[x] = (c - b).abs() + (b - d).abs();
            self.corner[x] = c;
            self.north[x] = b;
            self.tilt[x] = (d - c) >> 2;
        }
    }
}

#[inline(never)]
fn decode_row<P: Predictor, const N: usize>(
    tables: &TansDecoder,
    bases: [&[u16; 1024]; N],
    planes: &mut [&mut Padded<u8>; N],
    lanes: &mut [LaneReader<'_>; N],
    y: usize,
) {
    let (width, start, lag) = (planes[0].width, planes[0].start(y), planes[0].lag);
    let mut windows = lanes.each_ref().map(LaneReader::window);
    let mut west = [0i16; N];
    for lane in 0..N {
        planes[lane].open_row(y);
        west[lane] = planes[lane].samples[start - 1].into();
    }
    let mut above = [RowAbove::NONE; N];
    let mut here = [[0u8; CHUNK]; N];
    let mut x = 0;
    while x < width {
        let length = (width - x).min(CHUNK);
        for lane in 0..N {
            above[lane].load(&planes[lane].samples[start + x - lag - 1..][..length + 2]);
        }
        for first in (0..length).step_by(BATCH) {
            for lane in 0..N {
                windows[lane] = lanes[lane].refill(windows[lane]);
            }
            let end = (first + BATCH).min(length).min(CHUNK);
            for at in first.min(end)..end {
                for lane in 0..N {
                    let (above, a) = (&above[lane], west[lane]);
                    let unease = above.ease[at] + (a - above.corner[at]).abs();
                    let base = bases[lane][unease as usize & 1023];
                    let difference = tables.symbol(base, &mut windows[lane]);
                    let guess = match P::KIND {
                        Kind::Slope => ((a + above.north[at]) >> 1) + above.tilt[at],
                        _ => guess::<P>(a, above.north[at], above.corner[at], 0),
                    };
                    let value = (guess as u8).wrapping_add(difference);
                    here[lane][at] = value;
                    west[lane] = value.into();
                }
            }
        }
        for lane in 0..N {
            planes[lane].samples[start + x..start + x + length].copy_from_slice(&here[lane][..length]);
        }
        x += length;
    }
    for lane in 0..N {
        lanes[lane].set_window(windows[lane]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn round_trip(planes: usize, width: usize, height: usize, sample: impl Fn(usize, usize, usize) -> u8) -> usize {
        let mut lanes = Lanes::pictures(planes, width, height);
        for plane in 0..planes {
            for y in 0..height {
                for (x, slot) in lanes.row_mut(plane, y).iter_mut().enumerate() {
                    *slot = sample(plane, x, y);
                }
            }
        }
        let mut bytes = Vec::new();
        encode(&mut lanes, planes, &mut bytes);
        let mut back = Lanes::pictures(planes, width, height);
        let mut input = FrameCursor::new(&bytes);
        decode(&mut input, &mut back, planes).unwrap();
        input.finish().unwrap();
        for plane in 0..planes {
            for y in 0..height {
                assert_eq!(back.row(plane, y), lanes.row(plane, y), "plane {plane}, row {y}");
            }
        }
        bytes.len()
    }

    #[test]
    fn pictures_of_all_shapes_come_back() {
        for planes in 1..=4 {
            for (width, height) in [(1, 1), (1, 7), (7, 1), (2, 2), (33, 35), (64, 32), (100, 131)] {
                round_trip(planes, width, height, |plane, x, y| (x * y * (plane + 3) + x) as u8);
                round_trip(planes, width, height, |_, x, y| ((x * 2_654_435_761 + y * 40_503) >> 7) as u8);
            }
        }
    }

    #[test]
    fn a_flat_picture_is_nearly_free() {
        assert!(round_trip(3, 640, 480, |plane, _, _| 40 * plane as u8) < 400);
        assert!(round_trip(1, 640, 480, |_, x, _| (x / 4) as u8) < 4000);
    }

    #[test]
    fn a_cut_stream_is_an_error() {
        let mut lanes = Lanes::pictures(1, 40, 40);
        for y in 0..40 {
            lanes.row_mut(0, y).iter_mut().enumerate().for_each(|(x, slot)| *slot = (x * y) as u8);
        }
        let mut bytes = Vec::new();
        encode(&mut lanes, 1, &mut bytes);
        for length in 0..bytes.len() {
            let mut back = Lanes::pictures(1, 40, 40);
            assert!(decode(&mut FrameCursor::new(&bytes[..length]), &mut back, 1).is_err(), "{length}");
        }
    }
}
