//! The local original as its user sees it: start, stop, feed, call; its state and its outputs come back.
//!
//! ```text
//!             start              registered, inputs subscribed to
//!  Stopped ──────────▶ Starting ──────────────────────────────────▶ Ready
//!     ▲                   ▲  └─────────────── crash ◀────────────────┤
//!     │                   └── after a pause, doubled each time ◀┘    │
//!     └──────────────────────────── stop ◀────────────────────────────┘
//! ```

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use parking_lot::Mutex;
use qos::LocalState;
use ros::bus::{Bus, BusError, Matched, Message, PeerId, Publisher, Qos, WireType, reaches};
use tokio::process::Child;
use tokio::sync::{mpsc, watch};
use tokio::task::AbortHandle;
use tokio::time::{sleep, timeout};

use super::latched::Latched;
use super::private_master::{PrivateMaster, Registered};
use super::process::{self, Program};

/// Messages kept per topic: what waits longer is old.
const QUEUE: usize = 16;
/// How long the original may take to register all of the interface once its node is registered; another version of it may
/// lack a part.
const SETTLE: Duration = Duration::from_secs(3);
/// Pauses after crashes, at first and at last; and how long a life forgives them.
const BACKOFF: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(10));
const FORGIVEN: Duration = Duration::from_secs(30);

/// What the original needs.
#[derive(Debug, Clone)]
pub struct Setting {
    /// Its executable, arguments and environment; none where no original is installed.
    pub program: Option<Program>,
    /// Its absolute node name.
    pub node: String,
}

/// What is known of the node's interface. It is ready when it listens to what it is waited for, and has registered the
/// rest or has had time to.
#[derive(Debug, Clone, Default)]
pub struct Interface {
    /// What it listens to.
    pub inputs: BTreeMap<String, WireType>,
    /// Of these, those that it must listen to before it is given anything.
    pub awaited: BTreeSet<String>,
    /// What it publishes.
    pub outputs: Vec<String>,
    /// What it serves.
    pub services: Vec<String>,
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
    master: Arc<PrivateMaster>,
    publishers: Publishers,
    sources: Sources,
    latched: Latched,
    expected: Expected,
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
        let master = Arc::new(PrivateMaster::new().await?);
        master.lend(&setting.node, &robot, limit).await?;
        let (news, received) = mpsc::unbounded_channel();
        let publishers = Arc::default();
        let sources = Arc::default();
        let expected = Expected::default();
        let latched = Latched::begin(&master);
        let (orders, taken) = mpsc::unbounded_channel();
        let node = setting.node.clone();
        let runner = Runner {
            setting,
            master: master.clone(),
            robot,
            publishers: Arc::clone(&publishers),
            sources: Arc::clone(&sources),
            expected: Arc::clone(&expected),
            news: news.clone(),
        };
        let task = tokio::spawn(runner.run(taken)).abort_handle();
        let original = Self {
            node,
            orders,
            master,
            publishers,
            sources,
            latched,
            expected,
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
                .master
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
            if !self.publishers.lock().contains_key(&topic) {
                let publisher = advertise(&self.master, &topic, &wire_type).await?;
                self.publishers.lock().insert(topic, publisher);
            }
        }
        Ok(())
    }

    /// What it has registered, with types.
    pub async fn registered(&self) -> Registered {
        self.master.registered_by(&self.node).await
    }

    /// Changes with whatever is registered.
    pub fn registrations(&self) -> watch::Receiver<u64> {
        self.master.changes()
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
        let (master, publishers) = (self.master.clone(), self.publishers.clone());
        let (topic, message) = (topic.to_owned(), message.clone());
        tokio::spawn(async move {
            match advertise(&master, &topic, &message.wire_type).await {
                Ok(publisher) => {
                    publisher.publish(message.bytes);
                    publishers.lock().entry(topic).or_insert(publisher);
                }
                Err(error) => tracing::debug!(topic, %error, "the local original is not fed"),
            }
        });
    }

    /// Calls one of its services.
    pub async fn call(
        &self,
        service: &str,
        request: Bytes,
        timeout: Duration,
    ) -> Result<Bytes, BusError> {
        self.master.bus().call(service, request, timeout).await
    }
}

async fn advertise(
    master: &PrivateMaster,
    topic: &str,
    wire_type: &WireType,
) -> Result<Box<dyn Publisher>, BusError> {
    master
        .bus()
        .advertise(topic, wire_type.clone(), Qos::keep_last(QUEUE))
        .await
}

struct Runner {
    setting: Setting,
    master: Arc<PrivateMaster>,
    robot: Arc<dyn Bus>,
    publishers: Publishers,
    sources: Sources,
    expected: Expected,
    news: mpsc::UnboundedSender<News>,
}

impl Runner {
    async fn run(self, mut orders: mpsc::UnboundedReceiver<Order>) {
        while let Some(order) = orders.recv().await {
            if matches!(order, Order::Start) {
                let Some(program) = &self.setting.program else {
                    self.report(LocalState::Missing);
                    continue;
                };
                self.live(program, &mut orders).await;
                self.report(LocalState::Stopped);
            }
        }
    }

    /// From start to stop, through all crashes.
    async fn live(&self, program: &Program, orders: &mut mpsc::UnboundedReceiver<Order>) {
        let mut pause = BACKOFF.0;
        loop {
            let born = Instant::now();
            self.report(LocalState::Starting);
            let reason = match self.spawn(program).await {
                Ok(mut child) => tokio::select! {
                    reason = self.watch(&mut child) => reason,
                    () = stopped(orders) => {
                        process::end(&mut child).await;
                        self.master.process_exited().await;
                        return;
                    }
                },
                Err(error) => format!("{error:#}"),
            };
            self.master.process_exited().await;
            let _ = self.news.send(News::Crashed(reason));
            if born.elapsed() > FORGIVEN {
                pause = BACKOFF.0;
            }
            tokio::select! {
                () = sleep(pause) => {}
                () = stopped(orders) => return,
            }
            pause = (pause * 2).min(BACKOFF.1);
        }
    }

    async fn spawn(&self, program: &Program) -> anyhow::Result<Child> {
        // They may have changed since the last start.
        self.master.copy_parameters(&*self.robot).await?;
        program.spawn(self.master.uri())
    }

    /// Tells when it is ready; gives the reason when it ends.
    async fn watch(&self, child: &mut Child) -> String {
        tokio::select! {
            status = child.wait() => return process::ended(status),
            () = self.ready() => self.report(LocalState::Ready),
        }
        process::ended(child.wait().await)
    }

    /// Its node is registered, listens to its inputs, and what it publishes is heard.
    async fn ready(&self) {
        let node = &self.setting.node;
        self.master.registered(node).await;
        let expected = self.expected.lock().clone();
        let _ = timeout(SETTLE, self.master.registers(node, &expected)).await;
        let published = self.master.graph();
        let listens = |topic: &String| {
            let nodes = published.topics.get(topic).map(|topic| &topic.subscribers);
            nodes.is_some_and(|nodes| nodes.contains(node))
        };
        let ends: Vec<_> = {
            let inputs = self.publishers.lock();
            let due = inputs
                .iter()
                .filter(|(topic, _)| expected.awaited.contains(*topic) || listens(topic));
            due.map(|(_, input)| input.matched()).collect()
        };
        for end in ends {
            reaches(end, 1).await;
        }
        let sources = self.sources.lock().clone();
        for (topic, source) in sources {
            let nodes = published.topics.get(&topic).map(|topic| &topic.publishers);
            if nodes.is_some_and(|nodes| nodes.contains(&self.setting.node)) {
                reaches(source, 1).await;
            }
        }
    }

    fn report(&self, state: LocalState) {
        let _ = self.news.send(News::State(state));
    }
}

/// Waits for the order to stop, or for nobody being left to give it.
async fn stopped(orders: &mut mpsc::UnboundedReceiver<Order>) {
    while let Some(order) = orders.recv().await {
        if matches!(order, Order::Stop) {
            return;
        }
    }
}
