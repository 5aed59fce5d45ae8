//! The outputs of a servant that is given recorded requests, and which of them answer what.

use std::sync::Arc;
use std::time::{Duration, Instant};

use api::trial::Heard;
use bytes::Bytes;
use package::interface::{Direction, Interface, Topic};
use ros::bus::{Bus, Qos, Subscription, WireType};
use ros::codec::{JsonOptions, Time, to_json};
use ros::schema::Registry;
use tokio::sync::mpsc;

use super::plan::stamp;
use super::{QUEUE, failed};
use crate::Error;

/// Longer messages are not shown.
const LONGEST_SHOWN: usize = 2000;

/// All outputs, each heard by a task.
pub(super) struct Ears {
    topics: Vec<(Topic, usize, Bytes)>,
    said: mpsc::UnboundedReceiver<(usize, Instant, Bytes)>,
    /// The output whose messages answer requests that have no stamp.
    answering: Option<usize>,
    tasks: Vec<tokio::task::AbortHandle>,
}

impl Ears {
    pub(super) async fn open(bus: &Arc<dyn Bus>, interface: &Interface) -> Result<Ears, Error> {
        let (sender, said) = mpsc::unbounded_channel();
        let mut ears = Ears {
            topics: Vec::new(),
            said,
            answering: None,
            tasks: Vec::new(),
        };
        // Latched outputs tell a state; they answer nothing.
        let outputs = interface
            .topics
            .iter()
            .filter(|topic| topic.direction == Direction::Output && !topic.latched);
        for (number, topic) in outputs.enumerate() {
            let subscription = bus
                .subscribe(&topic.name, WireType::any(), Qos::keep_last(QUEUE))
                .await
                .map_err(failed)?;
            let task = tokio::spawn(listen(number, subscription, sender.clone()));
            ears.tasks.push(task.abort_handle());
            ears.topics.push((topic.clone(), 0, Bytes::new()));
        }
        Ok(ears)
    }

    fn note(&mut self, (number, at, bytes): (usize, Instant, Bytes)) -> Instant {
        let (_, received, last) = &mut self.topics[number];
        *received += 1;
        *last = bytes;
        at
    }

    /// What came by now answers nothing that is asked from now on.
    pub(super) fn forget(&mut self) {
        while let Ok(said) = self.said.try_recv() {
            self.note(said);
        }
    }

    /// When the answer came: the first output with the request's stamp, or, where either has none, the next on the
    /// topic that answered the first request.
    pub(super) async fn answer(
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
            self.note((number, at, bytes));
            let answers = match (asked, stamp) {
                (Some(asked), Some(stamp)) => asked == stamp,
                _ => *self.answering.get_or_insert(number) == number,
            };
            if answers {
                return Some(at);
            }
        }
    }

    pub(super) fn heard(&mut self, registry: &Registry) -> Vec<Heard> {
        self.forget();
        let shown = |topic: &Topic, last: &Bytes| {
            let of_type = registry.message(&topic.type_name).ok()?;
            let mut json = Vec::new();
            let options = JsonOptions {
                max_bytes: LONGEST_SHOWN,
                ..JsonOptions::default()
            };
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

impl Drop for Ears {
    fn drop(&mut self) {
        self.tasks.iter().for_each(|task| task.abort());
    }
}

async fn listen(
    number: usize,
    mut subscription: Subscription,
    said: mpsc::UnboundedSender<(usize, Instant, Bytes)>,
) {
    while let Some(message) = subscription.messages.recv().await {
        if said.send((number, Instant::now(), message.bytes)).is_err() {
            return;
        }
    }
}
