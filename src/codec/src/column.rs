//! Columns of numbers, integer or float: the common part of depth images, scans and clouds.
//!
//! Sensors measure in integers even where drivers publish floats, and often use few of them. So before prediction a
//! column is mapped to the integers behind it if that is exact: floats that are multiples of a scale to the multiples,
//! sparse numbers to their ranks. Values that do not fit the mapping (no echo, NaN, infinity) are *missing* from the
//! plane and listed separately.
//!
//! Layout: `flags · [scale] · [missing] · [offset] · [ranks] · plane`.

use crate::Error;
use crate::generic::{self, ZstdCompressor};
use crate::padded::Lanes;
use crate::predict::{Kind, PlaneSample};
use crate::scale::Scale;
use crate::wide::Wide;
use crate::wire::{FrameCursor, put_block, put_varint, unzigzag, zigzag};

/// Flag: some samples are missing.
const MISSING: u8 = 1;
/// Flag: samples are ranks in a list.
const RANKS: u8 = 2;
/// Flag: samples are 32 bits wide, otherwise 16.
const WIDE: u8 = 4;
/// Flag: floats are multiples of a scale.
const SCALED: u8 = 8;
/// Flag: floats are mapped to integers in their order.
const ORDERED: u8 = 16;

/// Arrangement of the samples.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Shape {
    Picture { width: usize, height: usize },
    Sequence(usize),
}

impl Shape {
    pub(crate) fn count(self) -> usize {
        match self {
            Self::Picture { width, height } => width * height,
            Self::Sequence(length) => length,
        }
    }

    fn lanes<T: Copy + Default>(self) -> Lanes<T> {
        match self {
            Self::Picture { width, height } => Lanes::pictures(1, width, height),
            Self::Sequence(length) => Lanes::sequence(length),
        }
    }

    fn kinds(self) -> &'static [Kind] {
        match self {
            Self::Picture { .. } => &[Kind::West, Kind::North, Kind::Slope, Kind::Plane, Kind::Median, Kind::Middle],
            Self::Sequence(_) => &[Kind::West, Kind::Line],
        }
    }
}

/// Maps a float's bits to an integer such that the order of floats is kept.
#[inline]
pub(crate) fn to_ordered_bits(bits: u32) -> u32 {
    if bits >> 31 == 0 { bits | 1 << 31 } else { !bits }
}

/// The inverse of [`to_ordered_bits`].
#[inline]
pub(crate) fn from_ordered_bits(order: u32) -> u32 {
    if order >> 31 == 0 { !order } else { order & !(1 << 31) }
}

/// Encodes 16-bit integers. Zero counts as "nothing measured" if all others are far from it.
pub(crate) fn encode_shorts(samples: &[u16], shape: Shape, out: &mut Vec<u8>) {
    let (mut zeros, mut smallest) = (0usize, u16::MAX);
    for &sample in samples {
        zeros += usize::from(sample == 0);
        smallest = smallest.min(sample.wrapping_sub(1));
    }
    let missing = (zeros > 0 && smallest >= 15).then(|| {
        let mut lanes = shape.lanes();
        lanes.fill(samples, |sample| u8::from(sample == 0));
        lanes
    });
    let flags = if missing.is_some() { MISSING } else { 0 };
    encode_plane16(samples, missing, flags, &[], shape, out);
}

/// Returns the distinct values of `samples`, without the missing ones, and the rank of each; `None` if the values are
/// not sparse enough for a list.
fn ranks(samples: &[u16], missing: Option<&Lanes<u8>>) -> Option<(Vec<u16>, Vec<u16>)> {
    if samples.len() < 4096 {
        return None;
    }
    // Missing samples are recorded in the upper half, so that no check is needed before.
    let mut present = vec![false; 1 << 17];
    match missing {
        None => samples.iter().for_each(|&sample| present[usize::from(sample)] = true),
        Some(missing) => {
            let mut rest = samples;
            for gaps in missing.rows() {
                let (row, after) = rest.split_at(gaps.len().min(rest.len()));
                for (&sample, &gap) in row.iter().zip(gaps) {
                    present[usize::from(gap != 0) << 16 | usize::from(sample)] = true;
                }
                rest = after;
            }
        }
    }
    let values: Vec<u16> = (0..=u16::MAX).filter(|&value| present[usize::from(value)]).collect();
    let (first, last) = (values.first()?, values.last()?);
    let span = usize::from(last - first) + 1;
    if values.len() * 4 > span * 3 || values.len() * 8 > samples.len() {
        return None;
    }
    let mut rank = vec![0u16; 1 << 16];
    for (index, &value) in values.iter().enumerate() {
        rank[usize::from(value)] = index as u16;
    }
    Some((values, rank))
}

fn encode_plane16(
    samples: &[u16],
    missing: Option<Lanes<u8>>,
    flags: u8,
    preamble: &[u8],
    shape: Shape,
    out: &mut Vec<u8>,
) {
    let mut lanes = shape.lanes();
    match ranks(samples, missing.as_ref()) {
        Some((values, rank)) => {
            out.push(flags | RANKS);
            out.extend_from_slice(preamble);
            let mut steps = Vec::with_capacity(values.len() + 8);
            let mut last = 0;
            for &value in &values {
                put_varint(&mut steps, u64::from(value - last));
                last = value;
            }
            put_varint(out, values.len() as u64);
            put_packed(&steps, out);
            lanes.fill(samples, |sample| rank[usize::from(sample)]);
        }
        None => {
            out.push(flags);
            out.extend_from_slice(preamble);
            lanes.fill(samples, |sample| sample);
        }
    }
    Wide { samples: lanes, missing }.encode(shape.kinds(), out);
}

/// Encodes 32-bit integers.
pub(crate) fn encode_words(samples: &[u32], shape: Shape, out: &mut Vec<u8>) {
    let smallest = samples.iter().copied().min().unwrap_or(0);
    let largest = samples.iter().copied().max().unwrap_or(0);
    let mut preamble = Vec::new();
    put_varint(&mut preamble, zigzag(i64::from(smallest)));
    if largest - smallest < 1 << 16 {
        let samples: Vec<u16> = samples.iter().map(|&sample| (sample - smallest) as u16).collect();
        encode_plane16(&samples, None, 0, &preamble, shape, out);
    } else {
        out.push(WIDE);
        out.extend_from_slice(&preamble);
        let mut lanes = shape.lanes();
        lanes.fill(samples, |sample| sample - smallest);
        Wide { samples: lanes, missing: None }.encode(shape.kinds(), out);
    }
}

/// Encodes differences that are small already.
pub(crate) fn encode_differences(samples: &[u32], shape: Shape, out: &mut Vec<u8>) {
    let mut lanes = shape.lanes();
    lanes.fill(samples, |sample| sample);
    Wide { samples: lanes, missing: None }.encode(&[Kind::Zero], out);
}

/// Decodes what [`encode_differences`] wrote.
pub(crate) fn decode_differences(input: &mut FrameCursor<'_>, shape: Shape) -> Result<Vec<u32>, Error> {
    decode_plane(input, shape, None::<Lanes<u8>>).map(|(samples, _)| samples)
}

/// Encodes 32-bit floats, given as bits.
pub(crate) fn encode_floats(bits: &[u32], shape: Shape, out: &mut Vec<u8>) {
    match Scale::find(bits) {
        Some(scale) => encode_scaled(bits, scale, shape, out),
        None => encode_ordered(bits, shape, out),
    }
}

fn encode_scaled(bits: &[u32], scale: Scale, shape: Shape, out: &mut Vec<u8>) {
    let mut multiples = scale.multiples(bits);
    // Zero counts as "nothing measured" if all others are far from it. Values that do not fit are far from it, too.
    let (mut zeros, mut nearest) = (0u32, i32::MAX);
    for &multiple in &multiples {
        zeros += u32::from(multiple == 0);
        let above_one = multiple.wrapping_abs().wrapping_sub(1) & i32::MAX;
        nearest = nearest.min(above_one);
    }
    if zeros > 0 && nearest >= 15 {
        for multiple in &mut multiples {
            *multiple = if *multiple == 0 { Scale::NONE } else { *multiple };
        }
    }
    let fits = |multiple: i32| multiple != Scale::NONE;
    let (mut unfit, mut below, mut largest) = (0u32, i32::MAX, i32::MIN);
    for &multiple in &multiples {
        unfit += u32::from(multiple == Scale::NONE);
        // The value for "does not fit" minus one wraps to the largest number.
        below = below.min(multiple.wrapping_sub(1));
        largest = largest.max(multiple);
    }
    let mut smallest = below.wrapping_add(1);
    let unfit = unfit as usize;
    if unfit == multiples.len() {
        (smallest, largest) = (0, 0);
    }
    let mut flags = SCALED;
    let mut preamble = vec![scale.name()];
    let mut missing = None;
    if unfit > 0 {
        flags |= MISSING;
        if !put_unscaled(bits, &multiples, unfit, &mut preamble) {
            return encode_ordered(bits, shape, out);
        }
        let mut lanes = shape.lanes();
        lanes.fill(&multiples, |multiple| u8::from(!fits(multiple)));
        missing = Some(lanes);
    }
    put_varint(&mut preamble, zigzag(i64::from(smallest)));
    // Missing samples may have any value: they are bridged.
    if i64::from(largest) - i64::from(smallest) < 1 << 16 {
        let above = |multiple: i32| multiple.wrapping_sub(smallest) as u16;
        let samples: Vec<u16> = multiples.iter().map(|&multiple| above(multiple)).collect();
        encode_plane16(&samples, missing, flags, &preamble, shape, out);
    } else {
        out.push(flags | WIDE);
        out.extend_from_slice(&preamble);
        let mut lanes = shape.lanes();
        lanes.fill(&multiples, |multiple| multiple.wrapping_sub(smallest) as u32);
        Wide { samples: lanes, missing }.encode(shape.kinds(), out);
    }
}

/// Appends the `unfit` floats that are no multiples. Returns false if too many of them are measurements for a scale to
/// pay off.
fn put_unscaled(bits: &[u32], multiples: &[i32], unfit: usize, out: &mut Vec<u8>) -> bool {
    let pairs = || bits.iter().zip(multiples);
    let first = pairs().find(|&(_, &multiple)| multiple == Scale::NONE).map_or(0, |(&bits, _)| bits);
    let same = |(&bits, &multiple): (&u32, &i32)| u32::from((multiple == Scale::NONE) & (bits == first));
    if pairs().map(same).sum::<u32>() as usize == unfit {
        put_run(first, unfit as u32, out);
        return !is_measured(first) || unfit * 16 <= bits.len();
    }
    let apart = || pairs().filter(|&(_, &multiple)| multiple == Scale::NONE).map(|(&bits, _)| bits);
    put_exceptions(apart(), out);
    apart().filter(|&bits| is_measured(bits)).count() * 16 <= bits.len()
}

/// Returns true if the float is a measurement rather than a mark for "nothing".
fn is_measured(bits: u32) -> bool {
    // In one comparison: neither zero of either sign nor infinite nor NaN.
    (bits & 0x7fff_ffff).wrapping_sub(1) < f32::INFINITY.to_bits() - 1
}

fn encode_ordered(bits: &[u32], shape: Shape, out: &mut Vec<u8>) {
    let mut flags = ORDERED | WIDE;
    let mut preamble = Vec::new();
    let unfit: u32 = bits.iter().map(|&bits| u32::from(!is_measured(bits))).sum();
    let missing = (unfit > 0).then(|| {
        flags |= MISSING;
        put_unmeasured(bits, unfit, &mut preamble);
        let mut lanes = shape.lanes();
        lanes.fill(bits, |bits| u8::from(!is_measured(bits)));
        lanes
    });
    put_varint(&mut preamble, 0);
    out.push(flags);
    out.extend_from_slice(&preamble);
    let mut lanes = shape.lanes();
    lanes.fill(bits, to_ordered_bits);
    Wide { samples: lanes, missing }.encode(shape.kinds(), out);
}

/// Appends the `unfit` floats that are no measurements.
fn put_unmeasured(bits: &[u32], unfit: u32, out: &mut Vec<u8>) {
    let apart = || bits.iter().copied().filter(|&bits| !is_measured(bits));
    let first = apart().next().unwrap_or(0);
    let same: u32 = bits.iter().map(|&bits| u32::from(bits == first)).sum();
    if same == unfit {
        put_run(first, unfit, out);
    } else {
        put_exceptions(apart(), out);
    }
}

/// Appends one repeated mark for "nothing", as most drivers use it, in the format of [`put_exceptions`].
fn put_run(value: u32, count: u32, out: &mut Vec<u8>) {
    let mut run = value.to_le_bytes().to_vec();
    put_varint(&mut run, u64::from(count) - 1);
    put_packed(&run, out);
}

/// Appends the exceptional values as runs, since they are mostly the same.
fn put_exceptions(values: impl Iterator<Item = u32>, out: &mut Vec<u8>) {
    let mut runs = Vec::new();
    let mut values = values.peekable();
    while let Some(value) = values.next() {
        let mut run = 0u64;
        while values.next_if_eq(&value).is_some() {
            run += 1;
        }
        runs.extend_from_slice(&value.to_le_bytes());
        put_varint(&mut runs, run);
    }
    put_packed(&runs, out);
}

fn take_exceptions(input: &mut FrameCursor<'_>, count: usize) -> Result<Vec<u32>, Error> {
    let runs = take_packed(input, count.saturating_mul(6) + 16)?;
    let mut runs = FrameCursor::new(&runs);
    let mut values = Vec::new();
    while runs.remaining() > 0 {
        let value = runs.u32()?;
        let run = runs.bounded_varint(count - values.len().min(count))? + 1;
        if run > count - values.len() {
            return Err(Error::Corrupt("more values apart than there are"));
        }
        values.resize(values.len() + run, value);
    }
    Ok(values)
}

/// Appends a block of bytes, compressed by zstd if that makes it smaller.
pub(crate) fn put_packed(bytes: &[u8], out: &mut Vec<u8>) {
    put_varint(out, bytes.len() as u64);
    let mut packed = Vec::new();
    if bytes.len() > 32 {
        ZstdCompressor::default().compress(bytes, 3, &mut packed);
    }
    if packed.is_empty() || packed.len() >= bytes.len() {
        put_block(out, bytes);
    } else {
        put_block(out, &packed);
    }
}

/// Reads what [`put_packed`] wrote, at most `limit` bytes.
pub(crate) fn take_packed(input: &mut FrameCursor<'_>, limit: usize) -> Result<Vec<u8>, Error> {
    let length = input.bounded_varint(limit)?;
    let packed = input.block()?;
    let mut bytes = Vec::new();
    if packed.len() == length {
        bytes.extend_from_slice(packed);
    } else {
        generic::unzstd(packed, length, &mut bytes)?;
    }
    Ok(bytes)
}

fn decode_plane<T: PlaneSample>(
    input: &mut FrameCursor<'_>,
    shape: Shape,
    missing: Option<Lanes<u8>>,
) -> Result<(Vec<T>, Option<Lanes<u8>>), Error> {
    let mut wide = Wide { samples: shape.lanes::<T>(), missing };
    wide.decode(input)?;
    let mut samples = Vec::with_capacity(shape.count());
    wide.samples.rows().for_each(|row| samples.extend_from_slice(row));
    samples.truncate(shape.count());
    Ok((samples, wide.missing))
}

/// A decoded plane with the information to map its samples back.
struct DecodedColumn {
    flags: u8,
    scale: Option<Scale>,
    apart: Vec<u32>,
    offset: i64,
    samples: Vec<u32>,
    missing: Option<Lanes<u8>>,
}

/// Reads a column; `allowed` are the flags its type can have, `listed` whether missing values are listed.
fn decode(input: &mut FrameCursor<'_>, shape: Shape, allowed: u8, listed: bool) -> Result<DecodedColumn, Error> {
    let flags = input.byte()?;
    if flags & !allowed != 0 {
        return Err(Error::Corrupt("a column of another type"));
    }
    let scale = if flags & SCALED != 0 { Some(Scale::from_name(input.byte()?)?) } else { None };
    let gaps = flags & MISSING != 0;
    let apart = if gaps && listed { take_exceptions(input, shape.count())? } else { Vec::new() };
    let offset = if allowed & WIDE != 0 { unzigzag(input.varint()?) } else { 0 };
    let missing = gaps.then(|| shape.lanes());
    let (samples, missing) = if flags & WIDE != 0 {
        decode_plane::<u32>(input, shape, missing)?
    } else {
        let values = if flags & RANKS != 0 { Some(take_ranks(input)?) } else { None };
        let (samples, missing) = decode_plane::<u16>(input, shape, missing)?;
        let samples = match values {
            None => samples.into_iter().map(u32::from).collect(),
            Some(values) => {
                samples.into_iter().map(|rank| values.get(usize::from(rank)).copied().unwrap_or(0).widen()).collect()
            }
        };
        (samples, missing)
    };
    Ok(DecodedColumn { flags, scale, apart, offset, samples, missing })
}

fn take_ranks(input: &mut FrameCursor<'_>) -> Result<Vec<u16>, Error> {
    let count = input.bounded_varint(1 << 16)?;
    let steps = take_packed(input, count * 3)?;
    let mut steps = FrameCursor::new(&steps);
    let mut values = Vec::with_capacity(count);
    let mut last = 0usize;
    for _ in 0..count {
        last += steps.bounded_varint(usize::from(u16::MAX) - last)?;
        values.push(last as u16);
    }
    steps.finish()?;
    Ok(values)
}

impl DecodedColumn {
    /// Maps the samples to values, and inserts the listed values where samples are missing.
    fn restore(self, mut number: impl FnMut(u32) -> u32) -> Result<Vec<u32>, Error> {
        let Some(missing) = self.missing else {
            return Ok(self.samples.into_iter().map(number).collect());
        };
        let mut apart = self.apart.into_iter();
        let mut values = Vec::with_capacity(self.samples.len());
        for (sample, &gap) in self.samples.into_iter().zip(missing.rows().flatten()) {
            values.push(match gap {
                0 => number(sample),
                _ => apart.next().ok_or(Error::Corrupt("fewer values apart than are missing"))?,
            });
        }
        Ok(values)
    }
}

/// Decodes what [`encode_shorts`] wrote.
pub(crate) fn decode_shorts(input: &mut FrameCursor<'_>, shape: Shape) -> Result<Vec<u16>, Error> {
    let decoded = decode(input, shape, MISSING | RANKS, false)?;
    let mut samples: Vec<u16> = decoded.samples.iter().map(|&sample| sample as u16).collect();
    if let Some(missing) = &decoded.missing {
        for (sample, &gap) in samples.iter_mut().zip(missing.rows().flatten()) {
            if gap != 0 {
                *sample = 0;
            }
        }
    }
    Ok(samples)
}

/// Decodes what [`encode_words`] wrote.
pub(crate) fn decode_words(input: &mut FrameCursor<'_>, shape: Shape) -> Result<Vec<u32>, Error> {
    let decoded = decode(input, shape, RANKS | WIDE, false)?;
    let offset = decoded.offset as u32;
    decoded.restore(|sample| sample.wrapping_add(offset))
}

/// Decodes what [`encode_floats`] wrote.
pub(crate) fn decode_floats(input: &mut FrameCursor<'_>, shape: Shape) -> Result<Vec<u32>, Error> {
    let decoded = decode(input, shape, MISSING | RANKS | WIDE | SCALED | ORDERED, true)?;
    let offset = decoded.offset as i32;
    match (decoded.scale, decoded.flags & ORDERED != 0) {
        (Some(scale), false) => decoded.restore(|sample| scale.value((sample as i32).wrapping_add(offset))),
        (None, true) => decoded.restore(from_ordered_bits),
        _ => Err(Error::Corrupt("a column of floats without a mapping")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PICTURE: Shape = Shape::Picture { width: 40, height: 50 };

    fn round_trip_floats(values: &[f32], shape: Shape) -> usize {
        let bits: Vec<u32> = values.iter().map(|value| value.to_bits()).collect();
        let mut bytes = Vec::new();
        encode_floats(&bits, shape, &mut bytes);
        let mut input = FrameCursor::new(&bytes);
        assert_eq!(decode_floats(&mut input, shape).unwrap(), bits);
        input.finish().unwrap();
        bytes.len()
    }

    #[test]
    fn shorts_with_holes_and_steps_come_back() {
        let picture = Shape::Picture { width: 80, height: 100 };
        for shape in [picture, Shape::Sequence(8000)] {
            let samples: Vec<u16> =
                (0..8000u16).map(|index| if index % 11 == 0 { 0 } else { 400 + index / 14 * 5 }).collect();
            let mut bytes = Vec::new();
            encode_shorts(&samples, shape, &mut bytes);
            assert_eq!(bytes[0], MISSING | RANKS);
            let mut input = FrameCursor::new(&bytes);
            assert_eq!(decode_shorts(&mut input, shape).unwrap(), samples);
            input.finish().unwrap();
        }
    }

    #[test]
    fn words_come_back() {
        for spread in [1u32, 1000, 2_000_000] {
            let samples: Vec<u32> = (0..2000u32).map(|index| u32::MAX - index * spread).collect();
            let mut bytes = Vec::new();
            encode_words(&samples, PICTURE, &mut bytes);
            let mut input = FrameCursor::new(&bytes);
            assert_eq!(decode_words(&mut input, PICTURE).unwrap(), samples);
            input.finish().unwrap();
        }
    }

    #[test]
    fn floats_of_all_sorts_come_back() {
        let millimetres: Vec<f32> = (0..2000).map(|index| (1000 + index % 300) as f32 * 0.001).collect();
        assert!(round_trip_floats(&millimetres, PICTURE) < 800);
        let mut holes = millimetres.clone();
        holes.iter_mut().step_by(9).for_each(|value| *value = f32::NAN);
        holes[3] = f32::from_bits(0x7fc0_1234);
        holes[4] = f32::NEG_INFINITY;
        holes[5] = 1.234_567_9;
        round_trip_floats(&holes, PICTURE);
        round_trip_floats(&holes, Shape::Sequence(2000));
        let rough: Vec<f32> = (0..2000).map(|index| (index as f32).sin() * 1e10).collect();
        round_trip_floats(&rough, PICTURE);
        round_trip_floats(&rough, Shape::Sequence(2000));
        round_trip_floats(&[0.0, -0.0, f32::MIN_POSITIVE, f32::MAX], Shape::Sequence(4));
        round_trip_floats(&[], Shape::Sequence(0));
    }

    #[test]
    fn what_is_no_measurement_is_told() {
        for value in [1.0, -1.0, f32::MIN_POSITIVE, f32::MAX, f32::MIN, 1e-45] {
            assert!(is_measured(value.to_bits()), "{value}");
        }
        for value in [0.0, -0.0, f32::INFINITY, f32::NEG_INFINITY, f32::NAN] {
            assert!(!is_measured(value.to_bits()), "{value}");
        }
    }

    #[test]
    fn the_order_of_floats_is_kept() {
        let values = [f32::NEG_INFINITY, -2.0, -1.0, -0.0, 0.0, 1e-30, 1.0, f32::INFINITY];
        let orders = values.map(|value| to_ordered_bits(value.to_bits()));
        assert!(orders.windows(2).all(|pair| pair[0] < pair[1]));
        assert_eq!(orders.map(from_ordered_bits), values.map(f32::to_bits));
    }

    #[test]
    fn a_short_stream_is_an_error() {
        let samples: Vec<u16> = (0..2000u16).map(|index| index * 13 % 997).collect();
        let mut bytes = Vec::new();
        encode_shorts(&samples, PICTURE, &mut bytes);
        for length in 0..bytes.len() {
            assert!(decode_shorts(&mut FrameCursor::new(&bytes[..length]), PICTURE).is_err());
        }
    }
}
