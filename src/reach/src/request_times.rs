//! How long requests of robots take, and in which phase: histograms by service, for `/metrics`. Each request is told
//! once; a row for each of them would grow without end, one for each service does not.

use std::collections::BTreeMap;
use std::fmt::Write;

use link::control::Request;
use parking_lot::Mutex;

/// Upper bounds, seconds: from a loopback's relay to a link that is all but gone.
const BOUNDS: [f64; 13] = [
    0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0,
];
/// What stands in for a time that makes no sense, milliseconds: robots are not to be trusted.
const LONGEST: f64 = 1e9;

/// Histograms of all services.
#[derive(Default)]
pub struct RequestTimes {
    services: Mutex<BTreeMap<String, Service>>,
}

#[derive(Default)]
struct Service {
    total: Histogram,
    /// In the order of [`PHASES`].
    phases: [Histogram; 5],
}

const PHASES: [&str; 5] = ["serialise", "up", "queue", "compute", "down"];

#[derive(Default)]
struct Histogram {
    /// By bound, not summed up; the last: beyond all of them.
    counts: [u64; BOUNDS.len() + 1],
    sum: f64,
}

impl RequestTimes {
    /// A request of this service was answered by the cloud.
    pub fn note(&self, service: &str, request: &Request) {
        let Some(total) = request.total else {
            return;
        };
        let mut services = self.services.lock();
        let service = match services.get_mut(service) {
            Some(known) => known,
            None => services.entry(service.to_owned()).or_default(),
        };
        service.total.note(total);
        let phases = [
            request.serialise,
            request.up,
            request.queue,
            request.compute,
            request.down,
        ];
        // Of some answers it is not known.
        if phases.iter().any(|time| *time > 0.0) {
            for (histogram, time) in service.phases.iter_mut().zip(phases) {
                histogram.note(time);
            }
        }
    }

    /// Writes them in Prometheus's text format; those of services that are no more are forgotten.
    pub fn prometheus(&self, out: &mut String, exists: impl Fn(&str) -> bool) {
        let mut services = self.services.lock();
        services.retain(|name, _| exists(name));
        // Writing to a String cannot fail.
        let _ = writeln!(
            out,
            "# HELP cloudroid_request_seconds Time from asked to answered by the cloud: as stubs with an SLA tell it, and between the bridge and the servant of robots that speak rosbridge.\n\
             # TYPE cloudroid_request_seconds histogram"
        );
        for (name, service) in &*services {
            let labels = format!("service=\"{name}\"");
            service
                .total
                .prometheus(out, "cloudroid_request_seconds", &labels);
        }
        let _ = writeln!(
            out,
            "# HELP cloudroid_request_phase_seconds The parts of that time.\n\
             # TYPE cloudroid_request_phase_seconds histogram"
        );
        for (name, service) in &*services {
            for (phase, histogram) in PHASES.iter().zip(&service.phases) {
                let labels = format!("service=\"{name}\",phase=\"{phase}\"");
                histogram.prometheus(out, "cloudroid_request_phase_seconds", &labels);
            }
        }
    }
}

impl Histogram {
    fn note(&mut self, milliseconds: f64) {
        let sane = milliseconds.is_finite() && milliseconds >= 0.0;
        let seconds = if sane {
            milliseconds.min(LONGEST)
        } else {
            LONGEST
        } / 1e3;
        let at = BOUNDS.iter().position(|bound| seconds <= *bound);
        self.counts[at.unwrap_or(BOUNDS.len())] += 1;
        self.sum += seconds;
    }

    fn prometheus(&self, out: &mut String, name: &str, labels: &str) {
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
        let request = |total| Request {
            total: Some(total),
            up: 4.0,
            compute: total - 4.0,
            ..Request::default()
        };
        times.note("people", &request(90.0));
        times.note("people", &request(20_000.0));
        times.note("people", &Request::default());
        times.note("odd", &request(f64::NAN));
        times.note("gone", &request(1.0));
        let mut out = String::new();
        times.prometheus(&mut out, |name| name != "gone");
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
