//! An axis: positions of values, and tick marks.

use plotters::coord::ranged1d::{KeyPointHint, NoDefaultFormatting, Ranged, ValueFormatter};
use std::ops::Range;

/// Approximate number of marks on an axis.
const MARKS: f64 = 6.0;
/// Margin on both sides, as a fraction of the range.
const MARGIN: f64 = 0.04;

/// A linear or logarithmic axis. Positions are values or their decimal logarithms.
#[derive(Clone)]
pub(super) struct Axis {
    log: bool,
    /// Position of the start.
    pub low: f64,
    /// Position of the end.
    pub high: f64,
    /// Positions of the marks.
    pub marks: Vec<f64>,
    /// Decimals of the labels on a linear axis.
    decimals: usize,
}

impl Axis {
    /// Creates an axis for these values; `None` if it can show none of them.
    pub fn for_values(values: impl IntoIterator<Item = f64>, log: bool) -> Option<Self> {
        let mut axis = Self { log, low: f64::INFINITY, high: f64::NEG_INFINITY, marks: Vec::new(), decimals: 0 };
        for value in values {
            if let Some(position) = axis.position(value) {
                axis.low = axis.low.min(position);
                axis.high = axis.high.max(position);
            }
        }
        if axis.low > axis.high {
            return None;
        }
        axis.widen();
        Some(axis.with_marks())
    }

    /// Creates a linear axis exactly from `low` to `high`, with marks.
    pub fn with_bounds(low: f64, high: f64) -> Self {
        Self { log: false, low, high, marks: Vec::new(), decimals: 0 }.with_marks()
    }

    /// Returns the position of a value; `None` if the axis cannot show it, or if it is so large that differences would
    /// overflow.
    pub fn position(&self, value: f64) -> Option<f64> {
        let usable = value.is_finite() && value.abs() < 1e300 && (!self.log || value > 0.0);
        usable.then(|| if self.log { value.log10() } else { value })
    }

    /// Adds a margin on both sides; a range of zero width is extended around its value.
    fn widen(&mut self) {
        let size = self.low.abs().max(self.high.abs());
        let least = if self.log {
            0.1
        } else if size < 1e-290 {
            1.0
        } else {
            size * 1e-12
        };
        let span = self.high - self.low;
        let by = if span >= least {
            span * MARGIN
        } else if self.log {
            0.3
        } else {
            (size * 0.1).max(least)
        };
        // An axis of non-negative values starts at zero if that is near.
        self.low = if !self.log && self.low >= 0.0 && self.low < span * 0.3 { 0.0 } else { self.low - by };
        self.high += by;
    }

    /// Extends the axis to zero, unless it is logarithmic.
    pub fn with_zero(mut self) -> Self {
        if !self.log {
            self.low = self.low.min(0.0);
            self.high = self.high.max(0.0);
        }
        self.with_marks()
    }

    /// Extends the axis at its end by a fraction of its length.
    pub fn with_room(mut self, share: f64) -> Self {
        self.high += (self.high - self.low) * share;
        self.with_marks()
    }

    /// Removes every other mark, for small plots.
    pub fn sparse(mut self) -> Self {
        let mut index = 0;
        self.marks.retain(|_| {
            index += 1;
            index % 2 == 1
        });
        self
    }

    fn with_marks(mut self) -> Self {
        let span = self.high - self.low;
        if self.log {
            self.marks = self.decades(span);
            if self.marks.len() >= 2 {
                return self;
            }
            // Less than a decade: the marks of a linear axis, at their logarithms.
            let (low, high) = (10f64.powf(self.low), 10f64.powf(self.high));
            self.marks = even_marks(low, high).0.into_iter().filter(|mark| *mark > 0.0).map(f64::log10).collect();
        } else {
            (self.marks, self.decimals) = even_marks(self.low, self.high);
        }
        self
    }

    /// Returns powers of ten and, if there is room, their multiples by two and five.
    fn decades(&self, span: f64) -> Vec<f64> {
        let every = (span / (MARKS + 2.0)).ceil().max(1.0);
        let between: &[f64] = if span <= 3.0 { &[1.0, 2.0, 5.0] } else { &[1.0] };
        let first = (self.low / every).floor() * every;
        let mut marks = Vec::new();
        let mut decade = first;
        while decade <= self.high {
            for factor in between {
                let mark = decade + factor.log10();
                if mark >= self.low && mark <= self.high {
                    marks.push(mark);
                }
            }
            decade += every;
        }
        marks
    }

    /// Returns the label of a mark.
    pub fn label(&self, position: f64) -> String {
        if self.log {
            return format_plain(10f64.powf(position));
        }
        if position.abs() >= 1e6 || self.decimals > 6 {
            return format_plain(position);
        }
        let text = format!("{position:.*}", self.decimals);
        // Zero except for rounding errors.
        if text.trim_start_matches('-').parse() == Ok(0.0) { text.trim_start_matches('-').to_owned() } else { text }
    }

    /// Returns the length of the longest label in characters.
    pub fn longest_label(&self) -> usize {
        let lengths = self.marks.iter().map(|mark| self.label(*mark).chars().count());
        lengths.max().unwrap_or(0)
    }
}

impl Ranged for Axis {
    type FormatOption = NoDefaultFormatting;
    type ValueType = f64;

    fn map(&self, position: &f64, (begin, end): (i32, i32)) -> i32 {
        let share = (position - self.low) / (self.high - self.low);
        begin + (f64::from(end - begin) * share).round() as i32
    }

    fn key_points<Hint: KeyPointHint>(&self, hint: Hint) -> Vec<f64> {
        // Grid lines at marks only.
        if hint.weight().allow_light_points() { Vec::new() } else { self.marks.clone() }
    }

    fn range(&self) -> Range<f64> {
        self.low..self.high
    }
}

impl ValueFormatter<f64> for Axis {
    fn format_ext(&self, position: &f64) -> String {
        self.label(*position)
    }
}

/// Returns multiples of 1, 2 or 5 times a power of ten within a range, and their number of decimals.
fn even_marks(low: f64, high: f64) -> (Vec<f64>, usize) {
    let rough = (high - low) / MARKS;
    let power = 10f64.powf(rough.log10().floor());
    if !(power.is_finite() && power > 0.0) {
        return (Vec::new(), 0);
    }
    let step = match rough / power {
        share if share < 1.5 => power,
        share if share < 3.5 => 2.0 * power,
        share if share < 7.5 => 5.0 * power,
        _ => 10.0 * power,
    };
    let first = (low / step - 1e-6).ceil();
    let marks = (0..=2 * MARKS as usize)
        .map(|index| (first + index as f64) * step)
        .take_while(|mark| *mark <= high + step * 1e-6)
        .collect();
    let decimals = (-(step * 1.000_001).log10().floor()).max(0.0) as usize;
    (marks, decimals)
}

/// Formats with at most four significant digits, without trailing zeros; very large and small numbers with an exponent.
fn format_plain(value: f64) -> String {
    let size = value.abs();
    if size != 0.0 && !(1e-3..1e6).contains(&size) {
        let text = format!("{value:.3e}");
        let (digits, power) = text.split_once('e').unwrap_or((&text, "0"));
        let digits = digits.trim_end_matches('0').trim_end_matches('.');
        return format!("{digits}e{power}");
    }
    let whole = if size >= 1.0 { size.log10().floor() + 1.0 } else { 0.0 };
    let text = format!("{value:.*}", (4.0 - whole).max(0.0) as usize);
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

/// Formats with three significant digits, as for the value of a bar.
pub(super) fn three_digits(value: f64) -> String {
    let size = value.abs();
    match size {
        _ if size == 0.0 => "0".to_owned(),
        _ if !(1e-4..1e7).contains(&size) => format!("{value:.2e}"),
        _ => {
            let power = size.log10().floor();
            format!("{value:.*}", (2.0 - power).max(0.0) as usize)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(axis: &Axis) -> Vec<String> {
        axis.marks.iter().map(|mark| axis.label(*mark)).collect()
    }

    #[test]
    fn a_linear_axis_has_round_marks() {
        assert_eq!(labels(&Axis::with_bounds(0.0, 10.0)), ["0", "2", "4", "6", "8", "10"]);
        assert_eq!(labels(&Axis::with_bounds(-0.3, 0.3)), ["-0.3", "-0.2", "-0.1", "0.0", "0.1", "0.2", "0.3"]);
    }

    #[test]
    fn a_logarithmic_axis_marks_decades() {
        let axis = Axis::for_values([0.01, 100_000.0], true).expect("it has values");
        let labels = labels(&axis);
        assert_eq!(labels.first().map(String::as_str), Some("0.01"));
        assert_eq!(labels.last().map(String::as_str), Some("100000"));
        assert_eq!(labels.len(), 8);
    }

    #[test]
    fn a_logarithmic_axis_of_less_than_a_decade_still_has_marks() {
        for range in [[1.1, 1.2], [3.0, 4.5], [0.11, 0.18], [7.0, 7.0]] {
            let axis = Axis::for_values(range, true).expect("it has values");
            assert!(axis.marks.len() >= 2, "{range:?}: {:?}", labels(&axis));
        }
    }

    #[test]
    fn what_has_no_place_makes_no_axis() {
        assert!(Axis::for_values([f64::NAN, f64::INFINITY], false).is_none());
        assert!(Axis::for_values([0.0, -1.0], true).is_none());
    }

    #[test]
    fn values_have_three_digits() {
        let texts: Vec<String> = [0.0, 0.012_345, 1.0, 12.34, 123.4, 12_345.0].into_iter().map(three_digits).collect();
        assert_eq!(texts, ["0", "0.0123", "1.00", "12.3", "123", "12345"]);
    }
}
