use async_trait::async_trait;
use budget::WorkLimit;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{FailureReason, Publisher, QosProfile, ServiceHandler, ServiceType, WireFormat, WireType};
use tokio::sync::Semaphore;
use tokio::time::timeout;

use super::*;
use crate::doubles::{RecordedEvents, StubNodesDouble};
use crate::memory_bus::{MemoryBus, MemorySystem};

/// Only limits the duration of a failing test.
const PATIENCE: Duration = Duration::from_secs(60);
/// More than these tests take.
const WORK: WorkLimit = WorkLimit { cores: 1.0, burst: PATIENCE };
const NODE: &str = "/sentry";
/// State ids (`lifecycle_msgs/msg/State`).
const UNCONFIGURED: u8 = 1;
const INACTIVE: u8 = 2;
const ACTIVE: u8 = 3;

/// A servant, initially without nodes.
struct LifecycleWorld {
    system: Arc<MemorySystem>,
    events: Arc<RecordedEvents>,
    lifecycles: LifecycleDriver,
    budget: Budget,
}

impl LifecycleWorld {
    fn new(started: StubNodesDouble) -> Self {
        let (system, events) = (Arc::<MemorySystem>::default(), Arc::<RecordedEvents>::default());
        let bus: Arc<dyn Bus> = system.join("/cloudroid_bridge");
        let (nodes, observer): (Arc<dyn NodeController>, Arc<dyn Observer>) = (Arc::new(started), events.clone());
        let budget = Budget::new("the daemon", 1 << 20).child_with_work("servant x", 1 << 20, WORK);
        let lifecycles = LifecycleDriver::start(&bus, &nodes, &observer, &budget);
        Self { system, events, lifecycles: lifecycles.expect("ROS 2"), budget }
    }

    async fn wait_stages(&self, wanted: impl Fn(&Stages) -> bool) -> Stages {
        let mut stages = self.lifecycles.stages();
        let found = timeout(PATIENCE, stages.wait_for(wanted)).await;
        found.expect("in time").expect("followed").clone()
    }

    /// Waits until the node is shown in this state and nobody is about to change it.
    async fn wait_stage(&self, state: &str) -> LifecycleStage {
        let over = |stage: &LifecycleStage| stage.state == state && !stage.begins;
        let all = self.wait_stages(|all| all.get(NODE).is_some_and(over)).await;
        all[NODE].clone()
    }
}

/// Returns the stage of a node without anything special.
fn settled_stage(state: &str) -> LifecycleStage {
    LifecycleStage { state: state.to_owned(), refused: None, begins: false }
}

/// A lifecycle node.
struct Staged {
    life: Arc<Life>,
    changes: Box<dyn Publisher>,
    _serving: Vec<Box<dyn Send + Sync>>,
    _node: Arc<MemoryBus>,
}

struct Life {
    state: Mutex<u8>,
    asked: Mutex<Vec<&'static str>>,
    /// It refuses to become active.
    refuses: bool,
    /// Number of transitions that are carried out.
    transitions: Semaphore,
}

/// A service of the node that returns or changes its state.
struct Part(Arc<Life>);

/// CDR, little-endian.
const HEADER: [u8; 4] = [0, 1, 0, 0];

/// Appends an id and an empty label.
fn put_state(out: &mut Vec<u8>, number: u8) {
    out.push(number);
    out.resize(out.len().next_multiple_of(4), 0);
    out.extend([1, 0, 0, 0, 0]);
}

#[async_trait]
impl ServiceHandler for Part {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        let Part(life) = self;
        let mut answer = HEADER.to_vec();
        let told = String::from_utf8_lossy(&request).into_owned();
        let label = ["configure", "activate"].into_iter();
        let Some(label) = label.clone().find(|label| told.contains(label)) else {
            put_state(&mut answer, *life.state.lock());
            return Ok(answer.into());
        };
        life.asked.lock().push(label);
        let allowed = life.transitions.acquire().await.expect("open");
        allowed.forget();
        let to = match label {
            "configure" => INACTIVE,
            _ => ACTIVE,
        };
        let done = !(life.refuses && to == ACTIVE);
        if done {
            *life.state.lock() = to;
        }
        answer.push(u8::from(done));
        Ok(answer.into())
    }
}

/// Returns the type of a lifecycle service.
fn service(part: &str) -> ServiceType {
    ServiceType::new(part, "*")
}

impl Staged {
    async fn start(world: &LifecycleWorld, refuses: bool, transitions: usize) -> Self {
        let node = world.system.join(NODE);
        let of = WireType {
            name: "lifecycle_msgs/msg/TransitionEvent".to_owned(),
            format: WireFormat::Cdr,
            ..WireType::any()
        };
        let topic = format!("{NODE}/transition_event");
        let changes = node.advertise(&topic, of, QosProfile::keep_last(10)).await;
        let life = Arc::new(Life {
            state: Mutex::new(UNCONFIGURED),
            asked: Mutex::default(),
            refuses,
            transitions: Semaphore::new(transitions),
        });
        let mut serving = Vec::new();
        // The last of them makes it recognizable as a lifecycle node.
        for (part, of) in
            [("get_state", "lifecycle_msgs/srv/GetState"), ("change_state", "lifecycle_msgs/srv/ChangeState")]
        {
            let (name, handler) = (format!("{NODE}/{part}"), Arc::new(Part(life.clone())));
            let served = node.serve(&name, service(of), handler).await;
            serving.push(served.expect("served"));
        }
        Self { life, changes: changes.expect("advertised"), _serving: serving, _node: node }
    }

    /// Simulates a transition triggered by somebody else.
    fn transition(&self, from: u8, to: u8) {
        *self.life.state.lock() = to;
        let mut event = HEADER.to_vec();
        // Timestamp.
        event.extend([0; 8]);
        for number in [0, from, to] {
            put_state(&mut event, number);
        }
        self.changes.publish(event.into());
    }

    fn requested_transitions(&self) -> Vec<&'static str> {
        self.life.asked.lock().clone()
    }
}

#[tokio::test]
async fn a_node_begins_as_it_appears_and_its_states_are_told() {
    let world = LifecycleWorld::new(StubNodesDouble::default());
    // The daemon has other nodes, which are not managers.
    let ours = world.system.join("/cloudroid_probe");
    let change = service("lifecycle_msgs/srv/ChangeState");
    let _client = ours.seek("/sentry/change_state", change);
    let node = Staged::start(&world, false, 0).await;
    let begins = |all: &Stages| all.get(NODE).is_some_and(|stage| stage.begins);
    world.wait_stages(begins).await;
    node.life.transitions.add_permits(2);
    assert_eq!(world.wait_stage("active").await, settled_stage("active"));
    assert_eq!(node.requested_transitions(), ["configure", "activate"]);
    // The follower starts watching a moment after the activation.
    let watched = |matched: &ros::bus::MatchedPeers| matched.connected_count() == 1;
    let mut watchers = node.changes.matched_subscribers();
    let waited = timeout(PATIENCE, watchers.wait_for(watched)).await;
    waited.expect("in time").expect("advertised");
    node.transition(ACTIVE, INACTIVE);
    assert_eq!(world.wait_stage("inactive").await, settled_stage("inactive"));
    assert!(world.events.0.lock().is_empty());

    drop(node);
    world.wait_stages(Stages::is_empty).await;
    let again = Staged::start(&world, false, 2).await;
    assert_eq!(world.wait_stage("active").await, settled_stage("active"));
    assert_eq!(again.requested_transitions(), ["configure", "activate"]);
}

#[tokio::test]
async fn following_nodes_is_charged_to_their_servant() {
    let world = LifecycleWorld::new(StubNodesDouble::default());
    let _node = Staged::start(&world, false, 2).await;
    world.wait_stage("active").await;
    assert!(world.budget.work_time() > Duration::ZERO);
}

#[tokio::test]
async fn what_a_node_refuses_is_an_event_and_stands_until_it_is_active() {
    let world = LifecycleWorld::new(StubNodesDouble::default());
    let node = Staged::start(&world, true, 2).await;
    let words = "the lifecycle node /sentry does not activate: /sentry did not activate, and is inactive now; see its \
        log: often a parameter (--param) or a device is missing";
    let refused = LifecycleStage { refused: Some(words.to_owned()), ..settled_stage("inactive") };
    assert_eq!(world.wait_stage("inactive").await, refused);
    let events = world.events.0.lock().clone();
    assert_eq!(events, [("lifecycle-refused".to_owned(), words.to_owned())]);
    node.transition(INACTIVE, UNCONFIGURED);
    let unconfigured = LifecycleStage { state: "unconfigured".to_owned(), ..refused };
    assert_eq!(world.wait_stage("unconfigured").await, unconfigured);
    node.transition(UNCONFIGURED, ACTIVE);
    assert_eq!(world.wait_stage("active").await, settled_stage("active"));
    assert_eq!(node.requested_transitions(), ["configure", "activate"]);
}

#[tokio::test]
async fn a_node_that_a_stub_has_started_is_left_to_the_robot() {
    let world = LifecycleWorld::new(StubNodesDouble::node(NODE));
    let node = Staged::start(&world, false, 2).await;
    assert_eq!(world.wait_stage("unconfigured").await, settled_stage("unconfigured"));
    assert!(node.requested_transitions().is_empty());
    node.transition(UNCONFIGURED, INACTIVE);
    assert_eq!(world.wait_stage("inactive").await, settled_stage("inactive"));
    assert!(node.requested_transitions().is_empty());
}

#[tokio::test]
async fn a_node_that_a_manager_drives_is_left_to_it() {
    let world = LifecycleWorld::new(StubNodesDouble::default());
    let manager = world.system.join("/manager");
    let change = service("lifecycle_msgs/srv/ChangeState");
    let _client = manager.seek("/sentry/change_state", change);
    let node = Staged::start(&world, false, 2).await;
    assert_eq!(world.wait_stage("unconfigured").await, settled_stage("unconfigured"));
    assert!(node.requested_transitions().is_empty());
}
