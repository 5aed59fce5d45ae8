//! Recordings of pictures, made of what Debian's opencv-doc has: a video of pedestrians, photographs, and a stereo
//! camera, a window that moves over the two photographs of a plant (Middlebury's Aloe, which is rectified).

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use anyhow::{Result, ensure};
use bytes::Bytes;
use ros::bus::{RosVersion, WireType};
use support::layout::MessageLayout;
use support::people::{self, picture};

use crate::deadline;
use crate::stream::{self, TopicType};

const PLACE: &str = "/usr/share/doc/opencv-doc/examples/data";
/// Video of pedestrians.
pub const VIDEO: &str = "vtest.avi";
const PHOTOGRAPHS: [&str; 6] = [STEREO[0], "baboon.jpg", "board.jpg", "fruits.jpg", "home.jpg", "building.jpg"];
/// Photographs of the left and of the right camera.
pub const STEREO: [&str; 2] = ["aloeL.jpg", "aloeR.jpg"];
/// Size of the images in bgr8, and their bytes.
const SIZE: (u32, u32) = (640, 480);
pub const PICTURE: usize = (SIZE.0 * SIZE.1 * 3) as usize;
/// Topic of the last message of each moment of the stereo camera.
pub const LAST: &str = "/right/image_raw";
/// Size of the moving window, in pixels, and number of its positions.
const WINDOW: (u32, u32) = (480, 400);
const COUNT: usize = 44;
/// Focal length of an ideal camera, in pixels, and distance between the cameras, in metres.
const FOCAL_LENGTH: f64 = 400.0;
const BASELINE: f64 = 0.1;
/// Maximum time to read one source.
const LONGEST: Duration = Duration::from_secs(300);

pub fn check_source(name: &str) -> Result<()> {
    let path = Path::new(PLACE).join(name);
    let how = "it comes with Debian's opencv-doc: apt-get install opencv-doc";
    ensure!(path.exists(), "{} is missing; {how}", path.display());
    Ok(())
}

/// Reads frames of a video or photograph as raw pixels.
fn read_frames(name: &str, before: &[&str], filter: &str, count: usize, format: &str) -> Result<Vec<u8>> {
    check_source(name)?;
    let mut command = Command::new("ffmpeg");
    command.args(["-v", "error"]).args(before).arg("-i").arg(Path::new(PLACE).join(name));
    command.args(["-vf", filter, "-frames:v", &count.to_string(), "-pix_fmt", format, "-f", "rawvideo", "-"]);
    let output = deadline::output(&mut command, LONGEST)?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.success(), "ffmpeg ended with {} at {name}: {}", output.status, said.trim());
    Ok(output.stdout)
}

/// Writes a recording of pictures, `rounds` times.
pub fn write_pictures(to: &Path, pictures: &[Bytes], rounds: usize) -> Result<()> {
    let moments: Vec<Vec<Bytes>> = pictures.iter().map(|picture| vec![picture.clone()]).collect();
    stream::write(to, &[TopicType::new("/image", &people::image_type())], &moments, rounds)
}

pub fn write_video(to: &Path) -> Result<()> {
    let frames = read_frames(VIDEO, &[], "scale=640:480", 60, "bgr24")?;
    let pictures = (0..).zip(frames.chunks_exact(PICTURE)).map(|(number, pixels)| picture(number, SIZE, pixels));
    write_pictures(to, &pictures.collect::<Vec<_>>(), 1)
}

pub fn photographs() -> Result<Vec<Bytes>> {
    let read = |name| {
        let pixels = read_frames(name, &[], "scale=640:480", 1, "bgr24")?;
        ensure!(pixels.len() == PICTURE, "ffmpeg made {} bytes of {name}", pixels.len());
        Ok(picture(1, SIZE, &pixels))
    };
    PHOTOGRAPHS.into_iter().map(read).collect()
}

/// Writes the stereo camera's pictures: four messages each moment, with equal stamps.
pub fn write_stereo(to: &Path) -> Result<()> {
    let (width, height) = WINDOW;
    // The photographs are of 1282x1110 pixels.
    let windows = format!("scale=640:554,crop={width}:{height}:x='3*n':y='2*n'");
    let read = |name| read_frames(name, &["-loop", "1"], &windows, COUNT, "gray");
    let [left, right] = [read(STEREO[0])?, read(STEREO[1])?];
    let size = (width * height) as usize;
    let pairs = (0..).zip(left.chunks_exact(size).zip(right.chunks_exact(size)));
    let moments = pairs.map(|(number, (left, right))| {
        let infos = [0.0, BASELINE].map(|baseline| serialize_camera_info(number, baseline));
        let [left_info, right_info] = infos;
        vec![serialize_grey(number, left), left_info, right_info, serialize_grey(number, right)]
    });
    let image = people::image_type();
    let info = WireType::new("sensor_msgs/CameraInfo", "c9a58c1b0b154e0e6da7578cb991d214", CAMERA_INFO);
    let topics = [("/left/image_raw", &image), ("/left/camera_info", &info), ("/right/camera_info", &info)];
    let topics = topics.into_iter().chain([(LAST, &image)]).map(|(topic, of)| TopicType::new(topic, of));
    stream::write(to, &topics.collect::<Vec<_>>(), &moments.collect::<Vec<_>>(), 1)
}

/// Serializes a `sensor_msgs/Image` in mono8.
fn serialize_grey(number: u32, pixels: &[u8]) -> Bytes {
    let mut out = MessageLayout::new(RosVersion::One);
    out.header(number, "camera").u32(WINDOW.1).u32(WINDOW.0).text("mono8").u8(0).u32(WINDOW.0);
    out.bytes(pixels).finish()
}

/// Serializes a `sensor_msgs/CameraInfo` of an ideal camera, `baseline` metres to the right of the left one.
fn serialize_camera_info(number: u32, baseline: f64) -> Bytes {
    let (width, height) = WINDOW;
    let (f, x, y) = (FOCAL_LENGTH, f64::from(width) / 2.0, f64::from(height) / 2.0);
    let mut out = MessageLayout::new(RosVersion::One);
    // D, an array, has its length before it.
    out.header(number, "camera").u32(height).u32(width).text("plumb_bob").u32(5);
    let (distortion, intrinsic) = ([0.0; 5], [f, 0.0, x, 0.0, f, y, 0.0, 0.0, 1.0]);
    let rectifying = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let projecting = [f, 0.0, x, -f * baseline, 0.0, f, y, 0.0, 0.0, 0.0, 1.0, 0.0];
    for number in distortion.iter().chain(&intrinsic).chain(&rectifying).chain(&projecting) {
        out.f64(*number);
    }
    // binning_x, binning_y, roi: the whole image
    (0..6).for_each(|_| {
        out.u32(0);
    });
    out.u8(0).finish()
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

    #[test]
    fn a_camera_is_as_long_as_its_type() {
        let told = serialize_camera_info(7, BASELINE);
        // Header and frame id, size, model, D with its length, K, R, P, binning, roi.
        let length = (16 + 6) + 8 + (4 + 9) + (4 + 40) + 8 * (9 + 9 + 12) + 8 + 17;
        assert_eq!(told.len(), length);
    }
}
