//! Stubs of a shared service: a group of two servants with real Masters, and simulated robots' ends.

use std::collections::BTreeSet;
use std::sync::{Arc, Weak};
use std::time::Duration;

use async_trait::async_trait;
use bridge::BridgeOptions;
use budget::{Budget, Permit};
use bytes::Bytes;
use link::control::{Exit, FromCloud, FromRobot, Graph, Hello, NodeLaunch, Welcome};
use link::record::Record;
use link::session::{receive_open, send_open};
use link::{MAX_FRAME, MAX_RECORD, RobotSession, SessionHandler, SessionOptions};
use package::interface::Interface;
use package::inventory::Inventory;
use reach::group::dispatch::Rules;
use reach::group::{ServantGroup, open_seat};
use reach::links::MeasuredRequest;
use reach::{Observer, Reach, ReachOptions, RecordedRevision, Tenant};
use ros::bus::{Bus, FailureReason, ParamValue, RosVersion, ServiceHandler, ServiceType};
use ros::net::HostSockets;
use ros::ros1::Ros1Bus;
use ros::ros1::master::{Master, MasterOptions};
use ros::schema::Registry;
use serde_json::json;
use tokio::io::DuplexStream;
use tokio::sync::{Semaphore, mpsc};
use tokio::time::timeout;
use ws::WebSocket;

/// Only limits the duration of a failing test.
const PATIENCE: Duration = Duration::from_secs(120);

/// Answers with the request and its servant's name; "long" is never answered.
struct WorkService {
    servant: &'static str,
    asked: Semaphore,
}

#[async_trait]
impl ServiceHandler for WorkService {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        self.asked.add_permits(1);
        if &request[..] == b"long" {
            std::future::pending::<()>().await;
        }
        let asked = String::from_utf8_lossy(&request);
        Ok(format!("{asked} by {}", self.servant).into())
    }
}

/// A servant of the group.
struct Member {
    bus: Arc<Ros1Bus>,
    worker: Arc<WorkService>,
    _node: Arc<Ros1Bus>,
    _serves: Box<dyn Send + Sync>,
}

async fn member(servant: &'static str) -> Member {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let master = Master::new(MasterOptions::default());
    tokio::spawn(async move { master.serve(listener, Arc::new(HostSockets)).await });
    let join = |name: &'static str| Ros1Bus::connect(Arc::new(HostSockets), address, name);
    let (bus, node) = (join("/bridge").await, join("/worker").await);
    let worker = Arc::new(WorkService { servant, asked: Semaphore::new(0) });
    let node = node.unwrap();
    let serves = node.serve("/work", work(), worker.clone()).await;
    Member { bus: bus.unwrap(), worker, _node: node, _serves: serves.unwrap() }
}

fn work() -> ServiceType {
    ServiceType::new("x_msgs/Work", "0123456789abcdef0123456789abcdef")
}

struct NullObserver;

#[async_trait]
impl Observer for NullObserver {
    async fn check_stub(&self, _: Option<u64>, _: &str) -> Result<(), FailureReason> {
        Ok(())
    }
    fn record_event(&self, _: api::Level, _: &str, _: &str, _: Option<&str>) {}
    fn on_served_locally(&self, _: &str, _: &str, _: std::time::SystemTime, _: Option<&str>) {}
    fn on_request_measured(&self, _: Option<&str>, _: &MeasuredRequest<'_>) {}
}

#[async_trait]
impl Tenant for NullObserver {
    fn robot(&self) -> &str {
        "rover"
    }
    async fn take_over(&self) -> bool {
        false
    }
}

/// Creates a group with one node, `/worker`, that provides `/work`, a private service, and an action.
fn group() -> Arc<ServantGroup> {
    let md5 = work().digest.to_string();
    let interface = json!({
        "services": [
            { "name": "/work", "type": "x_msgs/Work", "md5": md5, "node": "/worker" },
            { "name": "/worker/set", "type": "x_msgs/Work", "md5": md5, "node": "/worker" },
        ],
        "actions": [{ "name": "/count", "type": "x_msgs/Count", "node": "/worker" }],
    });
    let interface: Interface = serde_json::from_value(interface).unwrap();
    let rules = Rules { window: 8, replicas: 1, idempotent: false };
    ServantGroup::new(RosVersion::One, "noetic", &interface, rules)
}

fn test_revision() -> RecordedRevision {
    let node = json!({ "name": "/worker", "argv": ["/opt/lib/works/worker"] });
    let definition = "int32 at\n---\nint32 at\n---\nint32 at\n".to_owned();
    let definitions = [("x_msgs/action/Count".to_owned(), definition)].into();
    RecordedRevision {
        service: "works".into(),
        package: "works".into(),
        flavour: Default::default(),
        environment: Default::default(),
        nodes: vec![serde_json::from_value(node).unwrap()],
        parameters: Default::default(),
        components: Default::default(),
        interface: Default::default(),
        inventory: Arc::new(Inventory {
            programs: [("worker".into(), "/opt/lib/works/worker".into())].into(),
            ..Inventory::default()
        }),
        registry: Arc::new(Registry::from_definitions(&definitions).unwrap()),
        egress: Vec::new(),
    }
}

/// Messages to a robot's end.
#[derive(Debug)]
enum StubEvent {
    Graph(Graph),
    Answer(u32, Result<Bytes, FailureReason>),
    Notice(String),
    Exited(Exit),
}

struct StubEventForwarder(mpsc::UnboundedSender<StubEvent>);

impl SessionHandler<FromCloud> for StubEventForwarder {
    fn on_record(&self, record: Record<FromCloud>, _held: Permit, _arrived: i64) {
        let told = match record {
            Record::Answer { id, response, .. } => StubEvent::Answer(id, response),
            Record::Control(FromCloud::Graph(graph)) => StubEvent::Graph(graph),
            Record::Control(FromCloud::Notice { text, .. }) => StubEvent::Notice(text),
            Record::Control(FromCloud::Exited(exit)) => StubEvent::Exited(exit),
            _ => return,
        };
        let _ = self.0.send(told);
    }
}

/// Opens a robot's place; also returns its tenant, which must be kept.
fn place(group: &Arc<ServantGroup>) -> (Arc<dyn Reach>, Arc<dyn Tenant>) {
    let options = ReachOptions {
        ros: RosVersion::One,
        distribution: "noetic".into(),
        bridge: BridgeOptions::default(),
        grace: Duration::from_secs(30),
        budget: Budget::without_limit(),
        unfinished: PATIENCE,
        rules: Arc::default(),
    };
    let reach = open_seat(group, "place", test_revision(), options, Arc::new(NullObserver));
    let tenant: Arc<dyn Tenant> = Arc::new(NullObserver);
    let weak: Weak<dyn Tenant> = Arc::downgrade(&tenant);
    reach.bind_tenant(weak);
    (reach, tenant)
}

/// A stub's end of a link.
struct Stub {
    session: Arc<RobotSession>,
    told: mpsc::UnboundedReceiver<StubEvent>,
}

fn hello(node: &str, argv: &[&str]) -> Hello {
    Hello {
        run: format!("run of {node}"),
        node: NodeLaunch {
            name: node.to_owned(),
            package: "works".to_owned(),
            executable: "worker".to_owned(),
            argv: argv.iter().map(|&argument| argument.to_owned()).collect(),
            ..NodeLaunch::default()
        },
        ..Hello::default()
    }
}

/// Sends a hello on a new connection; returns the welcome.
async fn send_hello(reach: &Arc<dyn Reach>, hello: &Hello) -> (WebSocket<DuplexStream>, Welcome) {
    let (theirs, ours) = tokio::io::duplex(1 << 16);
    let reach = Arc::clone(reach);
    tokio::spawn(async move { reach.serve_link(Box::new(theirs), &[], Box::pin(std::future::pending())).await });
    let mut socket = WebSocket::client(ours, &[], MAX_FRAME, MAX_RECORD, 7);
    send_open(&mut socket, hello).await.unwrap();
    let mut held = Budget::without_limit().permit();
    let welcome = receive_open(&mut socket, "welcome", &mut held).await.unwrap();
    (socket, welcome)
}

async fn stub(reach: &Arc<dyn Reach>, mut hello: Hello) -> Stub {
    let session = Arc::new(RobotSession::new(SessionOptions {
        ping: Duration::from_secs(1),
        silent: Duration::from_secs(2),
        lost: Duration::from_secs(20),
        max_age: None,
    }));
    hello.next = session.position().2;
    let (mut socket, welcome) = send_hello(reach, &hello).await;
    let Welcome::Accepted { received, ahead, next, .. } = welcome else {
        panic!("{welcome:?}");
    };
    session.reconnect(received, &ahead, next);
    let (ear, told) = mpsc::unbounded_channel();
    let runs = Arc::clone(&session);
    tokio::spawn(async move { runs.run(&mut socket, &StubEventForwarder(ear)).await });
    Stub { session, told }
}

impl Stub {
    async fn next_event(&mut self) -> StubEvent {
        let told = timeout(PATIENCE, self.told.recv()).await;
        told.expect("something should be told").unwrap()
    }

    /// Returns the next graph: names of services, of topics that the node subscribes to, and of topics that it
    /// publishes.
    async fn next_graph(&mut self) -> (Graph, [BTreeSet<String>; 3]) {
        loop {
            if let StubEvent::Graph(graph) = self.next_event().await {
                let services = graph.services.iter().map(|it| it.name.clone()).collect();
                let inputs = graph.inputs.iter().map(|it| it.topic.clone()).collect();
                let outputs = graph.outputs.iter().map(|it| it.topic.clone()).collect();
                return (graph, [services, inputs, outputs]);
            }
        }
    }

    /// Calls a service; returns the response.
    async fn call(&mut self, channel: u32, request: &str) -> Result<String, FailureReason> {
        let asked = self.session.call(channel, request.to_owned().into());
        self.answer(asked).await
    }

    async fn answer(&mut self, asked: u32) -> Result<String, FailureReason> {
        loop {
            if let StubEvent::Answer(id, answer) = self.next_event().await {
                assert_eq!(id, asked, "of another call");
                return answer.map(|it| String::from_utf8_lossy(&it).into_owned());
            }
        }
    }
}

fn channel(graph: &Graph, service: &str) -> u32 {
    let mut services = graph.services.iter();
    services.find(|it| it.name == service).expect(service).channel
}

fn set<const N: usize>(names: [&str; N]) -> BTreeSet<String> {
    names.map(str::to_owned).into()
}

#[tokio::test]
async fn stubs_have_their_robots_names_and_the_groups_answers() {
    let group = group();
    let members = [member("one").await, member("two").await];
    for member in &members {
        group.join(member.worker.servant, member.bus.clone());
    }
    let ((first, _one), (second, _two)) = (place(&group), place(&group));
    let mut plain = stub(&first, hello("/worker", &[])).await;
    let mut front = hello("/front/hands", &["work:=/plan", "count:=tally"]);
    front.run = "another".to_owned();
    let mut front = stub(&second, front).await;
    let (graph, names) = plain.next_graph().await;
    let inputs = set(["/count/cancel", "/count/goal"]);
    let outputs = set(["/count/feedback", "/count/result", "/count/status"]);
    assert_eq!(names, [set(["/work", "/worker/set"]), inputs, outputs]);
    let (theirs, names) = front.next_graph().await;
    assert_eq!(names[0], set(["/front/hands/set", "/plan"]));
    assert_eq!(names[1], set(["/front/tally/cancel", "/front/tally/goal"]));
    // Each call goes to the servant with the lowest load, each response to its caller.
    let (work, plan) = (channel(&graph, "/work"), channel(&theirs, "/plan"));
    let mut by = BTreeSet::new();
    for number in 0..4 {
        let asked = [format!("plain {number}"), format!("front {number}")];
        for (stub, channel, words) in [(&mut plain, work, &asked[0]), (&mut front, plan, &asked[1])] {
            let answer = stub.call(channel, words).await.unwrap();
            let (said, servant) = answer.split_once(" by ").unwrap();
            assert_eq!(said, words);
            by.insert(servant.to_owned());
        }
    }
    assert_eq!(by, set(["one", "two"]));
    // Rosbridge clients of the same robot keep the deployer's names.
    let shown = second.graph().borrow().services.clone();
    assert!(shown.contains_key("/work") && !shown.contains_key("/plan"));
}

#[tokio::test]
async fn a_call_of_a_stub_at_a_lost_servant_fails_and_the_next_is_answered() {
    let group = group();
    let members = [member("one").await, member("two").await];
    let ids = members.each_ref().map(|member| group.join(member.worker.servant, member.bus.clone()));
    let (reach, _tenant) = place(&group);
    let mut stub = stub(&reach, hello("/worker", &[])).await;
    let work = channel(&stub.next_graph().await.0, "/work");
    let asked = stub.session.call(work, "long".into());
    let has = |at: usize| members[at].worker.asked.acquire();
    let lost = tokio::select! {
        permit = has(0) => { permit.unwrap().forget(); 0 }
        permit = has(1) => { permit.unwrap().forget(); 1 }
    };
    group.leave(ids[lost], "its power went");
    let reason = stub.answer(asked).await.unwrap_err().to_string();
    let servant = members[lost].worker.servant;
    assert!(reason.contains(servant) && reason.contains("its power went"), "{reason}");
    assert!(reason.contains("--idempotent"), "{reason}");
    let other = members[1 - lost].worker.servant;
    let answer = stub.call(work, "again").await;
    assert_eq!(answer, Ok(format!("again by {other}")));
}

#[tokio::test]
async fn a_stub_that_is_told_to_end_takes_its_names_back() {
    let group = group();
    let (reach, _tenant) = place(&group);
    let mut one = stub(&reach, hello("/one", &[])).await;
    let mut other = stub(&reach, hello("/other", &["work:=/plan"])).await;
    assert_eq!(other.next_graph().await.1[0], set(["/other/set", "/plan"]));
    assert_eq!(one.next_graph().await.1[0], set(["/one/set", "/work"]));
    one.session.send_control(&FromRobot::Signal { signal: 2 });
    let exit = loop {
        if let StubEvent::Exited(exit) = one.next_event().await {
            break exit;
        }
    };
    assert_eq!(exit.code, Some(0), "{exit:?}");
    assert_eq!(reach.links().len(), 2, "its link ends with its stub");
    // Other signals do not end the node.
    other.session.send_control(&FromRobot::Signal { signal: 18 });
    other.session.send_control(&FromRobot::Signal { signal: 15 });
    let exit = loop {
        if let StubEvent::Exited(exit) = other.next_event().await {
            break exit;
        }
    };
    assert!(exit.text.contains("/other"), "{exit:?}");
}

#[tokio::test]
async fn what_a_robot_gives_the_shared_node_in_vain_is_told_and_other_programs_are_refused() {
    let group = group();
    let (reach, _tenant) = place(&group);
    let mut gives = hello("/worker", &["_speed:=3"]);
    let own = ParamValue::Map([("gain".to_owned(), ParamValue::Int(1))].into());
    gives.parameters = [("worker".to_owned(), own)].into();
    let mut stub = stub(&reach, gives).await;
    let told = loop {
        if let StubEvent::Notice(told) = stub.next_event().await {
            break told;
        }
    };
    for words in ["works", "/worker", "~gain, ~speed", "--shared"] {
        assert!(told.contains(words), "{told}");
    }
    let mut stranger = hello("/shell", &[]);
    stranger.node.executable = "sh".to_owned();
    let (_, welcome) = send_hello(&reach, &stranger).await;
    match welcome {
        Welcome::Refused { reason, again } => {
            assert!(reason.contains("was not pushed with") && !again, "{reason}");
        }
        accepted => panic!("{accepted:?}"),
    }
}
