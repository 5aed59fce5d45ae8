//! Smaller forms of messages for people who look at them: of the same type with less in it, never to be restored.

use std::borrow::Cow;

use crate::jpeg::{self, JpegOptions};
use crate::layout::{CloudLayout, ImageLayout, Pixel, Schema};

/// Maximum number of pixels of an image: encoding more would delay the messages of robots.
const MOST_PIXELS: usize = 640 * 480;
/// Maximum number of points of a cloud: more of them are hardly told apart on a screen.
const MOST_POINTS: usize = 20_000;

/// Returns a smaller message of the same type, or `None` if the message is best sent as it is. An image of a camera
/// keeps its fields, but its `data` is a JPEG (first bytes `FF D8`), with every n-th row and column if it is large; of
/// a large cloud every n-th point remains, in one row.
pub fn encode_preview(schema: Schema, message: &[u8]) -> Option<Vec<u8>> {
    let smaller = match schema {
        Schema::Image => preview_image(message),
        Schema::PointCloud2 => thin_cloud(message),
        Schema::OccupancyGrid | Schema::LaserScan | Schema::Other => None,
    };
    smaller.filter(|smaller| smaller.len() < message.len())
}

fn preview_image(message: &[u8]) -> Option<Vec<u8>> {
    let layout = ImageLayout::read(message, message.len())?;
    let mut smaller = message[..layout.head].to_vec();
    let (pixels, thinned) = thin_image(layout.data(message), layout)?;
    jpeg::encode_pixels(&pixels, &thinned, JpegOptions::default(), &mut smaller)?;
    let length = smaller.len() - layout.head;
    put_size(&mut smaller, layout.head - 4, length)?;
    Some(smaller)
}

/// Returns the pixels in `data` that are few enough, and their layout; `None` if a pixel is not of bytes.
fn thin_image(data: &[u8], layout: ImageLayout) -> Option<(Cow<'_, [u8]>, ImageLayout)> {
    let Pixel::Bytes(channels) = layout.pixel else {
        return None;
    };
    let size = |step: usize| (layout.width.div_ceil(step), layout.height.div_ceil(step));
    let step = (1..=layout.width.max(layout.height)).find(|step| {
        let (width, height) = size(*step);
        width * height <= MOST_PIXELS
    })?;
    if step == 1 {
        return Some((Cow::Borrowed(data), layout));
    }
    let (width, height) = size(step);
    let mut pixels = Vec::with_capacity(width * height * channels);
    for row in data.chunks_exact(layout.step).step_by(step) {
        for pixel in row[..layout.row_bytes()].chunks_exact(channels).step_by(step) {
            pixels.extend_from_slice(pixel);
        }
    }
    Some((Cow::Owned(pixels), ImageLayout { width, height, step: width * channels, ..layout }))
}

fn thin_cloud(message: &[u8]) -> Option<Vec<u8>> {
    let layout = CloudLayout::read(message, message.len())?;
    let step = layout.points().div_ceil(MOST_POINTS);
    if step < 2 {
        return None;
    }
    let dense_at = layout.head + layout.row_step * layout.height;
    let mut smaller = message[..layout.head].to_vec();
    for point in (0..layout.points()).step_by(step) {
        let at = layout.head + point / layout.width * layout.row_step + point % layout.width * layout.point_step;
        smaller.extend_from_slice(&message[at..at + layout.point_step]);
    }
    let length = smaller.len() - layout.head;
    put_size(&mut smaller, layout.size_at, 1)?;
    put_size(&mut smaller, layout.size_at + 4, length / layout.point_step)?;
    // The length of a row stands right before that of the data.
    put_size(&mut smaller, layout.head - 8, length)?;
    put_size(&mut smaller, layout.head - 4, length)?;
    smaller.push(message[dense_at]);
    Some(smaller)
}

/// Overwrites a 32-bit size.
fn put_size(message: &mut [u8], at: usize, size: usize) -> Option<()> {
    let size = u32::try_from(size).ok()?;
    message.get_mut(at..at + 4)?.copy_from_slice(&size.to_le_bytes());
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A message under construction, packed as in ROS 1, or as CDR: there each number is aligned to four bytes after
    /// the encapsulation header, which takes the place of `seq`.
    struct Writing {
        bytes: Vec<u8>,
        is_cdr: bool,
    }

    impl Writing {
        fn begin(is_cdr: bool) -> Writing {
            let mut writing = Writing { bytes: vec![0, u8::from(is_cdr), 0, 0], is_cdr };
            writing.size(7);
            writing.size(8);
            writing.text("odd");
            writing
        }

        fn size(&mut self, size: u32) {
            while self.is_cdr && self.bytes.len() % 4 != 0 {
                self.bytes.push(0);
            }
            self.bytes.extend(size.to_le_bytes());
        }

        fn text(&mut self, text: &str) {
            self.size(text.len() as u32 + u32::from(self.is_cdr));
            self.bytes.extend(text.as_bytes());
            if self.is_cdr {
                self.bytes.push(0);
            }
        }

        fn data(&mut self, data: &[u8]) {
            self.size(data.len() as u32);
            self.bytes.extend(data);
        }
    }

    fn image(is_cdr: bool, encoding: &str, (width, height, channels): (u32, u32, u32)) -> Vec<u8> {
        let mut writing = Writing::begin(is_cdr);
        writing.size(height);
        writing.size(width);
        writing.text(encoding);
        writing.bytes.push(0);
        // Two bytes of padding behind each row.
        let step = width * channels + 2;
        writing.size(step);
        writing.data(&vec![200; (step * height) as usize]);
        writing.bytes
    }

    fn cloud(is_cdr: bool, (width, height): (u32, u32)) -> Vec<u8> {
        let mut writing = Writing::begin(is_cdr);
        writing.size(height);
        writing.size(width);
        writing.size(1);
        writing.text("x");
        writing.size(0);
        writing.bytes.push(7);
        writing.size(1);
        writing.bytes.push(0);
        let row = 4 * width + 4;
        writing.size(4);
        writing.size(row);
        let rows = (0..height).map(|row| (0..width).map(move |column| row * width + column));
        let data = rows.flat_map(|row| row.flat_map(|point| (point as f32).to_le_bytes()).chain([9; 4]));
        writing.data(&data.collect::<Vec<u8>>());
        writing.bytes.push(1);
        writing.bytes
    }

    #[test]
    fn an_image_of_a_camera_becomes_a_jpeg_within_the_same_message() {
        for is_cdr in [false, true] {
            let message = image(is_cdr, "rgb8", (64, 48, 3));
            let layout = ImageLayout::read(&message, message.len()).expect("an image");
            let smaller = encode_preview(Schema::Image, &message).expect("a preview");
            assert!(smaller.len() < message.len() / 4, "{} of {}", smaller.len(), message.len());
            let (before, data) = smaller.split_at(layout.head);
            assert_eq!(before[..layout.head - 4], message[..layout.head - 4]);
            assert_eq!(before[layout.head - 4..], (data.len() as u32).to_le_bytes());
            assert!(data.starts_with(&[0xff, 0xd8]) && data.ends_with(&[0xff, 0xd9]));
        }
    }

    #[test]
    fn of_a_large_image_every_nth_row_and_column_remains() {
        for ((width, height), expected) in
            [((640, 480), (640, 480)), ((1280, 960), (640, 480)), ((1921, 30), (1921, 30))]
        {
            let message = image(true, "bgr8", (width, height, 3));
            let smaller = encode_preview(Schema::Image, &message).expect("a preview");
            // The frame header of a baseline JPEG: marker, length, precision, height, width.
            let at = smaller.windows(4).position(|four| four == [0xff, 0xc0, 0, 17]).expect("a frame header");
            let number = |at: usize| u16::from_be_bytes([smaller[at], smaller[at + 1]]);
            assert_eq!((number(at + 7), number(at + 5)), expected, "{width} x {height}");
        }
    }

    #[test]
    fn labels_and_depths_stay_as_they_are() {
        for (encoding, bytes) in [("8UC1", 1), ("16UC1", 2), ("32FC1", 4), ("yuv422", 2)] {
            let message = image(false, encoding, (64, 48, bytes));
            assert_eq!(encode_preview(Schema::Image, &message), None, "{encoding}");
        }
        assert_eq!(encode_preview(Schema::Image, b"no image"), None);
        assert_eq!(encode_preview(Schema::Other, &image(false, "rgb8", (64, 48, 3))), None);
    }

    #[test]
    fn of_a_large_cloud_every_nth_point_remains_in_one_row() {
        for is_cdr in [false, true] {
            let message = cloud(is_cdr, (300, 150));
            let smaller = encode_preview(Schema::PointCloud2, &message).expect("a preview");
            let layout = CloudLayout::read(&smaller, smaller.len()).expect("a cloud");
            // 45,000 points: every third.
            assert_eq!((layout.width, layout.height, layout.row_step), (15_000, 1, 60_000));
            let value = |point: usize| {
                let at = layout.head + 4 * point;
                f32::from_le_bytes(smaller[at..at + 4].try_into().expect("four bytes"))
            };
            assert_eq!([value(0), value(1), value(101), value(14_999)], [0.0, 3.0, 303.0, 44_997.0]);
            assert_eq!(smaller.last(), Some(&1), "is_dense");
            assert_eq!(encode_preview(Schema::PointCloud2, &cloud(is_cdr, (100, 100))), None, "few points");
        }
    }
}
