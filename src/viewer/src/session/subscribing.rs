//! Topics that a viewer subscribes to.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use access::Operation;
use budget::Budget;
use bytes::{BufMut, BytesMut};
use foxglove::ws_protocol::JsonMessage;
use foxglove::ws_protocol::server::Status;
use ros::bus::{QosProfile, Subscription, WireType};
use tokio::sync::mpsc;

use super::{FinishedTask, Session};
use crate::line::ViewerFrame;

/// Limit on one viewer's subscriptions.
const SUBSCRIPTIONS: usize = 512;
/// Minimum interval between two warnings about dropped messages of a topic.
const WARNING_INTERVAL: Duration = Duration::from_secs(5);

/// A subscription of the viewer; unsubscribes when dropped.
pub(super) struct ViewerSubscription {
    pub(super) channel: u64,
    pub(super) topic: String,
    task: tokio::task::AbortHandle,
}

impl Drop for ViewerSubscription {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Session {
    pub(super) fn subscribe(&mut self, id: u32, channel: u64) {
        let Some((topic, of)) = self.catalogue.channel(channel).cloned() else {
            return self.send_error(format!("there is no channel {channel}"));
        };
        if self.subscriptions.contains_key(&id) {
            return self.send_error(format!("subscription {id} already exists"));
        }
        if self.subscriptions.len() >= SUBSCRIPTIONS {
            let words = format!("{topic}: one viewer may have {SUBSCRIPTIONS} subscriptions");
            return self.send_error(words);
        }
        if let Err(refused) = self.granted.check(Operation::Subscribe, &topic) {
            return self.send_error(refused.to_string());
        }
        let (bus, out) = (Arc::clone(&self.bus), self.out.clone());
        let (listened, budget) = (topic.clone(), self.budget.clone());
        let qos = QosProfile::keep_last(self.depth).latching(true);
        let task = self.tasks.spawn(async move {
            match bus.subscribe(&listened, WireType::clone(&of), qos).await {
                Ok(subscription) => {
                    let mut reader = SubscriptionForwarder {
                        id,
                        topic: listened,
                        budget,
                        out,
                        missed: 0,
                        told: (0, Instant::now()),
                    };
                    reader.forward(subscription).await;
                }
                Err(error) => {
                    let words = format!("{listened} cannot be subscribed to: {error}");
                    let _ = out.send(ViewerFrame::Text(Status::error(words).to_string().into())).await;
                }
            }
            FinishedTask::Other
        });
        let subscribed = ViewerSubscription { channel, topic, task };
        self.subscriptions.insert(id, subscribed);
    }
}

/// Forwards the messages of one topic to the viewer.
struct SubscriptionForwarder {
    id: u32,
    topic: String,
    budget: Budget,
    out: mpsc::Sender<ViewerFrame>,
    /// Number of messages dropped because the budget was exhausted.
    missed: u64,
    /// Number of drops last reported to the viewer, and when.
    told: (u64, Instant),
}

impl SubscriptionForwarder {
    /// Forwards messages one by one, each once the viewer has taken the previous ones.
    async fn forward(&mut self, mut subscription: Subscription) {
        while let Some(message) = subscription.messages.recv().await {
            let now = SystemTime::now().duration_since(UNIX_EPOCH);
            let now = now.map_or(0, |since| since.as_nanos() as u64);
            let Ok(permit) = self.budget.take(message.bytes.len()) else {
                self.missed += 1;
                continue;
            };
            let frame = permit.wrap_bytes(encode_message_data(self.id, now, &message.bytes));
            if self.out.send(ViewerFrame::Binary(frame)).await.is_err() {
                return;
            }
            let missed = self.missed + subscription.dropped.get();
            let (told, at) = self.told;
            if missed > told && (told == 0 || at.elapsed() >= WARNING_INTERVAL) {
                self.told = (missed, Instant::now());
                let words = format!(
                    "{}: {missed} messages were dropped, since they arrive faster than they are read",
                    self.topic
                );
                let status = ViewerFrame::Text(Status::warning(words).to_string().into());
                let _ = self.out.send(status).await;
            }
        }
    }
}

fn encode_message_data(id: u32, time: u64, message: &[u8]) -> BytesMut {
    // Opcode of the protocol's MessageData.
    const MESSAGE_DATA: u8 = 1;
    let mut frame = BytesMut::with_capacity(13 + message.len());
    frame.put_u8(MESSAGE_DATA);
    frame.put_u32_le(id);
    frame.put_u64_le(time);
    frame.extend_from_slice(message);
    frame
}
