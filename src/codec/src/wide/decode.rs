//! Inner loops of the decoder.
//!
//! Every sample depends on the one to its left. So lanes run in lockstep, the contribution of the row above is computed
//! before in vector code, and buffers are small arrays whose size the compiler knows.

use super::{MISSING, RESIDUALS, Wide, gap_context, merge_shift, row_kind};
use crate::Error;
use crate::entropy::bits::BitReader;
use crate::entropy::counts::{CONTEXTS, SymbolOrder};
use crate::entropy::tans::{BATCH, LaneReader, TansDecoder};
use crate::padded::Padded;
use crate::predict::{EASE, Kind, PlaneSample, Predictor, with_predictor};
use crate::wire::FrameCursor;

impl<T: PlaneSample> Wide<T> {
    /// Decodes into samples (and gaps) of the shape they were encoded with.
    pub(crate) fn decode(&mut self, input: &mut FrameCursor<'_>) -> Result<(), Error> {
        let kind = Kind::read(input.byte()?)?;
        let shift = merge_shift(self.samples.count());
        let mut rest = *input;
        let (tables, used) = TansDecoder::read(rest.take_rest(), CONTEXTS >> shift, SymbolOrder::Natural)?;
        input.take(used)?;
        let bases = std::array::from_fn(|context| tables.base(context >> shift));
        let model = Model { bases, tables };
        for group in self.samples.groups() {
            let gaps = self.missing.as_mut().map(|missing| &mut missing.lanes[group.clone()]);
            let planes = &mut self.samples.lanes[group];
            match (planes, gaps) {
                ([a], None) => model.decode_group::<T, 1>(kind, [a], None, input)?,
                ([a], Some([x])) => model.decode_group(kind, [a], Some([x]), input)?,
                ([a, b, c, d], None) => model.decode_group::<T, 4>(kind, [a, b, c, d], None, input)?,
                ([a, b, c, d], Some([x, y, z, w])) => {
                    model.decode_group(kind, [a, b, c, d], Some([x, y, z, w]), input)?;
                }
                _ => unreachable!("one plane makes one lane or four, and gaps have its shape"),
            }
        }
        Ok(())
    }
}

struct Model {
    tables: TansDecoder,
    bases: [u16; CONTEXTS],
}

/// Streams of `N` lanes.
struct Streams<'a, const N: usize> {
    lanes: [LaneReader<'a>; N],
    plain: [BitReader<'a>; N],
}

impl Model {
    fn decode_group<T: PlaneSample, const N: usize>(
        &self,
        kind: Kind,
        mut planes: [&mut Padded<T>; N],
        gaps: Option<[&mut Padded<u8>; N]>,
        input: &mut FrameCursor<'_>,
    ) -> Result<(), Error> {
        let mut lanes = Vec::with_capacity(N);
        let mut plain = [BitReader::default(); N];
        for plain in &mut plain {
            lanes.push(self.tables.lane(input.block()?)?);
            *plain = BitReader::new(input.block()?);
        }
        let Ok(lanes) = lanes.try_into() else { unreachable!("N lanes were pushed") };
        let mut streams = Streams { lanes, plain };
        match gaps {
            None => {
                // Never read.
                let mut none: [Padded<u8>; N] = std::array::from_fn(|_| Padded::sequence(0));
                self.decode_rows::<T, N, false>(kind, &mut planes, &mut none.each_mut(), &mut streams);
            }
            Some(mut gaps) => self.decode_rows::<T, N, true>(kind, &mut planes, &mut gaps, &mut streams),
        }
        streams.lanes.iter().try_for_each(LaneReader::finish)?;
        if streams.plain.iter().any(BitReader::has_overrun) { Err(Error::Truncated) } else { Ok(()) }
    }

    fn decode_rows<T: PlaneSample, const N: usize, const GAPS: bool>(
        &self,
        kind: Kind,
        planes: &mut [&mut Padded<T>; N],
        gaps: &mut [&mut Padded<u8>; N],
        streams: &mut Streams<'_, N>,
    ) {
        if planes[0].is_sequence() {
            match kind {
                Kind::Zero => decode_sequence::<crate::predict::Zero, T, N, GAPS>(self, planes, gaps, streams),
                Kind::Line => decode_sequence::<crate::predict::Line, T, N, GAPS>(self, planes, gaps, streams),
                _ => decode_sequence::<crate::predict::West, T, N, GAPS>(self, planes, gaps, streams),
            }
            return;
        }
        for y in 0..planes[0].height {
            let kind = row_kind(kind, y, planes[0].height);
            with_predictor!(kind, row::<T, N, GAPS>(self, planes, gaps, streams, y));
        }
    }
}

/// Number of samples decoded at a time.
const CHUNK: usize = 16 * BATCH;

/// The contribution of the row above to a chunk.
struct WideRowAbove<T> {
    ease: [u32; CHUNK],
    corner: [T; CHUNK],
    north: [T; CHUNK],
    east: [T; CHUNK],
    gaps: [u8; CHUNK],
}

impl<T: PlaneSample> WideRowAbove<T> {
    fn new() -> Self {
        let none = [T::default(); CHUNK];
        Self { ease: [0; CHUNK], corner: none, north: none, east: none, gaps: [0; CHUNK] }
    }

    /// Loads the row above; `row` begins one sample left of the chunk and ends one to the right.
    #[inline(always)]
    fn load<P: Predictor>(&mut self, row: &[T]) {
        let length = (row.len() - 2).min(CHUNK);
        let (corner, north, east) = (&row[..length], &row[1..=length], &row[2..length + 2]);
        self.corner[..length].copy_from_slice(corner);
        self.north[..length].copy_from_slice(north);
        self.east[..length].copy_from_slice(east);
        for x in 0..length {
            self.ease[x] = T::ease::<P>(north[x], corner[x], east[x]);
        }
    }
}

#[inline(never)]
fn row<P: Predictor, T: PlaneSample, const N: usize, const GAPS: bool>(
    model: &Model,
    planes: &mut [&mut Padded<T>; N],
    gaps: &mut [&mut Padded<u8>; N],
    streams: &mut Streams<'_, N>,
    y: usize,
) {
    let (width, start, lag) = (planes[0].width, planes[0].start(y), planes[0].lag);
    let mut windows = streams.lanes.each_ref().map(LaneReader::window);
    let mut plain = streams.plain;
    let mut west = [T::default(); N];
    let mut gap = [0u8; N];
    for lane in 0..N {
        planes[lane].open_row(y);
        west[lane] = planes[lane].samples[start - 1];
        if GAPS {
            gaps[lane].open_row(y);
            gap[lane] = gaps[lane].samples[start - 1];
        }
    }
    let mut above: [WideRowAbove<T>; N] = std::array::from_fn(|_| WideRowAbove::new());
    let mut here = [[T::default(); CHUNK]; N];
    let mut missing = [[0u8; CHUNK]; N];
    let mut x = 0;
    while x < width {
        let length = (width - x).min(CHUNK);
        for lane in 0..N {
            above[lane].load::<P>(&planes[lane].samples[start + x - lag - 1..][..length + 2]);
            if GAPS {
                let row = &gaps[lane].samples[start + x - lag..][..length];
                above[lane].gaps[..length].copy_from_slice(row);
            }
        }
        for first in (0..length).step_by(BATCH) {
            for lane in 0..N {
                windows[lane] = streams.lanes[lane].refill(windows[lane]);
            }
            let end = (first + BATCH).min(length).min(CHUNK);
            for at in first.min(end)..end {
                for lane in 0..N {
                    let (above, a) = (&above[lane], west[lane]);
                    let (b, c, d) = (above.north[at], above.corner[at], above.east[at]);
                    let mut context = T::context(T::unease::<P>(above.ease[at], a, c));
                    if GAPS && gap[lane] | above.gaps[at] != 0 {
                        context = gap_context(gap[lane], above.gaps[at]);
                    }
                    let base = model.bases[usize::from(context) & (CONTEXTS - 1)];
                    let token = model.tables.symbol(base, &mut windows[lane]);
                    let absent = GAPS && token == MISSING;
                    let (smallest, bits) = RESIDUALS[usize::from(token)];
                    let residual = smallest | plain[lane].take(bits);
                    let value = if absent { a } else { T::restore::<P>(residual, a, b, c, d) };
                    here[lane][at] = value;
                    west[lane] = value;
                    if GAPS {
                        missing[lane][at] = absent.into();
                        gap[lane] = absent.into();
                    }
                }
            }
        }
        for lane in 0..N {
            let chunk = start + x..start + x + length;
            planes[lane].samples[chunk.clone()].copy_from_slice(&here[lane][..length]);
            if GAPS {
                gaps[lane].samples[chunk].copy_from_slice(&missing[lane][..length]);
            }
        }
        x += length;
    }
    streams.plain = plain;
    for lane in 0..N {
        streams.lanes[lane].set_window(windows[lane]);
    }
}

/// Decodes sequences, in which the neighbours above are the samples just decoded.
#[inline(never)]
fn decode_sequence<P: Predictor, T: PlaneSample, const N: usize, const GAPS: bool>(
    model: &Model,
    planes: &mut [&mut Padded<T>; N],
    gaps: &mut [&mut Padded<u8>; N],
    streams: &mut Streams<'_, N>,
) {
    const { assert!((EASE as usize) < CONTEXTS) };
    let (width, start) = (planes[0].width, planes[0].start(0));
    let mut windows = streams.lanes.each_ref().map(LaneReader::window);
    let mut plain = streams.plain;
    // The last samples, newest first, and which of them are missing.
    let mut last = [[T::default(); 3]; N];
    let mut gap = [[0u8; 2]; N];
    for at in 0..width {
        for lane in 0..N {
            if at % BATCH == 0 {
                windows[lane] = streams.lanes[lane].refill(windows[lane]);
            }
            let [a, b, c] = last[lane];
            let mut context = T::context(T::unease::<P>(T::ease::<P>(b, c, a), a, c));
            if GAPS && gap[lane] != [0; 2] {
                context = gap_context(gap[lane][0], gap[lane][1]);
            }
            let base = model.bases[usize::from(context) & (CONTEXTS - 1)];
            let token = model.tables.symbol(base, &mut windows[lane]);
            let absent = GAPS && token == MISSING;
            let (smallest, bits) = RESIDUALS[usize::from(token)];
            let residual = smallest | plain[lane].take(bits);
            let value = if absent { a } else { T::restore::<P>(residual, a, b, c, a) };
            planes[lane].samples[start + at] = value;
            last[lane] = [value, a, b];
            if GAPS {
                gaps[lane].samples[start + at] = absent.into();
                gap[lane] = [absent.into(), gap[lane][0]];
            }
        }
    }
    streams.plain = plain;
    for lane in 0..N {
        streams.lanes[lane].set_window(windows[lane]);
    }
}
