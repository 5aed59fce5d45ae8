//! An axis: positions of values, and tick marks.

/// Approximate number of marks on an axis.
const MARKS: f64 = 6.0;
/// Margin on both sides, as a fraction of the range.
const MARGIN: f64 = 0.04;

/// A linear or logarithmic axis. Positions are values or their decimal logarithms.
#[derive(Clone)]
pub(super) struct Axis {
    log: bool,
    pub low: f64,
    pub high: f64,
    pub marks: Vec<f64>,
}

impl Axis {
    /// Creates an axis for these values; `None` if it can show none of them.
    pub fn for_values(values: impl IntoIterator<Item = f64>, log: bool) -> Option<Self> {
        let positions: Vec<f64> = values.into_iter().filter_map(|value| find_position(value, log)).collect();
        let low = positions.iter().copied().reduce(f64::min)?;
        let high = positions.iter().copied().reduce(f64::max)?;
        let mut axis = Self { log, low, high, marks: Vec::new() };
        axis.widen();
        Some(axis.with_marks())
    }

    /// Creates a linear axis exactly from `low` to `high`, with marks.
    pub fn with_bounds(low: f64, high: f64) -> Self {
        Self { log: false, low, high, marks: Vec::new() }.with_marks()
    }

    /// Returns the position of a value; `None` if the axis cannot show it.
    pub fn position(&self, value: f64) -> Option<f64> {
        find_position(value, self.log)
    }

    /// Returns a position as a fraction of the axis' length.
    pub fn share(&self, position: f64) -> f64 {
        (position - self.low) / (self.high - self.low)
    }

    /// Adds a margin on both sides; a range of zero width is extended around its value.
    fn widen(&mut self) {
        let (size, span) = (self.low.abs().max(self.high.abs()), self.high - self.low);
        let tiny = if size < 1e-290 { 1.0 } else { size * 1e-12 };
        let (least, around) = if self.log { (0.1, 0.3) } else { (tiny, (size * 0.1).max(tiny)) };
        let by = if span >= least { span * MARGIN } else { around };
        // An axis of non-negative values starts at zero if that is near.
        self.low = if !self.log && self.low >= 0.0 && self.low < span * 0.3 { 0.0 } else { self.low - by };
        self.high += by;
    }

    /// Extends the axis to zero, unless it is logarithmic.
    pub fn with_zero(mut self) -> Self {
        if !self.log {
            (self.low, self.high) = (self.low.min(0.0), self.high.max(0.0));
        }
        self.with_marks()
    }

    /// Extends the axis at its end by a fraction of its length.
    pub fn with_room(mut self, share: f64) -> Self {
        self.high += (self.high - self.low) * share;
        self.with_marks()
    }

    fn with_marks(mut self) -> Self {
        self.marks = if self.log { self.decades() } else { even_marks(self.low, self.high) };
        if self.log && self.marks.len() < 2 {
            // Less than a decade: the marks of a linear axis, at their logarithms.
            let marks = even_marks(10f64.powf(self.low), 10f64.powf(self.high));
            self.marks = marks.into_iter().filter(|mark| *mark > 0.0).map(f64::log10).collect();
        }
        self
    }

    /// Returns powers of ten and, if there is room, their multiples by two and five.
    fn decades(&self) -> Vec<f64> {
        let span = self.high - self.low;
        let every = (span / (MARKS + 2.0)).ceil().max(1.0);
        let between: &[f64] = if span <= 3.0 { &[1.0, 2.0, 5.0] } else { &[1.0] };
        let first = (self.low / every).floor();
        let decades = (0..).map(|index| (first + f64::from(index)) * every).take_while(|decade| *decade <= self.high);
        let marks = decades.flat_map(|decade| between.iter().map(move |factor| decade + factor.log10()));
        marks.filter(|mark| (self.low..=self.high).contains(mark)).collect()
    }

    pub fn label(&self, position: f64) -> String {
        if self.log {
            return format_plain(10f64.powf(position));
        }
        let is_zero = position.abs() < (self.high - self.low) * 1e-9;
        format_plain(if is_zero { 0.0 } else { position })
    }

    /// Returns the length of the longest label in characters.
    pub fn longest_label(&self) -> usize {
        self.marks.iter().map(|mark| self.label(*mark).chars().count()).max().unwrap_or(0)
    }
}

/// Values so large that differences would overflow have no position, either.
fn find_position(value: f64, log: bool) -> Option<f64> {
    let is_usable = value.is_finite() && value.abs() < 1e300 && (!log || value > 0.0);
    is_usable.then(|| if log { value.log10() } else { value })
}

/// Returns multiples of 1, 2 or 5 times a power of ten within a range.
fn even_marks(low: f64, high: f64) -> Vec<f64> {
    let rough = (high - low) / MARKS;
    let power = 10f64.powf(rough.log10().floor());
    if !(power.is_finite() && power > 0.0) {
        return Vec::new();
    }
    let step = match rough / power {
        share if share < 1.5 => power,
        share if share < 3.5 => 2.0 * power,
        share if share < 7.5 => 5.0 * power,
        _ => 10.0 * power,
    };
    let first = (low / step - 1e-6).ceil();
    let marks = (0..=2 * MARKS as usize).map(|index| (first + index as f64) * step);
    marks.take_while(|mark| *mark <= high + step * 1e-6).collect()
}

/// Formats without trailing zeros; very large and small numbers with an exponent.
fn format_plain(value: f64) -> String {
    let size = value.abs();
    if size != 0.0 && !(1e-3..1e6).contains(&size) {
        let text = format!("{value:.3e}");
        let (digits, power) = text.split_once('e').unwrap_or((&text, "0"));
        return format!("{}e{power}", digits.trim_end_matches('0').trim_end_matches('.'));
    }
    let whole = if size >= 1.0 { size.log10().floor() + 1.0 } else { 0.0 };
    let text = format!("{value:.*}", (6.0 - whole).max(0.0) as usize);
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

/// Formats with three significant digits, as for the value of a bar.
pub(super) fn three_digits(value: f64) -> String {
    let size = value.abs();
    match size {
        _ if size == 0.0 => "0".to_owned(),
        _ if !(1e-4..1e7).contains(&size) => format!("{value:.2e}"),
        _ => format!("{value:.*}", (2.0 - size.log10().floor()).max(0.0) as usize),
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
        assert_eq!(labels(&Axis::with_bounds(-0.3, 0.3)), ["-0.3", "-0.2", "-0.1", "0", "0.1", "0.2", "0.3"]);
    }

    #[test]
    fn a_logarithmic_axis_marks_decades_or_what_is_between() {
        let axis = Axis::for_values([0.01, 100_000.0], true).expect("it has values");
        assert_eq!(labels(&axis), ["0.01", "0.1", "1", "10", "100", "1000", "10000", "100000"]);
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
        let texts = [0.0, 0.012_345, 1.0, 12.34, 123.4, 12_345.0].map(three_digits);
        assert_eq!(texts, ["0", "0.0123", "1.00", "12.3", "123", "12345"]);
    }
}
