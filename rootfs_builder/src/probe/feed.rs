//! Feeds nodes the input that they may be waiting for before they register their complete interface.
//!
//! ```text
//!   surroundings:  transforms (an identity tree), /clock, services that nodes wait for
//!        │ no new requests for these
//!        ▼
//!   inputs:        one default message each
//! ```
//!
//! What nodes register after that may need input as well, in the next round. Goals of actions are not sent, so that no
//! server begins to act.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use parking_lot::Mutex;
use ros::bus::{
    Bus, BusError, Graph, ParamValue, Publisher, QosProfile, RosVersion, Subscription, WireType, wait_for_connected,
};
use ros::codec::{self, FillOptions, JsonOptions, Time};
use ros::plumbing;
use ros::schema::{MessageType, Registry, SchemaError};
use tokio::task::JoinHandle;
use tokio::time::Instant;

use super::frames::{self, FrameSet};
use super::lender::AnyServiceLender;
use super::output_messages::{Stamp, read_stamp};
use super::{ProbeOptions, plausible, settle};

/// Time limit for a node to report the type of an input, and to connect, in its own time.
const ANSWER: Duration = Duration::from_secs(5);
/// Interval of transforms and of `/clock`.
const BEAT: Duration = Duration::from_millis(50);
/// Offset of the stamps of transforms into the future, so that lookups of the current time succeed.
const AHEAD: Duration = Duration::from_millis(100);
/// Maximum number of inputs that get a message.
const MOST_INPUTS: usize = 200;
/// Message type for inputs of any type, unless `--interface` gives one.
pub(super) const ANY: &str = "std_msgs/Empty";

const TRANSFORMS: [&str; 2] = ["/tf", "/tf_static"];
const CLOCK: &str = "/clock";
const LOG: &str = "/rosout";

/// Reason why a topic cannot be published.
#[derive(Debug, thiserror::Error)]
enum AdvertiseError {
    #[error("no response about its type within {ANSWER:?}")]
    NoResponse,
    #[error(transparent)]
    Type(#[from] SchemaError),
    #[error(transparent)]
    Bus(#[from] BusError),
}

/// Publishers and services provided so far; removed on drop.
pub(super) struct InputFeed<'a> {
    bus: &'a dyn Bus,
    registry: &'a Registry,
    options: &'a ProbeOptions,
    frames: Arc<Mutex<FrameSet>>,
    parameters: BTreeSet<String>,
    log: Option<Subscription>,
    /// Latest log message of each node, at level WARN or above.
    said: BTreeMap<String, String>,
    lender: Option<Arc<AnyServiceLender>>,
    /// Services that were looked up and are provided here (ROS 2).
    served: BTreeMap<String, Box<dyn Send + Sync>>,
    beats: BTreeMap<&'static str, PeriodicPublisher>,
    given: BTreeMap<String, Box<dyn Publisher>>,
    /// Input whose message had this stamp, for messages with stamps.
    stamps: BTreeMap<Stamp, String>,
    refused: BTreeMap<String, String>,
    goals: BTreeSet<String>,
    any: BTreeSet<String>,
}

/// A topic with periodic messages.
struct PeriodicPublisher(JoinHandle<()>);

impl Drop for PeriodicPublisher {
    fn drop(&mut self) {
        self.0.abort();
    }
}

impl Drop for InputFeed<'_> {
    fn drop(&mut self) {
        if let Some(lender) = &self.lender {
            lender.revoke();
        }
    }
}

impl<'a> InputFeed<'a> {
    /// Starts to listen to the log of the nodes.
    pub(super) async fn start(bus: &'a dyn Bus, registry: &'a Registry, options: &'a ProbeOptions) -> Self {
        Self {
            bus,
            registry,
            options,
            frames: Arc::default(),
            parameters: BTreeSet::new(),
            log: bus.subscribe(LOG, WireType::any(), QosProfile::keep_last(200)).await.ok(),
            said: BTreeMap::new(),
            lender: None,
            served: BTreeMap::new(),
            beats: BTreeMap::new(),
            given: BTreeMap::new(),
            stamps: BTreeMap::new(),
            refused: BTreeMap::new(),
            goals: BTreeSet::new(),
            any: BTreeSet::new(),
        }
    }

    /// Provides what the nodes of this graph wait for and have not been given; returns how long they may take to react,
    /// or `None` if there was nothing to provide.
    pub(super) async fn give_inputs(&mut self, graph: &Graph) -> Option<Duration> {
        let began = Instant::now();
        let (patience, longest) = if self.give_surroundings(graph).await {
            // Nodes that wait for these retry from time to time.
            (self.options.settle * 3, began.elapsed())
        } else {
            (self.options.settle * 2, self.give_default_messages(graph).await?)
        };
        // On a busy machine everything takes longer. The duration for one of them measures that; the total only depends
        // on their number.
        Some(patience.max(longest * 6).min(self.options.restless))
    }

    /// Returns the services looked up so far, with the nodes that did.
    pub(super) fn requested_services(&self) -> BTreeMap<String, BTreeSet<String>> {
        self.lender.as_ref().map(|lender| lender.requested_services()).unwrap_or_default()
    }

    /// Returns the inputs of any type without a stated type.
    pub(super) fn any_type_inputs(&self) -> &BTreeSet<String> {
        &self.any
    }

    /// Returns the input whose message had this stamp.
    pub(super) fn input_with_stamp(&self, stamp: &Stamp) -> Option<&String> {
        self.stamps.get(stamp)
    }

    /// Returns the inputs that could not be fed, with the reason.
    pub(super) fn failed_inputs(&self) -> &BTreeMap<String, String> {
        &self.refused
    }

    /// Returns the latest message of each node about waiting for something.
    pub(super) fn wait_messages(&mut self) -> BTreeMap<String, String> {
        self.read_log_messages();
        self.said.clone()
    }

    async fn give_surroundings(&mut self, graph: &Graph) -> bool {
        let told = self.collect_parameter_frames(graph).await | self.collect_node_frames(graph).await;
        let heard = self.read_log_messages() | told;
        let (clock, timed) = has_other_ends(graph, CLOCK, &self.options.own_name);
        let listens = |topic: &&str| has_other_ends(graph, topic, &self.options.own_name).0;
        let mut new = false;
        if clock && !timed {
            new |= self.publish_periodically(CLOCK, "rosgraph_msgs/Clock").await;
        }
        if TRANSFORMS.iter().any(listens) {
            // Moving transforms, since a node may check their age.
            new |= heard | self.publish_periodically(TRANSFORMS[0], "tf2_msgs/TFMessage").await;
        }
        let looked_for = graph.sought.iter().any(|(name, nodes)| {
            !graph.services.contains_key(name) && nodes.iter().any(|node| *node != self.options.own_name)
        });
        if !looked_for {
            return new;
        }
        let lender = match &self.lender {
            Some(lender) => Arc::clone(lender),
            None => {
                let lender = AnyServiceLender::new(self.registry, &self.options.own_name);
                if self.options.ros == RosVersion::One {
                    let lent = async { self.bus.lending()?.lend(lender.clone()).await };
                    match lent.await {
                        Ok(()) => new = true,
                        Err(error) => {
                            tracing::warn!("cannot provide services to the package: {error}");
                        }
                    }
                }
                Arc::clone(self.lender.insert(lender))
            }
        };
        // ROS 2 clients announce the type of the service that they look up.
        if self.options.ros == RosVersion::Two {
            new |= self.serve_sought(graph, &lender).await;
        }
        new
    }

    /// Provides the services that are looked up, with the types announced by their clients; returns whether any is new.
    async fn serve_sought(&mut self, graph: &Graph, lender: &Arc<AnyServiceLender>) -> bool {
        let mut new = false;
        for (name, nodes) in &graph.sought {
            let mut clients = nodes.iter().filter(|node| **node != self.options.own_name);
            let of = clients.find_map(|node| graph.ends.get(node)?.clients.get(name));
            let known = graph.services.contains_key(name) || self.served.contains_key(name);
            let Some((of, false)) = of.map(|of| (of, known)) else {
                continue;
            };
            let Some((of, handler)) = lender.handler_for(self.registry, name, &of.name, nodes) else {
                continue;
            };
            match self.bus.serve(name, of, handler).await {
                Ok(guard) => {
                    self.served.insert(name.clone(), guard);
                    new = true;
                }
                Err(error) => tracing::warn!("cannot provide {name} to the package: {error}"),
            }
        }
        new
    }

    /// Collects frames from the nodes' log; returns whether there are new ones.
    fn read_log_messages(&mut self) -> bool {
        let Some(log) = &mut self.log else {
            return false;
        };
        let mut new = false;
        while let Some(message) = log.messages.try_recv() {
            let Some((level, node, text)) = read_log(self.registry, self.options.ros, &message.bytes) else {
                continue;
            };
            if node == self.options.own_name {
                continue;
            }
            new |= self.frames.lock().add_from_log(&text);
            if level >= warning_level(self.options.ros) && text.to_lowercase().contains("wait") {
                self.said.insert(node, text);
            }
        }
        new
    }

    async fn collect_parameter_frames(&mut self, graph: &Graph) -> bool {
        let mut new = false;
        for key in graph.parameters.keys().filter(|key| frames::is_parameter(key)) {
            if !self.parameters.insert(key.clone()) {
                continue;
            }
            if let Ok(ParamValue::String(name)) = self.bus.parameter(key).await {
                new |= self.frames.lock().add(&name);
            }
        }
        new
    }

    /// Collects frames from the nodes' own parameters; returns whether there are new ones.
    async fn collect_node_frames(&mut self, graph: &Graph) -> bool {
        let Ok(parameters) = self.bus.node_parameters() else {
            return false;
        };
        let mut new = false;
        for node in graph.nodes.keys() {
            let list = graph.services.get(&format!("{node}/list_parameters"));
            let own = *node == self.options.own_name;
            if own || list != Some(node) || !self.parameters.insert(node.clone()) {
                continue;
            }
            let asked = async {
                let mut names = parameters.list(node, &[], 0).await?.names;
                names.retain(|name| frames::is_parameter(&name.replace('.', "/")));
                if names.is_empty() { Ok(Vec::new()) } else { parameters.get(node, &names).await }
            };
            let values = self.await_answer(asked).await;
            for value in values.and_then(Result::ok).into_iter().flatten() {
                if let Some(ParamValue::String(name)) = value {
                    new |= self.frames.lock().add(&name);
                }
            }
        }
        new
    }

    /// Starts periodic messages on a topic; returns whether that is new.
    async fn publish_periodically(&mut self, topic: &'static str, usual: &str) -> bool {
        if self.beats.contains_key(topic) || self.refused.contains_key(topic) {
            return false;
        }
        let (message, publisher) = match self.advertise(topic, Some(usual), false).await {
            Ok(Some(pair)) => pair,
            Ok(None) => return false,
            Err(error) => {
                self.refused.insert(topic.to_owned(), error.to_string());
                return false;
            }
        };
        // The duration of this on a busy machine shows how long the nodes will take.
        let _ = self.await_answer(wait_for_connected(publisher.matched_subscribers(), 1)).await;
        let frames = self.frames.clone();
        let beating = tokio::spawn(async move {
            let mut beats = tokio::time::interval(BEAT);
            loop {
                beats.tick().await;
                let json = if topic == CLOCK {
                    let now = Time::now();
                    serde_json::json!({"clock": {"secs": now.secs, "nsecs": now.nsecs}})
                } else {
                    frames.lock().tree(Time::from(SystemTime::now() + AHEAD))
                };
                let mut bytes = Vec::new();
                let written =
                    codec::from_json(&message, json.to_string().as_bytes(), &mut bytes, &FillOptions::default());
                if written.is_ok() {
                    publisher.publish(bytes.into());
                }
            }
        });
        self.beats.insert(topic, PeriodicPublisher(beating));
        true
    }

    /// Sends a default message to each input that the package does not feed itself. Returns the duration for the
    /// slowest one, or `None` if there was none.
    async fn give_default_messages(&mut self, graph: &Graph) -> Option<Duration> {
        let mut longest = None;
        for name in graph.topics.keys() {
            let (subscribed, published) = has_other_ends(graph, name, &self.options.own_name);
            let apart = name == CLOCK || TRANSFORMS.contains(&name.as_str()) || plumbing::is_builtin_topic(graph, name);
            let known = self.given.contains_key(name) || self.refused.contains_key(name) || self.goals.contains(name);
            if !subscribed || published || apart || known || self.given.len() >= MOST_INPUTS {
                continue;
            }
            let began = Instant::now();
            let demanded = requires_latched(graph, name);
            match self.advertise(name, None, demanded).await {
                Ok(Some((message, publisher))) => {
                    match plausible::default_message(&message, Time::now()) {
                        Ok(bytes) => {
                            // Not latched unless required, which would also reach later subscribers: relays latch
                            // what was latched.
                            let _ = self.await_answer(wait_for_connected(publisher.matched_subscribers(), 1)).await;
                            if let Some(stamp) = read_stamp(&bytes).filter(|_| message.has_header()) {
                                self.stamps.insert(stamp, name.clone());
                            }
                            publisher.publish(bytes);
                            self.given.insert(name.clone(), publisher);
                            longest = longest.max(Some(began.elapsed()));
                        }
                        Err(error) => {
                            self.refused.insert(name.clone(), error.to_string());
                        }
                    }
                }
                Ok(None) => {
                    self.goals.insert(name.clone());
                }
                Err(error) => {
                    self.refused.insert(name.clone(), error.to_string());
                }
            }
        }
        longest
    }

    async fn await_answer<T>(&self, answer: impl Future<Output = T>) -> Option<T> {
        settle::await_answer(ANSWER, self.options, answer).await
    }

    /// Advertises a topic with the type requested by its subscribers, or `usual` if they accept any; returns `None` if
    /// a message would start an action.
    async fn advertise(
        &mut self,
        topic: &str,
        usual: Option<&str>,
        latching: bool,
    ) -> Result<Option<(Arc<MessageType>, Box<dyn Publisher>)>, AdvertiseError> {
        let wire = self.await_answer(self.bus.topic_type(topic)).await;
        let asked = wire.ok_or(AdvertiseError::NoResponse)??.name;
        let stated = self.options.types.get(topic).map(String::as_str);
        let name = match asked.as_str() {
            "*" => stated.or(usual).unwrap_or_else(|| {
                self.any.insert(topic.to_owned());
                ANY
            }),
            asked => asked,
        };
        if ros::ros1::actions::is_command_type(name) {
            return Ok(None);
        }
        let message = self.registry.message(name)?;
        let publisher = self
            .bus
            .advertise(topic, WireType::from_message(&message), QosProfile::keep_last(10).latching(latching))
            .await?;
        Ok(Some((message, publisher)))
    }
}

/// Returns whether anybody but the observing node subscribes to a topic, and publishes on it.
fn has_other_ends(graph: &Graph, topic: &str, own: &str) -> (bool, bool) {
    let others = |nodes: &[String]| nodes.iter().any(|node| node != own);
    graph.topics.get(topic).map_or((false, false), |topic| (others(&topic.subscribers), others(&topic.publishers)))
}

/// Returns whether a subscriber requires publishers that keep their last message for it.
fn requires_latched(graph: &Graph, topic: &str) -> bool {
    let mut ends = graph.ends.values();
    ends.any(|ends| {
        let end = ends.subscribers.get(topic);
        end.is_some_and(|(_, qos)| qos.is_latching())
    })
}

/// Returns the log level of warnings.
fn warning_level(ros: RosVersion) -> u64 {
    match ros {
        // WARN of rosgraph_msgs/Log is a bit.
        RosVersion::One => 4,
        RosVersion::Two => 30,
    }
}

/// Parses the level, node and text of a log message (`rosgraph_msgs/Log`, or in ROS 2 `rcl_interfaces/msg/Log`, which
/// has the logger's name with dots for slashes).
fn read_log(registry: &Registry, ros: RosVersion, bytes: &[u8]) -> Option<(u64, String, String)> {
    let log = registry.message(match ros {
        RosVersion::One => "rosgraph_msgs/Log",
        RosVersion::Two => "rcl_interfaces/msg/Log",
    });
    let log = log.ok()?;
    let mut json = Vec::new();
    codec::to_json(&log, bytes, &mut json, &JsonOptions::default()).ok()?;
    let log: serde_json::Value = serde_json::from_slice(&json).ok()?;
    let text = |field: &str| log[field].as_str().map(str::to_owned);
    let name = match ros {
        RosVersion::One => text("name")?,
        RosVersion::Two => format!("/{}", text("name")?.replace('.', "/")),
    };
    Some((log["level"].as_u64()?, name, text("msg")?))
}
