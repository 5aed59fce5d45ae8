//! Images of a stereo camera, for packages that compute disparities: a window that moves over the two photographs of a
//! plant in Debian's opencv-doc (Middlebury's Aloe, which is rectified).

use std::path::Path;
use std::process::Command;
use std::sync::Arc;

use anyhow::{Context, Result, ensure};
use bytes::{BufMut, Bytes, BytesMut};
use ros::bag::BagMessage;
use ros::bus::WireType;

/// Photographs of the left and of the right camera.
pub const PICTURES: [&str; 2] =
    ["/usr/share/doc/opencv-doc/examples/data/aloeL.jpg", "/usr/share/doc/opencv-doc/examples/data/aloeR.jpg"];
/// Topic of the last message of each moment.
pub const LAST: &str = "/right/image_raw";
/// Size of a window, in pixels.
const SIZE: (u32, u32) = (480, 400);
/// Number of windows.
const COUNT: usize = 44;
/// Interval between two windows, in nanoseconds.
const PERIOD: u64 = 100_000_000;
/// Focal length of an ideal camera, in pixels.
const FOCAL_LENGTH: f64 = 400.0;
/// Distance between the cameras, in metres.
const BASELINE: f64 = 0.1;

/// Writes the images: all of the left camera, then all of the right one, one byte per pixel.
pub fn write(to: &Path) -> Result<()> {
    let (width, height) = SIZE;
    // The photographs are of 1282x1110 pixels.
    let windows = format!("scale=640:554,crop={width}:{height}:x='3*n':y='2*n'");
    let mut whole = Vec::new();
    for picture in PICTURES {
        let output = Command::new("ffmpeg")
            .args(["-v", "error", "-loop", "1", "-i", picture, "-vf", &windows])
            .args(["-frames:v", &COUNT.to_string()])
            .args(["-pix_fmt", "gray", "-f", "rawvideo", "-"])
            .output()
            .context("ffmpeg")?;
        let said = String::from_utf8_lossy(&output.stderr);
        ensure!(output.status.success(), "ffmpeg ended with {}: {}", output.status, said.trim());
        whole.extend(output.stdout);
    }
    std::fs::write(to, whole).with_context(|| to.display().to_string())
}

/// Reads the images as ten moments per second: four messages each, with equal stamps.
pub fn read(file: &Bytes) -> Vec<BagMessage> {
    let (width, height) = SIZE;
    let (left, right) = file.split_at(file.len() / 2);
    let size = (width * height) as usize;
    let pairs = left.chunks_exact(size).zip(right.chunks_exact(size));
    let image = Arc::new(support::people::image_type());
    let info = Arc::new(WireType::new("sensor_msgs/CameraInfo", "c9a58c1b0b154e0e6da7578cb991d214", CAMERA_INFO));
    let mut messages = Vec::new();
    for ((left, right), number) in pairs.zip(0..) {
        let all = [
            ("/left/image_raw", &image, serialize_image(number, left)),
            ("/left/camera_info", &info, serialize_camera_info(number, 0.0)),
            ("/right/camera_info", &info, serialize_camera_info(number, BASELINE)),
            (LAST, &image, serialize_image(number, right)),
        ];
        messages.extend(all.map(|(topic, wire_type, bytes)| BagMessage {
            topic: Arc::from(topic),
            wire_type: wire_type.clone(),
            time: u64::from(number) * PERIOD,
            bytes,
        }));
    }
    messages
}

fn put_string(out: &mut BytesMut, text: &str) {
    out.put_u32_le(text.len() as u32);
    out.put_slice(text.as_bytes());
}

/// Writes a `std_msgs/Header` whose stamp is its number.
fn put_header(out: &mut BytesMut, number: u32) {
    [number, number, 0].iter().for_each(|word| out.put_u32_le(*word));
    put_string(out, "camera");
}

/// Serializes a `sensor_msgs/Image` in mono8.
fn serialize_image(number: u32, pixels: &[u8]) -> Bytes {
    let mut out = BytesMut::new();
    put_header(&mut out, number);
    out.put_u32_le(SIZE.1);
    out.put_u32_le(SIZE.0);
    put_string(&mut out, "mono8");
    out.put_u8(0);
    out.put_u32_le(SIZE.0);
    out.put_u32_le(pixels.len() as u32);
    out.put_slice(pixels);
    out.freeze()
}

/// Serializes a `sensor_msgs/CameraInfo` of an ideal camera, `baseline` metres to the right of the left one.
fn serialize_camera_info(number: u32, baseline: f64) -> Bytes {
    let (width, height) = SIZE;
    let (f, x, y) = (FOCAL_LENGTH, f64::from(width) / 2.0, f64::from(height) / 2.0);
    let mut out = BytesMut::new();
    put_header(&mut out, number);
    out.put_u32_le(height);
    out.put_u32_le(width);
    put_string(&mut out, "plumb_bob");
    out.put_u32_le(5);
    let distortion = [0.0; 5];
    let intrinsic = [f, 0.0, x, 0.0, f, y, 0.0, 0.0, 1.0];
    let rectifying = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let projecting = [[f, 0.0, x, -f * baseline], [0.0, f, y, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let numbers = distortion.iter().chain(&intrinsic).chain(&rectifying);
    let numbers = numbers.chain(projecting.as_flattened());
    numbers.for_each(|number| out.put_f64_le(*number));
    // binning_x, binning_y, roi: the whole image
    out.put_bytes(0, 4 * 6 + 1);
    out.freeze()
}

/// Definition of `sensor_msgs/CameraInfo`.
const CAMERA_INFO: &str = "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] \
    D\nfloat64[9] K\n\
    float64[9] R\nfloat64[12] P\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n\
    ================================================================================\n\
    MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n\
    ================================================================================\n\
    MSG: sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool \
    do_rectify\n";

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::with_relative_stamp;

    #[test]
    fn a_moment_is_four_messages_of_one_stamp() {
        let size = (SIZE.0 * SIZE.1) as usize;
        let file = Bytes::from([vec![1; 2 * size], vec![2; 2 * size]].concat());
        let messages = read(&file);
        assert_eq!(messages.len(), 8);
        let request = &messages[7];
        assert_eq!(&*request.topic, LAST);
        assert_eq!(request.bytes.last(), Some(&2));
        assert_eq!(messages[4].bytes.last(), Some(&1));
        for before in &messages[4..7] {
            let again = with_relative_stamp(before, request, 1001);
            assert_eq!(again[4..12], [0xe9, 3, 0, 0, 0, 0, 0, 0]);
        }
    }

    #[test]
    fn a_camera_is_as_long_as_its_type() {
        let told = serialize_camera_info(7, BASELINE);
        // Header and frame id, size, model, D with its length, K, R, P, binning, roi.
        let length = (16 + 6) + 8 + (4 + 9) + (4 + 40) + 8 * (9 + 9 + 12) + 8 + 17;
        assert_eq!(told.len(), length);
    }
}
