//! Scans and clouds derived from the recordings, in the form in which drivers publish them.

use crate::messages::{PointFieldType, cloud, scan};
use crate::recorded::PACKET;
use crate::samples::{Noise, Picture};

/// Metres per cell of the office floor.
const CELL: f64 = 0.1;

/// A free position on the floor, far from walls, with a heading.
struct Pose {
    x: f64,
    y: f64,
    heading: f64,
}

/// Returns positions spread over the map.
fn sample_poses(map: &Picture, count: usize) -> Vec<Pose> {
    let free = |x: usize, y: usize| {
        (0..9).all(|at| {
            let (x, y) = (x + at % 3 * 4, y + at / 3 * 4);
            x < map.width && y < map.height && map.data[y * map.width + x] == 0
        })
    };
    let mut noise = Noise(42);
    let mut poses = Vec::new();
    while poses.len() < count {
        let (x, y) = (noise.next() as usize % map.width, noise.next() as usize % map.height);
        if free(x, y) {
            let heading = noise.unit() * std::f64::consts::TAU;
            poses.push(Pose { x: (x + 4) as f64 * CELL, y: (y + 4) as f64 * CELL, heading });
        }
    }
    poses
}

/// Returns the distance along a ray to the next wall, at most 30 m; `None` if there is no wall.
fn cast_ray(map: &Picture, pose: &Pose, angle: f64) -> Option<f64> {
    let (sin, cos) = (pose.heading + angle).sin_cos();
    let mut distance = 0.0;
    while distance < 30.0 {
        distance += CELL / 10.0;
        let (x, y) = ((pose.x + cos * distance) / CELL, (pose.y + sin * distance) / CELL);
        if x < 0.0 || y < 0.0 || x as usize >= map.width || y as usize >= map.height {
            return None;
        }
        if map.data[y as usize * map.width + x as usize] == 100 {
            return Some(distance);
        }
    }
    None
}

/// Scans of 1081 beams over 270 degrees with 10 mm of noise; `float` returns what the driver publishes for metres.
pub fn laser_scans(map: &Picture, float: impl Fn(f64) -> f32, intensities: bool) -> Vec<Vec<u8>> {
    let mut noise = Noise(7);
    sample_poses(map, 12)
        .iter()
        .map(|pose| {
            let mut ranges = Vec::new();
            let mut echoes = Vec::new();
            for beam in 0..1081 {
                let angle = (f64::from(beam) - 540.0) * 0.25_f64.to_radians();
                let distance = cast_ray(map, pose, angle).map(|distance| distance + 0.01 * noise.normal());
                ranges.push(float(distance.unwrap_or(f64::INFINITY)));
                let echo = distance.map_or(0.0, |distance| 3000.0 / (1.0 + distance) + 20.0 * noise.normal());
                echoes.push(echo.round().max(0.0) as f32);
            }
            scan(&ranges, if intensities { &echoes } else { &[] })
        })
        .collect()
}

/// Scans cut out of depth frames, as `depthimage_to_laserscan` produces them.
pub fn camera_scans(depths: &[Picture]) -> Vec<Vec<u8>> {
    let mut scans = Vec::new();
    for depth in depths {
        for row in (60..depth.height - 60).step_by(90) {
            let ranges: Vec<f32> = (0..depth.width)
                .rev()
                .map(|u| {
                    let z = depth_metres(depth, u, row);
                    let x = (u as f32 - 319.5) * z / 525.0;
                    if z > 0.0 { x.hypot(z) } else { f32::NAN }
                })
                .collect();
            scans.push(scan(&ranges, &[]));
        }
    }
    scans
}

/// Depth of the recorded frames, which are in fifths of a millimetre.
fn depth_metres(depth: &Picture, u: usize, v: usize) -> f32 {
    depth_value(depth, u, v) / 5000.0
}

fn depth_value(depth: &Picture, u: usize, v: usize) -> f32 {
    let at = (v * depth.width + u) * 2;
    f32::from(u16::from_le_bytes([depth.data[at], depth.data[at + 1]]))
}

/// Coloured point clouds of a depth camera, as `depth_image_proc` produces them: `step` bytes per point, padded as PCL
/// does. With `organised` the image layout is kept, with NaN for missing points; otherwise those points are dropped.
pub fn camera_clouds(colours: &[Picture], depths: &[Picture], step: usize, organised: bool) -> Vec<Vec<u8>> {
    let pairs = colours
        .iter()
        .zip(depths)
        .filter(|(colour, depth)| (colour.width, colour.height) == (depth.width, depth.height));
    pairs
        .enumerate()
        .map(|(index, (colour, depth))| {
            let mut noise = Noise(index as u64 + 1);
            let metres = |u: usize, v: usize| {
                let z = depth_metres(depth, u, v);
                // Real cameras miss a few per cent of the points; these recordings had been filled.
                if z == 0.0 || noise.next() % 40 == 0 { 0.0 } else { z }
            };
            camera_cloud(colour, metres, step, organised)
        })
        .collect()
}

/// One cloud of a real camera, whose depth is in millimetres.
pub fn recorded_camera_cloud(colour: &Picture, depth: &Picture, step: usize, organised: bool) -> Vec<u8> {
    camera_cloud(colour, |u, v| depth_value(depth, u, v) * 0.001, step, organised)
}

/// One cloud of a camera with the picture `colour`; `metres` returns the depth of a pixel, zero if it is missing.
fn camera_cloud(
    colour: &Picture,
    mut metres: impl FnMut(usize, usize) -> f32,
    step: usize,
    organised: bool,
) -> Vec<u8> {
    let rgb = if step >= 32 { 16 } else { 12 };
    let mut data = Vec::new();
    for v in 0..colour.height {
        for u in 0..colour.width {
            let z = metres(u, v);
            let missing = z == 0.0;
            if missing && !organised {
                continue;
            }
            let constant = 1.0f32 / 525.0;
            let (x, y) = ((u as f32 - 319.5) * z * constant, (v as f32 - 239.5) * z * constant);
            let point = if missing { [f32::NAN; 3] } else { [x, y, z] };
            let start = data.len();
            data.resize(start + step, 0);
            for (axis, value) in point.iter().enumerate() {
                data[start + axis * 4..][..4].copy_from_slice(&value.to_le_bytes());
            }
            let pixel = &colour.data[(v * colour.width + u) * 3..][..3];
            data[start + rgb..][..4].copy_from_slice(&[pixel[2], pixel[1], pixel[0], 0]);
        }
    }
    let fields = [
        ("x", 0, PointFieldType::F32),
        ("y", 4, PointFieldType::F32),
        ("z", 8, PointFieldType::F32),
        ("rgb", rgb, PointFieldType::F32),
    ];
    let count = data.len() / step;
    let (width, height) = if organised { (colour.width, colour.height) } else { (count, 1) };
    cloud(width, height, step, &fields, &data)
}

/// Revolutions of a 16-ring laser in the office, with 2 mm resolution and 20 mm of noise, in the driver's layout.
pub fn spinning_clouds(map: &Picture) -> Vec<Vec<u8>> {
    let mut noise = Noise(11);
    sample_poses(map, 4)
        .iter()
        .map(|pose| {
            let mut data = Vec::new();
            for shot in 0..1800u32 {
                let azimuth = f64::from(shot) * 0.2_f64.to_radians();
                let wall = cast_ray(map, pose, -azimuth);
                for laser in 0..16u32 {
                    // The lasers fire in the order -15, 1, -13, 3, … degrees.
                    let degrees = if laser % 2 == 0 { f64::from(laser) - 15.0 } else { f64::from(laser) };
                    let (sin, cos) = degrees.to_radians().sin_cos();
                    let floor = if sin < 0.0 { -1.2 / sin } else { 1.8 / sin };
                    let range = wall.map_or(f64::INFINITY, |wall| wall / cos).min(floor);
                    if range > 100.0 || noise.next() % 50 == 0 {
                        continue;
                    }
                    let range = ((range + 0.02 * noise.normal()) / 0.002).round() as f32 * 0.002;
                    let turned = azimuth + f64::from(laser) * 2.304e-6 * std::f64::consts::TAU * 10.0;
                    let intensity = (20.0 + 60.0 / (1.0 + f64::from(range)) + 4.0 * noise.normal()).clamp(0.0, 255.0);
                    put_laser_point(&mut data, range, degrees, turned, intensity.round() as f32, (shot, laser));
                }
            }
            laser_cloud(&data)
        })
        .collect()
}

/// One revolution of a real VLP-16, from its packets; points without an echo are dropped.
pub fn recorded_spinning_cloud(packets: &[u8]) -> Vec<u8> {
    /// Twelve blocks of a flag, an azimuth in hundredths of a degree, and two shots of sixteen lasers.
    const BLOCK: usize = 100;
    let blocks = packets.chunks_exact(PACKET).flat_map(|packet| packet.chunks_exact(BLOCK));
    let blocks: Vec<&[u8]> = blocks.collect();
    let azimuth = |block: &[u8]| f64::from(u16::from_le_bytes([block[2], block[3]])) / 100.0;
    let mut data = Vec::new();
    let mut turn = 0.4;
    for (index, block) in blocks.iter().enumerate() {
        let start = azimuth(block);
        if let Some(next) = blocks.get(index + 1) {
            turn = (azimuth(next) - start).rem_euclid(360.0);
        }
        for (place, echo) in block[4..].chunks_exact(3).enumerate() {
            let range = f32::from(u16::from_le_bytes([echo[0], echo[1]])) * 0.002;
            if range == 0.0 {
                continue;
            }
            let (half, laser) = (place as u32 / 16, place as u32 % 16);
            let degrees = if laser % 2 == 0 { f64::from(laser) - 15.0 } else { f64::from(laser) };
            let share = (f64::from(half) * 55.296 + f64::from(laser) * 2.304) / (2.0 * 55.296);
            // The driver rounds to hundredths of a degree, for its table of sines.
            let turned = ((start + turn * share) * 100.0).round() / 100.0;
            let shot = index as u32 * 2 + half;
            put_laser_point(&mut data, range, degrees, turned.to_radians(), f32::from(echo[2]), (shot, laser));
        }
    }
    laser_cloud(&data)
}

/// Appends a point in the driver's packed layout of 22 bytes.
fn put_laser_point(
    data: &mut Vec<u8>,
    range: f32,
    degrees: f64,
    azimuth: f64,
    intensity: f32,
    (shot, laser): (u32, u32),
) {
    let (sin, cos) = degrees.to_radians().sin_cos();
    let (turn_sin, turn_cos) = (azimuth.sin() as f32, azimuth.cos() as f32);
    let flat = range * cos as f32;
    let point = [flat * turn_cos, -(flat * turn_sin), range * sin as f32];
    point.iter().for_each(|value| data.extend_from_slice(&value.to_le_bytes()));
    data.extend_from_slice(&intensity.to_le_bytes());
    let ring = ((degrees + 15.0) / 2.0) as u16;
    data.extend_from_slice(&ring.to_le_bytes());
    let time = f64::from(shot) * 55.296e-6 + f64::from(laser) * 2.304e-6;
    data.extend_from_slice(&(time as f32).to_le_bytes());
}

fn laser_cloud(data: &[u8]) -> Vec<u8> {
    let fields = [
        ("x", 0, PointFieldType::F32),
        ("y", 4, PointFieldType::F32),
        ("z", 8, PointFieldType::F32),
        ("intensity", 12, PointFieldType::F32),
        ("ring", 16, PointFieldType::U16),
        ("time", 18, PointFieldType::F32),
    ];
    cloud(data.len() / 22, 1, 22, &fields, data)
}
