//! Input data: the recordings next to the repository if present, otherwise Debian packages and synthetic data.

use anyhow::{Context, Result, bail};
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::Command;

/// A decoded image.
#[derive(Clone)]
pub struct Picture {
    pub width: usize,
    pub height: usize,
    /// Bytes per pixel: 1 for grey, 2 for depth (little endian), 3 for red, green, blue.
    pub depth: usize,
    pub data: Vec<u8>,
}

/// Directory of the recordings, if they exist: `CLOUDROID_RECORDINGS`, or `../shared/data` next to the repository.
pub fn recordings_directory() -> Option<PathBuf> {
    let beside = || bench_report::root().join("../shared/data");
    let path = std::env::var_os("CLOUDROID_RECORDINGS").map_or_else(beside, PathBuf::from);
    path.join("color1.png").exists().then_some(path)
}

/// Directory of the samples of Debian's `opencv-doc`.
pub fn opencv_samples_directory() -> PathBuf {
    PathBuf::from("/usr/share/doc/opencv-doc/examples/data")
}

fn read_picture(path: &Path) -> Result<Picture> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let decoder = png::Decoder::new(BufReader::new(File::open(path).with_context(|| path.display().to_string())?));
    let mut reader = decoder.read_info()?;
    let mut data = vec![0; reader.output_buffer_size().context("picture is too large")?];
    let info = reader.next_frame(&mut data)?;
    data.truncate(info.buffer_size());
    let depth = match (info.color_type, info.bit_depth) {
        (png::ColorType::Grayscale, png::BitDepth::Eight) => 1,
        (png::ColorType::Grayscale, png::BitDepth::Sixteen) => {
            // PNG is big endian.
            data.chunks_exact_mut(2).for_each(|pair| pair.swap(0, 1));
            2
        }
        (png::ColorType::Rgb, png::BitDepth::Eight) => 3,
        (png::ColorType::Rgba, png::BitDepth::Eight) => {
            data = data.chunks_exact(4).flat_map(|pixel| &pixel[..3]).copied().collect();
            3
        }
        other => bail!("{name} holds {other:?}, which is not measured"),
    };
    Ok(Picture { width: info.width as usize, height: info.height as usize, depth, data })
}

fn read_pictures(directory: &Path, names: &[&str]) -> Result<Vec<Picture>> {
    names.iter().map(|name| read_picture(&directory.join(name))).collect()
}

/// Colour frames of a camera: from the recordings, or from the packaged video.
pub fn colour_frames() -> Result<Vec<Picture>> {
    if let Some(path) = recordings_directory() {
        return read_pictures(&path, &["color1.png", "color2.png", "color3.png"]);
    }
    let (width, height, mut data) = decode_video(150)?;
    data.chunks_exact_mut(3).for_each(|pixel| pixel.swap(0, 2));
    let frames = data.chunks_exact(width * height * 3).step_by(60);
    let frames = frames.map(|frame| Picture { width, height, depth: 3, data: frame.to_vec() });
    Ok(frames.collect())
}

/// Photographs of Debian's `opencv-doc`.
pub fn packaged_photographs() -> Result<Vec<Picture>> {
    let mut pictures = read_pictures(&opencv_samples_directory(), &["graf1.png", "graf3.png"])?;
    pictures.retain(|picture| picture.depth == 3);
    Ok(pictures)
}

/// Depth frames: from the recordings; none without them.
pub fn depth_frames() -> Result<Vec<Picture>> {
    let names = ["depth1.png", "depth2.png", "depth3.png"];
    recordings_directory().map_or_else(|| Ok(Vec::new()), |path| read_pictures(&path, &names))
}

/// Floor plan of an office, 566×608 cells, as an occupancy grid: unknown, free, occupied.
pub fn office_map() -> Result<Picture> {
    let Some(path) = recordings_directory() else {
        return Ok(synthetic_rooms());
    };
    let mut pgm = Vec::new();
    flate2::read::GzDecoder::new(File::open(path.join("willow.pgm.gz"))?).read_to_end(&mut pgm)?;
    let mut numbers = Vec::new();
    let mut at = 2;
    while numbers.len() < 3 {
        while pgm[at].is_ascii_whitespace() || pgm[at] == b'#' {
            let line = pgm[at] == b'#';
            while line && pgm[at] != b'\n' {
                at += 1;
            }
            at += 1;
        }
        let end = at + pgm[at..].iter().position(u8::is_ascii_whitespace).context("a header without end")?;
        numbers.push(std::str::from_utf8(&pgm[at..end])?.parse::<usize>()?);
        at = end;
    }
    let (width, height) = (numbers[0], numbers[1]);
    let pixels = &pgm[at + 1..at + 1 + width * height];
    // Same conversion as map_server's, with its default thresholds.
    let cell = |&pixel: &u8| match (255.0 - f64::from(pixel)) / 255.0 {
        occupied if occupied > 0.65 => 100u8,
        occupied if occupied < 0.196 => 0,
        _ => 255,
    };
    // A map starts at the bottom, an image at the top.
    let data = pixels.chunks_exact(width).rev().flatten().map(cell).collect();
    Ok(Picture { width, height, depth: 1, data })
}

/// Synthetic rooms and corridors, used without recordings.
fn synthetic_rooms() -> Picture {
    let (width, height) = (566, 608);
    let mut data = vec![255u8; width * height];
    for y in 20..height - 20 {
        for x in 20..width - 20 {
            let wall = (x % 90 < 2 && y % 70 > 12) || (y % 110 < 2 && x % 80 > 10);
            let noise = ((x * 2_654_435_761) ^ (y * 40_503)) % 97 == 0;
            data[y * width + x] = if wall || noise { 100 } else { 0 };
        }
    }
    Picture { width, height, depth: 1, data }
}

/// Returns a grid of `size`×`size` cells with `map` at its centre, as gmapping publishes it.
pub fn centre_in_grid(map: &Picture, size: usize) -> Vec<u8> {
    let mut cells = vec![255u8; size * size];
    let (left, top) = ((size - map.width) / 2, (size - map.height) / 2);
    for (y, row) in map.data.chunks_exact(map.width).enumerate() {
        let start = (top + y) * size + left;
        cells[start..start + map.width].copy_from_slice(row);
    }
    cells
}

/// Decodes `frames` frames of `vtest.avi` as blue, green, red.
pub fn decode_video(frames: usize) -> Result<(usize, usize, Vec<u8>)> {
    let output = Command::new("ffmpeg")
        .args(["-v", "error", "-i"])
        .arg(opencv_samples_directory().join("vtest.avi"))
        .args(["-frames:v", &frames.to_string(), "-f", "rawvideo", "-pix_fmt", "bgr24", "-"])
        .output()
        .context("ffmpeg decodes the video; install it")?;
    if !output.status.success() {
        bail!("ffmpeg: {}; install opencv-doc for vtest.avi", String::from_utf8_lossy(&output.stderr));
    }
    Ok((768, 576, output.stdout))
}

/// A small deterministic noise generator (xorshift).
pub struct Noise(pub u64);

impl Noise {
    pub fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    /// Returns a uniformly distributed number in 0.0..1.0.
    pub fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Returns a normally distributed number, computed as a sum of twelve uniform ones.
    pub fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.unit()).sum::<f64>() - 6.0
    }
}
