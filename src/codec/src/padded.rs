//! Samples laid out for prediction: every sample finds its neighbours at fixed distances before it.
//!
//! ```text
//!        c b d        c = at - lag - 1    b = at - lag    d = at - lag + 1
//!        a v          a = at - 1          v = at
//! ```
//! A picture has a margin of one sample left and right (so `lag` is the width plus two) and a row of zeros above. The
//! margin repeats the sample above (left) or the last one of the row (right). A plain sequence is one row with a lag of
//! two: its neighbours are the three samples before.

/// Samples of one lane with their margins.
pub(crate) struct Padded<T> {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) lag: usize,
    pub(crate) samples: Vec<T>,
}

impl<T: Copy + Default> Padded<T> {
    pub(crate) fn picture(width: usize, height: usize) -> Self {
        let lag = width + 2;
        Self { width, height, lag, samples: vec![T::default(); lag * (height + 1) + 2] }
    }

    pub(crate) fn sequence(length: usize) -> Self {
        Self { width: length, height: usize::from(length > 0), lag: 2, samples: vec![T::default(); length + 4] }
    }

    pub(crate) fn is_sequence(&self) -> bool {
        self.lag == 2
    }

    /// Returns the index of the first sample of row `y`.
    #[inline]
    pub(crate) fn start(&self, y: usize) -> usize {
        self.lag * (y + 1) + 1
    }

    pub(crate) fn row(&self, y: usize) -> &[T] {
        let start = self.start(y);
        &self.samples[start..start + self.width]
    }

    pub(crate) fn row_mut(&mut self, y: usize) -> &mut [T] {
        let start = self.start(y);
        &mut self.samples[start..start + self.width]
    }

    /// Sets the margins of row `y`, whose samples are known.
    #[inline]
    pub(crate) fn close_row(&mut self, y: usize) {
        if self.height > 1 && self.width > 0 {
            let start = self.start(y);
            self.samples[start - 1] = if y > 0 { self.samples[start - self.lag] } else { T::default() };
            self.samples[start + self.width] = self.samples[start + self.width - 1];
        }
    }

    /// Sets the margins that a decoder needs to predict row `y`: those of the row before, and its own left one.
    #[inline]
    pub(crate) fn open_row(&mut self, y: usize) {
        self.close_row_before(y);
        if y > 0 && self.width > 0 {
            let start = self.start(y);
            self.samples[start - 1] = self.samples[start - self.lag];
        }
    }

    /// Sets the margins of the row before `y`.
    #[inline]
    pub(crate) fn close_row_before(&mut self, y: usize) {
        if y > 0 {
            self.close_row(y - 1);
        }
    }

    /// Returns the neighbourhood of row `y`: (a, b, c, d, v), each as long as the row.
    #[inline]
    pub(crate) fn neighbours(&self, y: usize) -> [&[T]; 5] {
        let (start, lag, width) = (self.start(y), self.lag, self.width);
        let from = |first: usize| &self.samples[first..first + width];
        [from(start - 1), from(start - lag), from(start - lag - 1), from(start - lag + 1), from(start)]
    }
}

/// The planes of one picture (or one sequence), divided into lanes that are coded in lockstep.
///
/// Several planes are one lane each. A single plane is divided into four stripes of equal height, and the remainder is
/// a fifth lane coded by itself.
pub(crate) struct Lanes<T> {
    pub(crate) lanes: Vec<Padded<T>>,
    stripe: usize,
    stripes: usize,
}

/// Number of stripes of a single plane of any useful size.
pub(crate) const STRIPES: usize = 4;

impl<T: Copy + Default> Lanes<T> {
    pub(crate) fn pictures(planes: usize, width: usize, height: usize) -> Self {
        if planes != 1 || height < 8 * STRIPES {
            let lanes = (0..planes).map(|_| Padded::picture(width, height)).collect();
            return Self { lanes, stripe: height.max(1), stripes: 1 };
        }
        let stripe = height / STRIPES;
        let mut lanes: Vec<_> = (0..STRIPES).map(|_| Padded::picture(width, stripe)).collect();
        if height % STRIPES > 0 {
            lanes.push(Padded::picture(width, height % STRIPES));
        }
        Self { stripes: lanes.len(), lanes, stripe }
    }

    pub(crate) fn sequence(length: usize) -> Self {
        if length < 1024 {
            return Self { lanes: vec![Padded::sequence(length)], stripe: length.max(1), stripes: 1 };
        }
        // A remainder is padded rather than coded separately.
        let stripe = length.div_ceil(STRIPES);
        Self { lanes: (0..STRIPES).map(|_| Padded::sequence(stripe)).collect(), stripe, stripes: STRIPES }
    }

    /// Creates several sequences of one length, one lane each.
    pub(crate) fn sequences(count: usize, length: usize) -> Self {
        let lanes = (0..count).map(|_| Padded::sequence(length)).collect();
        Self { lanes, stripe: 1, stripes: 1 }
    }

    /// Returns the ranges of lanes that run in lockstep: groups of equal shape.
    pub(crate) fn groups(&self) -> Vec<std::ops::Range<usize>> {
        let count = self.lanes.len();
        if self.stripes > STRIPES { vec![0..STRIPES, STRIPES..count] } else { std::iter::once(0..count).collect() }
    }

    pub(crate) fn row(&self, plane: usize, y: usize) -> &[T] {
        self.lanes[plane * self.stripes + y / self.stripe].row(y % self.stripe)
    }

    pub(crate) fn row_mut(&mut self, plane: usize, y: usize) -> &mut [T] {
        self.lanes[plane * self.stripes + y / self.stripe].row_mut(y % self.stripe)
    }

    /// Sets all margins, once the samples are in place.
    pub(crate) fn close(&mut self) {
        for lane in &mut self.lanes {
            for y in 0..lane.height {
                lane.close_row(y);
            }
        }
    }

    /// Fills a single plane or sequence with the mapped samples in order; what is left over gets the last one.
    pub(crate) fn fill<S: Copy>(&mut self, samples: &[S], map: impl Fn(S) -> T) {
        let mut rest = samples;
        let mut last = T::default();
        for lane in &mut self.lanes {
            for y in 0..lane.height {
                let row = lane.row_mut(y);
                let (front, back) = rest.split_at(row.len().min(rest.len()));
                let (filled, over) = row.split_at_mut(front.len());
                for (slot, &sample) in filled.iter_mut().zip(front) {
                    *slot = map(sample);
                }
                last = filled.last().copied().unwrap_or(last);
                over.fill(last);
                rest = back;
            }
        }
    }

    /// Returns all samples, lane by lane and row by row: for a single plane or sequence this is their order.
    pub(crate) fn rows(&self) -> impl Iterator<Item = &[T]> {
        self.lanes.iter().flat_map(|lane| (0..lane.height).map(move |y| lane.row(y)))
    }

    pub(crate) fn count(&self) -> usize {
        self.lanes.iter().map(|lane| lane.width * lane.height).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_comes_back_row_by_row() {
        for (planes, width, height) in [(1, 5, 3), (1, 7, 32), (1, 7, 35), (3, 4, 33), (1, 0, 9)] {
            let mut lanes = Lanes::<u16>::pictures(planes, width, height);
            for plane in 0..planes {
                for y in 0..height {
                    lanes.row_mut(plane, y).fill((plane * 100 + y) as u16);
                }
            }
            lanes.close();
            for plane in 0..planes {
                for y in 0..height {
                    assert_eq!(lanes.row(plane, y), vec![(plane * 100 + y) as u16; width]);
                }
            }
            assert_eq!(lanes.count(), planes * width * height);
        }
    }

    #[test]
    fn neighbours_are_where_they_are_drawn() {
        let mut plane = Padded::<u8>::picture(3, 2);
        plane.row_mut(0).copy_from_slice(&[1, 2, 3]);
        plane.row_mut(1).copy_from_slice(&[4, 5, 6]);
        plane.close_row(0);
        plane.close_row(1);
        assert_eq!(plane.neighbours(0), [&[0, 1, 2], &[0, 0, 0], &[0, 0, 0], &[0, 0, 0], &[1, 2, 3]]);
        assert_eq!(plane.neighbours(1), [&[1, 4, 5], &[1, 2, 3], &[0, 1, 2], &[2, 3, 3], &[4, 5, 6]]);
    }

    #[test]
    fn a_sequence_is_cut_and_joined() {
        for length in [0, 1, 1023, 1024, 1027] {
            let samples: Vec<u32> = (0..length).collect();
            let mut lanes = Lanes::sequence(samples.len());
            lanes.fill(&samples, |sample| sample);
            let back: Vec<u32> = lanes.rows().flatten().copied().take(samples.len()).collect();
            assert_eq!(back, samples);
            assert!(lanes.count() < samples.len() + 4);
        }
    }
}
