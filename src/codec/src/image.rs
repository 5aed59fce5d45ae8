//! Lossless codec for `sensor_msgs/Image`: 8-bit colour, grey and Bayer, 16-bit and float depth.
//!
//! Body: `head · padding · decorrelated? · planes`. Colour channels are sent as green and the differences of the others
//! to it if that makes them smaller; a Bayer picture is sent as its four colours.

use crate::Error;
use crate::column::{self, Shape};
use crate::layout::{ImageLayout, Pixel};
use crate::padded::Lanes;
use crate::plane8;
use crate::rows::{put_padding, take_padding};
use crate::wire::{FrameCursor, MessageEnds};

/// Appends the body of `message`, which has `layout`.
pub(crate) fn encode(message: &[u8], layout: &ImageLayout, out: &mut Vec<u8>) {
    let data = layout.data(message);
    MessageEnds::from_message(message, layout.head, layout.tail).put(out);
    put_padding(data, layout.row_bytes(), layout.step, out);
    match layout.pixel {
        Pixel::Bytes(channels) => encode_colour(data, layout, channels, out),
        Pixel::Bayer if layout.width % 2 == 0 && layout.height % 2 == 0 => encode_bayer(data, layout, out),
        Pixel::Bayer => encode_colour(data, layout, 1, out),
        Pixel::Short => column::encode_shorts(&read_shorts(data, layout), picture_shape(layout), out),
        Pixel::Word => column::encode_words(&read_words(data, layout), picture_shape(layout), out),
        Pixel::Float => column::encode_floats(&read_words(data, layout), picture_shape(layout), out),
    }
}

/// The inverse of [`encode`]: appends a message of `total` bytes to `out`.
pub(crate) fn decode(input: &mut FrameCursor<'_>, total: usize, out: &mut Vec<u8>) -> Result<(), Error> {
    let (layout, ends) = ImageLayout::take(input, total)?;
    let data = ends.restore(layout.step * layout.height, out);
    take_padding(input, data, layout.row_bytes(), layout.step)?;
    match layout.pixel {
        Pixel::Bytes(channels) => decode_colour(input, data, &layout, channels),
        Pixel::Bayer if layout.width % 2 == 0 && layout.height % 2 == 0 => decode_bayer(input, data, &layout),
        Pixel::Bayer => decode_colour(input, data, &layout, 1),
        Pixel::Short => {
            let samples = column::decode_shorts(input, picture_shape(&layout))?;
            let order = if layout.big_endian { u16::to_be_bytes } else { u16::to_le_bytes };
            put_samples(data, &layout, samples.into_iter().map(order));
            Ok(())
        }
        Pixel::Word | Pixel::Float => {
            let samples = match layout.pixel {
                Pixel::Word => column::decode_words(input, picture_shape(&layout))?,
                _ => column::decode_floats(input, picture_shape(&layout))?,
            };
            let order = if layout.big_endian { u32::to_be_bytes } else { u32::to_le_bytes };
            put_samples(data, &layout, samples.into_iter().map(order));
            Ok(())
        }
    }
}

fn picture_shape(layout: &ImageLayout) -> Shape {
    Shape::Picture { width: layout.width, height: layout.height }
}

fn sample_rows<'a>(data: &'a [u8], layout: &ImageLayout) -> impl Iterator<Item = &'a [u8]> {
    let row = layout.row_bytes();
    data.chunks_exact(layout.step).map(move |line| &line[..row])
}

fn read_shorts(data: &[u8], layout: &ImageLayout) -> Vec<u16> {
    let mut samples = Vec::with_capacity(layout.width * layout.height);
    for row in sample_rows(data, layout) {
        let shorts = row.chunks_exact(2).map(|bytes| u16::from_le_bytes([bytes[0], bytes[1]]));
        samples.extend(shorts);
    }
    if layout.big_endian {
        samples.iter_mut().for_each(|sample| *sample = sample.swap_bytes());
    }
    samples
}

fn read_words(data: &[u8], layout: &ImageLayout) -> Vec<u32> {
    let mut samples = Vec::with_capacity(layout.width * layout.height);
    for row in sample_rows(data, layout) {
        let words = row.chunks_exact(4).map(|bytes| u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]));
        samples.extend(words);
    }
    if layout.big_endian {
        samples.iter_mut().for_each(|sample| *sample = sample.swap_bytes());
    }
    samples
}

fn put_samples<const N: usize>(data: &mut [u8], layout: &ImageLayout, mut samples: impl Iterator<Item = [u8; N]>) {
    let row = layout.row_bytes();
    for line in data.chunks_exact_mut(layout.step) {
        for (slot, sample) in line[..row].chunks_exact_mut(N).zip(&mut samples) {
            slot.copy_from_slice(&sample);
        }
    }
}

/// Returns true if channels differ less from green than from their own neighbours.
fn should_decorrelate(data: &[u8], layout: &ImageLayout, channels: usize) -> bool {
    let (mut apart, mut together) = (0u64, 0u64);
    for row in sample_rows(data, layout).step_by(16) {
        for pair in row.windows(2 * channels).step_by(channels * 3) {
            let step = |channel: usize| i32::from(pair[channels + channel]) - i32::from(pair[channel]);
            for channel in [0, 2] {
                apart += u64::from(step(channel).unsigned_abs());
                together += u64::from((step(channel) - step(1)).unsigned_abs());
            }
        }
    }
    together <= apart
}

fn encode_colour(data: &[u8], layout: &ImageLayout, channels: usize, out: &mut Vec<u8>) {
    let mut lanes = Lanes::<u8>::pictures(channels, layout.width, layout.height);
    let decorrelate = channels >= 3 && should_decorrelate(data, layout, channels);
    out.push(decorrelate.into());
    for (y, row) in sample_rows(data, layout).enumerate() {
        match channels {
            1 => lanes.row_mut(0, y).copy_from_slice(row),
            2 => split_row::<2>(row, &mut lanes, y, false),
            3 => split_row::<3>(row, &mut lanes, y, decorrelate),
            _ => split_row::<4>(row, &mut lanes, y, decorrelate),
        }
    }
    plane8::encode(&mut lanes, channels, out);
}

fn split_row<const C: usize>(row: &[u8], lanes: &mut Lanes<u8>, y: usize, decorrelate: bool) {
    let width = row.len() / C;
    let mut channels = lanes.lanes.iter_mut().map(|lane| &mut lane.row_mut(y)[..width]);
    let channels: [&mut [u8]; C] = std::array::from_fn(|_| channels.next().unwrap_or_default());
    let green = if decorrelate { 0xff } else { 0 };
    for (x, pixel) in row.chunks_exact(C).enumerate() {
        for channel in 0..C {
            // Green and alpha stay unchanged.
            let reference = if channel == 0 || channel == 2 { pixel[1] & green } else { 0 };
            channels[channel][x] = pixel[channel].wrapping_sub(reference);
        }
    }
}

fn decode_colour(
    input: &mut FrameCursor<'_>,
    data: &mut [u8],
    layout: &ImageLayout,
    channels: usize,
) -> Result<(), Error> {
    let decorrelated = match input.byte()? {
        0 => false,
        1 if channels >= 3 => true,
        _ => return Err(Error::Corrupt("channels decorrelated in an unknown way")),
    };
    let mut lanes = Lanes::<u8>::pictures(channels, layout.width, layout.height);
    plane8::decode(input, &mut lanes, channels)?;
    let row = layout.row_bytes();
    for (y, line) in data.chunks_exact_mut(layout.step).enumerate() {
        let line = &mut line[..row];
        match channels {
            1 => line.copy_from_slice(lanes.row(0, y)),
            2 => join_row::<2>(line, &lanes, y, false),
            3 => join_row::<3>(line, &lanes, y, decorrelated),
            _ => join_row::<4>(line, &lanes, y, decorrelated),
        }
    }
    Ok(())
}

fn join_row<const C: usize>(row: &mut [u8], lanes: &Lanes<u8>, y: usize, decorrelated: bool) {
    let width = row.len() / C;
    let channels: [&[u8]; C] = std::array::from_fn(|channel| &lanes.row(channel, y)[..width]);
    let green = if decorrelated { 0xff } else { 0 };
    for (x, pixel) in row.chunks_exact_mut(C).enumerate() {
        for channel in 0..C {
            let reference = if channel == 0 || channel == 2 { channels[1][x] & green } else { 0 };
            pixel[channel] = channels[channel][x].wrapping_add(reference);
        }
    }
}

/// Encodes the four colours of a Bayer picture as planes of half its width and height.
fn encode_bayer(data: &[u8], layout: &ImageLayout, out: &mut Vec<u8>) {
    let mut lanes = Lanes::<u8>::pictures(4, layout.width / 2, layout.height / 2);
    for (y, row) in sample_rows(data, layout).enumerate() {
        let first = (y % 2) * 2;
        for (x, pair) in row.chunks_exact(2).enumerate() {
            lanes.row_mut(first, y / 2)[x] = pair[0];
            lanes.row_mut(first + 1, y / 2)[x] = pair[1];
        }
    }
    plane8::encode(&mut lanes, 4, out);
}

fn decode_bayer(input: &mut FrameCursor<'_>, data: &mut [u8], layout: &ImageLayout) -> Result<(), Error> {
    let mut lanes = Lanes::<u8>::pictures(4, layout.width / 2, layout.height / 2);
    plane8::decode(input, &mut lanes, 4)?;
    let row = layout.row_bytes();
    for (y, line) in data.chunks_exact_mut(layout.step).enumerate() {
        let first = (y % 2) * 2;
        let (left, right) = (lanes.row(first, y / 2), lanes.row(first + 1, y / 2));
        for (x, pair) in line[..row].chunks_exact_mut(2).enumerate() {
            pair.copy_from_slice(&[left[x], right[x]]);
        }
    }
    Ok(())
}
