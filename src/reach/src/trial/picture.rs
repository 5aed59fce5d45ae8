//! A picture as a camera would publish it: `sensor_msgs/Image`, `rgb8`.

use std::io::Cursor;
use std::time::{SystemTime, UNIX_EPOCH};

use bytes::Bytes;
use png::{ColorType, Decoder, Limits, Transformations};

use crate::Error;

/// What becomes of it.
pub const TYPE: &str = "sensor_msgs/Image";
/// The largest picture, decoded.
const MAX_BYTES: usize = 128 << 20;

/// Rows of red, green, blue.
pub struct Picture {
    width: u32,
    height: u32,
    rgb: Vec<u8>,
}

impl Picture {
    /// Decodes a PNG file.
    pub fn read(file: &[u8]) -> Result<Picture, Error> {
        let bad = |error: png::DecodingError| {
            Error::Trial(format!(
                "the picture cannot be read: {error}; give a PNG file (convert FILE picture.png makes one)"
            ))
        };
        let limits = Limits { bytes: MAX_BYTES };
        let mut decoder = Decoder::new_with_limits(Cursor::new(file), limits);
        decoder.set_transformations(Transformations::EXPAND | Transformations::STRIP_16);
        let mut reader = decoder.read_info().map_err(bad)?;
        let size = reader.output_buffer_size().unwrap_or(usize::MAX);
        if size > MAX_BYTES {
            return Err(Error::Trial(format!(
                "the picture has more than {MAX_BYTES} bytes when decoded; make it smaller"
            )));
        }
        let mut pixels = vec![0; size];
        let frame = reader.next_frame(&mut pixels).map_err(bad)?;
        let samples = match frame.color_type {
            ColorType::Grayscale | ColorType::Indexed => 1,
            ColorType::GrayscaleAlpha => 2,
            ColorType::Rgb => 3,
            ColorType::Rgba => 4,
        };
        let rgb = pixels[..frame.buffer_size()]
            .chunks_exact(samples)
            .flat_map(|pixel| match pixel {
                [red, green, blue, ..] => [*red, *green, *blue],
                [grey, ..] => [*grey; 3],
                [] => [0; 3],
            })
            .collect();
        Ok(Picture {
            width: frame.width,
            height: frame.height,
            rgb,
        })
    }

    /// The message, taken now. (sensor_msgs/Image: header, height, width, encoding, is_bigendian, step, data.)
    pub fn message(&self, sequence: usize) -> Bytes {
        let now = SystemTime::now()
            .duration_since(UNIX_EPOCH)
            .unwrap_or_default();
        let mut out = Vec::with_capacity(self.rgb.len() + 64);
        let mut word = |value: u32, text: &str| {
            out.extend_from_slice(&value.to_le_bytes());
            out.extend_from_slice(text.as_bytes());
        };
        word(sequence as u32, "");
        word(now.as_secs() as u32, "");
        word(now.subsec_nanos(), "");
        word(6, "camera");
        word(self.height, "");
        word(self.width, "");
        word(4, "rgb8");
        out.push(0);
        out.extend_from_slice(&(self.width * 3).to_le_bytes());
        out.extend_from_slice(&(self.rgb.len() as u32).to_le_bytes());
        out.extend_from_slice(&self.rgb);
        out.into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_becomes_a_message_of_its_size() {
        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, 2, 1);
        encoder.set_color(ColorType::Grayscale);
        let mut writer = encoder.write_header().expect("a header");
        writer.write_image_data(&[7, 9]).expect("pixels");
        writer.finish().expect("an end");
        let picture = Picture::read(&file).expect("a picture");
        assert_eq!(picture.rgb, [7, 7, 7, 9, 9, 9]);
        let message = picture.message(3);
        assert!(message.ends_with(&[6, 0, 0, 0, 6, 0, 0, 0, 7, 7, 7, 9, 9, 9]));
    }

    #[test]
    fn what_is_no_png_is_told() {
        let error = Picture::read(b"JFIF").err().map(|error| error.to_string());
        assert!(error.is_some_and(|text| text.contains("give a PNG file")));
    }
}
