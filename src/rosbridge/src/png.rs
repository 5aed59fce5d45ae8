//! `png`: a message's text as the pixels of an image, which compresses it.

use std::borrow::Cow;
use std::io::Cursor;

use base64_simd::STANDARD;

use crate::fields::Fields;
use crate::message::Message;
use crate::{Fragment, Id, Problem, Writer};

/// A message encoded as a PNG image, or a part of one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Png<'a> {
    /// Id of the message it belongs to, if it is a part.
    pub id: Option<Id<'a>>,
    /// The image in base64, or a piece of that text.
    pub data: Cow<'a, str>,
    /// Index and number of the parts, if it is a part.
    pub part: Option<(u64, u64)>,
}

impl<'a> Png<'a> {
    /// Returns a part as a fragment of the base64 text.
    pub fn fragment(&self) -> Option<Fragment<'a>> {
        let ((num, total), id) = (self.part?, self.id.clone()?);
        Some(Fragment { id, data: self.data.clone(), num, total })
    }
}

impl<'a> Message<'a> for Png<'a> {
    const OP: &'static str = "png";
    const FIELDS: &'static [&'static str] = &["data", "num", "total"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        const NUM: &str = "the part's index, from 0,";
        const TOTAL: &str = "the number of parts, 1 or more,";
        let part = match (fields.count("num", 0, NUM)?, fields.count("total", 1, TOTAL)?) {
            (None, None) => None,
            (Some(num), Some(total)) => Some((num, total)),
            (None, _) => {
                return Err(Problem::Missing { field: "num", expected: NUM });
            }
            (_, None) => {
                return Err(Problem::Missing { field: "total", expected: TOTAL });
            }
        };
        if part.is_some() && id.is_none() {
            return Err(Problem::Missing { field: "id", expected: "the id common to all parts" });
        }
        Ok(Self { id, data: fields.data("data", "a picture in base64")?, part })
    }

    fn id(&self) -> Option<&Id<'a>> {
        self.id.as_ref()
    }

    fn write(&self, writer: &mut Writer<'_>) {
        writer.text("data", &self.data);
        if let Some((num, total)) = self.part {
            writer.optional_count("num", Some(num));
            writer.optional_count("total", Some(total));
        }
    }
}

/// Reason why an image could not be decoded.
#[derive(Debug, thiserror::Error)]
pub enum PngError {
    /// `data` is not base64.
    #[error("field \"data\" is not base64")]
    Base64,
    /// It is not a PNG image.
    #[error("field \"data\" is not a PNG picture: {0}")]
    Picture(#[from] png::DecodingError),
    /// The pixel format is not one that holds text.
    #[error("the picture has {0}, 8 bits of grey, RGB or RGBA are expected")]
    Pixels(String),
    /// The decoded image is too large.
    #[error("the picture unpacks to {found} bytes, at most {limit} are allowed")]
    TooLarge {
        /// Bytes of the decoded image.
        found: u64,
        /// Maximum bytes.
        limit: usize,
    },
    /// The pixels are not UTF-8.
    #[error("the picture's pixels are not UTF-8 text")]
    Text,
}

/// Decodes the text of an image given in base64, of at most `limit` bytes.
///
/// # Errors
/// Fails if it is not such an image, or a decompression bomb.
pub fn decode_png(data: &str, limit: usize) -> Result<String, PngError> {
    let file = STANDARD.decode_to_vec(data.trim_ascii()).map_err(|_| PngError::Base64)?;
    let mut decoder = png::Decoder::new_with_limits(Cursor::new(file), png::Limits { bytes: limit.max(1 << 20) });
    decoder.set_ignore_text_chunk(true);
    decoder.set_ignore_iccp_chunk(true);
    let mut reader = decoder.read_info()?;
    let (color, depth) = reader.output_color_type();
    let channels = match (color, depth) {
        (png::ColorType::Grayscale, png::BitDepth::Eight) => 1u64,
        (png::ColorType::Rgb, png::BitDepth::Eight) => 3,
        (png::ColorType::Rgba, png::BitDepth::Eight) => 4,
        _ => return Err(PngError::Pixels(format!("{color:?} at {depth:?}"))),
    };
    let info = reader.info();
    let found = u64::from(info.width) * u64::from(info.height) * channels;
    if found > limit as u64 {
        return Err(PngError::TooLarge { found, limit });
    }
    let mut pixels = vec![0; found as usize];
    reader.next_frame(&mut pixels)?;
    // Encoders pad with line feeds (rosbridge) or zeros.
    let end = pixels.iter().rposition(|&byte| byte != b'\n' && byte != 0).map_or(0, |at| at + 1);
    pixels.truncate(end);
    String::from_utf8(pixels).map_err(|_| PngError::Text)
}

/// Encodes a text as an image in base64: nearly square, RGB, padded with line feeds as in rosbridge_suite.
///
/// # Errors
/// Fails if the text is longer than an image can be.
pub fn encode_png(text: &[u8]) -> Result<String, png::EncodingError> {
    let pixels = text.len().div_ceil(3).max(1);
    let width = pixels.isqrt().max(1);
    let height = pixels.div_ceil(width);
    let mut bytes = Vec::with_capacity(width * height * 3);
    bytes.extend_from_slice(text);
    bytes.resize(width * height * 3, b'\n');
    let side = |length: usize| u32::try_from(length).unwrap_or(u32::MAX);
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, side(width), side(height));
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&bytes)?;
    writer.finish()?;
    Ok(STANDARD.encode_to_string(file))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::op::tests::{assert_parses, assert_refused, assert_survives_cbor};

    #[test]
    fn png_is_read_and_checked() {
        let whole = Png { id: None, data: "iVBO".into(), part: None };
        assert_parses(r#"{"op":"png","data":"iVBO"}"#, whole.clone());
        assert_survives_cbor(whole);
        let part = Png { id: Some("a".into()), data: "iVBO".into(), part: Some((1, 3)) };
        assert_parses(r#"{"op":"png","id":"a","data":"iVBO","num":1,"total":3}"#, part);
        assert_refused(r#"{"op":"png"}"#, "png: field \"data\" is missing, a picture in base64 is expected");
        assert_refused(
            r#"{"op":"png","id":"a","data":"","num":1}"#,
            "png: field \"total\" is missing, the number of parts, 1 or more, is expected",
        );
        assert_refused(
            r#"{"op":"png","data":"","num":1,"total":2}"#,
            "png: field \"id\" is missing, the id common to all parts is expected",
        );
    }

    #[test]
    fn texts_survive_the_picture() {
        for length in [1, 2, 3, 4, 100, 10_007] {
            let text: String = "grüße {} ".chars().cycle().take(length).collect::<String>() + "}";
            let picture = encode_png(text.as_bytes()).unwrap();
            assert_eq!(decode_png(&picture, 100_000).unwrap(), text);
        }
    }

    #[test]
    fn bombs_and_rubbish_are_refused() {
        let bomb = encode_png(&vec![b'x'; 4 << 20]).unwrap();
        assert!(bomb.len() < 200_000);
        let error = decode_png(&bomb, 1 << 20).unwrap_err();
        assert!(matches!(error, PngError::TooLarge { limit: 0x10_0000, .. }), "{error}");
        assert!(matches!(decode_png("!!", 100), Err(PngError::Base64)));
        assert!(matches!(decode_png("AAAA", 100), Err(PngError::Picture(_))));

        // 60000 x 60000 pixels announced, none sent.
        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, 60_000, 60_000);
        encoder.set_color(png::ColorType::Rgb);
        drop(encoder.write_header().unwrap());
        assert!(decode_png(&STANDARD.encode_to_string(&file), 1 << 20).is_err());

        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, 2, 1);
        encoder.set_color(png::ColorType::Rgb);
        let mut writer = encoder.write_header().unwrap();
        writer.write_image_data(&[0xff; 6]).unwrap();
        drop(writer);
        assert!(matches!(decode_png(&STANDARD.encode_to_string(&file), 100), Err(PngError::Text)));
    }
}
