//! Gives nodes the input that they may be waiting for before they register all of their interface.
//!
//! ```text
//!   surroundings:  transforms (an identity tree), /clock, services that are looked for
//!        │ nothing new of these is asked for any more
//!        ▼
//!   inputs:        one default message each
//! ```
//!
//! What nodes register after that may need input in turn, in the next round. Goals of actions are not sent, so that no
//! server begins anything.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use parking_lot::Mutex;
use ros::bus::{
    Bus, Graph, ParamValue, Publisher, Qos, RosVersion, Subscription, WireType, reaches,
};
use ros::codec::{self, FillOptions, JsonOptions, Time};
use ros::plumbing;
use ros::schema::{MessageType, Registry};
use tokio::task::JoinHandle;
use tokio::time::Instant;

use super::frames::{self, Frames};
use super::heard::{Stamp, stamp};
use super::lender::AnyService;
use super::{ProbeOptions, plausible, settle};

/// How long a node may take to tell the type of an input, and to connect: of its own time.
const ANSWER: Duration = Duration::from_secs(5);
/// Time between two messages of transforms, and of `/clock`.
const BEAT: Duration = Duration::from_millis(50);
/// How far in the future transforms are stamped, so that a lookup for the present finds them.
const AHEAD: Duration = Duration::from_millis(100);
/// Most inputs that get a message.
const MOST_INPUTS: usize = 200;
/// The type of message for an input that takes any type, unless `--interface` gives one.
pub(super) const ANY: &str = "std_msgs/Empty";

const TRANSFORMS: [&str; 2] = ["/tf", "/tf_static"];
const CLOCK: &str = "/clock";
const LOG: &str = "/rosout";

/// What has been published and lent so far; it is taken back when this is dropped.
pub(super) struct Feed<'a> {
    bus: &'a dyn Bus,
    registry: &'a Registry,
    options: &'a ProbeOptions,
    frames: Arc<Mutex<Frames>>,
    parameters: BTreeSet<String>,
    log: Option<Subscription>,
    /// What nodes said last, at level WARN and above.
    said: BTreeMap<String, String>,
    lender: Option<Arc<AnyService>>,
    /// Services that were looked for and are served here (ROS 2).
    served: BTreeMap<String, Box<dyn Send + Sync>>,
    beats: BTreeMap<&'static str, Beat>,
    given: BTreeMap<String, Box<dyn Publisher>>,
    /// Whose message had this stamp, where messages have one.
    stamps: BTreeMap<Stamp, String>,
    refused: BTreeMap<String, String>,
    goals: BTreeSet<String>,
    any: BTreeSet<String>,
}

/// A topic that is published to again and again.
struct Beat(JoinHandle<()>);

impl Drop for Beat {
    fn drop(&mut self) {
        self.0.abort();
    }
}

impl Drop for Feed<'_> {
    fn drop(&mut self) {
        if let Some(lender) = &self.lender {
            lender.end();
        }
    }
}

impl<'a> Feed<'a> {
    /// Listens to what nodes say from now on.
    pub(super) async fn begin(
        bus: &'a dyn Bus,
        registry: &'a Registry,
        options: &'a ProbeOptions,
    ) -> Self {
        Self {
            bus,
            registry,
            options,
            frames: Arc::default(),
            parameters: BTreeSet::new(),
            log: bus
                .subscribe(LOG, WireType::any(), Qos::keep_last(200))
                .await
                .ok(),
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

    /// Gives what the nodes of this graph ask for and have not been given; how long they may take to make something
    /// of it, or none if there was nothing to give.
    pub(super) async fn give(&mut self, graph: &Graph) -> Option<Duration> {
        let began = Instant::now();
        let (patience, longest) = if self.surroundings(graph).await {
            // Whoever waits for these asks again now and then.
            (self.options.settle * 3, began.elapsed())
        } else {
            (self.options.settle * 2, self.inputs(graph).await?)
        };
        // On a busy machine everything takes longer. How long one of them took tells that; all together they only tell how
        // many they are.
        Some(patience.max(longest * 6).min(self.options.restless))
    }

    /// Services that were looked for since, with the nodes that did.
    pub(super) fn asked(&self) -> BTreeMap<String, BTreeSet<String>> {
        self.lender
            .as_ref()
            .map(|lender| lender.asked())
            .unwrap_or_default()
    }

    /// Inputs that take any type, of which nobody said which.
    pub(super) fn any(&self) -> &BTreeSet<String> {
        &self.any
    }

    /// The input whose message had this stamp.
    pub(super) fn stamped(&self, stamp: &Stamp) -> Option<&String> {
        self.stamps.get(stamp)
    }

    /// Inputs that could not be fed, with the reason.
    pub(super) fn refused(&self) -> &BTreeMap<String, String> {
        &self.refused
    }

    /// What each node said last of waiting for something.
    pub(super) fn said(&mut self) -> BTreeMap<String, String> {
        self.listen();
        self.said.clone()
    }

    async fn surroundings(&mut self, graph: &Graph) -> bool {
        let told = self.frames_of_parameters(graph).await | self.frames_of_nodes(graph).await;
        let heard = self.listen() | told;
        let (clock, timed) = ends(graph, CLOCK, &self.options.own_name);
        let listens = |topic: &&str| ends(graph, topic, &self.options.own_name).0;
        let mut new = false;
        if clock && !timed {
            new |= self.beat(CLOCK, "rosgraph_msgs/Clock").await;
        }
        if TRANSFORMS.iter().any(listens) {
            // Transforms that move: a node may well look at how old one is.
            new |= heard | self.beat(TRANSFORMS[0], "tf2_msgs/TFMessage").await;
        }
        let looked_for = graph.sought.iter().any(|(name, nodes)| {
            !graph.services.contains_key(name)
                && nodes.iter().any(|node| *node != self.options.own_name)
        });
        if !looked_for {
            return new;
        }
        let lender = match &self.lender {
            Some(lender) => Arc::clone(lender),
            None => {
                let lender = AnyService::new(self.registry, &self.options.own_name);
                if self.options.ros == RosVersion::One {
                    let lent = async { self.bus.lending()?.lend(lender.clone()).await };
                    match lent.await {
                        Ok(()) => new = true,
                        Err(error) => {
                            tracing::warn!("services cannot be lent to a package: {error}");
                        }
                    }
                }
                Arc::clone(self.lender.insert(lender))
            }
        };
        // Clients of ROS 2 tell of which type they look for a service.
        if self.options.ros == RosVersion::Two {
            new |= self.serve(graph, &lender).await;
        }
        new
    }

    /// Serves what is looked for, of the types that its clients tell; whether any of it is new.
    async fn serve(&mut self, graph: &Graph, lender: &Arc<AnyService>) -> bool {
        let mut new = false;
        for (name, nodes) in &graph.sought {
            let mut clients = nodes.iter().filter(|node| **node != self.options.own_name);
            let of = clients.find_map(|node| graph.ends.get(node)?.clients.get(name));
            let known = graph.services.contains_key(name) || self.served.contains_key(name);
            let Some((of, false)) = of.map(|of| (of, known)) else {
                continue;
            };
            let Some((of, handler)) = lender.serves(self.registry, name, &of.name, nodes) else {
                continue;
            };
            match self.bus.serve(name, of, handler).await {
                Ok(guard) => {
                    self.served.insert(name.clone(), guard);
                    new = true;
                }
                Err(error) => tracing::warn!("{name} cannot be served to a package: {error}"),
            }
        }
        new
    }

    /// Hears frames in what nodes say; whether there are new ones.
    fn listen(&mut self) -> bool {
        let Some(log) = &mut self.log else {
            return false;
        };
        let mut new = false;
        while let Some(message) = log.messages.try_recv() {
            let Some((level, node, text)) =
                read_log(self.registry, self.options.ros, &message.bytes)
            else {
                continue;
            };
            if node == self.options.own_name {
                continue;
            }
            new |= self.frames.lock().hear(&text);
            if level >= warning(self.options.ros) && text.to_lowercase().contains("wait") {
                self.said.insert(node, text);
            }
        }
        new
    }

    async fn frames_of_parameters(&mut self, graph: &Graph) -> bool {
        let mut new = false;
        for key in graph
            .parameters
            .keys()
            .filter(|key| frames::is_parameter(key))
        {
            if !self.parameters.insert(key.clone()) {
                continue;
            }
            if let Ok(ParamValue::String(name)) = self.bus.parameter(key).await {
                new |= self.frames.lock().add(&name);
            }
        }
        new
    }

    /// The same of parameters that nodes have of their own.
    async fn frames_of_nodes(&mut self, graph: &Graph) -> bool {
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
                match names.is_empty() {
                    true => Ok(Vec::new()),
                    false => parameters.get(node, &names).await,
                }
            };
            let values = self.answered(asked).await;
            for value in values.and_then(Result::ok).into_iter().flatten() {
                if let Some(ParamValue::String(name)) = value {
                    new |= self.frames.lock().add(&name);
                }
            }
        }
        new
    }

    /// Publishes again and again; whether that is new.
    async fn beat(&mut self, topic: &'static str, usual: &str) -> bool {
        if self.beats.contains_key(topic) || self.refused.contains_key(topic) {
            return false;
        }
        let (message, publisher) = match self.advertise(topic, Some(usual), false).await {
            Ok(Some(pair)) => pair,
            Ok(None) => return false,
            Err(reason) => {
                self.refused.insert(topic.to_owned(), reason);
                return false;
            }
        };
        // How long that takes on a busy machine tells how long the nodes will take.
        let _ = self.answered(reaches(publisher.matched(), 1)).await;
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
                let written = codec::from_json(
                    &message,
                    json.to_string().as_bytes(),
                    &mut bytes,
                    &FillOptions::default(),
                );
                if written.is_ok() {
                    publisher.publish(bytes.into());
                }
            }
        });
        self.beats.insert(topic, Beat(beating));
        true
    }

    /// One default message for each input that the package itself does not feed. How long the slowest of them took; none
    /// if there was none.
    async fn inputs(&mut self, graph: &Graph) -> Option<Duration> {
        let mut longest = None;
        for name in graph.topics.keys() {
            let (subscribed, published) = ends(graph, name, &self.options.own_name);
            let apart = name == CLOCK
                || TRANSFORMS.contains(&name.as_str())
                || plumbing::topic(graph, name);
            let known = self.given.contains_key(name)
                || self.refused.contains_key(name)
                || self.goals.contains(name);
            if !subscribed || published || apart || known || self.given.len() >= MOST_INPUTS {
                continue;
            }
            let began = Instant::now();
            let demanded = demands_latched(graph, name);
            match self.advertise(name, None, demanded).await {
                Ok(Some((message, publisher))) => match plausible::message(&message, Time::now()) {
                    Ok(bytes) => {
                        // Not latched unless it is asked for, which would reach whoever is late, too: relays latch what
                        // was latched.
                        let _ = self.answered(reaches(publisher.matched(), 1)).await;
                        if let Some(stamp) = stamp(&bytes).filter(|_| message.has_header()) {
                            self.stamps.insert(stamp, name.clone());
                        }
                        publisher.publish(bytes);
                        self.given.insert(name.clone(), publisher);
                        longest = longest.max(Some(began.elapsed()));
                    }
                    Err(error) => {
                        self.refused.insert(name.clone(), error.to_string());
                    }
                },
                Ok(None) => {
                    self.goals.insert(name.clone());
                }
                Err(reason) => {
                    self.refused.insert(name.clone(), reason);
                }
            }
        }
        longest
    }

    async fn answered<T>(&self, answer: impl Future<Output = T>) -> Option<T> {
        settle::answered(ANSWER, self.options, answer).await
    }

    /// Advertises a topic with the type that its subscribers ask for, or `usual` where they ask for none; nothing
    /// where that would begin an action.
    async fn advertise(
        &mut self,
        topic: &str,
        usual: Option<&str>,
        latching: bool,
    ) -> Result<Option<(Arc<MessageType>, Box<dyn Publisher>)>, String> {
        let asked = match self.answered(self.bus.topic_type(topic)).await {
            Some(Ok(wire)) => wire.name,
            Some(Err(error)) => return Err(error.to_string()),
            None => return Err(format!("its type was not told within {ANSWER:?}")),
        };
        let stated = self.options.types.get(topic).map(String::as_str);
        let name = match asked.as_str() {
            "*" => stated.or(usual).unwrap_or_else(|| {
                self.any.insert(topic.to_owned());
                ANY
            }),
            asked => asked,
        };
        if ros::ros1::actions::commands(name) {
            return Ok(None);
        }
        let message = self
            .registry
            .message(name)
            .map_err(|error| error.to_string())?;
        let publisher = self
            .bus
            .advertise(
                topic,
                WireType::of(&message),
                Qos::keep_last(10).latching(latching),
            )
            .await;
        Ok(Some((
            message,
            publisher.map_err(|error| error.to_string())?,
        )))
    }
}

/// Whether anybody but the looking node subscribes to a topic, and publishes on it.
fn ends(graph: &Graph, topic: &str, own: &str) -> (bool, bool) {
    let others = |nodes: &[String]| nodes.iter().any(|node| node != own);
    graph.topics.get(topic).map_or((false, false), |topic| {
        (others(&topic.subscribers), others(&topic.publishers))
    })
}

/// Whether a subscriber hears those publishers alone that keep their last message for it.
fn demands_latched(graph: &Graph, topic: &str) -> bool {
    let mut ends = graph.ends.values();
    ends.any(|ends| {
        let end = ends.subscribers.get(topic);
        end.is_some_and(|(_, qos)| qos.is_latching())
    })
}

/// From which level on a node warns.
fn warning(ros: RosVersion) -> u64 {
    match ros {
        // WARN of rosgraph_msgs/Log is a bit.
        RosVersion::One => 4,
        RosVersion::Two => 30,
    }
}

/// Level, node and text of a line of a node's log. (`rosgraph_msgs/Log`, of ROS 2 `rcl_interfaces/msg/Log`, which has the
/// logger's name, dots for slashes.)
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
