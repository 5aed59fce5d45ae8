//! Pictures of two cameras beside each other, for packages that look for disparities: a window that moves over the two photographs of a
//! plant of Debian's opencv-doc (Middlebury's Aloe, which is rectified).

use std::path::Path;
use std::process::Command;
use std::sync::Arc;

use anyhow::{Context, Result, ensure};
use bytes::{BufMut, Bytes, BytesMut};
use ros::bag::Recorded;
use ros::bus::WireType;

/// What the left camera sees, and the right one.
pub const PICTURES: [&str; 2] = [
    "/usr/share/doc/opencv-doc/examples/data/aloeL.jpg",
    "/usr/share/doc/opencv-doc/examples/data/aloeR.jpg",
];
/// The topic of the last of the messages of each moment.
pub const LAST: &str = "/right/image_raw";
/// Of a window, pixels.
const SIZE: (u32, u32) = (480, 400);
/// Windows.
const COUNT: usize = 44;
/// Between two of them, nanoseconds.
const PERIOD: u64 = 100_000_000;
/// Of an ideal camera, pixels.
const FOCAL_LENGTH: f64 = 400.0;
/// Between the cameras, metres.
const BASELINE: f64 = 0.1;

/// Writes them: all pictures of the left camera, then all of the right one, one byte a pixel.
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
        ensure!(
            output.status.success(),
            "ffmpeg ended with {}: {}",
            output.status,
            said.trim()
        );
        whole.extend(output.stdout);
    }
    std::fs::write(to, whole).with_context(|| to.display().to_string())
}

/// Reads them, ten moments a second: four messages each, with equal stamps.
pub fn read(file: &Bytes) -> Vec<Recorded> {
    let (width, height) = SIZE;
    let (left, right) = file.split_at(file.len() / 2);
    let size = (width * height) as usize;
    let pairs = left.chunks_exact(size).zip(right.chunks_exact(size));
    let image = Arc::new(support::people::image_type());
    let info = Arc::new(WireType::new(
        "sensor_msgs/CameraInfo",
        "c9a58c1b0b154e0e6da7578cb991d214",
        CAMERA_INFO,
    ));
    let mut messages = Vec::new();
    for ((left, right), number) in pairs.zip(0..) {
        let all = [
            ("/left/image_raw", &image, picture(number, left)),
            ("/left/camera_info", &info, camera(number, 0.0)),
            ("/right/camera_info", &info, camera(number, BASELINE)),
            (LAST, &image, picture(number, right)),
        ];
        messages.extend(all.map(|(topic, wire_type, bytes)| Recorded {
            topic: Arc::from(topic),
            wire_type: wire_type.clone(),
            time: u64::from(number) * PERIOD,
            bytes,
        }));
    }
    messages
}

fn text(out: &mut BytesMut, text: &str) {
    out.put_u32_le(text.len() as u32);
    out.put_slice(text.as_bytes());
}

/// `std_msgs/Header`, stamped with its number.
fn header(out: &mut BytesMut, number: u32) {
    [number, number, 0]
        .iter()
        .for_each(|word| out.put_u32_le(*word));
    text(out, "camera");
}

/// A `sensor_msgs/Image` in mono8.
fn picture(number: u32, pixels: &[u8]) -> Bytes {
    let mut out = BytesMut::new();
    header(&mut out, number);
    out.put_u32_le(SIZE.1);
    out.put_u32_le(SIZE.0);
    text(&mut out, "mono8");
    out.put_u8(0);
    out.put_u32_le(SIZE.0);
    out.put_u32_le(pixels.len() as u32);
    out.put_slice(pixels);
    out.freeze()
}

/// A `sensor_msgs/CameraInfo` of an ideal camera, so many metres to the right of the left one.
fn camera(number: u32, baseline: f64) -> Bytes {
    let (width, height) = SIZE;
    let (f, x, y) = (
        FOCAL_LENGTH,
        f64::from(width) / 2.0,
        f64::from(height) / 2.0,
    );
    let mut out = BytesMut::new();
    header(&mut out, number);
    out.put_u32_le(height);
    out.put_u32_le(width);
    text(&mut out, "plumb_bob");
    out.put_u32_le(5);
    let distortion = [0.0; 5];
    let intrinsic = [f, 0.0, x, 0.0, f, y, 0.0, 0.0, 1.0];
    let rectifying = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let projecting = [
        [f, 0.0, x, -f * baseline],
        [0.0, f, y, 0.0],
        [0.0, 0.0, 1.0, 0.0],
    ];
    let numbers = distortion.iter().chain(&intrinsic).chain(&rectifying);
    let numbers = numbers.chain(projecting.as_flattened());
    numbers.for_each(|number| out.put_f64_le(*number));
    // binning_x, binning_y, roi: the whole picture
    out.put_bytes(0, 4 * 6 + 1);
    out.freeze()
}

/// `sensor_msgs/CameraInfo`.
const CAMERA_INFO: &str = "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] D\nfloat64[9] K\n\
    float64[9] R\nfloat64[12] P\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n\
    ================================================================================\n\
    MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n\
    ================================================================================\n\
    MSG: sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n";

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::stamped_before;

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
            let again = stamped_before(before, request, 1001);
            assert_eq!(again[4..12], [0xe9, 3, 0, 0, 0, 0, 0, 0]);
        }
    }

    #[test]
    fn a_camera_is_as_long_as_its_type() {
        let told = camera(7, BASELINE);
        // Header and frame, size, model, D with its length, K, R, P, binning, roi.
        let length = (16 + 6) + 8 + (4 + 9) + (4 + 40) + 8 * (9 + 9 + 12) + 8 + 17;
        assert_eq!(told.len(), length);
    }
}
