//! Subscribes an observer to a servant's topics as they come and go.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use ros::bus::{Bus, Graph, QosProfile, SerializedMessage, Subscription, WireType};
use ros::schema::Registry;
use tokio::task::{AbortHandle, JoinSet};

/// Queue size of a topic while the observer handles others.
const QUEUE: usize = 100;
/// Limit on the observed topics.
const TOPICS: usize = 1000;

/// A servant to observe.
pub struct ObservedServant {
    /// The servant's ROS bus.
    pub bus: Arc<dyn Bus>,
    /// Message definitions of its image.
    pub registry: Arc<Registry>,
    /// Guard, dropped when the observation ends.
    pub held: Box<dyn Send + Sync>,
}

/// Receives the messages of a servant's topics.
pub(crate) trait Observer: Send + Sync + 'static {
    /// Returns true if the topic, whose type is `named`, should be observed.
    fn wants_topic(&self, topic: &str, named: &str) -> bool;
    /// Called when observation of the topic starts. Returns the id under which its messages are delivered, or `None`
    /// to decline.
    fn on_topic_started(&self, topic: &str, of: WireType) -> Option<u32>;
    /// Called for each message of the topic with this id.
    fn on_message(&self, topic: u32, message: SerializedMessage);
    /// Called when nobody publishes the topic any more.
    fn on_topic_ended(&self, topic: &str);
}

/// Handle of an observer's task; ends the observation when dropped.
pub struct ObserverTask(AbortHandle);

impl Drop for ObserverTask {
    fn drop(&mut self) {
        self.0.abort();
    }
}

/// Subscribes `observer` to what is published on a servant's bus.
pub(crate) fn spawn_observer(seen: ObservedServant, observer: Arc<dyn Observer>) -> ObserverTask {
    let task = tokio::spawn(async move {
        let ObservedServant { bus, registry, held } = seen;
        follow_graph(&bus, &registry, &observer).await;
        drop(held);
    });
    ObserverTask(task.abort_handle())
}

async fn follow_graph(bus: &Arc<dyn Bus>, registry: &Arc<Registry>, observer: &Arc<dyn Observer>) {
    let mut graph = bus.graph();
    graph.mark_changed();
    let mut heard: HashMap<String, AbortHandle> = HashMap::new();
    // They are aborted when this function returns.
    let mut tasks = JoinSet::new();
    while graph.changed().await.is_ok() {
        let now = Arc::clone(&graph.borrow_and_update());
        heard.retain(|topic, task| {
            let stays = is_published(&now, bus.node(), topic);
            if !stays {
                task.abort();
                observer.on_topic_ended(topic);
            }
            stays
        });
        while tasks.try_join_next().is_some() {}
        for (topic, ends) in &now.topics {
            let new = !heard.contains_key(topic) && heard.len() < TOPICS;
            let named = &ends.type_name;
            if new && is_published(&now, bus.node(), topic) && observer.wants_topic(topic, named) {
                let hearing = forward_messages(
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

async fn forward_messages(
    bus: Arc<dyn Bus>,
    registry: Arc<Registry>,
    observer: Arc<dyn Observer>,
    (name, named): (String, String),
) {
    let of = match registry.message(&named) {
        Ok(message) => WireType::from_message(&message),
        // The publisher tells the definitions of types that are not in the image.
        Err(_) => match bus.topic_type(&name).await {
            Ok(of) if !of.definition.is_empty() => of,
            _ => return,
        },
    };
    let qos = QosProfile::keep_last(QUEUE).latching(true);
    let subscription = match bus.subscribe(&name, of.clone(), qos).await {
        Ok(subscription) => subscription,
        Err(error) => {
            tracing::debug!(topic = name, %error, "an observer cannot hear it");
            return;
        }
    };
    let Some(topic) = observer.on_topic_started(&name, of) else {
        return;
    };
    // The subscription lasts until this guard is dropped.
    let Subscription { mut messages, guard: _guard, .. } = subscription;
    while let Some(message) = messages.recv().await {
        observer.on_message(topic, message);
    }
}

/// Returns true if another node publishes the topic.
fn is_published(graph: &Graph, own: &str, topic: &str) -> bool {
    let ends = graph.topics.get(topic);
    ends.is_some_and(|ends| ends.publishers.iter().any(|node| node != own))
}

/// Returns the time in nanoseconds since 1970.
pub(crate) fn now() -> u64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    now.map_or(0, |since| u64::try_from(since.as_nanos()).unwrap_or(u64::MAX))
}
