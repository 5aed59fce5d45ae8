//! Numbers as the report has them.

/// In words; a dash where it is not known.
pub fn known<T>(value: Option<T>, says: impl FnOnce(T) -> String) -> String {
    value.map_or_else(|| "–".to_owned(), says)
}

/// A share, of which 1 is all, with one digit after the point; a dash where it is not known.
pub fn percent(share: Option<f64>) -> String {
    // Adding nothing makes zero of what is rounded to minus zero.
    known(share, |share| {
        format!("{:.1} %", (share * 1000.0).round() / 10.0 + 0.0)
    })
}

/// Seconds as milliseconds of three digits; a dash where there is none.
pub fn milliseconds(seconds: Option<f64>) -> String {
    known(seconds, |seconds| digits(seconds * 1e3))
}

/// How many times; a dash where it is not known.
pub fn ratio(times: Option<f64>) -> String {
    known(times, |times| {
        if times < 1.0 {
            format!("{times:.2}")
        } else {
            format!("{times:.1}")
        }
    })
}

/// Three digits, or all of those before the point.
pub fn digits(value: f64) -> String {
    match value.abs() {
        size if size >= 100.0 => format!("{value:.0}"),
        size if size >= 10.0 => format!("{value:.1}"),
        _ => format!("{value:.2}"),
    }
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
