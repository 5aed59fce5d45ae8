//! Looks once a second at how large what robots send is, and gives their servants what that costs by the dictionary.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use api::Phase;
use ros::sizes::Seen;
use tokio::time::{Instant, MissedTickBehavior, interval};

use super::Inner;
use super::visits::Visits;
use crate::Error;
use crate::decide::measured::Input;
use crate::lives::handle::Handle;

/// Between two looks.
const LOOK: Duration = Duration::from_secs(1);
/// Where a servant could not be given what its robot's messages cost, it is tried again.
const AGAIN: Duration = Duration::from_secs(10);

/// What is remembered of a servant.
#[derive(Default)]
struct Watched {
    /// When the first message of each input was seen.
    first: HashMap<String, Instant>,
    /// As its terms were made of it.
    known: Vec<Input>,
    refused: Option<Refusal>,
}

/// A servant could not be given what is right for it.
pub(super) struct Refusal {
    at: Instant,
    why: String,
}

impl Refusal {
    /// It is to be tried again.
    pub(super) fn is_due(&self, now: Instant) -> bool {
        now.saturating_duration_since(self.at) >= AGAIN
    }

    /// What is remembered after one more try; a refusal is told unless it says what the one before has said.
    pub(super) fn after(
        before: Option<Refusal>,
        outcome: Result<(), Error>,
        inner: &Inner,
        handle: &Handle,
    ) -> Option<Refusal> {
        match outcome {
            Ok(()) => None,
            Err(error @ Error::NotResized { .. }) => {
                let (at, why) = (Instant::now(), error.to_string());
                if before.is_none_or(|before| before.why != why) {
                    inner.report_not_resized(handle, &error);
                }
                Some(Refusal { at, why })
            }
            // One that ends just now is told of elsewhere.
            Err(error) => {
                tracing::debug!("servant {} stays as it is: {error}", handle.id);
                None
            }
        }
    }
}

/// A servant was to be given what its robot's messages cost.
struct Given {
    handle: Arc<Handle>,
    inputs: Vec<Input>,
    outcome: Result<(), Error>,
}

/// Looks, for ever.
pub(crate) async fn watch(inner: Arc<Inner>) {
    let mut watched: HashMap<String, Watched> = HashMap::new();
    let mut visits = Visits::default();
    let mut looks = interval(LOOK);
    looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        looks.tick().await;
        if inner.is_ending() {
            return;
        }
        for (id, given) in visits.take_over() {
            if let Some(watched) = watched.get_mut(&id) {
                watched.note(given, &inner);
            }
        }
        let handles: Vec<Arc<Handle>> = inner.servants.lock().all.values().cloned().collect();
        watched.retain(|id, _| handles.iter().any(|handle| handle.id == *id));
        for handle in handles {
            if handle.life().phase != Phase::Ready || handle.is_ending() || handle.is_place() {
                continue;
            }
            // Of what nobody wishes for there is nothing to look up.
            let terms = handle.terms();
            if terms.stated.is_empty() && terms.class.is_none() {
                continue;
            }
            if let Some(reach) = handle.reach() {
                let watched = watched.entry(handle.id.clone()).or_default();
                let inputs = watched.look(reach.inputs(), Instant::now());
                if let Some(inputs) = inputs.filter(|_| visits.can_begin(&handle.id)) {
                    let (id, inner) = (handle.id.clone(), Arc::clone(&inner));
                    visits.begin(&id, async move {
                        let outcome = inner.measured(&handle, &inputs).await;
                        Given {
                            handle,
                            inputs,
                            outcome,
                        }
                    });
                }
            }
        }
    }
}

impl Watched {
    /// What was seen, where the servant is to be given what it costs.
    fn look(&mut self, seen: Vec<(String, Seen)>, now: Instant) -> Option<Vec<Input>> {
        let inputs = self.inputs(seen, now);
        let again = self.refused.as_ref().is_some_and(|it| it.is_due(now));
        (self.known != inputs || again).then_some(inputs)
    }

    fn note(&mut self, given: Given, inner: &Inner) {
        let Given {
            handle,
            inputs,
            outcome,
        } = given;
        self.known = inputs;
        self.refused = Refusal::after(self.refused.take(), outcome, inner, &handle);
    }

    /// What was seen, without what changes with each message and says nothing new.
    fn inputs(&mut self, seen: Vec<(String, Seen)>, now: Instant) -> Vec<Input> {
        use crate::decide::measured::{ENOUGH, PATIENCE};
        let seen = seen.into_iter().filter(|(_, seen)| seen.count > 0);
        seen.map(|(name, seen)| {
            let first = *self.first.entry(name.clone()).or_insert(now);
            let known = now.saturating_duration_since(first).min(PATIENCE);
            Input {
                known: match known < PATIENCE {
                    true => Duration::ZERO,
                    false => known,
                },
                seen: Seen {
                    count: seen.count.min(ENOUGH),
                    ..seen
                },
                name,
            }
        })
        .collect()
    }
}
