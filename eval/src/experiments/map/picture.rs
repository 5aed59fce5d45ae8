//! Images of maps side by side: all show the same area and have a scale bar.

use anyhow::{Context, Result};

use crate::trace::MapGrid;

/// Length of the scale bar, in metres.
pub const BAR: f64 = 5.0;
/// Space between two maps and around the bar, in pixels.
const MARGIN: usize = 12;
/// Thickness of the bar, in pixels.
const THICK: usize = 6;
/// Shade of unknown cells.
const UNKNOWN: u8 = 205;
/// Shade between maps.
const BACKGROUND: u8 = 255;

/// Draws maps, two in a row, north up, over the area that any of them knows: free white, occupied black, unknown grey.
/// Pixels are as large as the cells of the first map.
pub fn draw_maps(maps: &[&MapGrid]) -> Result<Vec<u8>> {
    let side = maps.first().context("a map to draw")?.resolution;
    let (from, to) = known_bounds(maps).context("a map that knows something")?;
    let count = |axis: usize| ((to[axis] - from[axis]) / side).round().max(1.0) as usize;
    let (width, height) = (count(0), count(1));
    let columns = maps.len().min(2);
    let rows = maps.len().div_ceil(columns);
    let whole_width = columns * (width + MARGIN) - MARGIN;
    let whole_height = rows * (height + 2 * MARGIN + THICK);
    let mut pixels = vec![BACKGROUND; whole_width * whole_height];
    for (at, map) in maps.iter().enumerate() {
        let (left, top) = ((at % columns) * (width + MARGIN), (at / columns) * (height + 2 * MARGIN + THICK));
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

/// Returns the bounding box of the cells known to any map: least and greatest x and y, in metres.
fn known_bounds(maps: &[&MapGrid]) -> Option<([f64; 2], [f64; 2])> {
    let mut found: Option<([f64; 2], [f64; 2])> = None;
    for map in maps {
        for (at, cell) in map.cells.iter().enumerate() {
            if *cell < 0 {
                continue;
            }
            let index = [at % map.width, at / map.width];
            let corner = |axis: usize, of: usize| map.origin[axis] + (index[axis] + of) as f64 * map.resolution;
            let (from, to) = found.get_or_insert(([f64::MAX; 2], [f64::MIN; 2]));
            for axis in 0..2 {
                from[axis] = from[axis].min(corner(axis, 0));
                to[axis] = to[axis].max(corner(axis, 1));
            }
        }
    }
    found
}

/// Returns the cell of a map at a position; `None` outside its edges.
fn cell(map: &MapGrid, x: f64, y: f64) -> Option<i8> {
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

    fn decode_drawing(all: &[&MapGrid]) -> (usize, usize, Vec<u8>) {
        let file = draw_maps(all).expect("a picture");
        let mut reader = png::Decoder::new(std::io::Cursor::new(file)).read_info().expect("a PNG");
        let mut pixels = vec![0; reader.output_buffer_size().expect("a size")];
        let frame = reader.next_frame(&mut pixels).expect("pixels");
        (frame.width as usize, frame.height as usize, pixels)
    }

    fn map(origin: [f64; 2]) -> MapGrid {
        MapGrid { width: 3, height: 3, resolution: 1.0, origin, cells: vec![-1, -1, -1, -1, 0, 100, -1, 100, -1] }
    }

    #[test]
    fn a_map_is_drawn_north_up_without_what_is_unknown() {
        let (width, height, pixels) = decode_drawing(&[&map([0.0, 0.0])]);
        assert_eq!((width, height), (2, 2 + 2 * MARGIN + THICK));
        assert_eq!(pixels[..4], [0, 205, 255, 0]);
        // A bar longer than the map is truncated.
        let bar = (2 + MARGIN) * 2;
        assert_eq!(pixels[bar - 1..bar + 1], [255, 0]);
        let mut nothing = map([0.0, 0.0]);
        nothing.cells.fill(-1);
        assert!(draw_maps(&[&nothing]).is_err() && draw_maps(&[]).is_err());
    }

    #[test]
    fn maps_beside_each_other_show_the_same_place() {
        let (width, _, pixels) = decode_drawing(&[&map([0.0, 0.0]), &map([1.0, 0.0])]);
        assert_eq!(width, 3 + MARGIN + 3);
        assert_eq!(pixels[..3], [0, 205, 205]);
        assert_eq!(pixels[3 + MARGIN..width], [205, 0, 205]);
    }
}
