//! Listener of the live updates.

use std::collections::HashMap;
use std::sync::Arc;

use access::{AccessAction, AccessObject};
use api::explain::Served;
use api::stream::Update;
use axum::response::sse;
use tokio::sync::watch;

use super::live::StateSample;
use super::sampler::EVENTS;
use crate::app::App;
use crate::caller::Caller;
use crate::events::is_visible;
use crate::slots::Slot;

/// A listener.
pub struct Listener {
    app: Arc<App>,
    caller: Caller,
    samples: watch::Receiver<Option<Arc<StateSample>>>,
    /// State last sent.
    told: Option<LastSent>,
    _place: Slot<String>,
}

/// The part of a sample that was sent.
struct LastSent {
    seen: StateSample,
    /// Number of the latest event at that time.
    event: i64,
}

impl Listener {
    pub fn new(
        app: Arc<App>,
        caller: Caller,
        samples: watch::Receiver<Option<Arc<StateSample>>>,
        place: Slot<String>,
    ) -> Listener {
        Listener { app, caller, samples, told: None, _place: place }
    }

    /// Waits for the next update.
    pub async fn next(&mut self) -> Option<sse::Event> {
        loop {
            // If others listen, a first sample is already there.
            let sample = match &self.told {
                None => self.samples.wait_for(Option::is_some).await.ok()?.clone(),
                Some(_) => {
                    self.samples.changed().await.ok()?;
                    self.samples.borrow_and_update().clone()
                }
            };
            let Some(sample) = sample else { continue };
            let seen = self.visible_sample(&sample);
            let event = sample.events.last().map_or(0, |event| event.id);
            let earlier = self.told.take().filter(|told| !has_missed_events(&sample, told.event));
            let name = match earlier {
                Some(_) => "update",
                None => "snapshot",
            };
            let update = compute_update(&seen, earlier.as_ref());
            self.told = Some(LastSent { seen, event });
            if earlier.is_some() && update == Update::default() {
                continue;
            }
            let update = Update { time: store::now(), ..update };
            match sse::Event::default().event(name).json_data(&update) {
                Ok(event) => return Some(event),
                Err(error) => tracing::error!("an update for a page cannot be serialized: {error}"),
            }
        }
    }

    /// Returns the part of the sample that the caller may see now; permissions are checked each time because they may
    /// change.
    fn visible_sample(&self, sample: &StateSample) -> StateSample {
        let (app, caller) = (&*self.app, &self.caller);
        let mut known: HashMap<String, bool> = HashMap::new();
        let mut sees = |service: &str| match known.get(service) {
            Some(sees) => *sees,
            None => {
                let sees = caller.can_see(app, service);
                known.insert(service.to_owned(), sees);
                sees
            }
        };
        let all = caller.who.principal.sees_all();
        let is_own = |served: &Arc<Served>| caller.can_act_for_robot(&served.servant.robot);
        let machine = sample.machine.clone();
        StateSample {
            machine: machine.filter(|_| caller.check_access(AccessAction::Look, &AccessObject::MACHINE).is_ok()),
            services: filter_cloned(&sample.services, |one| sees(&one.name)),
            servants: filter_cloned(&sample.servants, |one| is_own(one) && sees(&one.servant.service)),
            back_offs: if all {
                Arc::clone(&sample.back_offs)
            } else {
                let mut seen = (*sample.back_offs).clone();
                seen.retain(|one| caller.can_act_for_robot(&one.robot) && sees(&one.service));
                Arc::new(seen)
            },
            events: if all {
                Arc::clone(&sample.events)
            } else {
                Arc::new(filter_cloned(&sample.events, |event| is_visible(caller, event, &mut sees)))
            },
        }
    }
}

fn filter_cloned<T>(all: &[Arc<T>], mut of: impl FnMut(&Arc<T>) -> bool) -> Vec<Arc<T>> {
    all.iter().filter(|one| of(one)).cloned().collect()
}

/// Returns true if events after `last` are no longer kept.
fn has_missed_events(sample: &StateSample, last: i64) -> bool {
    let first = sample.events.first();
    sample.events.len() >= EVENTS && first.is_some_and(|first| first.id > last + 1)
}

/// Computes the changes since the last update, or everything if there was none.
fn compute_update(seen: &StateSample, told: Option<&LastSent>) -> Update {
    let nothing = StateSample::default();
    let (earlier, last) = told.map_or((&nothing, 0), |told| (&told.seen, told.event));
    let (services, services_gone) = diff(&seen.services, &earlier.services, |one| &one.name);
    let (servants, servants_gone) = diff(&seen.servants, &earlier.servants, |one| &one.servant.id);
    let is_new = |now: &Arc<api::stream::Machine>| earlier.machine.as_ref().is_none_or(|then| **then != **now);
    Update {
        time: 0,
        machine: seen.machine.clone().filter(is_new),
        services,
        services_gone,
        servants,
        servants_gone,
        back_offs: (told.is_none() || seen.back_offs != earlier.back_offs).then(|| (*seen.back_offs).clone()),
        events: filter_cloned(&seen.events, |event| event.id > last),
    }
}

/// Returns new or changed items, and the names of those that have disappeared.
fn diff<T>(now: &[Arc<T>], then: &[Arc<T>], name: fn(&T) -> &String) -> (Vec<Arc<T>>, Vec<String>) {
    let known: HashMap<&String, &Arc<T>> = then.iter().map(|one| (name(one), one)).collect();
    let is_new = |one: &Arc<T>| known.get(name(one)).is_none_or(|same| !Arc::ptr_eq(same, one));
    let there: HashMap<&String, ()> = now.iter().map(|one| (name(one), ())).collect();
    let gone = then.iter().map(|one| name(one));
    let gone = gone.filter(|name| !there.contains_key(name)).cloned();
    (filter_cloned(now, is_new), gone.collect())
}

#[cfg(test)]
mod tests {
    use api::Event;

    use super::*;

    fn event(id: i64) -> Arc<Event> {
        Arc::new(Event {
            id,
            time: 0,
            level: api::Level::Info,
            kind: "test".into(),
            service: None,
            servant: None,
            robot: None,
            message: String::new(),
        })
    }

    fn sample(events: std::ops::Range<i64>) -> StateSample {
        StateSample { events: Arc::new(events.map(event).collect()), ..StateSample::default() }
    }

    #[test]
    fn what_is_new_changed_and_gone_is_told() {
        let [a, b, b2, c] = ["a", "b", "b", "c"].map(|name| Arc::new(name.to_owned()));
        let then = [Arc::clone(&a), b];
        let (new, gone) = diff(&[Arc::clone(&b2), Arc::clone(&c)], &then, |name| name);
        assert_eq!((new, gone), (vec![b2, c], vec!["a".to_owned()]));
        let (new, gone) = diff(&then, &then, |name| name);
        assert!(new.is_empty() && gone.is_empty(), "{new:?} {gone:?}");
        drop(a);
    }

    #[test]
    fn events_are_told_once() {
        let told = LastSent { seen: sample(1..4), event: 3 };
        let ids = |update: Update| update.events.iter().map(|event| event.id).collect::<Vec<_>>();
        assert_eq!(ids(compute_update(&sample(1..6), Some(&told))), [4, 5]);
        assert_eq!(ids(compute_update(&sample(1..4), None)), [1, 2, 3]);
        assert_eq!(compute_update(&sample(1..4), Some(&told)), Update::default());
    }

    #[test]
    fn who_reads_too_slowly_is_told_all_anew() {
        let kept = EVENTS as i64;
        assert!(!has_missed_events(&sample(1..4), 0), "all there ever were");
        assert!(!has_missed_events(&sample(4..kept + 4), 3));
        assert!(has_missed_events(&sample(5..kept + 5), 3));
    }
}
