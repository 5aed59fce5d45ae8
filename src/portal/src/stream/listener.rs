//! What one who listens is told.

use std::collections::HashMap;
use std::sync::Arc;

use access::{Action, Object};
use api::explain::Served;
use api::stream::Update;
use axum::response::sse;
use tokio::sync::watch;

use super::Place;
use super::sampler::{EVENTS, Sample};
use crate::app::App;
use crate::events::is_told;
use crate::guard::Caller;

/// One who listens.
pub struct Listener {
    app: Arc<App>,
    caller: Caller,
    samples: watch::Receiver<Option<Arc<Sample>>>,
    /// What it was told last.
    told: Option<Told>,
    _place: Place,
}

/// What the caller sees of a sample.
struct Told {
    seen: Sample,
    /// The number of the last event that there was.
    event: i64,
}

impl Listener {
    pub fn new(
        app: Arc<App>,
        caller: Caller,
        samples: watch::Receiver<Option<Arc<Sample>>>,
        place: Place,
    ) -> Listener {
        Listener {
            app,
            caller,
            samples,
            told: None,
            _place: place,
        }
    }

    /// What it is told next.
    pub async fn next(&mut self) -> Option<sse::Event> {
        loop {
            // The first is there already where others listen.
            let sample = match &self.told {
                None => self.samples.wait_for(Option::is_some).await.ok()?.clone(),
                Some(_) => {
                    self.samples.changed().await.ok()?;
                    self.samples.borrow_and_update().clone()
                }
            };
            let Some(sample) = sample else { continue };
            let seen = self.seen(&sample);
            let event = sample.events.last().map_or(0, |event| event.id);
            let earlier = self.told.take().filter(|told| !missed(&sample, told.event));
            let name = match earlier {
                Some(_) => "update",
                None => "snapshot",
            };
            let update = update(&seen, earlier.as_ref());
            self.told = Some(Told { seen, event });
            if earlier.is_some() && update == Update::default() {
                continue;
            }
            let update = Update {
                time: store::now(),
                ..update
            };
            match sse::Event::default().event(name).json_data(&update) {
                Ok(event) => return Some(event),
                Err(error) => tracing::error!("what a page is told cannot be written: {error}"),
            }
        }
    }

    /// What the caller sees now: what it may is asked each time, since it may change.
    fn seen(&self, sample: &Sample) -> Sample {
        let (app, caller) = (&*self.app, &self.caller);
        let mut known: HashMap<String, bool> = HashMap::new();
        let mut sees = |service: &str| match known.get(service) {
            Some(sees) => *sees,
            None => {
                let sees = caller.sees(app, service);
                known.insert(service.to_owned(), sees);
                sees
            }
        };
        let all = caller.who.principal.sees_all();
        let is_own = |served: &Arc<Served>| caller.is_robot_of(&served.servant.robot);
        let machine = sample.machine.clone();
        Sample {
            machine: machine.filter(|_| caller.may(Action::Look, &Object::MACHINE).is_ok()),
            services: cloned(&sample.services, |one| sees(&one.name)),
            servants: cloned(&sample.servants, |one| {
                is_own(one) && sees(&one.servant.service)
            }),
            back_offs: match all {
                true => Arc::clone(&sample.back_offs),
                false => {
                    let mut seen = (*sample.back_offs).clone();
                    seen.retain(|one| caller.is_robot_of(&one.robot) && sees(&one.service));
                    Arc::new(seen)
                }
            },
            events: match all {
                true => Arc::clone(&sample.events),
                false => Arc::new(cloned(&sample.events, |event| {
                    is_told(caller, event, &mut sees)
                })),
            },
        }
    }
}

fn cloned<T>(all: &[Arc<T>], mut of: impl FnMut(&Arc<T>) -> bool) -> Vec<Arc<T>> {
    all.iter().filter(|one| of(one)).cloned().collect()
}

/// Whether events between the last that was told and those that are kept are not there any more.
fn missed(sample: &Sample, last: i64) -> bool {
    let first = sample.events.first();
    sample.events.len() >= EVENTS && first.is_some_and(|first| first.id > last + 1)
}

/// What has changed since; all where nothing was told.
fn update(seen: &Sample, told: Option<&Told>) -> Update {
    let nothing = Sample::default();
    let (earlier, last) = told.map_or((&nothing, 0), |told| (&told.seen, told.event));
    let (services, services_gone) = changes(&seen.services, &earlier.services, |one| &one.name);
    let (servants, servants_gone) =
        changes(&seen.servants, &earlier.servants, |one| &one.servant.id);
    let is_new = |now: &Arc<api::stream::Machine>| {
        earlier.machine.as_ref().is_none_or(|then| **then != **now)
    };
    Update {
        time: 0,
        machine: seen.machine.clone().filter(is_new),
        services,
        services_gone,
        servants,
        servants_gone,
        back_offs: (told.is_none() || seen.back_offs != earlier.back_offs)
            .then(|| (*seen.back_offs).clone()),
        events: cloned(&seen.events, |event| event.id > last),
    }
}

/// What is new or has changed, and names of what is not there any more.
fn changes<T>(
    now: &[Arc<T>],
    then: &[Arc<T>],
    name: fn(&T) -> &String,
) -> (Vec<Arc<T>>, Vec<String>) {
    let known: HashMap<&String, &Arc<T>> = then.iter().map(|one| (name(one), one)).collect();
    let is_new = |one: &Arc<T>| {
        known
            .get(name(one))
            .is_none_or(|same| !Arc::ptr_eq(same, one))
    };
    let there: HashMap<&String, ()> = now.iter().map(|one| (name(one), ())).collect();
    let gone = then.iter().map(|one| name(one));
    let gone = gone.filter(|name| !there.contains_key(name)).cloned();
    (cloned(now, is_new), gone.collect())
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

    fn sample(events: std::ops::Range<i64>) -> Sample {
        Sample {
            events: Arc::new(events.map(event).collect()),
            ..Sample::default()
        }
    }

    #[test]
    fn what_is_new_changed_and_gone_is_told() {
        let [a, b, b2, c] = ["a", "b", "b", "c"].map(|name| Arc::new(name.to_owned()));
        let then = [Arc::clone(&a), b];
        let (new, gone) = changes(&[Arc::clone(&b2), Arc::clone(&c)], &then, |name| name);
        assert_eq!((new, gone), (vec![b2, c], vec!["a".to_owned()]));
        let (new, gone) = changes(&then, &then, |name| name);
        assert!(new.is_empty() && gone.is_empty(), "{new:?} {gone:?}");
        drop(a);
    }

    #[test]
    fn events_are_told_once() {
        let told = Told {
            seen: sample(1..4),
            event: 3,
        };
        let ids = |update: Update| {
            update
                .events
                .iter()
                .map(|event| event.id)
                .collect::<Vec<_>>()
        };
        assert_eq!(ids(update(&sample(1..6), Some(&told))), [4, 5]);
        assert_eq!(ids(update(&sample(1..4), None)), [1, 2, 3]);
        assert_eq!(update(&sample(1..4), Some(&told)), Update::default());
    }

    #[test]
    fn who_reads_too_slowly_is_told_all_anew() {
        let kept = EVENTS as i64;
        assert!(!missed(&sample(1..4), 0), "all there ever were");
        assert!(!missed(&sample(4..kept + 4), 3));
        assert!(missed(&sample(5..kept + 5), 3));
    }
}
