//! Outputs of a servant during a replay, and which of them answer requests.

use std::sync::Arc;
use std::time::{Duration, Instant};

use api::trial::Heard;
use bytes::Bytes;
use package::interface::{Direction, Interface, Topic};
use ros::bus::{Bus, QosProfile, Subscription, WireType};
use ros::codec::{JsonOptions, Time, to_json};
use ros::schema::Registry;
use tokio::sync::mpsc;

use super::plan::stamp;
use super::{QUEUE, trial_error};
use crate::Error;

/// Maximum size of a message that is shown.
const MAX_SHOWN_MESSAGE: usize = 2000;

/// All outputs, each received by a task.
pub(super) struct OutputListeners {
    topics: Vec<(Topic, usize, Bytes)>,
    said: mpsc::UnboundedReceiver<(usize, Instant, Bytes)>,
    /// The output whose messages answer requests without a stamp.
    answering: Option<usize>,
    tasks: Vec<tokio::task::AbortHandle>,
}

impl OutputListeners {
    pub(super) async fn open(bus: &Arc<dyn Bus>, interface: &Interface) -> Result<OutputListeners, Error> {
        let (sender, said) = mpsc::unbounded_channel();
        let mut ears = OutputListeners { topics: Vec::new(), said, answering: None, tasks: Vec::new() };
        // Latched outputs are states, not responses.
        let outputs = interface.topics.iter().filter(|topic| topic.direction == Direction::Output && !topic.latched);
        for (number, topic) in outputs.enumerate() {
            let subscription =
                bus.subscribe(&topic.name, WireType::any(), QosProfile::keep_last(QUEUE)).await.map_err(trial_error)?;
            let task = tokio::spawn(listen(number, subscription, sender.clone()));
            ears.tasks.push(task.abort_handle());
            ears.topics.push((topic.clone(), 0, Bytes::new()));
        }
        Ok(ears)
    }

    fn record(&mut self, (number, at, bytes): (usize, Instant, Bytes)) -> Instant {
        let (_, received, last) = &mut self.topics[number];
        *received += 1;
        *last = bytes;
        at
    }

    /// Discards what has arrived, which does not answer later requests.
    pub(super) fn drain(&mut self) {
        while let Ok(said) = self.said.try_recv() {
            self.record(said);
        }
    }

    /// Waits for the response: the first output with the request's stamp, or, if either has none, the next message on
    /// the topic that answered the first request.
    pub(super) async fn wait_answer(
        &mut self,
        patience: Duration,
        asked: Option<Time>,
        registry: &Registry,
    ) -> Option<Instant> {
        let deadline = tokio::time::Instant::now() + patience;
        loop {
            let said = tokio::time::timeout_at(deadline, self.said.recv()).await;
            let (number, at, bytes) = said.ok()??;
            let stamp = stamp(&self.topics[number].0.type_name, &bytes, registry);
            self.record((number, at, bytes));
            let answers = match (asked, stamp) {
                (Some(asked), Some(stamp)) => asked == stamp,
                _ => *self.answering.get_or_insert(number) == number,
            };
            if answers {
                return Some(at);
            }
        }
    }

    pub(super) fn summarize(&mut self, registry: &Registry) -> Vec<Heard> {
        self.drain();
        let shown = |topic: &Topic, last: &Bytes| {
            let of_type = registry.message(&topic.type_name).ok()?;
            let mut json = Vec::new();
            let options = JsonOptions { max_bytes: MAX_SHOWN_MESSAGE, ..JsonOptions::default() };
            to_json(&of_type, last, &mut json, &options).ok()?;
            serde_json::from_slice(&json).ok()
        };
        self.topics
            .iter()
            .map(|(topic, received, last)| Heard {
                topic: topic.name.clone(),
                type_name: topic.type_name.clone(),
                received: *received,
                bytes: last.len(),
                last: (*received > 0).then(|| shown(topic, last)).flatten(),
            })
            .collect()
    }
}

impl Drop for OutputListeners {
    fn drop(&mut self) {
        self.tasks.iter().for_each(|task| task.abort());
    }
}

async fn listen(number: usize, mut subscription: Subscription, said: mpsc::UnboundedSender<(usize, Instant, Bytes)>) {
    while let Some(message) = subscription.messages.recv().await {
        if said.send((number, Instant::now(), message.bytes)).is_err() {
            return;
        }
    }
}
