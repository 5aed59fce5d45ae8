//! Planes and sequences of 16- or 32-bit samples, some of which may be missing.
//!
//! A difference is coded as a *token*, its size to about two bits, in a context of its surroundings; the bits below
//! follow plainly, for they are noise. A missing sample (no echo, NaN) is a token of its own: its place takes
//! the value left of it, so that prediction goes on undisturbed on the other side.
//!
//! Layout: `predictor · tables`, then per lane `tokens · plain bits`, each preceded by its length.

use crate::Error;
use crate::entropy::bits::{BitReader, BitWriter};
use crate::entropy::counts::{CONTEXTS, Order};
use crate::entropy::tans::{Decoder, Encoder, Histogram, Lane};
use crate::padded::{Lanes, Padded};
use crate::predict::{EASE, Kind, Predictor, Sample, with_predictor};
use crate::wire::{Cursor, put_block};

/// The token of a missing sample.
const MISSING: u8 = 200;
/// Differences below this are their own token.
const EXACT: u32 = 16;
/// Above it, four tokens per octave.
const LAST_TOKEN: usize = 16 + 27 * 4 + 3;

#[inline(always)]
fn token(residual: u32) -> (u8, u32) {
    if residual < EXACT {
        return (residual as u8, 0);
    }
    let octave = residual.ilog2();
    (
        (16 + (octave - 4) * 4 + ((residual >> (octave - 2)) & 3)) as u8,
        octave - 2,
    )
}

/// Per token: the smallest residual, and how many plain bits tell the rest.
fn residuals() -> [(u32, u32); 256] {
    std::array::from_fn(|token| match token {
        0..16 => (token as u32, 0),
        16..=LAST_TOKEN => {
            let octave = (token as u32 - 16) / 4 + 4;
            ((4 + token as u32 % 4) << (octave - 2), octave - 2)
        }
        _ => (0, 0),
    })
}

/// How many neighbouring contexts are merged into one (as a shift): tables cost bytes.
fn merge(samples: usize) -> u32 {
    match samples {
        0..0x200 => 5,
        0x200..0x800 => 3,
        0x800..0x2000 => 2,
        0x2000..0x8000 => 1,
        _ => 0,
    }
}

/// The samples of one column or plane. `missing`, of the same shape, is not zero where there is no sample.
pub(crate) struct Wide<T> {
    pub(crate) samples: Lanes<T>,
    pub(crate) missing: Option<Lanes<u8>>,
}

impl<T: Sample> Wide<T> {
    /// Gives every missing sample the value left of it.
    fn bridge(&mut self) {
        let Some(missing) = &mut self.missing else {
            return;
        };
        missing.close();
        for (plane, gaps) in self.samples.lanes.iter_mut().zip(&missing.lanes) {
            for y in 0..plane.height {
                plane.close_row_before(y);
                let start = plane.start(y);
                let mut last = if y > 0 {
                    plane.samples[start - plane.lag]
                } else {
                    T::default()
                };
                for (sample, &gap) in plane.row_mut(y).iter_mut().zip(gaps.row(y)) {
                    if gap != 0 {
                        *sample = last;
                    }
                    last = *sample;
                }
            }
        }
    }

    /// Encodes with the best predictor of `kinds`.
    pub(crate) fn encode(&mut self, kinds: &[Kind], out: &mut Vec<u8>) {
        self.bridge();
        self.samples.close();
        let kind = self.choose(kinds);
        let shift = merge(self.samples.count());
        out.push(kind as u8);
        let mut histogram = Histogram::new();
        let mut keys = Vec::with_capacity(self.samples.lanes.len());
        let mut plain = Vec::with_capacity(self.samples.lanes.len());
        for (index, plane) in self.samples.lanes.iter().enumerate() {
            let gaps = self.missing.as_ref().map(|missing| &missing.lanes[index]);
            let mut lane = vec![0u16; plane.width * plane.height];
            let mut bits = BitWriter::default();
            for (y, keys) in lane.chunks_exact_mut(plane.width.max(1)).enumerate() {
                let kind = row_kind(kind, y, plane.height);
                with_predictor!(kind, row_keys::<T>(plane, gaps, y, shift, keys, &mut bits));
                histogram.add(keys);
            }
            keys.push(lane);
            plain.push(bits.finish());
        }
        let encoder = Encoder::new(&histogram, CONTEXTS >> shift, Order::Natural, out);
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

    /// The predictor whose differences take the fewest bits on every sixteenth row, or on all of a short plane.
    fn choose(&self, kinds: &[Kind]) -> Kind {
        if let [only] = kinds {
            return *only;
        }
        let rows: usize = self.samples.lanes.iter().map(|plane| plane.height).sum();
        let step = (rows / 32).clamp(1, 16);
        let cost = |kind: Kind| -> u64 {
            let mut cost = 0;
            for plane in &self.samples.lanes {
                for y in (usize::from(plane.height > 1)..plane.height).step_by(step) {
                    cost += with_predictor!(kind, row_cost::<T>(plane, y));
                }
            }
            cost
        };
        kinds
            .iter()
            .copied()
            .min_by_key(|&kind| cost(kind))
            .unwrap_or(Kind::West)
    }

    /// Decodes into samples (and gaps) of the shape they were encoded with.
    pub(crate) fn decode(&mut self, input: &mut Cursor<'_>) -> Result<(), Error> {
        let kind = Kind::read(input.byte()?)?;
        let shift = merge(self.samples.count());
        let mut rest = *input;
        let (tables, used) = Decoder::read(rest.take_rest(), CONTEXTS >> shift, Order::Natural)?;
        input.take(used)?;
        let model = Model {
            bases: std::array::from_fn(|context| tables.base(context >> shift)),
            residuals: residuals(),
            tables,
        };
        for group in self.samples.groups() {
            let gaps = self
                .missing
                .as_mut()
                .map(|missing| &mut missing.lanes[group.clone()]);
            let planes = &mut self.samples.lanes[group];
            match (planes, gaps) {
                ([a], None) => model.group::<T, 1>(kind, [a], None, input)?,
                ([a], Some([x])) => model.group(kind, [a], Some([x]), input)?,
                ([a, b, c, d], None) => model.group::<T, 4>(kind, [a, b, c, d], None, input)?,
                ([a, b, c, d], Some([x, y, z, w])) => {
                    model.group(kind, [a, b, c, d], Some([x, y, z, w]), input)?;
                }
                _ => unreachable!("one plane makes one lane or four, and gaps have its shape"),
            }
        }
        Ok(())
    }
}

/// In the first row of a picture there is nothing above to guess from.
fn row_kind(kind: Kind, y: usize, height: usize) -> Kind {
    if y == 0 && height > 1 && kind != Kind::Zero {
        Kind::West
    } else {
        kind
    }
}

fn row_cost<P: Predictor, T: Sample>(plane: &Padded<T>, y: usize) -> u64 {
    let [a, b, c, d, v] = plane.neighbours(y);
    let mut sum = 0u64;
    for x in 0..v.len() {
        sum += u64::from(32 - v[x].residual::<P>(a[x], b[x], c[x], d[x]).leading_zeros());
    }
    sum
}

/// The context where the neighbour left (1) or above (2) is missing, or both.
#[inline(always)]
fn gap_context(left: u8, above: u8) -> u16 {
    EASE - 1 + u16::from(left != 0) + 2 * u16::from(above != 0)
}

#[inline(never)]
fn row_keys<P: Predictor, T: Sample>(
    plane: &Padded<T>,
    gaps: Option<&Padded<u8>>,
    y: usize,
    shift: u32,
    keys: &mut [u16],
    plain: &mut BitWriter,
) {
    let width = keys.len();
    let [a, b, c, d, v] = plane.neighbours(y).map(|row| &row[..width]);
    let gaps = gaps.map(|gaps| {
        let [left, above, _, _, here] = gaps.neighbours(y).map(|row| &row[..width]);
        (left, above, here)
    });
    for x in 0..width {
        let mut context = T::context::<P>(a[x], b[x], c[x], d[x]);
        let mut missing = false;
        if let Some((left, above, here)) = gaps {
            if left[x] | above[x] != 0 {
                context = gap_context(left[x], above[x]);
            }
            missing = here[x] != 0;
        }
        let token = if missing {
            MISSING
        } else {
            let residual = v[x].residual::<P>(a[x], b[x], c[x], d[x]);
            let (token, bits) = token(residual);
            plain.put(residual & ((1 << bits) - 1), bits);
            token
        };
        keys[x] = (context >> shift) << 8 | u16::from(token);
    }
}

struct Model {
    tables: Decoder,
    bases: [u16; CONTEXTS],
    residuals: [(u32, u32); 256],
}

impl Model {
    fn group<T: Sample, const N: usize>(
        &self,
        kind: Kind,
        mut planes: [&mut Padded<T>; N],
        mut gaps: Option<[&mut Padded<u8>; N]>,
        input: &mut Cursor<'_>,
    ) -> Result<(), Error> {
        let mut lanes = Vec::with_capacity(N);
        let mut plain = [BitReader::default(); N];
        for plain in &mut plain {
            lanes.push(Lane::new(input.block()?, self.tables.log)?);
            *plain = BitReader::new(input.block()?);
        }
        let Ok(mut lanes) = <[Lane<'_>; N]>::try_from(lanes) else {
            unreachable!("N lanes were pushed")
        };
        for y in 0..planes[0].height {
            let kind = row_kind(kind, y, planes[0].height);
            match &mut gaps {
                None => with_predictor!(
                    kind,
                    row_all::<T, N>(self, &mut planes, &mut lanes, &mut plain, y)
                ),
                Some(gaps) => with_predictor!(
                    kind,
                    row_gaps::<T, N>(self, &mut planes, gaps, &mut lanes, &mut plain, y)
                ),
            }
        }
        lanes.iter().try_for_each(Lane::finish)?;
        if plain.iter().any(BitReader::overran) {
            Err(Error::Truncated)
        } else {
            Ok(())
        }
    }

    #[inline(always)]
    fn residual(&self, token: u8, plain: &mut BitReader<'_>) -> u32 {
        let (smallest, bits) = self.residuals[usize::from(token)];
        if bits == 0 {
            smallest
        } else {
            smallest | plain.take(bits)
        }
    }
}

/// Decodes row `y` of every lane where no sample can be missing.
#[inline(never)]
fn row_all<P: Predictor, T: Sample, const N: usize>(
    model: &Model,
    planes: &mut [&mut Padded<T>; N],
    lanes: &mut [Lane<'_>; N],
    plain: &mut [BitReader<'_>; N],
    y: usize,
) {
    let (width, start, lag) = (planes[0].width, planes[0].start(y), planes[0].lag);
    let mut a = [T::default(); N];
    let (mut b, mut c) = (a, a);
    for lane in 0..N {
        planes[lane].open_row(y);
        a[lane] = planes[lane].samples[start - 1];
        b[lane] = planes[lane].samples[start - lag];
        c[lane] = planes[lane].samples[start - lag - 1];
    }
    for at in start..start + width {
        for lane in 0..N {
            let samples = &mut planes[lane].samples;
            let d = samples[at + 1 - lag];
            let base = model.bases[usize::from(T::context::<P>(a[lane], b[lane], c[lane], d))];
            let token = model.tables.symbol(base, &mut lanes[lane]);
            let residual = model.residual(token, &mut plain[lane]);
            let value = T::restore::<P>(residual, a[lane], b[lane], c[lane], d);
            samples[at] = value;
            a[lane] = value;
            c[lane] = b[lane];
            b[lane] = d;
        }
    }
}

/// Decodes row `y` of every lane, and where its samples are missing.
#[inline(never)]
fn row_gaps<P: Predictor, T: Sample, const N: usize>(
    model: &Model,
    planes: &mut [&mut Padded<T>; N],
    gaps: &mut [&mut Padded<u8>; N],
    lanes: &mut [Lane<'_>; N],
    plain: &mut [BitReader<'_>; N],
    y: usize,
) {
    let (width, start, lag) = (planes[0].width, planes[0].start(y), planes[0].lag);
    for lane in 0..N {
        planes[lane].open_row(y);
        gaps[lane].open_row(y);
    }
    for at in start..start + width {
        for lane in 0..N {
            let samples = &mut planes[lane].samples;
            let [a, b, c, d] = [
                samples[at - 1],
                samples[at - lag],
                samples[at - lag - 1],
                samples[at + 1 - lag],
            ];
            let (left, above) = (gaps[lane].samples[at - 1], gaps[lane].samples[at - lag]);
            let context = if left | above == 0 {
                T::context::<P>(a, b, c, d)
            } else {
                gap_context(left, above)
            };
            let token = model
                .tables
                .symbol(model.bases[usize::from(context)], &mut lanes[lane]);
            if token == MISSING {
                samples[at] = a;
                gaps[lane].samples[at] = 1;
            } else {
                samples[at] = T::restore::<P>(model.residual(token, &mut plain[lane]), a, b, c, d);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KINDS: [Kind; 7] = [
        Kind::West,
        Kind::North,
        Kind::Slope,
        Kind::Plane,
        Kind::Median,
        Kind::Middle,
        Kind::Line,
    ];

    #[test]
    fn tokens_name_every_residual() {
        let table = residuals();
        for residual in (0..70_000).chain([1 << 20, 1 << 31, u32::MAX]) {
            let (token, bits) = token(residual);
            assert!(usize::from(token) <= LAST_TOKEN);
            let low = if bits == 0 {
                0
            } else {
                residual & ((1 << bits) - 1)
            };
            assert_eq!(table[usize::from(token)], (residual - low, bits));
        }
    }

    fn round_trip<T: Sample + std::fmt::Debug>(
        shape: impl Fn() -> Lanes<T>,
        gaps: impl Fn() -> Option<Lanes<u8>>,
        kinds: &[Kind],
        sample: impl Fn(usize) -> Option<T>,
    ) -> usize {
        let mut wide = Wide {
            samples: shape(),
            missing: gaps(),
        };
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
        let mut back = Wide {
            samples: shape(),
            missing: gaps(),
        };
        let mut input = Cursor::new(&bytes);
        back.decode(&mut input).unwrap();
        input.finish().unwrap();
        let gaps: Vec<u8> = back
            .missing
            .iter()
            .flat_map(Lanes::rows)
            .flatten()
            .copied()
            .collect();
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
            for kind in KINDS {
                let size = width * height;
                let noise = |index: usize| (index as u32).wrapping_mul(2_654_435_761);
                round_trip(
                    || Lanes::pictures(1, width, height),
                    || None,
                    &[kind],
                    |index| Some((noise(index) >> 20) as u16 + index as u16),
                );
                round_trip(
                    || Lanes::pictures(1, width, height),
                    || None,
                    &[kind],
                    |index| Some(noise(index)),
                );
                round_trip(
                    || Lanes::pictures(1, width, height),
                    || Some(Lanes::pictures(1, width, height)),
                    &[kind],
                    |index| (noise(index) >> 30 != 0).then(|| noise(index) >> 3),
                );
                round_trip(
                    || Lanes::sequence(size),
                    || Some(Lanes::sequence(size)),
                    &KINDS,
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
            &KINDS,
            |index| {
                let (x, y) = (index % 640, index / 640);
                (!(200..300).contains(&x) || !(100..200).contains(&y))
                    .then_some((3 * x + 5 * y) as u16)
            },
        );
        assert!(size < 5000, "{size}");
    }

    #[test]
    fn a_cut_stream_is_an_error() {
        let mut wide = Wide {
            samples: Lanes::pictures(1, 40, 40),
            missing: None,
        };
        for y in 0..40 {
            wide.samples
                .row_mut(0, y)
                .iter_mut()
                .enumerate()
                .for_each(|(x, slot)| *slot = (x * y * y) as u16);
        }
        let mut bytes = Vec::new();
        wide.encode(&KINDS, &mut bytes);
        for length in 0..bytes.len() {
            let mut back = Wide {
                samples: Lanes::<u16>::pictures(1, 40, 40),
                missing: None,
            };
            assert!(
                back.decode(&mut Cursor::new(&bytes[..length])).is_err(),
                "{length}"
            );
        }
    }
}
