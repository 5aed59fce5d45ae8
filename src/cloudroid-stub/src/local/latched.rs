//! Keeps the messages that the robot's publishers have latched, for the local original. Each publisher gets an advertisement of
//! its own in the private ROS system, so that a process that starts later gets all of them.

use std::collections::HashMap;
use std::sync::Arc;

use ros::bus::{AdvertiseOptions, Bus, Message, Publisher};
use tokio::sync::mpsc;
use tokio::task::AbortHandle;

use super::place::Place;

/// Messages kept for a process that is slow; a newcomer is given the last one of each publisher.
const QUEUE: usize = 16;

/// A handle; the advertisements end with it.
pub struct Latched {
    orders: mpsc::UnboundedSender<Order>,
    task: AbortHandle,
}

enum Order {
    Keep(Arc<str>, Message),
    Forget(Arc<str>, Arc<str>),
}

impl Drop for Latched {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Latched {
    pub fn begin(place: &Arc<Place>) -> Self {
        let (orders, taken) = mpsc::unbounded_channel();
        let task = tokio::spawn(serve(place.clone(), taken)).abort_handle();
        Self { orders, task }
    }

    /// Keeps a message of a publisher that latches.
    pub fn keep(&self, topic: &Arc<str>, message: &Message) {
        let order = Order::Keep(topic.clone(), message.clone());
        let _ = self.orders.send(order);
    }

    /// The publisher has unregistered or ended.
    pub fn forget(&self, topic: &Arc<str>, publisher: &Arc<str>) {
        let order = Order::Forget(topic.clone(), publisher.clone());
        let _ = self.orders.send(order);
    }
}

/// By topic and publisher: the MD5 of its type, and who repeats it here.
type Repeated = HashMap<(Arc<str>, Arc<str>), (String, Box<dyn Publisher>)>;

/// Handles requests one after the other; only a publisher's first message takes time, for its advertisement.
async fn serve(place: Arc<Place>, mut orders: mpsc::UnboundedReceiver<Order>) {
    let mut all = Repeated::new();
    while let Some(order) = orders.recv().await {
        let (topic, message) = match order {
            Order::Keep(topic, message) => (topic, message),
            Order::Forget(topic, publisher) => {
                all.remove(&(topic, publisher));
                continue;
            }
        };
        let md5 = &message.wire_type.md5;
        let key = (topic.clone(), message.publisher.clone());
        if let Some((_, publisher)) = all.get(&key).filter(|(known, _)| known == md5) {
            publisher.publish(message.bytes);
            continue;
        }
        let options = AdvertiseOptions {
            wire_type: (*message.wire_type).clone(),
            latch: true,
            queue: QUEUE,
        };
        match place.bus().advertise(&topic, options).await {
            Ok(publisher) => {
                publisher.publish(message.bytes);
                all.insert(key, (md5.clone(), publisher));
            }
            Err(error) => {
                tracing::warn!(%topic, %error, "the local original is not given what is latched there");
            }
        }
    }
}
