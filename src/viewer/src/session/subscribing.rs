//! Topics that a viewer subscribes to.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use access::Operation;
use budget::Budget;
use bytes::{BufMut, BytesMut};
use foxglove::ws_protocol::JsonMessage;
use foxglove::ws_protocol::server::Status;
use ros::bus::{Qos, Subscription, WireType};
use tokio::sync::mpsc;

use super::{Ended, Session};
use crate::line::Frame;

/// Of one viewer.
const SUBSCRIPTIONS: usize = 512;
/// Between two words about messages that a topic's reader missed.
const MISSED: Duration = Duration::from_secs(5);

/// A subscription of the viewer's, until dropped.
pub(super) struct Subscribed {
    pub(super) channel: u64,
    pub(super) topic: String,
    task: tokio::task::AbortHandle,
}

impl Drop for Subscribed {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Session {
    pub(super) fn subscribe(&mut self, id: u32, channel: u64) {
        let Some((topic, of)) = self.catalogue.channel(channel).cloned() else {
            return self.complain(format!("there is no channel {channel}"));
        };
        if self.subscriptions.contains_key(&id) {
            return self.complain(format!("subscription {id} is there already"));
        }
        if self.subscriptions.len() >= SUBSCRIPTIONS {
            let words = format!("{topic}: one viewer may have {SUBSCRIPTIONS} subscriptions");
            return self.complain(words);
        }
        if let Err(refused) = self.granted.check(Operation::Subscribe, &topic) {
            return self.complain(refused);
        }
        let (bus, out) = (Arc::clone(&self.bus), self.out.clone());
        let (listened, budget) = (topic.clone(), self.budget.clone());
        let qos = Qos::keep_last(self.depth).latching(true);
        let task = self.tasks.spawn(async move {
            match bus.subscribe(&listened, WireType::clone(&of), qos).await {
                Ok(subscription) => {
                    let mut reader = Reader {
                        id,
                        topic: listened,
                        budget,
                        out,
                        missed: 0,
                        told: (0, Instant::now()),
                    };
                    reader.passes(subscription).await;
                }
                Err(error) => {
                    let words = format!("{listened} cannot be subscribed to: {error}");
                    let _ = out
                        .send(Frame::Text(Status::error(words).to_string().into()))
                        .await;
                }
            }
            Ended::Other
        });
        let subscribed = Subscribed {
            channel,
            topic,
            task,
        };
        self.subscriptions.insert(id, subscribed);
    }
}

/// One topic on its way to the viewer.
struct Reader {
    id: u32,
    topic: String,
    budget: Budget,
    out: mpsc::Sender<Frame>,
    /// Messages for which there was no room in the budget.
    missed: u64,
    /// How many it was told to have missed, and when.
    told: (u64, Instant),
}

impl Reader {
    /// Passes messages on, each when the viewer has taken those before.
    async fn passes(&mut self, mut subscription: Subscription) {
        while let Some(message) = subscription.messages.recv().await {
            let now = SystemTime::now().duration_since(UNIX_EPOCH);
            let now = now.map_or(0, |since| since.as_nanos() as u64);
            let Ok(permit) = self.budget.take(message.bytes.len()) else {
                self.missed += 1;
                continue;
            };
            let frame = permit.around(framed(self.id, now, &message.bytes));
            if self.out.send(Frame::Binary(frame)).await.is_err() {
                return;
            }
            let missed = self.missed + subscription.dropped.get();
            let (told, at) = self.told;
            if missed > told && (told == 0 || at.elapsed() >= MISSED) {
                self.told = (missed, Instant::now());
                let words = format!(
                    "{}: {missed} messages were left out, since they come faster than they are read",
                    self.topic
                );
                let status = Frame::Text(Status::warning(words).to_string().into());
                let _ = self.out.send(status).await;
            }
        }
    }
}

fn framed(id: u32, time: u64, message: &[u8]) -> BytesMut {
    // The operation's code in the protocol.
    const MESSAGE_DATA: u8 = 1;
    let mut frame = BytesMut::with_capacity(13 + message.len());
    frame.put_u8(MESSAGE_DATA);
    frame.put_u32_le(id);
    frame.put_u64_le(time);
    frame.extend_from_slice(message);
    frame
}
