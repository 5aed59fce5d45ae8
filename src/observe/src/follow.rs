//! Hears topics of a servant's ROS as they come and go.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use ros::bus::{Bus, Graph, Message, Qos, Subscription, WireType};
use ros::schema::Registry;
use tokio::task::{AbortHandle, JoinSet};

/// Messages of a topic that wait while others are looked at.
const QUEUE: usize = 100;
/// Topics that are heard at most.
const TOPICS: usize = 1000;

/// What is observed.
pub struct Seen {
    /// The servant's ROS.
    pub bus: Arc<dyn Bus>,
    /// Message definitions of its image.
    pub registry: Arc<Registry>,
    /// Dropped when nobody observes any more.
    pub held: Box<dyn Send + Sync>,
}

/// Hears messages.
pub(crate) trait Observer: Send + Sync + 'static {
    /// Whether it hears this topic, whose type is called so.
    fn wants(&self, topic: &str, named: &str) -> bool;
    /// The topic is heard from now on. Its number, by which messages are told; none: it is not heard.
    fn begins(&self, topic: &str, of: WireType) -> Option<u32>;
    /// A message of the topic of this number.
    fn hears(&self, topic: u32, message: Message);
    /// Nobody publishes the topic any more.
    fn ends(&self, topic: &str);
}

/// Keeps an observer hearing until it is dropped.
pub struct Followed(AbortHandle);

impl Drop for Followed {
    fn drop(&mut self) {
        self.0.abort();
    }
}

/// Has `observer` hear what is published on a bus.
pub(crate) fn follow(seen: Seen, observer: Arc<dyn Observer>) -> Followed {
    let task = tokio::spawn(async move {
        let Seen {
            bus,
            registry,
            held,
        } = seen;
        followed(&bus, &registry, &observer).await;
        drop(held);
    });
    Followed(task.abort_handle())
}

async fn followed(bus: &Arc<dyn Bus>, registry: &Arc<Registry>, observer: &Arc<dyn Observer>) {
    let mut graph = bus.graph();
    graph.mark_changed();
    let mut heard: HashMap<String, AbortHandle> = HashMap::new();
    // They end with this.
    let mut tasks = JoinSet::new();
    while graph.changed().await.is_ok() {
        let now = Arc::clone(&graph.borrow_and_update());
        heard.retain(|topic, task| {
            let stays = is_published(&now, bus.node(), topic);
            if !stays {
                task.abort();
                observer.ends(topic);
            }
            stays
        });
        while tasks.try_join_next().is_some() {}
        for (topic, ends) in &now.topics {
            let new = !heard.contains_key(topic) && heard.len() < TOPICS;
            let named = &ends.type_name;
            if new && is_published(&now, bus.node(), topic) && observer.wants(topic, named) {
                let hearing = hear(
                    Arc::clone(bus),
                    Arc::clone(registry),
                    Arc::clone(observer),
                    (topic.clone(), named.clone()),
                );
                heard.insert(topic.clone(), tasks.spawn(hearing));
            }
        }
    }
}

async fn hear(
    bus: Arc<dyn Bus>,
    registry: Arc<Registry>,
    observer: Arc<dyn Observer>,
    (name, named): (String, String),
) {
    let of = match registry.message(&named) {
        Ok(message) => WireType::of(&message),
        // What is not in the image is told by who publishes it.
        Err(_) => match bus.topic_type(&name).await {
            Ok(of) if !of.definition.is_empty() => of,
            _ => return,
        },
    };
    let qos = Qos::keep_last(QUEUE).latching(true);
    let subscription = match bus.subscribe(&name, of.clone(), qos).await {
        Ok(subscription) => subscription,
        Err(error) => {
            tracing::debug!(topic = name, %error, "an observer cannot hear it");
            return;
        }
    };
    let Some(topic) = observer.begins(&name, of) else {
        return;
    };
    // What keeps the subscription is dropped with it.
    let Subscription {
        mut messages,
        guard: _guard,
        ..
    } = subscription;
    while let Some(message) = messages.recv().await {
        observer.hears(topic, message);
    }
}

/// Whether anybody else publishes it.
fn is_published(graph: &Graph, own: &str, topic: &str) -> bool {
    let ends = graph.topics.get(topic);
    ends.is_some_and(|ends| ends.publishers.iter().any(|node| node != own))
}

/// Nanoseconds since 1970.
pub(crate) fn now() -> u64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    now.map_or(0, |since| {
        u64::try_from(since.as_nanos()).unwrap_or(u64::MAX)
    })
}
