//! Samples the message sizes of robots once per second, and applies the dictionary's rows for them to their servants.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use api::Phase;
use ros::sizes::SizeSummary;
use tokio::time::{Instant, MissedTickBehavior, interval};

use super::ChoreographerInner;
use super::visits::Visits;
use crate::Error;
use crate::decide::measured::MeasuredInput;
use crate::lives::handle::Handle;

/// Interval between two rounds.
const LOOK: Duration = Duration::from_secs(1);
/// Interval between attempts to apply the rows to a servant.
const AGAIN: Duration = Duration::from_secs(10);

/// State about one servant.
#[derive(Default)]
struct InputWatch {
    /// Time of the first message by input.
    first: HashMap<String, Instant>,
    /// The inputs from which its terms were derived.
    known: Vec<MeasuredInput>,
    refused: Option<ResizeRefusal>,
}

/// A refused change of a servant's limits.
pub(super) struct ResizeRefusal {
    at: Instant,
    why: String,
}

impl ResizeRefusal {
    /// Returns true if the change is to be tried again.
    pub(super) fn is_due(&self, now: Instant) -> bool {
        now.saturating_duration_since(self.at) >= AGAIN
    }

    /// Returns the state after another attempt; a refusal is reported unless it equals the previous one.
    pub(super) fn from_outcome(
        before: Option<ResizeRefusal>,
        outcome: Result<(), Error>,
        inner: &ChoreographerInner,
        handle: &Handle,
    ) -> Option<ResizeRefusal> {
        match outcome {
            Ok(()) => None,
            Err(error @ Error::NotResized { .. }) => {
                let (at, why) = (Instant::now(), error.to_string());
                if before.is_none_or(|before| before.why != why) {
                    inner.report_not_resized(handle, &error);
                }
                Some(ResizeRefusal { at, why })
            }
            // A servant that is ending is reported elsewhere.
            Err(error) => {
                tracing::debug!("servant {} is unchanged: {error}", handle.id);
                None
            }
        }
    }
}

/// Result of applying the measured sizes to a servant.
struct ResizeOutcome {
    handle: Arc<Handle>,
    inputs: Vec<MeasuredInput>,
    outcome: Result<(), Error>,
}

/// Runs the watch until the daemon ends.
pub(crate) async fn watch(inner: Arc<ChoreographerInner>) {
    let mut watched: HashMap<String, InputWatch> = HashMap::new();
    let mut visits = Visits::default();
    let mut looks = interval(LOOK);
    looks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        looks.tick().await;
        if inner.is_ending() {
            return;
        }
        for (id, given) in visits.take_finished() {
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
            // Without goals there is nothing to look up.
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
                        let outcome = inner.apply_measured(&handle, &inputs).await;
                        ResizeOutcome { handle, inputs, outcome }
                    });
                }
            }
        }
    }
}

impl InputWatch {
    /// Returns the measured inputs if they are to be applied to the servant.
    fn look(&mut self, seen: Vec<(String, SizeSummary)>, now: Instant) -> Option<Vec<MeasuredInput>> {
        let inputs = self.inputs(seen, now);
        let again = self.refused.as_ref().is_some_and(|it| it.is_due(now));
        (self.known != inputs || again).then_some(inputs)
    }

    fn note(&mut self, given: ResizeOutcome, inner: &ChoreographerInner) {
        let ResizeOutcome { handle, inputs, outcome } = given;
        self.known = inputs;
        self.refused = ResizeRefusal::from_outcome(self.refused.take(), outcome, inner, &handle);
    }

    /// Returns the measured inputs, without values that change with each message and carry no news.
    fn inputs(&mut self, seen: Vec<(String, SizeSummary)>, now: Instant) -> Vec<MeasuredInput> {
        use crate::decide::measured::{MIN_MESSAGES, PATIENCE};
        let seen = seen.into_iter().filter(|(_, seen)| seen.count > 0);
        seen.map(|(name, seen)| {
            let first = *self.first.entry(name.clone()).or_insert(now);
            let known = now.saturating_duration_since(first).min(PATIENCE);
            MeasuredInput {
                known: if known < PATIENCE { Duration::ZERO } else { known },
                seen: SizeSummary { count: seen.count.min(MIN_MESSAGES), ..seen },
                name,
            }
        })
        .collect()
    }
}
