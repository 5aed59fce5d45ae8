//! Prometheus's text format (version 0.0.4), and OpenMetrics 1.0, which names a counter's family without `_total` and
//! marks the end, so that a truncated response is recognised.

use std::fmt::Write;

use axum::http::{HeaderMap, header};

/// Media type of OpenMetrics.
pub const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
/// Media type of Prometheus's text format.
pub const PROMETHEUS: &str = "text/plain; version=0.0.4";

/// Returns true if the client accepts OpenMetrics.
pub fn accepts_open_metrics(headers: &HeaderMap) -> bool {
    let accepted = headers.get_all(header::ACCEPT).iter();
    accepted
        .filter_map(|value| value.to_str().ok())
        .flat_map(|value| value.split(','))
        .filter_map(|one| one.split(';').next())
        .any(|kind| kind.trim() == "application/openmetrics-text")
}

/// Converts Prometheus's text format to OpenMetrics.
pub fn to_open_metrics(prometheus: &str) -> String {
    let mut out = String::with_capacity(prometheus.len());
    for line in prometheus.lines() {
        let about = line.strip_prefix("# HELP ").or_else(|| line.strip_prefix("# TYPE "));
        let named = about.and_then(|about| about.split_once(' '));
        match named.and_then(|(name, rest)| Some((name.strip_suffix("_total")?, rest))) {
            Some((name, rest)) => {
                out.push_str(&line[..7]);
                // Writing to a String cannot fail.
                let _ = writeln!(out, "{name} {rest}");
            }
            None => {
                out.push_str(line);
                out.push('\n');
            }
        }
    }
    out.push_str("# EOF\n");
    out
}

/// Writes a gauge.
pub fn write_gauge(out: &mut String, name: &str, help: &str, rows: impl IntoIterator<Item = (String, f64)>) {
    write_family(out, name, "gauge", help, rows);
}

/// Writes a metric family: type, help and rows of labels and value. A counter's `name` ends with `_total`.
pub fn write_family(
    out: &mut String,
    name: &str,
    kind: &str,
    help: &str,
    rows: impl IntoIterator<Item = (String, f64)>,
) {
    // Writing to a String cannot fail.
    let _ = writeln!(out, "# HELP {name} {help}\n# TYPE {name} {kind}");
    for (labels, value) in rows {
        let braces = if labels.is_empty() { String::new() } else { format!("{{{labels}}}") };
        let _ = writeln!(out, "{name}{braces} {value}");
    }
}

/// Formats labels as they appear between braces.
pub fn format_labels(pairs: &[(&str, &str)]) -> String {
    let escape = |text: &str| text.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n");
    pairs.iter().map(|(name, value)| format!("{name}=\"{}\"", escape(value))).collect::<Vec<_>>().join(",")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_come_out_as_prometheus_reads_them() {
        let mut out = String::new();
        write_gauge(&mut out, "a", "Help.", [(String::new(), 1.0), (format_labels(&[("x", "q\"\\")]), 0.5)]);
        assert_eq!(out, "# HELP a Help.\n# TYPE a gauge\na 1\na{x=\"q\\\"\\\\\"} 0.5\n");
    }

    #[test]
    fn open_metrics_names_counters_without_their_ending_and_says_where_it_ends() {
        let mut out = String::new();
        write_family(&mut out, "a_total", "counter", "A total.", [(String::new(), 1.0)]);
        write_gauge(&mut out, "b", "Not a_total.", [(String::new(), 2.0)]);
        assert_eq!(
            to_open_metrics(&out),
            "# HELP a A total.\n# TYPE a counter\na_total 1\n\
             # HELP b Not a_total.\n# TYPE b gauge\nb 2\n# EOF\n"
        );
    }

    #[test]
    fn who_asks_for_open_metrics_is_given_it() {
        for (accept, expected) in [
            (None, false),
            (Some("*/*"), false),
            (Some("text/plain; version=0.0.4"), false),
            (Some("application/openmetrics-text"), true),
            (Some("application/openmetrics-text;version=1.0.0;q=0.5,text/plain;q=0.1"), true),
            (Some("application/openmetrics-textual"), false),
        ] {
            let mut headers = HeaderMap::new();
            if let Some(accept) = accept {
                headers.insert(header::ACCEPT, accept.parse().expect("a value"));
            }
            assert_eq!(accepts_open_metrics(&headers), expected, "{accept:?}");
        }
    }
}
