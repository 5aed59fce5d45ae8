//! Converts between interleaved colour and planes of luma and halved chroma.
//!
//! Full-range BT.601, as in JPEG: both ends are ours, and the limited range would only cost precision.

/// Planes of an even width and height, as H.264 requires; the odd last column or row of a picture is repeated.
#[derive(Default)]
pub(super) struct Planes {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) luma: Vec<u8>,
    pub(super) blue: Vec<u8>,
    pub(super) red: Vec<u8>,
}

/// Order of the colours in a pixel.
#[derive(Clone, Copy)]
pub(super) struct ChannelOrder {
    pub(super) channels: usize,
    pub(super) red_first: bool,
}

impl Planes {
    /// Fills the planes from rows of pixels.
    pub(super) fn fill<'a>(
        &mut self,
        width: usize,
        height: usize,
        order: ChannelOrder,
        rows: impl Iterator<Item = &'a [u8]>,
    ) {
        self.width = width.next_multiple_of(2);
        self.height = height.next_multiple_of(2);
        let half = self.width / 2;
        self.luma.resize(self.width * self.height, 0);
        self.blue.resize(half * self.height / 2, 0);
        self.red.resize(half * self.height / 2, 0);
        // Chroma sums of two rows.
        let mut sums = vec![[0i32; 2]; half];
        let mut last: &[u8] = &[];
        let mut rows = rows.take(height);
        for y in 0..self.height {
            last = rows.next().unwrap_or(last);
            let luma = &mut self.luma[y * self.width..(y + 1) * self.width];
            match (order.channels, order.red_first) {
                (3, true) => split_row::<3, true>(last, luma, &mut sums),
                (3, false) => split_row::<3, false>(last, luma, &mut sums),
                (_, true) => split_row::<4, true>(last, luma, &mut sums),
                (_, false) => split_row::<4, false>(last, luma, &mut sums),
            }
            if y % 2 == 1 {
                let row = y / 2 * half..(y / 2 + 1) * half;
                let planes = self.blue[row.clone()].iter_mut().zip(&mut self.red[row]);
                for ((blue, red), sum) in planes.zip(&mut sums) {
                    // The sums cover four pixels, in 1/65536.
                    let mean = |sum: i32| (((sum + (1 << 17)) >> 18) + 128).clamp(0, 255) as u8;
                    (*blue, *red) = (mean(sum[0]), mean(sum[1]));
                    *sum = [0; 2];
                }
            }
        }
    }
}

/// Splits one row: luma, and chroma summed over pairs.
fn split_row<const C: usize, const RED_FIRST: bool>(row: &[u8], luma: &mut [u8], sums: &mut [[i32; 2]]) {
    let colours = |pixel: &[u8]| {
        let [first, green, last] = [pixel[0], pixel[1], pixel[2]].map(i32::from);
        if RED_FIRST { [first, green, last] } else { [last, green, first] }
    };
    let value = |[red, green, blue]: [i32; 3]| ((19_595 * red + 38_470 * green + 7_471 * blue + 32_768) >> 16) as u8;
    let add = |sum: &mut [i32; 2], [red, green, blue]: [i32; 3], times: i32| {
        sum[0] += times * (-11_059 * red - 21_709 * green + 32_768 * blue);
        sum[1] += times * (32_768 * red - 27_439 * green - 5_329 * blue);
    };
    let pairs = row.chunks_exact(2 * C);
    let odd = pairs.remainder();
    for ((pair, luma), sum) in pairs.zip(luma.chunks_exact_mut(2)).zip(sums.iter_mut()) {
        let (left, right) = (colours(&pair[..C]), colours(&pair[C..]));
        luma[0] = value(left);
        luma[1] = value(right);
        add(sum, left, 1);
        add(sum, right, 1);
    }
    if odd.len() >= C {
        let pixel = colours(odd);
        let end = luma.len();
        luma[end - 2..].fill(value(pixel));
        if let Some(sum) = sums.last_mut() {
            add(sum, pixel, 2);
        }
    }
}

/// Writes one row of pixels from planes; alpha is unchanged.
pub(super) fn join_row_pair(luma: &[u8], blue: &[u8], red: &[u8], order: ChannelOrder, row: &mut [u8]) {
    match (order.channels, order.red_first) {
        (3, true) => join_row::<3, true>(luma, blue, red, row),
        (3, false) => join_row::<3, false>(luma, blue, red, row),
        (_, true) => join_row::<4, true>(luma, blue, red, row),
        (_, false) => join_row::<4, false>(luma, blue, red, row),
    }
}

fn join_row<const C: usize, const RED_FIRST: bool>(luma: &[u8], blue: &[u8], red: &[u8], row: &mut [u8]) {
    for (((pixels, luma), &blue), &red) in row.chunks_mut(2 * C).zip(luma.chunks(2)).zip(blue).zip(red) {
        let (blue, red) = (i32::from(blue) - 128, i32::from(red) - 128);
        let add = [
            (91_881 * red + 32_768) >> 16,
            (-22_554 * blue - 46_802 * red + 32_768) >> 16,
            (116_130 * blue + 32_768) >> 16,
        ];
        for (pixel, &luma) in pixels.chunks_exact_mut(C).zip(luma) {
            let [red, green, blue] = add.map(|add| (i32::from(luma) + add).clamp(0, 255) as u8);
            pixel[..3].copy_from_slice(&if RED_FIRST { [red, green, blue] } else { [blue, green, red] });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn smooth_colours_come_back_nearly() {
        for (channels, red_first) in [(3, true), (3, false), (4, true), (4, false)] {
            for (width, height) in [(16, 8), (15, 7), (1, 1)] {
                let order = ChannelOrder { channels, red_first };
                let pixel = |x: usize, y: usize, channel: usize| (x * 3 + y * 5 + channel * 40 + 30) as u8;
                let data: Vec<u8> = (0..height * width * channels)
                    .map(|at| pixel(at / channels % width, at / channels / width, at % channels))
                    .collect();
                let mut planes = Planes::default();
                planes.fill(width, height, order, data.chunks_exact(width * channels));
                for y in 0..height {
                    let half = planes.width / 2;
                    let mut row = data[y * width * channels..(y + 1) * width * channels].to_vec();
                    join_row_pair(
                        &planes.luma[y * planes.width..][..width],
                        &planes.blue[y / 2 * half..][..half],
                        &planes.red[y / 2 * half..][..half],
                        order,
                        &mut row,
                    );
                    for (at, &value) in row.iter().enumerate() {
                        let truth = data[y * width * channels + at];
                        assert!(value.abs_diff(truth) <= 3, "{value} for {truth}");
                    }
                }
            }
        }
    }

    #[test]
    fn grey_is_exact() {
        let data: Vec<u8> = (0..=255).flat_map(|value| [value; 3]).collect();
        let order = ChannelOrder { channels: 3, red_first: true };
        let mut planes = Planes::default();
        planes.fill(256, 1, order, data.chunks_exact(768));
        assert_eq!(planes.luma[..256], (0..=255).collect::<Vec<u8>>());
        assert!(planes.blue.iter().chain(&planes.red).all(|&chroma| chroma == 128));
    }
}
