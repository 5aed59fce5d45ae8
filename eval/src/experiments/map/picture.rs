//! Maps beside each other, as pixels: all show the same place, and have a bar that tells their scale.

use anyhow::{Context, Result};

use crate::trace::Grid;

/// Length of the bar, metres.
pub const BAR: f64 = 5.0;
/// Between two maps and around the bar, pixels.
const MARGIN: usize = 12;
/// Of the bar, pixels.
const THICK: usize = 6;
/// What is not known.
const UNKNOWN: u8 = 205;
/// Between maps.
const BACKGROUND: u8 = 255;

/// Two in a row, north up, of the place that any of them knows: free white, occupied black, unknown grey. Pixels are as large as the first
/// map's cells.
pub fn maps(maps: &[&Grid]) -> Result<Vec<u8>> {
    let side = maps.first().context("a map to draw")?.resolution;
    let (from, to) = crop(maps).context("a map that knows something")?;
    let count = |axis: usize| ((to[axis] - from[axis]) / side).round().max(1.0) as usize;
    let (width, height) = (count(0), count(1));
    let columns = maps.len().min(2);
    let rows = maps.len().div_ceil(columns);
    let whole_width = columns * (width + MARGIN) - MARGIN;
    let whole_height = rows * (height + 2 * MARGIN + THICK);
    let mut pixels = vec![BACKGROUND; whole_width * whole_height];
    for (at, map) in maps.iter().enumerate() {
        let (left, top) = (
            (at % columns) * (width + MARGIN),
            (at / columns) * (height + 2 * MARGIN + THICK),
        );
        for row in 0..height {
            for column in 0..width {
                let x = from[0] + (column as f64 + 0.5) * side;
                let y = to[1] - (row as f64 + 0.5) * side;
                pixels[(top + row) * whole_width + left + column] = shade(cell(map, x, y));
            }
        }
        let long = ((BAR / side).round() as usize).min(width);
        for row in 0..THICK {
            let begins = (top + height + MARGIN + row) * whole_width + left;
            pixels[begins..begins + long].fill(0);
        }
    }
    png(&pixels, whole_width, whole_height)
}

/// The rectangle of what is known by any map: x and y of its least corner and of its greatest, metres.
fn crop(maps: &[&Grid]) -> Option<([f64; 2], [f64; 2])> {
    let mut found: Option<([f64; 2], [f64; 2])> = None;
    for map in maps {
        for (at, cell) in map.cells.iter().enumerate() {
            if *cell < 0 {
                continue;
            }
            let index = [at % map.width, at / map.width];
            let corner = |axis: usize, of: usize| {
                map.origin[axis] + (index[axis] + of) as f64 * map.resolution
            };
            let (from, to) = found.get_or_insert(([f64::MAX; 2], [f64::MIN; 2]));
            for axis in 0..2 {
                from[axis] = from[axis].min(corner(axis, 0));
                to[axis] = to[axis].max(corner(axis, 1));
            }
        }
    }
    found
}

/// What a map says of a place; nothing beyond its edges.
fn cell(map: &Grid, x: f64, y: f64) -> Option<i8> {
    let index = |value: f64, axis: usize, count: usize| {
        let at = ((value - map.origin[axis]) / map.resolution).floor();
        (at >= 0.0 && at < count as f64).then_some(at as usize)
    };
    let (column, row) = (index(x, 0, map.width)?, index(y, 1, map.height)?);
    map.cells.get(row * map.width + column).copied()
}

fn shade(cell: Option<i8>) -> u8 {
    match cell {
        Some(cell @ 0..=100) => 255 - (f64::from(cell) * 2.55).round() as u8,
        _ => UNKNOWN,
    }
}

fn png(pixels: &[u8], width: usize, height: usize) -> Result<Vec<u8>> {
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, width as u32, height as u32);
    encoder.set_color(png::ColorType::Grayscale);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(pixels)?;
    writer.finish()?;
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drawn(all: &[&Grid]) -> (usize, usize, Vec<u8>) {
        let file = maps(all).expect("a picture");
        let mut reader = png::Decoder::new(std::io::Cursor::new(file))
            .read_info()
            .expect("a PNG");
        let mut pixels = vec![0; reader.output_buffer_size().expect("a size")];
        let frame = reader.next_frame(&mut pixels).expect("pixels");
        (frame.width as usize, frame.height as usize, pixels)
    }

    fn map(origin: [f64; 2]) -> Grid {
        Grid {
            width: 3,
            height: 3,
            resolution: 1.0,
            origin,
            cells: vec![-1, -1, -1, -1, 0, 100, -1, 100, -1],
        }
    }

    #[test]
    fn a_map_is_drawn_north_up_without_what_is_unknown() {
        let (width, height, pixels) = drawn(&[&map([0.0, 0.0])]);
        assert_eq!((width, height), (2, 2 + 2 * MARGIN + THICK));
        assert_eq!(pixels[..4], [0, 205, 255, 0]);
        // Of a bar longer than the map, as much as there is place for.
        let bar = (2 + MARGIN) * 2;
        assert_eq!(pixels[bar - 1..bar + 1], [255, 0]);
    }

    #[test]
    fn maps_beside_each_other_show_the_same_place() {
        let (one, other) = (map([0.0, 0.0]), map([1.0, 0.0]));
        let (width, _, pixels) = drawn(&[&one, &other]);
        assert_eq!(width, 3 + MARGIN + 3);
        assert_eq!(pixels[..3], [0, 205, 205]);
        assert_eq!(pixels[3 + MARGIN..width], [205, 0, 205]);
    }

    #[test]
    fn a_map_that_knows_nothing_is_not_drawn() {
        let mut nothing = map([0.0, 0.0]);
        nothing.cells.fill(-1);
        assert!(maps(&[&nothing]).is_err());
        assert!(maps(&[]).is_err());
    }
}
