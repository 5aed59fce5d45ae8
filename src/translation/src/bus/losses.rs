//! Losses between the two ROS versions: messages that cannot be carried, and values that the other version cannot
//! represent. Both are counted, and the first of each is reported.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use parking_lot::Mutex;
use tokio::time::Instant;

use crate::MessageTranslator;
use crate::TranslationError;

/// Maximum number of topics and services that are counted; a robot can name any number.
const MAX_NAMES: usize = 1000;

/// Time after which another failure of a service is reported. A caller may repeat its call as fast as it fails.
const AGAIN: Duration = Duration::from_secs(1);

/// Receives what a translated bus reports to its robot.
pub trait TranslationObserver: Send + Sync + 'static {
    /// Called with a text for people when something of a topic or service is lost for the first time, and whenever a
    /// service fails whose caller cannot be told, though not more often than once a second for each.
    fn on_loss(&self, name: &str, text: &str);
}

/// Losses of one topic or service so far.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TranslationLosses {
    /// Name of the topic or service.
    pub name: String,
    /// Number of messages, requests and responses that were not carried.
    pub untranslated: u64,
    /// Number of values that were replaced by the nearest ones.
    pub saturated: u64,
}

/// Counters by topic and service.
pub(super) struct LossCounters {
    observer: Arc<dyn TranslationObserver>,
    counts: Mutex<BTreeMap<String, TranslationLosses>>,
    /// Services that failed, and when this was last reported.
    failed: Mutex<HashMap<String, Instant>>,
}

impl LossCounters {
    pub(super) fn new(observer: Arc<dyn TranslationObserver>) -> Self {
        Self { observer, counts: Mutex::default(), failed: Mutex::default() }
    }

    /// Translates a message of a topic or service, and counts what is lost.
    pub(super) fn translate(
        &self,
        name: &str,
        by: &MessageTranslator,
        message: &[u8],
    ) -> Result<Bytes, TranslationError> {
        let before = by.saturated_count();
        let translated = by.translate(message);
        let replaced = by.saturated_count().saturating_sub(before);
        if replaced > 0 && self.count(name, |counts| &mut counts.saturated, replaced) {
            let text = format!(
                "{name}: values that the other ROS cannot represent are replaced by the nearest ones, such as times \
                 before 1970 or after 2038; they are counted"
            );
            self.observer.on_loss(name, &text);
        }
        if let Err(error) = &translated {
            self.record_untranslated(name, error);
        }
        translated
    }

    /// Counts a message that is not carried for this reason.
    pub(super) fn record_untranslated(&self, name: &str, reason: impl std::fmt::Display) {
        if self.count(name, |counts| &mut counts.untranslated, 1) {
            let text =
                format!("{name}: a message is not carried to the other ROS: {reason}; further ones are only counted");
            self.observer.on_loss(name, &text);
        }
    }

    /// Reports a failed call whose caller gets a default response, unless one was reported a moment ago.
    pub(super) fn report_failed_call(&self, service: &str, reason: &str) {
        if !self.is_due(service) {
            return;
        }
        tracing::warn!(service, reason, "a call has failed; its caller of ROS 2 gets the default response");
        let text = format!(
            "{service} has failed: {reason}; its caller gets the default response, because calls of ROS 2 cannot fail"
        );
        self.observer.on_loss(service, &text);
    }

    /// Reports what a service has refused where its response has no place for it, unless that was done a moment ago.
    pub(super) fn report_refusal(&self, service: &str, text: &str) {
        if self.is_due(service) {
            self.observer.on_loss(service, text);
        }
    }

    /// Returns whether a failure of this service is to be reported now, which counts as done.
    fn is_due(&self, service: &str) -> bool {
        let mut failed = self.failed.lock();
        if failed.get(service).is_some_and(|before| before.elapsed() < AGAIN) {
            return false;
        }
        if failed.len() >= MAX_NAMES {
            failed.retain(|_, before| before.elapsed() < AGAIN);
        }
        // A flood of names is not reported further.
        let has_room = failed.len() < MAX_NAMES;
        if has_room {
            failed.insert(service.to_owned(), Instant::now());
        }
        has_room
    }

    /// Reports something that the robot's ROS has no field for.
    pub(super) fn report(&self, name: &str, text: &str) {
        self.observer.on_loss(name, text);
    }

    /// Adds to a counter; returns whether that was the first loss of its kind.
    fn count(&self, name: &str, of: impl Fn(&mut TranslationLosses) -> &mut u64, more: u64) -> bool {
        let mut counts = self.counts.lock();
        if counts.len() >= MAX_NAMES && !counts.contains_key(name) {
            return false;
        }
        let known = counts.entry(name.to_owned());
        let known =
            known.or_insert_with(|| TranslationLosses { name: name.to_owned(), ..TranslationLosses::default() });
        let counter = of(known);
        let before = std::mem::replace(counter, counter.saturating_add(more));
        before == 0
    }

    /// Returns all counts.
    pub(super) fn all(&self) -> Vec<TranslationLosses> {
        self.counts.lock().values().cloned().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Default)]
    struct Recorded(Mutex<Vec<(String, String)>>);

    impl TranslationObserver for Recorded {
        fn on_loss(&self, name: &str, text: &str) {
            self.0.lock().push((name.to_owned(), text.to_owned()));
        }
    }

    #[tokio::test(start_paused = true)]
    async fn a_service_that_fails_all_the_time_is_reported_now_and_then() {
        let recorded = Arc::new(Recorded::default());
        let losses = LossCounters::new(Arc::clone(&recorded) as _);
        for _ in 0..3 {
            for _ in 0..100 {
                losses.report_failed_call("/reset", "it is busy");
                losses.report_failed_call("/start", "it is busy");
            }
            tokio::time::advance(AGAIN).await;
        }
        assert_eq!(recorded.0.lock().len(), 6);
        (0..2 * MAX_NAMES).for_each(|number| losses.report_failed_call(&format!("/{number}"), "it is busy"));
        assert!(recorded.0.lock().len() <= 6 + MAX_NAMES && losses.failed.lock().len() <= MAX_NAMES);
    }

    #[test]
    fn each_topic_is_reported_once_and_counted_and_no_number_of_them_takes_more_memory() {
        let recorded = Arc::new(Recorded::default());
        let losses = LossCounters::new(Arc::clone(&recorded) as _);
        for _ in 0..3 {
            losses.record_untranslated("/map", "no such field");
        }
        assert_eq!(losses.all()[0].untranslated, 3);
        let reported = recorded.0.lock().clone();
        assert!(matches!(&reported[..], [(name, text)] if name == "/map" && text.contains("no such field")));
        for number in 0..2 * MAX_NAMES {
            losses.record_untranslated(&format!("/{number}"), "it is another");
        }
        assert_eq!(losses.all().len(), MAX_NAMES);
        assert_eq!(recorded.0.lock().len(), MAX_NAMES);
    }
}
