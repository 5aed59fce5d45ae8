//! Reports changes at a Master as events of the nodes that the parameters belong to.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use async_trait::async_trait;
use parking_lot::Mutex;
use ros::bus::parameter_names::spell_in_ros2;
use ros::bus::{Graph, ParamChange, ParamChangeReceiver, ParamValue, ParameterEvent, ParameterEvents};
use tokio::sync::{mpsc, watch};
use tokio_util::task::AbortOnDropHandle;

use super::super::names::{SIM_TIME, SIM_TIME_KEY};
use super::super::values::{NodeValues, Tree};
use super::known_values::KnownValues;

/// Maximum number of events that wait for a slow receiver; as in rmw.
const MAX_EVENTS: usize = 1000;

/// A watch of a Master, whose changes go to any number of receivers.
pub(super) struct MasterWatch {
    receivers: Arc<Mutex<Option<Vec<EventSender>>>>,
    _forwarding: AbortOnDropHandle<()>,
}

struct EventSender {
    node: Option<String>,
    events: mpsc::Sender<ParameterEvent>,
    dropped: Arc<AtomicU64>,
}

/// The events of one node, or of all nodes.
pub(super) struct MasterEvents {
    events: mpsc::Receiver<ParameterEvent>,
    dropped: Arc<AtomicU64>,
}

impl MasterWatch {
    /// Starts to forward what differs from the known values, first to one receiver.
    pub(super) fn start(
        changes: ParamChangeReceiver,
        known: KnownValues,
        graph: watch::Receiver<Arc<Graph>>,
        node: Option<&str>,
    ) -> (Self, MasterEvents) {
        let (sender, events) = EventSender::new(node);
        let receivers = Arc::new(Mutex::new(Some(vec![sender])));
        let forwarding = tokio::spawn(forward(changes, known, graph, Arc::clone(&receivers)));
        (Self { receivers, _forwarding: AbortOnDropHandle::new(forwarding) }, events)
    }

    /// Adds a receiver; returns `None` if the watch has ended.
    pub(super) fn subscribe(&self, node: Option<&str>) -> Option<MasterEvents> {
        let mut receivers = self.receivers.lock();
        let all = receivers.as_mut()?;
        let (sender, events) = EventSender::new(node);
        all.push(sender);
        Some(events)
    }
}

impl EventSender {
    fn new(node: Option<&str>) -> (Self, MasterEvents) {
        let (sender, events) = mpsc::channel(MAX_EVENTS);
        let dropped = Arc::new(AtomicU64::new(0));
        let sender = Self { node: node.map(str::to_owned), events: sender, dropped: Arc::clone(&dropped) };
        (sender, MasterEvents { events, dropped })
    }

    /// Sends an event, if it is of the node; returns false if nobody receives it any more.
    fn send(&self, event: &ParameterEvent) -> bool {
        if self.node.as_ref().is_some_and(|node| *node != event.node) {
            return !self.events.is_closed();
        }
        match self.events.try_send(event.clone()) {
            Ok(()) => true,
            Err(mpsc::error::TrySendError::Closed(_)) => false,
            Err(mpsc::error::TrySendError::Full(_)) => {
                self.dropped.fetch_add(1, Ordering::Relaxed);
                true
            }
        }
    }
}

#[async_trait]
impl ParameterEvents for MasterEvents {
    async fn next(&mut self) -> Option<ParameterEvent> {
        self.events.recv().await
    }

    fn dropped_count(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }
}

async fn forward(
    mut changes: ParamChangeReceiver,
    mut known: KnownValues,
    graph: watch::Receiver<Arc<Graph>>,
    receivers: Arc<Mutex<Option<Vec<EventSender>>>>,
) {
    while let Some(change) = changes.recv().await {
        let Some(change) = known.select_change(change) else { continue };
        let now = graph.borrow().clone();
        for event in to_events(&now, change) {
            if let Some(all) = &mut *receivers.lock() {
                all.retain(|receiver| receiver.send(&event));
            }
        }
    }
    // The receivers see the end.
    receivers.lock().take();
}

/// Returns the events that a change at a Master means: of the node of the longest name above the key. A Master does not
/// say whether a parameter is new; every set value counts as a changed one.
fn to_events(graph: &Graph, (key, value): ParamChange) -> Vec<ParameterEvent> {
    let key = key.trim_end_matches('/');
    if key == SIM_TIME_KEY {
        let changed = vec![(SIM_TIME.to_owned(), ParamValue::Bool(value == Some(ParamValue::Bool(true))))];
        let nodes = graph.nodes.keys();
        let event =
            |node: &String| ParameterEvent { node: node.clone(), changed: changed.clone(), ..Default::default() };
        return nodes.map(event).collect();
    }
    let mut above = key;
    let owner = loop {
        if graph.has_node(above) {
            break Some(above);
        }
        match above.rsplit_once('/') {
            Some((parent, _)) if !parent.is_empty() => above = parent,
            _ => break None,
        }
    };
    let Some(node) = owner else {
        return match value {
            Some(ParamValue::Map(entries)) => events_below(graph, key, entries),
            _ => Vec::new(),
        };
    };
    let rest = key[node.len()..].trim_start_matches('/');
    let mut event = ParameterEvent { node: node.to_owned(), ..ParameterEvent::default() };
    let mut values = NodeValues::default();
    match value {
        Some(ParamValue::Map(entries)) if rest.is_empty() => {
            entries.into_iter().for_each(|(name, value)| values.add(spell_in_ros2(&name), value));
        }
        Some(value) if !rest.is_empty() => values.add(spell_in_ros2(rest), value),
        None if !rest.is_empty() => event.deleted.push(spell_in_ros2(rest)),
        // Which parameters the node had is not known.
        _ => {}
    }
    event.changed = values.values;
    let is_empty = event.changed.is_empty() && event.deleted.is_empty();
    if is_empty { Vec::new() } else { vec![event] }
}

/// Returns the events of the nodes in a namespace that was set as a whole.
fn events_below(graph: &Graph, key: &str, entries: Tree) -> Vec<ParameterEvent> {
    let has_nodes = graph.nodes.keys().any(|node| node.strip_prefix(key).is_some_and(|rest| rest.starts_with('/')));
    if !has_nodes {
        return Vec::new();
    }
    let changes = entries.into_iter().map(|(entry, value)| (format!("{key}/{entry}"), Some(value)));
    changes.flat_map(|change| to_events(graph, change)).collect()
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt;
    use ros::bus::param_change_channel;

    use super::*;

    fn graph(nodes: &[&str]) -> Graph {
        Graph { nodes: nodes.iter().map(|node| ((*node).to_owned(), String::new())).collect(), ..Graph::default() }
    }

    fn value(json: &str) -> Option<ParamValue> {
        Some(serde_json::from_str(json).expect(json))
    }

    /// Returns the events as `NODE NAME=VALUE` or `NODE -NAME`.
    fn events(nodes: &[&str], key: &str, value: Option<ParamValue>) -> Vec<String> {
        let mut all = Vec::new();
        for event in to_events(&graph(nodes), (key.to_owned(), value)) {
            let node = &event.node;
            let changed = event.changed.iter().map(|(name, value)| format!("{node} {name}={value:?}"));
            all.extend(changed.chain(event.deleted.iter().map(|name| format!("{node} -{name}"))));
        }
        all
    }

    #[test]
    fn a_change_is_an_event_of_the_node_of_the_longest_name() {
        let nodes = ["/camera", "/camera/see", "/see"];
        assert_eq!(events(&nodes, "/camera/see/gains/p", value("1")), ["/camera/see gains.p=Int(1)"]);
        assert_eq!(events(&nodes, "/camera/seen", value("1")), ["/camera seen=Int(1)"]);
        assert_eq!(
            events(&nodes, "/see/gains/", value(r#"{"p": 1, "i": 2}"#)),
            ["/see gains.i=Int(2)", "/see gains.p=Int(1)"]
        );
        assert_eq!(events(&nodes, "/see", value(r#"{"a": true}"#)), ["/see a=Bool(true)"]);
        assert_eq!(events(&nodes, "/see/old", None), ["/see -old"]);
        for (key, set) in [("/map_frame", value(r#""map""#)), ("/see", None), ("/see", value("1"))] {
            assert!(events(&nodes, key, set).is_empty(), "{key}");
        }
        let tree = value(r#"{"see": {"a": 1}, "alien": {"b": 2}}"#);
        assert_eq!(events(&["/front/see"], "/front", tree.clone()), ["/front/see a=Int(1)"]);
        assert!(events(&["/see"], "/rear", tree).is_empty());
        let simulated = ["/a use_sim_time=Bool(true)", "/b use_sim_time=Bool(true)"];
        assert_eq!(events(&["/a", "/b"], "/use_sim_time", value("true")), simulated);
    }

    #[tokio::test]
    async fn each_receiver_gets_the_events_of_its_node_until_the_watch_ends() {
        let (teller, changes) = param_change_channel(&budget::Budget::without_limit());
        let (_graph, now) = watch::channel(Arc::new(graph(&["/a", "/b"])));
        let (watch, mut all) = MasterWatch::start(changes, KnownValues::default(), now, None);
        let mut one = watch.subscribe(Some("/b")).expect("it runs");
        for key in ["/a/x", "/b/y"] {
            teller.send(key.to_owned(), value("1")).expect("memory");
        }
        assert_eq!(all.next().await.expect("an event").node, "/a");
        assert_eq!(all.next().await.expect("an event").node, "/b");
        assert_eq!(one.next().await.expect("an event").changed, [("y".to_owned(), ParamValue::Int(1))]);
        assert!(one.next().now_or_never().is_none());
        drop(teller);
        assert_eq!((all.next().await, one.next().await), (None, None));
        assert!(watch.subscribe(None).is_none());
    }

    #[tokio::test]
    async fn a_slow_receiver_loses_events_and_is_told_how_many() {
        let (sender, mut events) = EventSender::new(None);
        for _ in 0..MAX_EVENTS + 7 {
            assert!(sender.send(&ParameterEvent::default()));
        }
        assert_eq!(events.dropped_count(), 7);
        for _ in 0..MAX_EVENTS {
            events.next().await.expect("an event");
        }
        drop(events);
        assert!(!sender.send(&ParameterEvent::default()));
    }
}
