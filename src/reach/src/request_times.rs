//! Response times of robots' requests and their phases: histograms by service for `/metrics`. Each request is recorded
//! once; one series per request would grow without limit, one per service does not.

use std::collections::BTreeMap;
use std::fmt::Write;

use link::control::RequestTiming;
use parking_lot::Mutex;

/// Upper bounds in seconds: from a relay on loopback to a link that is almost dead.
const BOUNDS: [f64; 13] = [0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0];
/// Replacement in milliseconds for invalid times; robots are not trusted.
const LONGEST: f64 = 1e9;

/// Histograms of all services.
#[derive(Default)]
pub struct RequestTimes {
    services: Mutex<BTreeMap<String, ServiceTimes>>,
}

#[derive(Default)]
struct ServiceTimes {
    total: Histogram,
    /// Histograms in the order of [`PHASES`].
    phases: [Histogram; 5],
}

const PHASES: [&str; 5] = ["serialise", "up", "queue", "compute", "down"];

#[derive(Default)]
struct Histogram {
    /// Counts by bound, not cumulative; the last one is for values beyond all bounds.
    counts: [u64; BOUNDS.len() + 1],
    sum: f64,
}

impl RequestTimes {
    /// Records a request of this service that was answered by the cloud.
    pub fn record(&self, service: &str, request: &RequestTiming) {
        let Some(total) = request.total else {
            return;
        };
        let mut services = self.services.lock();
        let service = match services.get_mut(service) {
            Some(known) => known,
            None => services.entry(service.to_owned()).or_default(),
        };
        service.total.record(total);
        let phases = [request.serialise, request.up, request.queue, request.compute, request.down];
        // They are unknown for some responses.
        if phases.iter().any(|time| *time > 0.0) {
            for (histogram, time) in service.phases.iter_mut().zip(phases) {
                histogram.record(time);
            }
        }
    }

    /// Writes the histograms in Prometheus text format and forgets services that no longer exist.
    pub fn write_prometheus(&self, out: &mut String, exists: impl Fn(&str) -> bool) {
        let mut services = self.services.lock();
        services.retain(|name, _| exists(name));
        // Writing to a String cannot fail.
        let _ = writeln!(
            out,
            "# HELP cloudroid_request_seconds Time from asked to answered by the cloud: as stubs with an SLA tell it, \
             and between the bridge and the servant of robots that speak rosbridge.\n\
             # TYPE cloudroid_request_seconds histogram"
        );
        for (name, service) in &*services {
            let labels = format!("service=\"{name}\"");
            service.total.write_prometheus(out, "cloudroid_request_seconds", &labels);
        }
        let _ = writeln!(
            out,
            "# HELP cloudroid_request_phase_seconds The parts of that time.\n\
             # TYPE cloudroid_request_phase_seconds histogram"
        );
        for (name, service) in &*services {
            for (phase, histogram) in PHASES.iter().zip(&service.phases) {
                let labels = format!("service=\"{name}\",phase=\"{phase}\"");
                histogram.write_prometheus(out, "cloudroid_request_phase_seconds", &labels);
            }
        }
    }
}

impl Histogram {
    fn record(&mut self, milliseconds: f64) {
        let sane = milliseconds.is_finite() && milliseconds >= 0.0;
        let seconds = if sane { milliseconds.min(LONGEST) } else { LONGEST } / 1e3;
        let at = BOUNDS.iter().position(|bound| seconds <= *bound);
        self.counts[at.unwrap_or(BOUNDS.len())] += 1;
        self.sum += seconds;
    }

    fn write_prometheus(&self, out: &mut String, name: &str, labels: &str) {
        let mut count = 0;
        let bounds = BOUNDS.iter().map(f64::to_string).chain(["+Inf".to_owned()]);
        for (bound, more) in bounds.zip(self.counts) {
            count += more;
            let _ = writeln!(out, "{name}_bucket{{{labels},le=\"{bound}\"}} {count}");
        }
        let _ = writeln!(out, "{name}_sum{{{labels}}} {}", self.sum);
        let _ = writeln!(out, "{name}_count{{{labels}}} {count}");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_are_counted_by_service_and_phase() {
        let times = RequestTimes::default();
        let request =
            |total| RequestTiming { total: Some(total), up: 4.0, compute: total - 4.0, ..RequestTiming::default() };
        times.record("people", &request(90.0));
        times.record("people", &request(20_000.0));
        times.record("people", &RequestTiming::default());
        times.record("odd", &request(f64::NAN));
        times.record("gone", &request(1.0));
        let mut out = String::new();
        times.write_prometheus(&mut out, |name| name != "gone");
        for line in [
            "# TYPE cloudroid_request_phase_seconds histogram",
            "cloudroid_request_seconds_bucket{service=\"people\",le=\"0.05\"} 0",
            "cloudroid_request_seconds_bucket{service=\"people\",le=\"0.1\"} 1",
            "cloudroid_request_seconds_bucket{service=\"people\",le=\"10\"} 1",
            "cloudroid_request_seconds_bucket{service=\"people\",le=\"+Inf\"} 2",
            "cloudroid_request_seconds_sum{service=\"people\"} 20.09",
            "cloudroid_request_seconds_count{service=\"people\"} 2",
            "cloudroid_request_phase_seconds_bucket{service=\"people\",phase=\"up\",le=\"0.005\"} 2",
            "cloudroid_request_phase_seconds_count{service=\"people\",phase=\"down\"} 2",
            "cloudroid_request_seconds_sum{service=\"odd\"} 1000000",
        ] {
            assert!(out.lines().any(|written| written == line), "{line}: {out}");
        }
        assert!(!out.contains("gone"), "{out}");
    }
}
