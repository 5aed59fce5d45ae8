//! Looks at the machine, the services and the servants.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use api::explain::Served;
use api::stream::Machine;
use api::{BackOff, Event, ServiceSummary};
use choreographer::Handle;
use tokio::time::Instant;

use crate::app::App;
use crate::errors::Error;
use crate::{explain, views};

/// Between two looks while nothing happens.
const PERIOD: Duration = Duration::from_secs(1);
/// After an event: others follow it, and what it tells of is done.
const SOON: Duration = Duration::from_millis(100);
/// Over less, processor time says little.
const MEASURED: Duration = Duration::from_millis(900);
/// Events that are kept for who listens.
pub const EVENTS: usize = 500;

/// All that is so. What has not changed since the sample before is the same allocation.
#[derive(Default)]
pub struct Sample {
    pub machine: Option<Arc<Machine>>,
    pub services: Vec<Arc<ServiceSummary>>,
    pub servants: Vec<Arc<Served>>,
    pub back_offs: Arc<Vec<BackOff>>,
    /// The newest, oldest first.
    pub events: Arc<Vec<Arc<Event>>>,
}

/// Processor time at a moment, and what was used before it.
#[derive(Clone, Copy)]
struct Measured {
    at: Instant,
    cpu_usec: u64,
    throttled_usec: u64,
    cores: f64,
    throttled: f64,
}

/// Takes samples until nobody listens or the daemon ends.
pub async fn run(app: Arc<App>) {
    let mut happened = app.state.watch_events();
    let mut earlier = Arc::new(Sample::default());
    let mut measured = HashMap::new();
    loop {
        happened.borrow_and_update();
        match take(&app, &earlier, &mut measured).await {
            Ok(sample) => {
                earlier = Arc::new(sample);
                app.live.newest.send_replace(Some(Arc::clone(&earlier)));
            }
            // The database cannot be read now; who listens sees that nothing comes.
            Err(error) => tracing::warn!("pages are not told what is so: {error}"),
        }
        let news = async {
            let _ = happened.changed().await;
            tokio::time::sleep(SOON).await;
        };
        tokio::select! {
            () = news => {}
            () = tokio::time::sleep(PERIOD) => {}
            () = app.live.newest.closed() => {}
            () = app.ending.cancelled() => return,
        }
        if app.live.rests() {
            return;
        }
    }
}

async fn take(
    app: &App,
    earlier: &Sample,
    measured: &mut HashMap<String, Measured>,
) -> Result<Sample, Error> {
    let handles = app.choreographer.servants();
    let looks = handles.iter().map(|handle| served(app, handle));
    let mut servants = futures_util::future::join_all(looks).await;
    let now = Instant::now();
    measured.retain(|id, _| servants.iter().any(|one| one.servant.id == *id));
    for servant in &mut servants {
        measure(servant, measured, now);
    }
    // The sum of none would be -0.
    let cores = servants.iter().fold(0.0, |sum, one| sum + one.cores);
    let mut services = Vec::new();
    for name in app.state.service_names()? {
        if let Some(revision) = app.state.current(&name)? {
            services.push(views::summary(app, &revision));
        }
    }
    let back_offs = app.choreographer.back_offs();
    Ok(Sample {
        machine: Some(Arc::new(machine(app, cores).await?)),
        services: kept(services, &earlier.services, |service| &service.name),
        servants: kept(servants, &earlier.servants, |served| &served.servant.id),
        back_offs: match *earlier.back_offs == back_offs {
            true => Arc::clone(&earlier.back_offs),
            false => Arc::new(back_offs),
        },
        events: events(app, &earlier.events)?,
    })
}

async fn served(app: &App, handle: &Handle) -> Served {
    Served {
        servant: app.choreographer.describe(handle).await,
        throttled: 0.0,
        cores: 0.0,
        links: explain::links(handle),
    }
}

/// Says what a servant has used since it was measured last.
fn measure(served: &mut Served, measured: &mut HashMap<String, Measured>, now: Instant) {
    let Some(usage) = &served.servant.usage else {
        measured.remove(&served.servant.id);
        return;
    };
    let new = Measured {
        at: now,
        cpu_usec: usage.cpu_usec,
        throttled_usec: usage.throttled_usec,
        cores: 0.0,
        throttled: 0.0,
    };
    let last = measured.entry(served.servant.id.clone()).or_insert(new);
    let passed = now.duration_since(last.at);
    if passed >= MEASURED {
        let share =
            |now: u64, then: u64| now.saturating_sub(then) as f64 / passed.as_micros() as f64;
        *last = Measured {
            cores: share(new.cpu_usec, last.cpu_usec),
            throttled: share(new.throttled_usec, last.throttled_usec).min(1.0),
            ..new
        };
    }
    served.cores = last.cores;
    served.throttled = last.throttled;
}

async fn machine(app: &App, cores: f64) -> Result<Machine, Error> {
    Ok(Machine {
        status: views::status(app).await?,
        cores,
        host_cores: std::thread::available_parallelism().map_or(1, usize::from),
        host_memory: servant::host::memory(),
        host_memory_available: servant::host::memory_available(),
    })
}

/// What is new, as the earlier allocation where it is equal.
fn kept<T: PartialEq>(new: Vec<T>, earlier: &[Arc<T>], name: fn(&T) -> &String) -> Vec<Arc<T>> {
    let earlier: HashMap<&String, &Arc<T>> = earlier.iter().map(|one| (name(one), one)).collect();
    let keep = |one: T| match earlier.get(name(&one)) {
        Some(same) if ***same == one => Arc::clone(same),
        _ => Arc::new(one),
    };
    new.into_iter().map(keep).collect()
}

/// The newest events, with those that are new.
fn events(app: &App, earlier: &Arc<Vec<Arc<Event>>>) -> Result<Arc<Vec<Arc<Event>>>, Error> {
    let since = earlier.last().map_or(0, |event| event.id);
    if since > 0 && *app.state.watch_events().borrow() <= since {
        return Ok(Arc::clone(earlier));
    }
    let new = app.state.events(since, EVENTS as u32)?;
    let mut all: Vec<_> = earlier
        .iter()
        .cloned()
        .chain(new.into_iter().map(Arc::new))
        .collect();
    let beyond = all.len().saturating_sub(EVENTS);
    Ok(Arc::new(all.split_off(beyond)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn served(cpu_usec: u64, throttled_usec: u64) -> Served {
        let usage = api::Usage {
            cpu_usec,
            throttled_usec,
            ..api::Usage::default()
        };
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
            let mut servant = served(cpu, throttled);
            measure(
                &mut servant,
                &mut measured,
                start + Duration::from_millis(after),
            );
            (servant.cores, servant.throttled)
        };
        assert_eq!(at(0, 1_000_000, 0), (0.0, 0.0));
        assert_eq!(at(1_000, 1_500_000, 250_000), (0.5, 0.25));
        // A look right after an event tells what was measured before.
        assert_eq!(at(1_100, 1_600_000, 250_000), (0.5, 0.25));
        assert_eq!(at(2_000, 1_500_000, 9_250_000), (0.0, 1.0));
    }

    #[test]
    fn what_has_not_changed_is_the_same() {
        let earlier = kept(vec![served(1, 0)], &[], |one| &one.servant.id);
        let same = kept(vec![served(1, 0)], &earlier, |one| &one.servant.id);
        assert!(Arc::ptr_eq(&earlier[0], &same[0]));
        let other = kept(vec![served(2, 0)], &earlier, |one| &one.servant.id);
        assert!(!Arc::ptr_eq(&earlier[0], &other[0]));
    }
}
