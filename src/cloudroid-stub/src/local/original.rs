//! Interface of the local original: start, stop, feed, call; its state and its outputs are reported as events.
//!
//! ```text
//!             start          registered, listens to its requests
//!  Stopped ──────────▶ Starting ──────────────────────────────────▶ Ready
//!     ▲                   ▲  └─────────────── crash ◀────────────────┤
//!     │                   └── after a pause, doubled each time ◀┘    │
//!     └──────────────────────────── stop ◀────────────────────────────┘
//! ```

mod runner;

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use parking_lot::Mutex;
use qos::{Failure, LocalState};
use ros::bus::{
    Bus, BusError, MatchedPeers, ParamValue, PeerId, Publisher, QosProfile, QosReliability, SerializedMessage,
    WireType, wait_for_connected,
};
use tokio::sync::{mpsc, watch};
use tokio::task::AbortHandle;
use tokio::time::timeout;

use super::expected::ExpectedInterface;
use super::latched::LatchedRelay;
use super::pending_answer::PendingAnswer;
use super::private_system::{GraphChanges, PrivateSystem, RegisteredInterface};
use super::process::OriginalProgram;
use super::remembered::RememberedSettings;
use runner::OriginalRunner;

/// Queue length for each topic, in messages: older ones are outdated.
pub const QUEUE: usize = 16;
/// Time limit for a call of a local service, longer than any call takes.
const CALL: Duration = Duration::from_secs(24 * 3600);
/// Time allowed for the original to register its whole interface after its node is registered; another version of it
/// may lack a part.
const SETTLE: Duration = Duration::from_secs(3);

/// Setup of the local original.
#[derive(Debug, Clone)]
pub struct OriginalSetup {
    /// Executable, arguments and environment; `None` if no original is installed.
    pub program: Option<OriginalProgram>,
    /// Absolute name of its node.
    pub node: String,
    /// Domain of the robot's nodes (ROS 2), which the original must not use.
    pub domain: Option<u16>,
    /// Time allowed for it to subscribe to its requests after its node is registered. It may wait for something that
    /// never happens; after this time it is fed requests all the same.
    pub patience: Duration,
}

/// An event of the local original.
#[derive(Debug)]
pub enum OriginalEvent {
    /// The state of the original has changed.
    State(LocalState),
    /// The process ended unexpectedly and will be restarted.
    Crashed(String),
    /// It published a message on this topic.
    Output(Arc<str>, SerializedMessage),
}

/// Handle of the local original; the process ends when it is dropped.
pub struct Original {
    /// Name of the node.
    node: String,
    orders: mpsc::UnboundedSender<OriginalCommand>,
    system: Arc<PrivateSystem>,
    publishers: Publishers,
    sources: Sources,
    latched: LatchedRelay,
    expected: Expected,
    remembered: Arc<RememberedSettings>,
    news: mpsc::UnboundedSender<OriginalEvent>,
    tasks: Mutex<Tasks>,
}

/// Publishers of the original's inputs.
type Publishers = Arc<Mutex<HashMap<String, Box<dyn Publisher>>>>;
/// Publishers that the original's outputs are matched with.
type Sources = Arc<Mutex<HashMap<String, watch::Receiver<MatchedPeers>>>>;
/// Interface that the node is expected to register.
type Expected = Arc<Mutex<ExpectedInterface>>;

enum OriginalCommand {
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
    /// Prepares everything except the process: creates the private ROS system, advertises inputs, and subscribes to
    /// outputs. An input that `interface` does not name may lose its first message. Parameters and services are those
    /// of `robot`; a service may take `limit`.
    pub async fn new(
        setting: OriginalSetup,
        interface: ExpectedInterface,
        robot: Arc<dyn Bus>,
        limit: Duration,
    ) -> anyhow::Result<(Self, mpsc::UnboundedReceiver<OriginalEvent>)> {
        let system = PrivateSystem::new(&*robot, setting.domain).await?;
        let system = Arc::new(system);
        system.lend(&setting.node, &robot, limit).await?;
        let (news, received) = mpsc::unbounded_channel();
        let publishers = Arc::default();
        let sources = Arc::default();
        let expected = Expected::default();
        let remembered = Arc::default();
        let latched = LatchedRelay::start(&system);
        let (orders, taken) = mpsc::unbounded_channel();
        let node = setting.node.clone();
        let runner = OriginalRunner {
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

    /// Advertises and subscribes to new parts of the interface.
    pub async fn adapt(&self, interface: ExpectedInterface) -> anyhow::Result<()> {
        *self.expected.lock() = interface.clone();
        for output in interface.outputs {
            if self.sources.lock().contains_key(&output) {
                continue;
            }
            let subscription = self
                .system
                .bus()
                .subscribe(&output, WireType::any(), QosProfile::keep_last(QUEUE).latching(true))
                .await?;
            self.sources.lock().insert(output.clone(), subscription.matched.clone());
            let (topic, news): (Arc<str>, _) = (output.into(), self.news.clone());
            let task = tokio::spawn(async move {
                // Capture the whole subscription: a part of it would leave its guard behind, which would end the
                // subscription.
                let subscription = &mut { subscription };
                while let Some(message) = subscription.messages.recv().await {
                    if news.send(OriginalEvent::Output(topic.clone(), message)).is_err() {
                        return;
                    }
                }
            });
            self.tasks.lock().0.push(task.abort_handle());
        }
        for (topic, wire_type) in interface.inputs {
            let asked = interface.asked.get(&topic);
            if accepts_volatile(asked) && !self.publishers.lock().contains_key(&topic) {
                let qos = offered_qos(asked);
                let publisher = advertise(&self.system, &topic, &wire_type, qos).await?;
                self.publishers.lock().insert(topic, publisher);
            }
        }
        Ok(())
    }

    /// Returns the settings that are replayed at each start.
    pub fn remembered_settings(&self) -> Arc<RememberedSettings> {
        Arc::clone(&self.remembered)
    }

    /// Returns the registered interface, with types.
    pub async fn registered_interface(&self) -> RegisteredInterface {
        self.system.registered_interface(&self.node).await
    }

    /// Returns a receiver of changes of the registrations.
    pub fn registration_changes(&self) -> GraphChanges {
        self.system.changes()
    }

    /// Returns when the process is connected to all inputs, or after the time allowed for that.
    pub async fn wait_connected(&self) {
        let ends: Vec<_> = {
            let inputs = self.publishers.lock();
            inputs.values().map(|input| input.matched_subscribers()).collect()
        };
        let all = async {
            for end in ends {
                wait_for_connected(end, 1).await;
            }
        };
        let _ = timeout(SETTLE, all).await;
    }

    /// Adds a latched message of a publisher. The process receives it now if it runs, and at each start.
    pub fn latch(&self, topic: &Arc<str>, message: &SerializedMessage) {
        self.latched.push(topic, message);
    }

    /// Discards the latched message of a publisher that has ended.
    pub fn unlatch(&self, topic: &Arc<str>, publisher: &PeerId) {
        self.latched.remove_publisher(topic, publisher);
    }

    /// Changes or deletes a parameter, because it has changed on the robot: ROS 1 nodes share parameters. A process
    /// starts with the robot's; this is for one that runs.
    pub async fn change_parameter(&self, name: &str, value: Option<ParamValue>) {
        if let Err(error) = self.system.change_parameter(name, value).await {
            tracing::debug!(name, %error, "cannot set a parameter of the local original");
        }
    }

    /// Starts the process, unless it runs.
    pub fn start(&self) {
        let _ = self.orders.send(OriginalCommand::Start);
    }

    /// Ends the process, if it runs.
    pub fn stop(&self) {
        let _ = self.orders.send(OriginalCommand::Stop);
    }

    /// Feeds it a message. A topic that was not named in advance is advertised first, and the message may be lost.
    pub fn feed(&self, topic: &str, message: &SerializedMessage) {
        if let Some(publisher) = self.publishers.lock().get(topic) {
            publisher.publish(message.bytes.clone());
            return;
        }
        let asked = self.expected.lock().asked.get(topic).copied();
        if !accepts_volatile(asked.as_ref()) {
            return;
        }
        let (system, publishers) = (self.system.clone(), self.publishers.clone());
        let qos = offered_qos(asked.as_ref());
        let (topic, message) = (topic.to_owned(), message.clone());
        tokio::spawn(async move {
            match advertise(&system, &topic, &message.wire_type, qos).await {
                Ok(publisher) => {
                    publisher.publish(message.bytes);
                    publishers.lock().entry(topic).or_insert(publisher);
                }
                Err(error) => {
                    tracing::debug!(topic, %error, "cannot publish to the local original")
                }
            }
        });
    }

    /// Calls one of its services, without a time limit.
    pub fn call(&self, service: &str, request: Bytes) -> PendingAnswer {
        call(self.system.bus().clone(), service, request)
    }
}

fn call(bus: Arc<dyn Bus>, service: &str, request: Bytes) -> PendingAnswer {
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
    qos: QosProfile,
) -> Result<Box<dyn Publisher>, BusError> {
    system.bus().advertise(topic, wire_type.clone(), qos).await
}

/// Returns whether a node with this request receives messages that are not latched. In ROS 2, one that requests latched
/// messages receives no others.
fn accepts_volatile(asked: Option<&QosProfile>) -> bool {
    asked.is_none_or(|asked| !asked.is_latching())
}

/// Returns the quality of service for advertising an input to a node with this request. All nodes accept a reliable
/// publisher; deadlines and the like must match what a ROS 2 node requests.
fn offered_qos(asked: Option<&QosProfile>) -> QosProfile {
    let plain = QosProfile::keep_last(QUEUE);
    asked.map_or(plain, |asked| QosProfile { reliability: QosReliability::Reliable, depth: QUEUE, ..*asked })
}
