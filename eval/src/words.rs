//! Formats numbers for the report.

pub use bench_report::format_number as digits;

/// Formats a value; a dash if it is unknown.
pub fn or_dash<T>(value: Option<T>, says: impl FnOnce(T) -> String) -> String {
    value.map_or_else(|| "–".to_owned(), says)
}

/// Formats a fraction as a percentage with one decimal; a dash if it is unknown.
pub fn percent(share: Option<f64>) -> String {
    // Adding zero turns a rounded minus zero into zero.
    or_dash(share, |share| format!("{:.1} %", (share * 1000.0).round() / 10.0 + 0.0))
}

/// Formats seconds as milliseconds with three digits; a dash if unknown.
pub fn milliseconds(seconds: Option<f64>) -> String {
    or_dash(seconds, |seconds| digits(seconds * 1e3))
}

/// Formats a ratio; a dash if it is unknown.
pub fn ratio(times: Option<f64>) -> String {
    or_dash(times, |times| if times < 1.0 { format!("{times:.2}") } else { format!("{times:.1}") })
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
    fn numbers_have_three_digits() {
        assert_eq!(milliseconds(Some(0.1234)), "123");
        assert_eq!(milliseconds(Some(0.01234)), "12.3");
        assert_eq!(milliseconds(Some(0.001234)), "1.23");
        assert_eq!(milliseconds(None), "–");
        assert_eq!(percent(Some(0.7541)), "75.4 %");
        assert_eq!(percent(Some(-0.0001)), "0.0 %");
        assert_eq!(percent(None), "–");
        assert_eq!(ratio(Some(0.5)), "0.50");
        assert_eq!(ratio(Some(3.96)), "4.0");
    }
}
