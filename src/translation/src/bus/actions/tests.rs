use std::collections::BTreeMap;

use async_trait::async_trait;
use ros::bus::{
    ActionNodes, Bus, FailureReason, GoalEnd, GoalError, GoalEvents, GoalOutcome, Graph, MessageReceiver,
    ServiceHandler,
};
use ros::codec::Time;
use ros::ros1::actions::messages::{self, ActionlibStatus, GoalId};
use ros::schema::Registry;
use tokio::sync::watch;
use tokio::time::timeout;

use super::*;
use crate::bus::{TranslatedBus, TranslationObserver};
use crate::{TranslationRules, TypeTranslations};

mod of_ros1;
mod of_ros2;

const PATIENCE: Duration = Duration::from_secs(60);
const DEFINITION: &str = "int32 order\n---\nint32 sum\n---\nint32 part\n";

/// A goal that the servant's server was given.
type SentGoal = (Bytes, Arc<dyn GoalEvents>);

/// A servant with one action, whose server is played by the test.
struct Servant {
    version: RosVersion,
    graph: watch::Sender<Arc<Graph>>,
    server: Arc<Server>,
}

#[derive(Default)]
struct Server {
    /// True once it listens.
    ready: watch::Sender<bool>,
    /// Ids in the order in which the goals were sent.
    order: Mutex<Vec<String>>,
    goals: Mutex<HashMap<String, SentGoal>>,
    cancelled: Mutex<Vec<String>>,
    changed: watch::Sender<usize>,
    /// Handler of the served action.
    handler: Mutex<Option<Arc<dyn ActionHandler>>>,
    ends: Mutex<Vec<(String, GoalEnd)>>,
}

impl Server {
    async fn wait_for(&self, is_so: impl Fn(&Self) -> bool) {
        let mut changes = self.changed.subscribe();
        timeout(PATIENCE, changes.wait_for(|_| is_so(self))).await.expect("it happens").expect("a sender");
    }

    /// Returns a goal once it was sent.
    async fn goal(&self, id: &str) -> SentGoal {
        self.wait_for(|server| server.goals.lock().contains_key(id)).await;
        self.goals.lock()[id].clone()
    }

    async fn wait_cancelled(&self, id: &str) {
        self.wait_for(|server| server.cancelled.lock().iter().any(|cancelled| cancelled == id)).await;
    }

    fn change(&self) {
        self.changed.send_modify(|changes| *changes += 1);
    }
}

struct ServantClient(Arc<Server>);

#[async_trait]
impl ActionClient for ServantClient {
    async fn wait_for_server(&self, patience: Duration) -> Result<(), BusError> {
        let mut ready = self.0.ready.subscribe();
        let ready = timeout(patience, ready.wait_for(|ready| *ready)).await;
        ready.map(drop).map_err(|_| BusError::Timeout { what: "action /count".to_owned(), after: patience })
    }

    fn send_goal(&self, id: &str, goal: Bytes, events: Arc<dyn GoalEvents>) {
        self.0.order.lock().push(id.to_owned());
        self.0.goals.lock().insert(id.to_owned(), (goal, events));
        self.0.change();
    }

    fn cancel_goal(&self, id: &str) {
        self.0.cancelled.lock().push(id.to_owned());
        self.0.change();
    }
}

struct ServantServer(Arc<Server>);

impl ActionServer for ServantServer {
    fn accept_goal(&self, _id: &str) {}

    fn execute_goal(&self, _id: &str) {}

    fn publish_feedback(&self, _id: &str, _feedback: Bytes) -> bool {
        true
    }

    fn end_goal(&self, id: &str, end: GoalEnd) -> bool {
        self.0.ends.lock().push((id.to_owned(), end));
        true
    }
}

#[async_trait]
impl Bus for Servant {
    fn version(&self) -> RosVersion {
        self.version
    }

    async fn distribution(&self) -> String {
        String::new()
    }

    fn node(&self) -> &str {
        "/bridge"
    }

    fn graph(&self) -> watch::Receiver<Arc<Graph>> {
        self.graph.subscribe()
    }

    async fn subscribe(&self, topic: &str, _: WireType, _: QosProfile) -> Result<Subscription, BusError> {
        Err(BusError::NoTopic(topic.to_owned()))
    }

    async fn advertise(&self, topic: &str, _: WireType, _: QosProfile) -> Result<Box<dyn Publisher>, BusError> {
        Err(BusError::NoTopic(topic.to_owned()))
    }

    async fn call_typed(&self, service: &str, _: &Digest, _: Bytes, _: Duration) -> Result<Bytes, BusError> {
        Err(BusError::NoService(service.to_owned()))
    }

    async fn service_type(&self, service: &str) -> Result<ServiceType, BusError> {
        Err(BusError::NoService(service.to_owned()))
    }

    async fn topic_type(&self, topic: &str) -> Result<WireType, BusError> {
        Err(BusError::NoTopic(topic.to_owned()))
    }

    async fn serve(
        &self,
        service: &str,
        _: ServiceType,
        _: Arc<dyn ServiceHandler>,
    ) -> Result<Box<dyn Send + Sync>, BusError> {
        Err(BusError::NoService(service.to_owned()))
    }

    fn action_client(&self, action: &str, of: &Arc<ActionDef>) -> Result<Box<dyn ActionClient>, BusError> {
        assert_eq!((action, of.goal.version()), ("/count", self.version));
        Ok(Box::new(ServantClient(Arc::clone(&self.server))))
    }

    fn serve_action(
        &self,
        _action: &str,
        _of: &Arc<ActionDef>,
        handler: Arc<dyn ActionHandler>,
    ) -> Result<Box<dyn ActionServer>, BusError> {
        *self.server.handler.lock() = Some(handler);
        Ok(Box::new(ServantServer(Arc::clone(&self.server))))
    }
}

#[derive(Default)]
struct Notices(Mutex<Vec<String>>);

impl TranslationObserver for Notices {
    fn on_loss(&self, _name: &str, text: &str) {
        self.0.lock().push(text.to_owned());
    }
}

struct World {
    bus: Arc<TranslatedBus>,
    server: Arc<Server>,
    servant: Arc<Servant>,
    notices: Arc<Notices>,
}

/// Name of the action's type in a ROS version.
fn type_name(version: RosVersion) -> &'static str {
    match version {
        RosVersion::One => "x_msgs/Count",
        RosVersion::Two => "x_msgs/action/Count",
    }
}

/// Returns a graph in which these nodes serve the action.
fn graph(version: RosVersion, servers: &[&str]) -> Arc<Graph> {
    let nodes = |names: &[&str]| names.iter().map(ToString::to_string).collect::<Vec<_>>();
    let topics = match version {
        RosVersion::One => {
            ["goal", "cancel", "status", "feedback", "result"].map(|part| format!("/count/{part}")).into()
        }
        RosVersion::Two => Vec::new(),
    };
    let action = ActionNodes {
        type_name: type_name(version).to_owned(),
        servers: nodes(servers),
        clients: nodes(&["/bridge", "/user"]),
        topics,
    };
    let names = ["/counter", "/bridge", "/user"];
    Arc::new(Graph {
        actions: [("/count".to_owned(), action)].into(),
        nodes: names.map(|node| (node.to_owned(), String::new())).into(),
        ..Graph::default()
    })
}

impl World {
    /// Creates a servant of this version whose action server is ready, and the bus of its robot.
    fn new(version: RosVersion) -> World {
        let world = World::starting(version);
        world.server.ready.send_replace(true);
        world
    }

    /// Creates a servant whose action server does not listen yet.
    fn starting(version: RosVersion) -> World {
        World::with_budget(version, &Budget::without_limit())
    }

    /// Creates such a servant, for a robot with this budget.
    fn with_budget(version: RosVersion, budget: &Budget) -> World {
        let definitions: BTreeMap<String, String> = [("x_msgs/action/Count".to_owned(), DEFINITION.to_owned())].into();
        let registry = Registry::with_definitions(version, &definitions).expect("definitions");
        let (server, notices) = (Arc::<Server>::default(), Arc::<Notices>::default());
        let shown = watch::Sender::new(graph(version, &["/counter"]));
        let servant = Arc::new(Servant { version, graph: shown, server: Arc::clone(&server) });
        let types = Arc::new(TypeTranslations::new(TranslationRules::default()));
        let inner: Arc<dyn Bus> = Arc::clone(&servant) as _;
        let bus = TranslatedBus::new(inner, types, Arc::new(registry), Arc::clone(&notices) as _, budget);
        World { bus, server, servant, notices }
    }

    /// Waits until the robot's graph has changed in this way.
    async fn wait_for_graph(&self, is_so: impl Fn(&Graph) -> bool) -> Arc<Graph> {
        let mut graphs = self.bus.graph();
        let found = timeout(PATIENCE, graphs.wait_for(|graph| is_so(graph))).await.expect("it changes");
        Arc::clone(&found.expect("a graph"))
    }
}

/// Returns a message of one number in the format of a ROS version.
fn number(version: RosVersion, value: i32) -> Bytes {
    let head: &[u8] = match version {
        RosVersion::One => &[],
        RosVersion::Two => &[0, 1, 0, 0],
    };
    [head, &value.to_le_bytes()].concat().into()
}

fn end(version: RosVersion, outcome: GoalOutcome) -> Result<GoalEnd, GoalError> {
    Ok(GoalEnd { outcome, text: String::new(), result: number(version, 9) })
}

fn drain(messages: &mut MessageReceiver) -> Vec<Bytes> {
    std::iter::from_fn(|| messages.try_recv()).map(|message| message.bytes).collect()
}
