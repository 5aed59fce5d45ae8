//! Codec for `sensor_msgs/PointCloud2` by field layout: every field is a column of its own.
//!
//! Coordinates are more than columns: a camera's x and y follow from z and the pixel's direction, and the points of a
//! spinning laser lie on cones. So a coordinate may be predicted from others (see [`ratio`]), and only what the
//! drivers' arithmetic leaves is coded.
//!
//! Body: `head · is_dense · row padding · gaps · columns`.

mod ratio;

use crate::Error;
use crate::column::{self, Shape, put_packed, take_packed};
use crate::layout::{CloudLayout, FieldMeaning, NumberType, PointField, take_ends};
use crate::padded::Lanes;
use crate::plane8;
use crate::rows::{put_padding, take_padding};
use crate::wire::{FrameCursor, MessageEnds};
use ratio::CoordinatePredictor;

/// Encodings of a column.
const NUMBERS: u8 = 0;
const SUCCESSORS: u8 = 1;
const GUESSED: u8 = 2;

/// Appends the body of `message`, which has `layout`.
pub(crate) fn encode(message: &[u8], layout: &CloudLayout, out: &mut Vec<u8>) {
    let dense = message.len() - layout.tail - 1;
    let data = &message[layout.head..dense];
    MessageEnds::from_message(message, layout.head, layout.tail).put(out);
    out.push(message[dense]);
    let row = layout.width * layout.point_step;
    put_padding(data, row, layout.row_step, out);
    let mut packed = Vec::new();
    let points: &[u8] = if row == layout.row_step {
        data
    } else {
        data.chunks_exact(layout.row_step).for_each(|line| packed.extend_from_slice(&line[..row]));
        &packed
    };
    for offset in gap_offsets(layout) {
        put_gap(points, layout, offset, out);
    }
    let shape = column_shape(layout);
    let mut known = ReferenceColumns::default();
    for field in column_order(layout) {
        match (field.meaning, field.number) {
            (FieldMeaning::Colour, _) => put_colours(points, layout, field.offset, out),
            (_, NumberType::Float) => {
                let bits = read_words(points, layout, field.offset);
                put_floats(&bits, &known, shape, out);
                known.add(field, bits);
            }
            (_, NumberType::Word) => {
                out.push(NUMBERS);
                column::encode_words(&read_words(points, layout, field.offset), shape, out);
            }
            (_, NumberType::Short) => {
                let at = |point: &[u8]| u16::from_le_bytes([point[field.offset], point[field.offset + 1]]);
                let samples: Vec<u16> = points.chunks_exact(layout.point_step).map(at).collect();
                put_shorts(&samples, shape, out);
                known.add_ring(field, samples);
            }
            (_, NumberType::Byte) => {
                let samples: Vec<u16> =
                    points.chunks_exact(layout.point_step).map(|point| point[field.offset].into()).collect();
                put_shorts(&samples, shape, out);
                known.add_ring(field, samples);
            }
            (_, NumberType::Double) => {
                for offset in [0, 4] {
                    out.push(NUMBERS);
                    column::encode_words(&read_words(points, layout, field.offset + offset), shape, out);
                }
            }
        }
    }
}

/// The inverse of [`encode`]: appends a message of `total` bytes to `out`.
pub(crate) fn decode(input: &mut FrameCursor<'_>, total: usize, out: &mut Vec<u8>) -> Result<(), Error> {
    let (layout, ends) = take_ends(input, "a head that is not a cloud's", |ends| {
        let layout = CloudLayout::read(ends, total)?;
        let (head, tail) = (layout.head, layout.tail);
        Some((layout, head, tail))
    })?;
    let length = layout.row_step * layout.height;
    let data = ends.restore(length + 1, out);
    let (data, dense) = data.split_at_mut(length);
    dense.copy_from_slice(&[input.byte()?]);
    let row = layout.width * layout.point_step;
    take_padding(input, data, row, layout.row_step)?;
    let mut points = PointWriter { data, layout: &layout };
    for offset in gap_offsets(&layout) {
        take_gap(input, &mut points, offset)?;
    }
    let shape = column_shape(&layout);
    let mut known = ReferenceColumns::default();
    for field in column_order(&layout) {
        match (field.meaning, field.number) {
            (FieldMeaning::Colour, _) => take_colours(input, &mut points, field.offset)?,
            (_, NumberType::Float) => {
                let bits = take_floats(input, &known, shape)?;
                points.put(field.offset, bits.iter().map(|bits| bits.to_le_bytes()));
                known.add(field, bits);
            }
            (_, NumberType::Word) => {
                expect_numbers(input)?;
                let samples = column::decode_words(input, shape)?;
                points.put(field.offset, samples.into_iter().map(u32::to_le_bytes));
            }
            (_, NumberType::Short) => {
                let samples = take_shorts(input, shape)?;
                points.put(field.offset, samples.iter().map(|sample| sample.to_le_bytes()));
                known.add_ring(field, samples);
            }
            (_, NumberType::Byte) => {
                let samples = take_shorts(input, shape)?;
                points.put(field.offset, samples.iter().map(|&sample| [sample as u8]));
                known.add_ring(field, samples);
            }
            (_, NumberType::Double) => {
                for offset in [0, 4] {
                    expect_numbers(input)?;
                    let samples = column::decode_words(input, shape)?;
                    points.put(field.offset + offset, samples.into_iter().map(u32::to_le_bytes));
                }
            }
        }
    }
    Ok(())
}

fn expect_numbers(input: &mut FrameCursor<'_>) -> Result<(), Error> {
    if input.byte()? == NUMBERS { Ok(()) } else { Err(Error::Corrupt("a column told in an unknown way")) }
}

fn column_shape(layout: &CloudLayout) -> Shape {
    if layout.height > 1 {
        Shape::Picture { width: layout.width, height: layout.height }
    } else {
        Shape::Sequence(layout.width)
    }
}

/// Returns the fields in coding order: rings first, because coordinates may depend on them; then z, x, y of a picture
/// (z is what a camera measures) or x, y, z of a sequence; then the rest.
fn column_order(layout: &CloudLayout) -> Vec<PointField> {
    let mut fields = layout.fields.clone();
    let camera = layout.height > 1;
    fields.sort_by_key(|field| match field.meaning {
        FieldMeaning::Ring => 0,
        FieldMeaning::Z if camera => 1,
        FieldMeaning::X => 2,
        FieldMeaning::Y => 3,
        FieldMeaning::Z => 4,
        FieldMeaning::Plain | FieldMeaning::Colour => 5,
    });
    fields
}

/// Returns the offsets of a point's bytes that belong to no field.
fn gap_offsets(layout: &CloudLayout) -> Vec<usize> {
    let mut free = vec![true; layout.point_step];
    for field in &layout.fields {
        free[field.offset..field.offset + field.number.bytes()].fill(false);
    }
    (0..layout.point_step).filter(|&offset| free[offset]).collect()
}

fn read_words(points: &[u8], layout: &CloudLayout, offset: usize) -> Vec<u32> {
    points
        .chunks_exact(layout.point_step)
        .map(|point| {
            let bytes = &point[offset..offset + 4];
            u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])
        })
        .collect()
}

/// Writes columns into the data being restored.
struct PointWriter<'a> {
    data: &'a mut [u8],
    layout: &'a CloudLayout,
}

impl PointWriter<'_> {
    fn put<const N: usize>(&mut self, offset: usize, mut samples: impl Iterator<Item = [u8; N]>) {
        let row = self.layout.width * self.layout.point_step;
        for line in self.data.chunks_exact_mut(self.layout.row_step) {
            for (point, sample) in line[..row].chunks_exact_mut(self.layout.point_step).zip(&mut samples) {
                point[offset..offset + N].copy_from_slice(&sample);
            }
        }
    }
}

/// Appends one byte of every point that no field describes; mostly constant.
fn put_gap(points: &[u8], layout: &CloudLayout, offset: usize, out: &mut Vec<u8>) {
    let mut bytes = points.iter().skip(offset).step_by(layout.point_step).copied();
    let first = bytes.clone().next().unwrap_or(0);
    if bytes.all(|byte| byte == first) {
        out.extend_from_slice(&[0, first]);
    } else {
        out.push(1);
        let bytes: Vec<u8> = points.iter().skip(offset).step_by(layout.point_step).copied().collect();
        put_packed(&bytes, out);
    }
}

fn take_gap(input: &mut FrameCursor<'_>, points: &mut PointWriter<'_>, offset: usize) -> Result<(), Error> {
    match input.byte()? {
        0 => {
            let byte = input.byte()?;
            points.put(offset, std::iter::repeat([byte]));
        }
        1 => {
            let bytes = take_packed(input, points.layout.points())?;
            if bytes.len() != points.layout.points() {
                return Err(Error::Corrupt("a gap of another size"));
            }
            points.put(offset, bytes.into_iter().map(|byte| [byte]));
        }
        _ => return Err(Error::Corrupt("a gap of an unknown kind")),
    }
    Ok(())
}

/// Appends colours as a picture of four channels, alpha mostly constant.
fn put_colours(points: &[u8], layout: &CloudLayout, offset: usize, out: &mut Vec<u8>) {
    let mut lanes = colour_lanes(layout);
    for (index, point) in points.chunks_exact(layout.point_step).enumerate() {
        let (x, y) = (index % layout.width, index / layout.width);
        let colour = &point[offset..offset + 4];
        let green = colour[1];
        let planes = [colour[0].wrapping_sub(green), green, colour[2].wrapping_sub(green), colour[3]];
        for (plane, value) in planes.into_iter().enumerate() {
            lanes.row_mut(plane, y)[x] = value;
        }
    }
    plane8::encode(&mut lanes, 4, out);
}

fn colour_lanes(layout: &CloudLayout) -> Lanes<u8> {
    if layout.height > 1 { Lanes::pictures(4, layout.width, layout.height) } else { Lanes::sequences(4, layout.width) }
}

fn take_colours(input: &mut FrameCursor<'_>, points: &mut PointWriter<'_>, offset: usize) -> Result<(), Error> {
    let mut lanes = colour_lanes(points.layout);
    plane8::decode(input, &mut lanes, 4)?;
    let (width, height) = (points.layout.width, points.layout.height);
    let lanes = &lanes;
    points.put(
        offset,
        (0..height).flat_map(|y| {
            let rows: [&[u8]; 4] = std::array::from_fn(|plane| lanes.row(plane, y));
            (0..width).map(move |x| {
                let green = rows[1][x];
                [rows[0][x].wrapping_add(green), green, rows[2][x].wrapping_add(green), rows[3][x]]
            })
        }),
    );
    Ok(())
}

/// Codes small numbers that are mostly a fixed sequence (rings): zero if a number follows the same one as last time.
fn successor_codes(samples: &[u16]) -> Option<Vec<u32>> {
    let mut next = vec![0u16; 1 << 16];
    let (mut last, mut hits) = (0u16, 0usize);
    let differences: Vec<u32> = samples
        .iter()
        .map(|&sample| {
            let guess = std::mem::replace(&mut next[usize::from(last)], sample);
            last = sample;
            hits += usize::from(guess == sample);
            if guess == sample { 0 } else { u32::from(sample) + 1 }
        })
        .collect();
    (hits * 8 > samples.len() * 7).then_some(differences)
}

fn put_shorts(samples: &[u16], shape: Shape, out: &mut Vec<u8>) {
    match successor_codes(samples) {
        Some(differences) => {
            out.push(SUCCESSORS);
            column::encode_differences(&differences, shape, out);
        }
        None => {
            out.push(NUMBERS);
            column::encode_shorts(samples, shape, out);
        }
    }
}

fn take_shorts(input: &mut FrameCursor<'_>, shape: Shape) -> Result<Vec<u16>, Error> {
    match input.byte()? {
        NUMBERS => column::decode_shorts(input, shape),
        SUCCESSORS => {
            let mut next = vec![0u16; 1 << 16];
            let mut last = 0u16;
            let differences = column::decode_differences(input, shape)?;
            Ok(differences
                .into_iter()
                .map(|difference| {
                    let sample = match difference {
                        0 => next[usize::from(last)],
                        _ => (difference - 1) as u16,
                    };
                    next[usize::from(last)] = sample;
                    last = sample;
                    sample
                })
                .collect())
        }
        _ => Err(Error::Corrupt("a column told in an unknown way")),
    }
}

/// Columns from which later ones can be predicted.
#[derive(Default)]
struct ReferenceColumns {
    coordinates: Vec<Vec<u32>>,
    ring: Option<Vec<u16>>,
}

impl ReferenceColumns {
    fn add(&mut self, field: PointField, bits: Vec<u32>) {
        if matches!(field.meaning, FieldMeaning::X | FieldMeaning::Y | FieldMeaning::Z) {
            self.coordinates.push(bits);
        }
    }

    fn add_ring(&mut self, field: PointField, samples: Vec<u16>) {
        if field.meaning == FieldMeaning::Ring && self.ring.is_none() {
            self.ring = Some(samples);
        }
    }
}

fn put_floats(bits: &[u32], known: &ReferenceColumns, shape: Shape, out: &mut Vec<u8>) {
    match ratio::choose(bits, known, shape) {
        Some(guess) => {
            out.push(GUESSED);
            out.push(guess.name());
            let differences = ratio::differences(bits, guess, known, shape);
            column::encode_differences(&differences, shape, out);
        }
        None => {
            out.push(NUMBERS);
            column::encode_floats(bits, shape, out);
        }
    }
}

fn take_floats(input: &mut FrameCursor<'_>, known: &ReferenceColumns, shape: Shape) -> Result<Vec<u32>, Error> {
    match input.byte()? {
        NUMBERS => column::decode_floats(input, shape),
        GUESSED => {
            let guess = CoordinatePredictor::from_name(input.byte()?, known)?;
            let differences = column::decode_differences(input, shape)?;
            Ok(ratio::restore(&differences, guess, known, shape))
        }
        _ => Err(Error::Corrupt("a column told in an unknown way")),
    }
}
