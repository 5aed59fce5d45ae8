//! Images as published by a camera: `sensor_msgs/Image`, `rgb8`.

use std::fmt;
use std::io::Cursor;
use std::time::{SystemTime, UNIX_EPOCH};

use bytes::Bytes;
use png::{ColorType, Decoder, Limits, Transformations};

use ros::bus::RosVersion;

use crate::Error;

/// Message type of the images, by its names in both ROS versions.
pub const TYPES: [&str; 2] = ["sensor_msgs/Image", "sensor_msgs/msg/Image"];
const SIGNATURE: &[u8] = b"\x89PNG\r\n\x1a\n";
/// Maximum size of a decoded image, and of several together.
const MAX_BYTES: usize = 128 << 20;

/// An image as rows of red, green, blue.
#[derive(Clone)]
pub struct Picture {
    width: u32,
    height: u32,
    rgb: Bytes,
}

impl fmt::Debug for Picture {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "Picture({}x{})", self.width, self.height)
    }
}

impl Picture {
    /// Decodes concatenated PNG files, as many as have 128 MiB when decoded. Also returns the total number of files.
    pub fn read_all(mut files: &[u8]) -> Result<(Vec<Picture>, usize), Error> {
        let (mut pictures, mut bytes, mut count) = (Vec::new(), 0, 0);
        while !files.is_empty() {
            count += 1;
            let (file, rest) = files.split_at(png_length(files).unwrap_or(files.len()));
            files = rest;
            if bytes >= MAX_BYTES {
                continue;
            }
            let picture = Picture::read(file)?;
            bytes += picture.rgb.len();
            if bytes <= MAX_BYTES {
                pictures.push(picture);
            }
        }
        if pictures.is_empty() {
            return Err(Error::Trial("there is no picture; give PNG files".into()));
        }
        Ok((pictures, count))
    }

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
        Ok(Picture { width: frame.width, height: frame.height, rgb })
    }

    /// Returns the message with the current time as its stamp. (sensor_msgs/Image: header, height, width, encoding,
    /// is_bigendian, step, data.)
    pub fn message(&self, sequence: usize, ros: RosVersion) -> Bytes {
        match ros {
            RosVersion::One => self.to_ros1_message(sequence),
            RosVersion::Two => self.to_ros2_message(),
        }
    }

    /// CDR: numbers are aligned to their size after the header of four bytes, and the length of a string includes its
    /// terminating zero.
    fn to_ros2_message(&self) -> Bytes {
        const HEADER: [u8; 4] = [0, 1, 0, 0];
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let mut out = Vec::with_capacity(self.rgb.len() + 64);
        out.extend_from_slice(&HEADER);
        let mut word = |value: u32, text: &str| {
            // The length of the header is a multiple of four, too.
            out.resize(out.len().next_multiple_of(4), 0);
            out.extend_from_slice(&value.to_le_bytes());
            out.extend_from_slice(text.as_bytes());
        };
        word(now.as_secs() as u32, "");
        word(now.subsec_nanos(), "");
        word(7, "camera\0");
        word(self.height, "");
        word(self.width, "");
        // The byte after the text: little-endian.
        word(5, "rgb8\0\0");
        word(self.width * 3, "");
        word(self.rgb.len() as u32, "");
        out.extend_from_slice(&self.rgb);
        out.into()
    }

    fn to_ros1_message(&self, sequence: usize) -> Bytes {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
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

/// Returns the length of the first PNG file in `files`: its signature and chunks, each with a length before and a
/// checksum after it, up to `IEND` (PNG specification, section 5). Returns `None` if it is truncated or not a PNG file.
fn png_length(files: &[u8]) -> Option<usize> {
    let mut at = SIGNATURE.len();
    if !files.starts_with(SIGNATURE) {
        return None;
    }
    loop {
        let head: [u8; 4] = files.get(at..at + 4)?.try_into().ok()?;
        let kind = files.get(at + 4..at + 8)?;
        at = at.checked_add(u32::from_be_bytes(head) as usize + 12)?;
        if kind == b"IEND" {
            return (at <= files.len()).then_some(at);
        }
    }
}

#[cfg(test)]
mod tests {
    use ros::codec::{JsonOptions, to_json};
    use ros::schema::Registry;

    use super::*;

    fn png(pixels: &[u8]) -> Vec<u8> {
        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, pixels.len() as u32, 1);
        encoder.set_color(ColorType::Grayscale);
        let mut writer = encoder.write_header().expect("a header");
        writer.write_image_data(pixels).expect("pixels");
        writer.finish().expect("an end");
        file
    }

    #[test]
    fn several_pictures_come_one_behind_the_other() {
        let files = [png(&[1]), png(&[2, 3]), png(&[4])].concat();
        let (pictures, count) = Picture::read_all(&files).expect("pictures");
        let widths: Vec<u32> = pictures.iter().map(|picture| picture.width).collect();
        assert_eq!((widths, count), (vec![1, 2, 1], 3));
        for bad in [&files[..files.len() - 20], &files[1..], &[]] {
            let error = Picture::read_all(bad).err().map(|error| error.to_string());
            assert!(error.is_some_and(|text| text.contains("PNG")));
        }
        // A chunk longer than any file.
        let endless = [SIGNATURE, &[255; 8]].concat();
        assert_eq!(png_length(&endless), None);
    }

    #[test]
    fn a_picture_becomes_a_message_of_its_size() {
        let file = png(&[7, 9]);
        let picture = Picture::read(&file).expect("a picture");
        assert_eq!(picture.rgb[..], [7, 7, 7, 9, 9, 9]);
        let message = picture.message(3, RosVersion::One);
        assert!(message.ends_with(&[6, 0, 0, 0, 6, 0, 0, 0, 7, 7, 7, 9, 9, 9]));
    }

    #[test]
    fn a_picture_is_an_image_of_ros_2_too() {
        let definitions = [
            (
                "sensor_msgs/msg/Image",
                "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n\
                 uint32 step\nuint8[] data\n",
            ),
            ("std_msgs/msg/Header", "builtin_interfaces/Time stamp\nstring frame_id\n"),
        ];
        let definitions = definitions.map(|(key, text)| (key.to_owned(), text.to_owned()));
        let registry = Registry::with_definitions(RosVersion::Two, &definitions.into());
        let image = registry.expect("valid").message("sensor_msgs/msg/Image").expect("defined");
        let picture = Picture::read(&png(&[7, 9])).expect("a picture");
        let message = picture.message(0, RosVersion::Two);
        let mut json = Vec::new();
        to_json(&image, &message, &mut json, &JsonOptions::default()).expect("valid");
        let seen: serde_json::Value = serde_json::from_slice(&json).expect("JSON");
        assert_eq!(seen["header"]["frame_id"], "camera");
        assert_eq!((&seen["height"], &seen["width"]), (&1.into(), &2.into()));
        assert_eq!((&seen["encoding"], &seen["step"]), (&"rgb8".into(), &6.into()));
        assert_eq!(seen["data"], "BwcHCQkJ");
    }

    #[test]
    fn files_that_are_no_png_are_rejected() {
        let error = Picture::read(b"JFIF").err().map(|error| error.to_string());
        assert!(error.is_some_and(|text| text.contains("give a PNG file")));
    }
}
