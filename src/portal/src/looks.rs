//! Samples servants and machine: their state, and the resources used since the previous sample.

use std::collections::HashMap;
use std::time::Duration;

use api::explain::Served;
use api::stream::Machine;
use choreographer::Handle;
use tokio::time::Instant;

use crate::app::App;
use crate::errors::Error;
use crate::{explain, views};

/// Minimum interval over which processor time is meaningful.
const MIN_CPU_INTERVAL: Duration = Duration::from_millis(900);

/// Samples servants repeatedly and computes usage since the previous sample.
#[derive(Default)]
pub struct ServantSampler {
    measured: HashMap<String, CpuMeasurement>,
}

impl ServantSampler {
    /// Returns the current state of all servants.
    pub async fn sample(&mut self, app: &App) -> Vec<Served> {
        let handles = app.choreographer.servants();
        let looks = handles.iter().map(|handle| describe_servant(app, handle));
        let mut servants = futures_util::future::join_all(looks).await;
        let now = Instant::now();
        self.measured.retain(|id, _| servants.iter().any(|one| one.servant.id == *id));
        for servant in &mut servants {
            measure(servant, &mut self.measured, now);
        }
        servants
    }
}

/// Processor time at a moment, and the usage computed up to then.
#[derive(Clone, Copy)]
struct CpuMeasurement {
    at: Instant,
    cpu_usec: u64,
    throttled_usec: u64,
    cores: f64,
    throttled: f64,
}

async fn describe_servant(app: &App, handle: &Handle) -> Served {
    Served {
        servant: app.choreographer.describe(handle).await,
        throttled: 0.0,
        cores: 0.0,
        links: explain::links(&app.choreographer, handle),
    }
}

/// Fills in what a servant has used since it was last measured.
fn measure(served: &mut Served, measured: &mut HashMap<String, CpuMeasurement>, now: Instant) {
    let Some(usage) = &served.servant.usage else {
        measured.remove(&served.servant.id);
        return;
    };
    let new = CpuMeasurement {
        at: now,
        cpu_usec: usage.cpu_usec,
        throttled_usec: usage.throttled_usec,
        cores: 0.0,
        throttled: 0.0,
    };
    let last = measured.entry(served.servant.id.clone()).or_insert(new);
    let passed = now.duration_since(last.at);
    if passed >= MIN_CPU_INTERVAL {
        let share = |now: u64, then: u64| now.saturating_sub(then) as f64 / passed.as_micros() as f64;
        *last = CpuMeasurement {
            cores: share(new.cpu_usec, last.cpu_usec),
            throttled: share(new.throttled_usec, last.throttled_usec).min(1.0),
            ..new
        };
    }
    served.cores = last.cores;
    served.throttled = last.throttled;
}

/// Returns the state of the machine, with the usage of these servants.
pub async fn sample_machine(app: &App, servants: &[Served]) -> Result<Machine, Error> {
    Ok(Machine {
        status: views::status(app).await?,
        // `sum()` of nothing would be -0.
        cores: servants.iter().fold(0.0, |sum, one| sum + one.cores),
        host_cores: std::thread::available_parallelism().map_or(1, usize::from),
        host_memory: servant::host::total_memory(),
        host_memory_available: servant::host::available_memory_percent(),
    })
}

#[cfg(test)]
pub mod tests {
    use super::*;

    pub fn served_servant(cpu_usec: u64, throttled_usec: u64) -> Served {
        let usage = api::Usage { cpu_usec, throttled_usec, ..api::Usage::default() };
        let servant = serde_json::json!({
            "id": "s1", "service": "adder", "revision": 1, "robot": "r1", "phase": "ready", "created": 0,
            "connections": 1, "limits": {}, "usage": usage,
        });
        Served {
            servant: serde_json::from_value(servant).expect("a servant"),
            throttled: 0.0,
            cores: 0.0,
            links: Vec::new(),
        }
    }

    #[test]
    fn use_is_measured_over_long_enough() {
        let (mut measured, start) = (HashMap::new(), Instant::now());
        let mut at = |after: u64, cpu, throttled| {
            let mut servant = served_servant(cpu, throttled);
            measure(&mut servant, &mut measured, start + Duration::from_millis(after));
            (servant.cores, servant.throttled)
        };
        assert_eq!(at(0, 1_000_000, 0), (0.0, 0.0));
        assert_eq!(at(1_000, 1_500_000, 250_000), (0.5, 0.25));
        // A sample right after an event repeats the previous measurement.
        assert_eq!(at(1_100, 1_600_000, 250_000), (0.5, 0.25));
        assert_eq!(at(2_000, 1_500_000, 9_250_000), (0.0, 1.0));
    }
}
