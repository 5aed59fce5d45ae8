use async_trait::async_trait;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{Publisher, Qos, ServiceHandler, ServiceType, WireFormat, WireType};
use tokio::sync::Semaphore;
use tokio::time::timeout;

use super::*;
use crate::doubles::{Events, Started};
use crate::memory_bus::{MemoryBus, MemorySystem};

/// Only bounds how long a failing test takes.
const LONG: Duration = Duration::from_secs(60);
const NODE: &str = "/sentry";
/// States by their numbers (`lifecycle_msgs/msg/State`).
const UNCONFIGURED: u8 = 1;
const INACTIVE: u8 = 2;
const ACTIVE: u8 = 3;

/// A servant without nodes so far.
struct World {
    system: Arc<MemorySystem>,
    events: Arc<Events>,
    lifecycles: Lifecycles,
}

impl World {
    fn new(started: Started) -> Self {
        let (system, events) = (Arc::<MemorySystem>::default(), Arc::<Events>::default());
        let bus: Arc<dyn Bus> = system.join("/cloudroid_bridge");
        let (nodes, observer): (Arc<dyn Nodes>, Arc<dyn Observer>) =
            (Arc::new(started), events.clone());
        let lifecycles = Lifecycles::follow(&bus, &nodes, &observer);
        Self {
            system,
            events,
            lifecycles: lifecycles.expect("ROS 2"),
        }
    }

    async fn until(&self, wanted: impl Fn(&Stages) -> bool) -> Stages {
        let mut stages = self.lifecycles.stages();
        let found = timeout(LONG, stages.wait_for(wanted)).await;
        found.expect("in time").expect("followed").clone()
    }

    /// What is shown of the node once it is in this state, and nobody is about to change that.
    async fn stage(&self, state: &str) -> Stage {
        let over = |stage: &Stage| stage.state == state && !stage.begins;
        let all = self.until(|all| all.get(NODE).is_some_and(over)).await;
        all[NODE].clone()
    }
}

/// What is shown of a node of which nothing is to be said.
fn shown(state: &str) -> Stage {
    Stage {
        state: state.to_owned(),
        refused: None,
        begins: false,
    }
}

/// A node with a lifecycle.
struct Staged {
    life: Arc<Life>,
    changes: Box<dyn Publisher>,
    _serving: Vec<Box<dyn Send + Sync>>,
    _node: Arc<MemoryBus>,
}

struct Life {
    state: Mutex<u8>,
    asked: Mutex<Vec<&'static str>>,
    /// It does not become active.
    refuses: bool,
    /// So many transitions are carried out.
    transitions: Semaphore,
}

/// A service of the node: it is asked for its state, or told to change it.
struct Part(Arc<Life>);

/// CDR, little endian.
const HEADER: [u8; 4] = [0, 1, 0, 0];

/// A number and an empty label.
fn put(out: &mut Vec<u8>, number: u8) {
    out.push(number);
    out.resize(out.len().next_multiple_of(4), 0);
    out.extend([1, 0, 0, 0, 0]);
}

#[async_trait]
impl ServiceHandler for Part {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, String> {
        let Part(life) = self;
        let mut answer = HEADER.to_vec();
        let told = String::from_utf8_lossy(&request).into_owned();
        let label = ["configure", "activate"].into_iter();
        let Some(label) = label.clone().find(|label| told.contains(label)) else {
            put(&mut answer, *life.state.lock());
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

/// The type of a part of every lifecycle.
fn service(part: &str) -> ServiceType {
    ServiceType::new(part, "*")
}

impl Staged {
    async fn start(world: &World, refuses: bool, transitions: usize) -> Self {
        let node = world.system.join(NODE);
        let of = WireType {
            name: "lifecycle_msgs/msg/TransitionEvent".to_owned(),
            format: WireFormat::Cdr,
            ..WireType::any()
        };
        let topic = format!("{NODE}/transition_event");
        let changes = node.advertise(&topic, of, Qos::keep_last(10)).await;
        let life = Arc::new(Life {
            state: Mutex::new(UNCONFIGURED),
            asked: Mutex::default(),
            refuses,
            transitions: Semaphore::new(transitions),
        });
        let mut serving = Vec::new();
        // By the last of them it is known to have a lifecycle.
        for (part, of) in [
            ("get_state", "lifecycle_msgs/srv/GetState"),
            ("change_state", "lifecycle_msgs/srv/ChangeState"),
        ] {
            let (name, handler) = (format!("{NODE}/{part}"), Arc::new(Part(life.clone())));
            let served = node.serve(&name, service(of), handler).await;
            serving.push(served.expect("served"));
        }
        Self {
            life,
            changes: changes.expect("advertised"),
            _serving: serving,
            _node: node,
        }
    }

    /// Somebody else has it go from one state to another.
    fn goes(&self, from: u8, to: u8) {
        *self.life.state.lock() = to;
        let mut event = HEADER.to_vec();
        // When it was.
        event.extend([0; 8]);
        for number in [0, from, to] {
            put(&mut event, number);
        }
        self.changes.publish(event.into());
    }

    fn asked(&self) -> Vec<&'static str> {
        self.life.asked.lock().clone()
    }
}

#[tokio::test]
async fn a_node_begins_as_it_appears_and_its_states_are_told() {
    let world = World::new(Started::default());
    // The daemon has other nodes: they are no managers.
    let ours = world.system.join("/cloudroid_probe");
    let change = service("lifecycle_msgs/srv/ChangeState");
    let _client = ours.seek("/sentry/change_state", change);
    let node = Staged::start(&world, false, 0).await;
    let begins = |all: &Stages| all.get(NODE).is_some_and(|stage| stage.begins);
    world.until(begins).await;
    node.life.transitions.add_permits(2);
    assert_eq!(world.stage("active").await, shown("active"));
    assert_eq!(node.asked(), ["configure", "activate"]);
    // Whoever watches does so a moment after it has begun.
    let watched = |matched: &ros::bus::Matched| matched.connected() == 1;
    let mut watchers = node.changes.matched();
    let waited = timeout(LONG, watchers.wait_for(watched)).await;
    waited.expect("in time").expect("advertised");
    node.goes(ACTIVE, INACTIVE);
    assert_eq!(world.stage("inactive").await, shown("inactive"));
    assert!(world.events.0.lock().is_empty());

    drop(node);
    world.until(Stages::is_empty).await;
    let again = Staged::start(&world, false, 2).await;
    assert_eq!(world.stage("active").await, shown("active"));
    assert_eq!(again.asked(), ["configure", "activate"]);
}

#[tokio::test]
async fn what_a_node_refuses_is_an_event_and_stands_until_it_is_active() {
    let world = World::new(Started::default());
    let node = Staged::start(&world, true, 2).await;
    let words = "the lifecycle node /sentry does not activate: /sentry did not activate, and is inactive now; its log says \
                 why, and what it lacks is often a parameter (--param) or a device";
    let refused = Stage {
        refused: Some(words.to_owned()),
        ..shown("inactive")
    };
    assert_eq!(world.stage("inactive").await, refused);
    let events = world.events.0.lock().clone();
    assert_eq!(events, [("lifecycle-refused".to_owned(), words.to_owned())]);
    node.goes(INACTIVE, UNCONFIGURED);
    let unconfigured = Stage {
        state: "unconfigured".to_owned(),
        ..refused
    };
    assert_eq!(world.stage("unconfigured").await, unconfigured);
    node.goes(UNCONFIGURED, ACTIVE);
    assert_eq!(world.stage("active").await, shown("active"));
    assert_eq!(node.asked(), ["configure", "activate"]);
}

#[tokio::test]
async fn a_node_that_a_stub_has_started_is_left_to_the_robot() {
    let world = World::new(Started::node(NODE));
    let node = Staged::start(&world, false, 2).await;
    assert_eq!(world.stage("unconfigured").await, shown("unconfigured"));
    assert!(node.asked().is_empty());
    node.goes(UNCONFIGURED, INACTIVE);
    assert_eq!(world.stage("inactive").await, shown("inactive"));
    assert!(node.asked().is_empty());
}

#[tokio::test]
async fn a_node_that_a_manager_drives_is_left_to_it() {
    let world = World::new(Started::default());
    let manager = world.system.join("/manager");
    let change = service("lifecycle_msgs/srv/ChangeState");
    let _client = manager.seek("/sentry/change_state", change);
    let node = Staged::start(&world, false, 2).await;
    assert_eq!(world.stage("unconfigured").await, shown("unconfigured"));
    assert!(node.asked().is_empty());
}
