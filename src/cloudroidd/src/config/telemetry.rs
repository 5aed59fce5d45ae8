//! `[telemetry]`: traces of robots' requests, sent to an OpenTelemetry collector.

use std::path::PathBuf;

use anyhow::{Context, bail, ensure};
use hyper::Uri;
use serde::Deserialize;

/// Path of traces below an endpoint (OpenTelemetry protocol, OTLP/HTTP).
const TRACES: &str = "/v1/traces";

/// An OpenTelemetry collector, and how many requests it is told of.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TelemetryConfig {
    /// Base URL of an OTLP/HTTP receiver; `/v1/traces` is appended.
    pub endpoint: String,
    /// Fraction of the requests that are traced, more than 0 and at most 1 (default: 0.01).
    #[serde(default = "one_percent")]
    pub sampling_ratio: f64,
    /// PEM file of the authorities by which the collector's certificate is checked; must be world-readable (default:
    /// the system's).
    pub authorities: Option<PathBuf>,
}

fn one_percent() -> f64 {
    0.01
}

impl TelemetryConfig {
    /// Returns the URL that traces are sent to. Fails if nothing can be sent there.
    pub fn traces_url(&self) -> anyhow::Result<Uri> {
        let base = self.endpoint.trim_end_matches('/');
        ensure!(
            !base.ends_with(TRACES) && !base.contains(['?', '#']),
            "endpoint = {:?} must be only the collector's base address: \"http://localhost:4318\"",
            self.endpoint
        );
        let url = format!("{base}{TRACES}");
        let url: Uri = url
            .parse()
            .with_context(|| format!("endpoint = {:?} is no address; write https://HOST:PORT", self.endpoint))?;
        outbound::find_server(&url).context("endpoint")?;
        Ok(url)
    }

    /// Checks the values. `can_export`: this program was built with the feature `otel`.
    pub(super) fn check(&self, can_export: bool) -> anyhow::Result<()> {
        if !can_export {
            bail!(
                "this cloudroidd was built without OpenTelemetry; build it with: cargo build --locked --release -p \
                 cloudroidd --features otel, or remove the section"
            );
        }
        ensure!(
            self.sampling_ratio > 0.0 && self.sampling_ratio <= 1.0,
            "sampling_ratio = {} is no fraction of the requests; write a number above 0 and at most 1, or remove the \
             section to export nothing",
            self.sampling_ratio
        );
        self.traces_url().map(|_| ())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(text: &str, can_export: bool) -> Result<(), String> {
        let read: TelemetryConfig = toml::from_str(text).expect(text);
        read.check(can_export).map_err(|error| format!("{error:#}"))
    }

    #[test]
    fn a_collector_has_an_address_and_a_ratio() {
        let read: TelemetryConfig = toml::from_str("endpoint = \"http://localhost:4318/\"").expect("well-formed");
        assert_eq!((read.sampling_ratio, &read.authorities), (0.01, &None));
        let url = read.traces_url().expect("good").to_string();
        assert_eq!(url, "http://localhost:4318/v1/traces");
        let lab = "endpoint = \"https://otel.lab.example/collector\"\nsampling_ratio = 1.0";
        assert_eq!(check(lab, true), Ok(()));
    }

    #[test]
    fn what_cannot_work_is_refused() {
        for (text, words) in [
            ("endpoint = \"\"", "endpoint"),
            ("endpoint = \"localhost:4318\"", "https://"),
            ("endpoint = \"http://otel.lab.example:4318\"", "plain text"),
            ("endpoint = \"http://localhost:4318/v1/traces\"", "base address"),
            ("endpoint = \"http://localhost:4318/?a=b\"", "base address"),
            ("endpoint = \"http://localhost:4318\"\nsampling_ratio = 0", "sampling_ratio"),
            ("endpoint = \"http://localhost:4318\"\nsampling_ratio = nan", "sampling_ratio"),
            ("endpoint = \"http://localhost:4318\"\nsampling_ratio = 10", "at most 1"),
        ] {
            let refused = check(text, true).expect_err(text);
            assert!(refused.contains(words), "{text}: {refused}");
        }
    }

    #[test]
    fn a_program_without_the_feature_says_how_to_build_one_with_it() {
        let good = "endpoint = \"http://localhost:4318\"";
        let refused = check(good, false).expect_err("nothing would be sent");
        assert!(refused.contains("--features otel"), "{refused}");
        let text = format!("[telemetry]\n{good}\n");
        let config = super::super::Config::parse(&text).expect("well-formed");
        assert_eq!(config.check().is_ok(), cfg!(feature = "otel"));
    }
}
