//! The local original as its user sees it: start, stop, feed, call; its state and its outputs come back.
//!
//! ```text
//!             start          registered, listens to its requests
//!  Stopped ──────────▶ Starting ──────────────────────────────────▶ Ready
//!     ▲                   ▲  └─────────────── crash ◀────────────────┤
//!     │                   └── after a pause, doubled each time ◀┘    │
//!     └──────────────────────────── stop ◀────────────────────────────┘
//! ```

mod runner;

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use parking_lot::Mutex;
use qos::{Failure, LocalState};
use ros::bus::{
    Bus, BusError, Matched, Message, ParamValue, PeerId, Publisher, Qos, Reliability, WireType,
    reaches,
};
use tokio::sync::{mpsc, watch};
use tokio::task::AbortHandle;
use tokio::time::timeout;

use super::keeper::Answer;
use super::latched::Latched;
use super::private_system::{Changes, PrivateSystem, Registered};
use super::process::Program;
use super::remembered::Remembered;
use runner::Runner;

/// Messages kept per topic: what waits longer is old.
pub const QUEUE: usize = 16;
/// Longer than any call of a local service is waited for.
const CALL: Duration = Duration::from_secs(24 * 3600);
/// How long the original may take to register all of the interface once its node is registered; another version of it may
/// lack a part.
const SETTLE: Duration = Duration::from_secs(3);

/// What the original needs.
#[derive(Debug, Clone)]
pub struct Setting {
    /// Its executable, arguments and environment; none where no original is installed.
    pub program: Option<Program>,
    /// Its absolute node name.
    pub node: String,
    /// The domain of the robot's nodes (ROS 2), which is not the original's.
    pub domain: Option<u16>,
    /// How long it may take to listen to its requests once its node is registered. What it waits for may never come; then it is
    /// given them all the same.
    pub patience: Duration,
}

/// What is known of the node's interface. It is ready when it listens to its requests, and has registered the rest or has had
/// time to. What it may itself wait for before it listens to requests is given to it from its first moment ([`Keeper`](super::Keeper)).
#[derive(Debug, Clone, Default)]
pub struct Interface {
    /// What it listens to.
    pub inputs: BTreeMap<String, WireType>,
    /// What it asks for of inputs, where that is told (ROS 2).
    pub asked: BTreeMap<String, Qos>,
    /// Of the inputs, its requests: it listens to them before it is ready.
    pub awaited: BTreeSet<String>,
    /// What it publishes.
    pub outputs: Vec<String>,
    /// What it serves.
    pub services: Vec<String>,
    /// Of all this, what lies below further nodes of its process: their names may be others in each of its lives (a listener to transforms has a random one), so
    /// that nothing of it is waited for that is not awaited, and that no longer than for the rest.
    pub of_others: BTreeSet<String>,
}

impl Interface {
    /// Whether this is waited for, as long as things have time to be registered.
    pub(super) fn waits_for(&self, name: &str) -> bool {
        self.awaited.contains(name) || !self.of_others.contains(name)
    }

    /// Whether it is not ready before it listens to this, as long as that may take.
    fn must_listen_to(&self, topic: &str) -> bool {
        self.awaited.contains(topic) && !self.of_others.contains(topic)
    }
}

/// What comes back.
#[derive(Debug)]
pub enum News {
    /// Its state has changed.
    State(LocalState),
    /// It ended by itself and will be started again.
    Crashed(String),
    /// It published on this topic.
    Output(Arc<str>, Message),
}

/// A handle; dropping it ends the process.
pub struct Original {
    /// The node's name.
    node: String,
    orders: mpsc::UnboundedSender<Order>,
    system: Arc<PrivateSystem>,
    publishers: Publishers,
    sources: Sources,
    latched: Latched,
    expected: Expected,
    remembered: Arc<Remembered>,
    news: mpsc::UnboundedSender<News>,
    tasks: Mutex<Tasks>,
}

/// The inputs that it is given.
type Publishers = Arc<Mutex<HashMap<String, Box<dyn Publisher>>>>;
/// Who publishes each output.
type Sources = Arc<Mutex<HashMap<String, watch::Receiver<Matched>>>>;
/// What the node is expected to register.
type Expected = Arc<Mutex<Interface>>;

enum Order {
    Start,
    Stop,
}

struct Tasks(Vec<AbortHandle>);

impl Drop for Tasks {
    fn drop(&mut self) {
        for task in &self.0 {
            task.abort();
        }
    }
}

impl Original {
    /// Prepares everything but the process: the private ROS system, inputs advertised, outputs subscribed to. Inputs
    /// fed without being named in `interface` may lose their first message. Parameters are those of `robot`, and so are
    /// services, which may take `limit`.
    pub async fn new(
        setting: Setting,
        interface: Interface,
        robot: Arc<dyn Bus>,
        limit: Duration,
    ) -> anyhow::Result<(Self, mpsc::UnboundedReceiver<News>)> {
        let system = PrivateSystem::new(&*robot, setting.domain).await?;
        let system = Arc::new(system);
        system.lend(&setting.node, &robot, limit).await?;
        let (news, received) = mpsc::unbounded_channel();
        let publishers = Arc::default();
        let sources = Arc::default();
        let expected = Expected::default();
        let remembered = Arc::default();
        let latched = Latched::begin(&system);
        let (orders, taken) = mpsc::unbounded_channel();
        let node = setting.node.clone();
        let runner = Runner {
            setting,
            system: system.clone(),
            robot,
            publishers: Arc::clone(&publishers),
            sources: Arc::clone(&sources),
            expected: Arc::clone(&expected),
            remembered: Arc::clone(&remembered),
            news: news.clone(),
        };
        let task = tokio::spawn(runner.run(taken)).abort_handle();
        let original = Self {
            node,
            orders,
            system,
            publishers,
            sources,
            latched,
            expected,
            remembered,
            news,
            tasks: Mutex::new(Tasks(vec![task])),
        };
        original.adapt(interface).await?;
        Ok((original, received))
    }

    /// Advertises and subscribes to what is new in the interface.
    pub async fn adapt(&self, interface: Interface) -> anyhow::Result<()> {
        *self.expected.lock() = interface.clone();
        for output in interface.outputs {
            if self.sources.lock().contains_key(&output) {
                continue;
            }
            let subscription = self
                .system
                .bus()
                .subscribe(
                    &output,
                    WireType::any(),
                    Qos::keep_last(QUEUE).latching(true),
                )
                .await?;
            self.sources
                .lock()
                .insert(output.clone(), subscription.matched.clone());
            let (topic, news): (Arc<str>, _) = (output.into(), self.news.clone());
            let task = tokio::spawn(async move {
                // All of it, or the guard would stay behind and end the subscription.
                let subscription = &mut { subscription };
                while let Some(message) = subscription.messages.recv().await {
                    if news.send(News::Output(topic.clone(), message)).is_err() {
                        return;
                    }
                }
            });
            self.tasks.lock().0.push(task.abort_handle());
        }
        for (topic, wire_type) in interface.inputs {
            let asked = interface.asked.get(&topic);
            if hears_plain(asked) && !self.publishers.lock().contains_key(&topic) {
                let qos = offered(asked);
                let publisher = advertise(&self.system, &topic, &wire_type, qos).await?;
                self.publishers.lock().insert(topic, publisher);
            }
        }
        Ok(())
    }

    /// What it is told at each start.
    pub fn remembered(&self) -> Arc<Remembered> {
        Arc::clone(&self.remembered)
    }

    /// What it has registered, with types.
    pub async fn registered(&self) -> Registered {
        self.system.registered_by(&self.node).await
    }

    /// Changes with whatever is registered.
    pub fn registrations(&self) -> Changes {
        self.system.changes()
    }

    /// Returns once the process is connected to all inputs, or has had time to be.
    pub async fn connected(&self) {
        let ends: Vec<_> = {
            let inputs = self.publishers.lock();
            inputs.values().map(|input| input.matched()).collect()
        };
        let all = async {
            for end in ends {
                reaches(end, 1).await;
            }
        };
        let _ = timeout(SETTLE, all).await;
    }

    /// A publisher has latched this message. The process gets it at once if it runs, and at each start.
    pub fn latch(&self, topic: &Arc<str>, message: &Message) {
        self.latched.keep(topic, message);
    }

    /// This publisher of a topic has gone; its latched message is dropped.
    pub fn unlatch(&self, topic: &Arc<str>, publisher: &PeerId) {
        self.latched.forget(topic, publisher);
    }

    /// A parameter of the robot has changed, or was deleted: nodes of ROS 1 share them. Those of a process are the robot's when it
    /// starts; this is for one that runs.
    pub async fn change_parameter(&self, name: &str, value: Option<ParamValue>) {
        if let Err(error) = self.system.change_parameter(name, value).await {
            tracing::debug!(name, %error, "the local original is not told of a parameter");
        }
    }

    /// Starts the process, if it does not run.
    pub fn start(&self) {
        let _ = self.orders.send(Order::Start);
    }

    /// Ends the process, if it runs.
    pub fn stop(&self) {
        let _ = self.orders.send(Order::Stop);
    }

    /// Gives it a message. A topic that was not named in advance is advertised first, and its message may be too
    /// early.
    pub fn feed(&self, topic: &str, message: &Message) {
        if let Some(publisher) = self.publishers.lock().get(topic) {
            publisher.publish(message.bytes.clone());
            return;
        }
        let asked = self.expected.lock().asked.get(topic).copied();
        if !hears_plain(asked.as_ref()) {
            return;
        }
        let (system, publishers) = (self.system.clone(), self.publishers.clone());
        let qos = offered(asked.as_ref());
        let (topic, message) = (topic.to_owned(), message.clone());
        tokio::spawn(async move {
            match advertise(&system, &topic, &message.wire_type, qos).await {
                Ok(publisher) => {
                    publisher.publish(message.bytes);
                    publishers.lock().entry(topic).or_insert(publisher);
                }
                Err(error) => tracing::debug!(topic, %error, "the local original is not fed"),
            }
        });
    }

    /// Calls one of its services, however long it takes.
    pub fn call(&self, service: &str, request: Bytes) -> Answer {
        call(self.system.bus().clone(), service, request)
    }
}

fn call(bus: Arc<dyn Bus>, service: &str, request: Bytes) -> Answer {
    let service = service.to_owned();
    Box::pin(async move {
        let answer = bus.call(&service, request, CALL).await;
        answer.map_err(|error| match error {
            BusError::CallFailed { reason, .. } => Failure::Refused(reason),
            other => Failure::Unreachable(other.to_string()),
        })
    })
}

async fn advertise(
    system: &PrivateSystem,
    topic: &str,
    wire_type: &WireType,
    qos: Qos,
) -> Result<Box<dyn Publisher>, BusError> {
    system.bus().advertise(topic, wire_type.clone(), qos).await
}

/// Whether a node that asks for this hears what is not latched. One that asks for what is hears nothing else (ROS 2).
fn hears_plain(asked: Option<&Qos>) -> bool {
    asked.is_none_or(|asked| !asked.is_latching())
}

/// What an input is advertised with, so that it is heard by a node that asks for this. All hear a reliable one; of what is said of
/// time, an end of ROS 2 asks for as much as it names.
fn offered(asked: Option<&Qos>) -> Qos {
    let plain = Qos::keep_last(QUEUE);
    asked.map_or(plain, |asked| Qos {
        reliability: Reliability::Reliable,
        depth: QUEUE,
        ..*asked
    })
}
