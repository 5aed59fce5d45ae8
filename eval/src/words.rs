//! Formats numbers for the report.

pub use bench_report::format_number as digits;

use crate::statistics::Spread;

/// The percentiles of all tables: p50, p95 and p99.
pub const PERCENTILES: [f64; 3] = [0.5, 0.95, 0.99];

/// Formats a value; a dash if it is unknown.
pub fn or_dash<T>(value: Option<T>, says: impl FnOnce(T) -> String) -> String {
    value.map_or_else(|| "–".to_owned(), says)
}

/// Formats the median of the runs, with the lowest and the highest in brackets unless all read the same; a dash if it
/// is unknown.
pub fn spread(figure: Option<Spread>, says: impl Fn(f64) -> String) -> String {
    or_dash(figure, |Spread { low, median, high }| match [low, median, high].map(says) {
        [low, median, high] if low == high => median,
        [low, median, high] => format!("{median} ({low}–{high})"),
    })
}

/// Formats seconds as milliseconds with three digits.
pub fn milliseconds(seconds: Option<Spread>) -> String {
    spread(seconds, |seconds| digits(seconds * 1e3))
}

/// Formats a fraction as a percentage with one decimal.
pub fn percent(share: Option<Spread>) -> String {
    // Adding zero turns a rounded minus zero into zero.
    spread(share, |share| format!("{:.1} %", (share * 1000.0).round() / 10.0 + 0.0))
}

pub fn ratio(times: Option<Spread>) -> String {
    spread(times, |times| if times < 1.0 { format!("{times:.2}") } else { format!("{times:.1}") })
}

/// Formats a count, or another number without decimals.
pub fn count(number: Option<Spread>) -> String {
    spread(number, |number| format!("{number:.0}"))
}

/// Checks that a text contains these words.
#[cfg(test)]
#[track_caller]
pub(crate) fn assert_tells(text: &str, words: &str) {
    assert!(text.contains(words), "{words}: {text}");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_three_digits_and_their_spread() {
        let one = |value: f64| Spread::from_values(&[value]);
        assert_eq!(milliseconds(one(0.1234)), "123");
        assert_eq!(milliseconds(one(0.01234)), "12.3");
        assert_eq!(milliseconds(one(0.001234)), "1.23");
        assert_eq!(milliseconds(None), "–");
        assert_eq!(percent(one(0.7541)), "75.4 %");
        assert_eq!(percent(one(-0.0001)), "0.0 %");
        assert_eq!(ratio(one(0.5)), "0.50");
        assert_eq!(ratio(Spread::from_values(&[3.96, 5.0, 4.5])), "4.5 (4.0–5.0)");
        assert_eq!(count(Spread::from_values(&[7.0, 7.1])), "7");
    }
}
