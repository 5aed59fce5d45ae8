//! Codec for pictures as JPEG, each decodable alone. The pixels are lossy, so it is only used if the robot's
//! configuration allows it. All other bytes of the message are exact, alpha included. Only camera encodings are
//! accepted: 8-bit grey and colour by name (`mono8`, `rgb8`, …), never `8UC1` and the like, which may hold labels.
//!
//! Body: `head · padding · [alpha] · JPEG (baseline, one interleaved scan)`.

mod guard;

use crate::Error;
use crate::layout::{ImageLayout, Pixel};
use crate::rows::{put_alpha, put_padding, take_alpha, take_padding};
use crate::wire::{FrameCursor, MessageEnds};
use jpeg_encoder::ColorType;
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

/// Settings of the JPEG encoder.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct JpegOptions {
    /// JPEG quality, 1 (smallest) to 100 (best). Below 90 colour has half the resolution in both directions.
    pub quality: u8,
}

impl Default for JpegOptions {
    fn default() -> Self {
        Self { quality: 80 }
    }
}

/// Returns the number of channels if the picture can be encoded as JPEG.
fn channels(layout: &ImageLayout) -> Option<usize> {
    let Pixel::Bytes(channels @ (1 | 3 | 4)) = layout.pixel else {
        return None;
    };
    let largest = usize::from(u16::MAX);
    let fits = layout.seen && layout.width <= largest && layout.height <= largest;
    fits.then_some(channels)
}

/// Appends the body of `message`; `None` if its encoding is not a camera's.
pub(crate) fn encode(message: &[u8], layout: &ImageLayout, options: JpegOptions, out: &mut Vec<u8>) -> Option<()> {
    let channels = channels(layout)?;
    let data = layout.data(message);
    MessageEnds::from_message(message, layout.head, layout.tail).put(out);
    put_padding(data, layout.row_bytes(), layout.step, out);
    if channels == 4 {
        put_alpha(data, layout, out);
    }
    encode_pixels(data, layout, options, out)
}

/// Appends the JPEG of the pixels in `data`, without alpha; `None` if their encoding is not a camera's.
pub(crate) fn encode_pixels(data: &[u8], layout: &ImageLayout, options: JpegOptions, out: &mut Vec<u8>) -> Option<()> {
    let channels = channels(layout)?;
    let packed: Vec<u8>;
    let pixels = if layout.row_bytes() == layout.step {
        data
    } else {
        let rows = data.chunks_exact(layout.step);
        packed = rows.flat_map(|row| &row[..layout.row_bytes()]).copied().collect();
        &packed
    };
    let colour = match (channels, layout.red_first) {
        (1, _) => ColorType::Luma,
        (3, true) => ColorType::Rgb,
        (3, false) => ColorType::Bgr,
        (_, true) => ColorType::Rgba,
        (_, false) => ColorType::Bgra,
    };
    let (width, height) = (u16::try_from(layout.width).ok()?, u16::try_from(layout.height).ok()?);
    jpeg_encoder::Encoder::new(out, options.quality.clamp(1, 100)).encode(pixels, width, height, colour).ok()
}

/// Decodes a message of `total` bytes and appends it to `out`.
pub(crate) fn decode(input: &mut FrameCursor<'_>, total: usize, out: &mut Vec<u8>) -> Result<(), Error> {
    let (layout, ends) = ImageLayout::take(input, total)?;
    let channels = channels(&layout).ok_or(Error::Corrupt("a JPEG of pictures that are none"))?;
    let colours = channels.min(3);
    let data = ends.restore(layout.step * layout.height, out);
    take_padding(input, data, layout.row_bytes(), layout.step)?;
    if channels == 4 {
        take_alpha(input, data, &layout)?;
    }
    let stream = input.take_rest();
    // Before the library allocates anything.
    guard::check(stream, layout.width, layout.height, colours)?;
    let space = if colours == 1 { ColorSpace::Luma } else { ColorSpace::RGB };
    let options = DecoderOptions::default()
        .set_max_width(layout.width)
        .set_max_height(layout.height)
        .set_strict_mode(true)
        .jpeg_set_out_colorspace(space);
    let refused = |error| Error::Jpeg(format!("{error:?}"));
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(stream), options);
    let pixels = decoder.decode().map_err(refused)?;
    if pixels.len() != layout.width * layout.height * colours {
        return Err(Error::Corrupt("a JPEG of another size"));
    }
    let lines = data.chunks_exact_mut(layout.step);
    for (line, pixels) in lines.zip(pixels.chunks_exact(layout.width * colours)) {
        let line = &mut line[..layout.width * channels];
        if channels == 1 || (channels == 3 && layout.red_first) {
            line.copy_from_slice(pixels);
            continue;
        }
        for (pixel, colours) in line.chunks_exact_mut(channels).zip(pixels.chunks_exact(3)) {
            pixel[..3].copy_from_slice(colours);
            if !layout.red_first {
                pixel.swap(0, 2);
            }
        }
    }
    Ok(())
}
