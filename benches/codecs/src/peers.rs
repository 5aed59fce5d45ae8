//! General-purpose codecs for columns of numbers: pco, and filters in front of zstd. A frame has what the link's frames
//! have as well (four bytes, the length, a CRC-32), the bytes around the columns, and the columns. Decoders are given
//! the layout, which costs the peers nothing.

use crate::columns::{Column, ColumnLayout};
use anyhow::{Context, Result, ensure};
use pco::ChunkConfig;
use pco::data_types::Number;
use pco::wrapped::{FileCompressor, FileDecompressor};
use std::num::Wrapping;
use std::ops::{Add, BitAnd, BitXor, Shl, Shr, Sub};

/// A way to make a column cheaper for zstd; a shuffle of its bytes (all lowest ones, then all second ones …) follows.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Filter {
    /// No other.
    Shuffle,
    /// Differences from the number before.
    Delta,
    /// Exclusive or with the number before.
    Xor,
    /// Differences from west + north - north-west in pictures, otherwise [`Filter::Delta`].
    Plane,
    /// Floats as multiples of a power of ten or of 1/4 mm where they are, then [`Filter::Plane`].
    Scaled,
}

/// A general-purpose codec of columns.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Peer {
    /// pco at this level.
    Pco(usize),
    /// A filter, then zstd 3 over all columns.
    Filtered(Filter),
}

/// All peers, in the order in which they are measured.
pub const PEERS: [Peer; 8] = [
    Peer::Pco(4),
    Peer::Pco(8),
    Peer::Pco(12),
    Peer::Filtered(Filter::Shuffle),
    Peer::Filtered(Filter::Delta),
    Peer::Filtered(Filter::Xor),
    Peer::Filtered(Filter::Plane),
    Peer::Filtered(Filter::Scaled),
];

/// The zstd level that the link uses where no other codec fits.
const LEVEL: i32 = 3;
/// Bytes of a frame in front of its length: tag, version, and a number of two bytes.
const FRONT: [u8; 4] = [0; 4];

impl Peer {
    pub fn name(self) -> String {
        match self {
            Self::Pco(level) => format!("pco {level}"),
            Self::Filtered(filter) => format!("{} + zstd {LEVEL}", format!("{filter:?}").to_lowercase()),
        }
    }

    /// Returns the frame of `message`.
    pub fn encode(
        self,
        layout: &ColumnLayout,
        message: &[u8],
        context: &mut zstd::bulk::Compressor,
    ) -> Result<Vec<u8>> {
        let mut out = FRONT.to_vec();
        out.extend_from_slice(&(message.len() as u32).to_le_bytes());
        out.extend_from_slice(&checksum(message).to_le_bytes());
        let surroundings = layout.surroundings(message);
        out.extend_from_slice(&(surroundings.len() as u16).to_le_bytes());
        out.extend_from_slice(&surroundings);
        match self {
            Self::Pco(level) => {
                // One page per column, and the paging's default otherwise splits large ones for no benefit here.
                let config = ChunkConfig::default().with_compression_level(level).with_enable_8_bit(true);
                let config = config.with_paging_spec(pco::PagingSpec::EqualPagesUpTo(1 << 24));
                let file = FileCompressor::default();
                out = file.write_header(out)?;
                for column in layout.columns.iter().filter(|column| column.count > 0) {
                    out = put_pco_column(&file, column, &column.read(message), &config, out)?;
                }
            }
            Self::Filtered(filter) => {
                let mut filtered = Vec::with_capacity(message.len() + message.len() / 8);
                for column in &layout.columns {
                    filter.apply(column, column.read(message), &mut filtered);
                }
                let first = out.len();
                out.resize(first + zstd::zstd_safe::compress_bound(filtered.len()), 0);
                let written = context.compress_to_buffer(&filtered, &mut out[first..])?;
                out.truncate(first + written);
            }
        }
        Ok(out)
    }

    /// Returns the message of `frame`.
    pub fn decode(
        self,
        layout: &ColumnLayout,
        frame: &[u8],
        context: &mut zstd::bulk::Decompressor,
    ) -> Result<Vec<u8>> {
        let number = |at: usize| Ok::<_, anyhow::Error>(u32::from_le_bytes(frame[at..at + 4].try_into()?));
        let (length, told) = (number(4)? as usize, number(8)?);
        let around = usize::from(u16::from_le_bytes([frame[12], frame[13]]));
        let (surroundings, mut rest) = frame[14..].split_at(around);
        let mut message = layout.restore(surroundings, length);
        match self {
            Self::Pco(_) => {
                let (file, after) = FileDecompressor::new(rest)?;
                rest = after;
                for column in layout.columns.iter().filter(|column| column.count > 0) {
                    let (numbers, after) = take_pco_column(&file, column, rest)?;
                    column.write(&numbers, &mut message);
                    rest = after;
                }
            }
            Self::Filtered(filter) => {
                let filtered = context.decompress(rest, length * 3 + 64)?;
                let mut rest = &filtered[..];
                for column in &layout.columns {
                    let numbers = filter.undo(column, &mut rest)?;
                    column.write(&numbers, &mut message);
                }
            }
        }
        ensure!(checksum(&message) == told, "a frame of {} holds another message", self.name());
        Ok(message)
    }
}

fn checksum(message: &[u8]) -> u32 {
    let mut crc = flate2::Crc::new();
    crc.update(message);
    crc.sum()
}

/// Appends a column, which is not empty.
fn put_pco_column(
    file: &FileCompressor,
    column: &Column,
    numbers: &[u8],
    config: &ChunkConfig,
    out: Vec<u8>,
) -> Result<Vec<u8>> {
    match (column.bytes, column.is_float) {
        (1, _) => put_pco(file, numbers, config, out),
        (2, _) => put_pco(file, &shorts(numbers), config, out),
        (_, false) => put_pco(file, &words(numbers), config, out),
        (_, true) => {
            let floats: Vec<f32> = words(numbers).into_iter().map(f32::from_bits).collect();
            put_pco(file, &floats, config, out)
        }
    }
}

fn put_pco<T: Number>(file: &FileCompressor, numbers: &[T], config: &ChunkConfig, out: Vec<u8>) -> Result<Vec<u8>> {
    let mut chunk = file.chunk_compressor(numbers, config)?;
    let out = chunk.write_meta(out)?;
    Ok(chunk.write_page(0, out)?)
}

/// The inverse: returns the column and the bytes behind it.
fn take_pco_column<'a>(file: &FileDecompressor, column: &Column, input: &'a [u8]) -> Result<(Vec<u8>, &'a [u8])> {
    let count = column.count;
    match (column.bytes, column.is_float) {
        (1, _) => take_pco(file, count, input, u8::to_le_bytes),
        (2, _) => take_pco(file, count, input, u16::to_le_bytes),
        (_, false) => take_pco(file, count, input, u32::to_le_bytes),
        (_, true) => take_pco(file, count, input, f32::to_le_bytes),
    }
}

fn take_pco<'a, T: Number + Default, const BYTES: usize>(
    file: &FileDecompressor,
    count: usize,
    input: &'a [u8],
    to_bytes: fn(T) -> [u8; BYTES],
) -> Result<(Vec<u8>, &'a [u8])> {
    let (mut chunk, rest) = file.chunk_decompressor::<T, _>(input)?;
    let mut numbers = vec![T::default(); count];
    let mut page = chunk.page_decompressor(rest, count)?;
    page.read(&mut numbers)?;
    Ok((numbers.into_iter().flat_map(to_bytes).collect(), page.into_src()))
}

fn shorts(numbers: &[u8]) -> Vec<u16> {
    numbers.chunks_exact(2).map(|bytes| u16::from_le_bytes([bytes[0], bytes[1]])).collect()
}

fn words(numbers: &[u8]) -> Vec<u32> {
    numbers.chunks_exact(4).map(|bytes| u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])).collect()
}

/// An unsigned number of a column, whose arithmetic wraps around.
trait Unsigned: Copy + Default + Add<Output = Self> + Sub<Output = Self> + Bits {
    const BYTES: usize;
    fn from_byte(byte: u8) -> Self;
    fn low_byte(self) -> u8;

    #[inline(always)]
    fn byte(self, index: usize) -> u8 {
        (self >> (8 * index)).low_byte()
    }

    /// Returns the number with these bytes, the lowest first.
    #[inline(always)]
    fn join(bytes: impl DoubleEndedIterator<Item = u8>) -> Self {
        bytes.rev().fold(Self::default(), |number, byte| (number << 8) ^ Self::from_byte(byte))
    }

    #[inline(always)]
    fn zigzag(self) -> Self {
        (self << 1) ^ (Self::default() - (self >> (Self::BYTES * 8 - 1)))
    }

    #[inline(always)]
    fn unzigzag(self) -> Self {
        (self >> 1) ^ (Self::default() - (self & Self::from_byte(1)))
    }
}

trait Bits:
    Sized + BitAnd<Output = Self> + BitXor<Output = Self> + Shl<usize, Output = Self> + Shr<usize, Output = Self>
{
}

macro_rules! unsigned {
    ($($type:ty),*) => { $(
        impl Bits for Wrapping<$type> {}

        impl Unsigned for Wrapping<$type> {
            const BYTES: usize = size_of::<$type>();

            #[inline(always)]
            fn from_byte(byte: u8) -> Self {
                Self(byte.into())
            }

            #[inline(always)]
            fn low_byte(self) -> u8 {
                self.0 as u8
            }
        }
    )* };
}

unsigned!(u8, u16, u32);

impl Filter {
    /// Appends the filtered numbers of a column.
    fn apply(self, column: &Column, mut numbers: Vec<u8>, out: &mut Vec<u8>) {
        let (mut gaps, mut apart) = (Vec::new(), Vec::new());
        if self == Self::Scaled && column.is_float {
            let scale = Scale::find(&numbers);
            out.push(scale.map_or(0, |scale| scale.0 + 1));
            if let Some(scale) = scale {
                (numbers, gaps, apart) = scale.multiples(&numbers);
            }
        }
        match column.bytes {
            1 => self.apply_to::<Wrapping<u8>>(&numbers, column.row, out),
            2 => self.apply_to::<Wrapping<u16>>(&numbers, column.row, out),
            _ => self.apply_to::<Wrapping<u32>>(&numbers, column.row, out),
        }
        out.extend_from_slice(&gaps);
        Self::Shuffle.apply_to::<Wrapping<u32>>(&apart, 0, out);
    }

    /// The inverse of [`Filter::apply`]: takes the column from the front of `input`.
    fn undo(self, column: &Column, input: &mut &[u8]) -> Result<Vec<u8>> {
        let mut scale = None;
        if self == Self::Scaled && column.is_float {
            let (&name, rest) = input.split_first().context("a column without its scale")?;
            (scale, *input) = (name.checked_sub(1).map(Scale), rest);
        }
        let (planes, rest) = input.split_at(column.count * column.bytes);
        *input = rest;
        let numbers = match column.bytes {
            1 => self.undo_of::<Wrapping<u8>>(planes, column.row),
            2 => self.undo_of::<Wrapping<u16>>(planes, column.row),
            _ => self.undo_of::<Wrapping<u32>>(planes, column.row),
        };
        let Some(scale) = scale else { return Ok(numbers) };
        let (gaps, rest) = input.split_at(column.count);
        let (apart, rest) = rest.split_at(gaps.iter().filter(|&&gap| gap != 0).count() * 4);
        *input = rest;
        Ok(scale.values(&numbers, gaps, &words(&Self::Shuffle.undo_of::<Wrapping<u32>>(apart, 0))))
    }

    fn apply_to<T: Unsigned>(self, numbers: &[u8], row: usize, out: &mut Vec<u8>) {
        let numbers: Vec<T> = numbers.chunks_exact(T::BYTES).map(|bytes| T::join(bytes.iter().copied())).collect();
        let zero = T::default();
        let mut filtered = Vec::with_capacity(numbers.len());
        match self {
            Self::Shuffle => filtered.extend_from_slice(&numbers),
            Self::Plane | Self::Scaled if row > 0 => {
                let none = vec![zero; row];
                let above = std::iter::once(&none[..]).chain(numbers.chunks(row));
                for (line, above) in numbers.chunks(row).zip(above) {
                    let (mut west, mut corner) = (zero, zero);
                    for (&number, &north) in line.iter().zip(above) {
                        filtered.push((number - (west + north - corner)).zigzag());
                        (west, corner) = (number, north);
                    }
                }
            }
            _ => {
                let pairs = numbers.iter().zip(std::iter::once(&zero).chain(&numbers));
                match self {
                    Self::Xor => filtered.extend(pairs.map(|(&number, &last)| number ^ last)),
                    _ => filtered.extend(pairs.map(|(&number, &last)| (number - last).zigzag())),
                }
            }
        }
        for byte in 0..T::BYTES {
            out.extend(filtered.iter().map(|number| number.byte(byte)));
        }
    }

    fn undo_of<T: Unsigned>(self, planes: &[u8], row: usize) -> Vec<u8> {
        let count = planes.len() / T::BYTES;
        let mut numbers: Vec<T> =
            (0..count).map(|index| T::join((0..T::BYTES).map(|byte| planes[byte * count + index]))).collect();
        let mut last = T::default();
        match self {
            Self::Shuffle => {}
            Self::Xor => numbers.iter_mut().for_each(|number| {
                last = *number ^ last;
                *number = last;
            }),
            Self::Plane | Self::Scaled if row > 0 => {
                let mut above = vec![T::default(); row];
                for line in numbers.chunks_mut(row) {
                    let (mut west, mut corner) = (T::default(), T::default());
                    for (number, north) in line.iter_mut().zip(&mut above) {
                        *number = number.unzigzag() + west + *north - corner;
                        (west, corner) = (*number, *north);
                        *north = *number;
                    }
                }
            }
            Self::Delta | Self::Plane | Self::Scaled => numbers.iter_mut().for_each(|number| {
                last = number.unzigzag() + last;
                *number = last;
            }),
        }
        let mut bytes = Vec::with_capacity(planes.len());
        for number in numbers {
            bytes.extend((0..T::BYTES).map(|byte| number.byte(byte)));
        }
        bytes
    }
}

/// A divisor of floats that are integers divided, or multiplied by its reciprocal.
#[derive(Clone, Copy)]
struct Scale(u8);

/// Divisors, with true for those that are multiplied by the reciprocal.
const SCALES: [(f32, bool); 7] =
    [(1.0, false), (100.0, false), (100.0, true), (1000.0, false), (1000.0, true), (4000.0, false), (500.0, true)];

impl Scale {
    /// Largest multiple that a float's mantissa still tells apart.
    const LARGEST: f32 = 4e6;

    fn value(self, multiple: i32) -> u32 {
        let (divisor, is_product) = SCALES[usize::from(self.0)];
        (if is_product { multiple as f32 * (1.0 / divisor) } else { multiple as f32 / divisor }).to_bits()
    }

    fn multiple(self, bits: u32) -> Option<i32> {
        let multiple = (f32::from_bits(bits) * SCALES[usize::from(self.0)].0).round();
        (multiple.abs() < Self::LARGEST && self.value(multiple as i32) == bits).then_some(multiple as i32)
    }

    /// Returns the first scale that fits fifteen of sixteen finite numbers.
    fn find(numbers: &[u8]) -> Option<Self> {
        let numbers = words(numbers);
        let step = (numbers.len() / 96) | 1;
        let is_finite = |bits: &u32| f32::from_bits(*bits).is_finite() && *bits != 0;
        let some: Vec<u32> = numbers.into_iter().step_by(step).filter(is_finite).collect();
        let unfit = |scale: Self| some.iter().filter(|&&bits| scale.multiple(bits).is_none()).count();
        (0..SCALES.len() as u8).map(Self).find(|&scale| !some.is_empty() && unfit(scale) * 16 <= some.len())
    }

    /// Returns the multiples, one byte per number that is not zero where the number is none, and those numbers.
    fn multiples(self, numbers: &[u8]) -> (Vec<u8>, Vec<u8>, Vec<u8>) {
        let (mut multiples, mut gaps, mut apart) = (Vec::with_capacity(numbers.len()), Vec::new(), Vec::new());
        let mut last = 0;
        for bits in words(numbers) {
            let multiple = self.multiple(bits);
            gaps.push(u8::from(multiple.is_none()));
            match multiple {
                Some(multiple) => last = multiple,
                None => apart.extend_from_slice(&bits.to_le_bytes()),
            }
            multiples.extend_from_slice(&last.to_le_bytes());
        }
        (multiples, gaps, apart)
    }

    /// The inverse of [`Scale::multiples`].
    fn values(self, multiples: &[u8], gaps: &[u8], apart: &[u32]) -> Vec<u8> {
        let mut apart = apart.iter().copied();
        let numbers = words(multiples).into_iter().zip(gaps);
        let value = |(multiple, &gap): (u32, &u8)| match gap {
            0 => self.value(multiple as i32),
            _ => apart.next().unwrap_or_default(),
        };
        numbers.map(value).flat_map(u32::to_le_bytes).collect()
    }
}
