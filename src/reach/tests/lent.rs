//! Services of the robot for nodes of the servant: a hub with a real Master, and a simulated robot's end.

use std::sync::Arc;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use budget::{Budget, Permit};
use bytes::Bytes;
use link::clock::now;
use link::control::{Exit, FromCloud, FromRobot, Hello, NodeLaunch, ServiceChannel, Welcome};
use link::record::{Call, Record};
use link::session::{receive_open, send_open};
use link::{MAX_FRAME, MAX_RECORD, RobotSession, SessionHandler, SessionOptions};
use reach::links::{Hub, HubOptions, NodeController, NodeError};
use ros::bus::{Bus, BusError, FailureReason, ParamValue};
use ros::net::HostSockets;
use ros::ros1::Ros1Bus;
use ros::ros1::master::{Master, MasterOptions};
use ros::schema::Registry;
use tokio::io::DuplexStream;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};
use ws::WebSocket;

/// Only limits the duration of a failing test.
const PATIENCE: Duration = Duration::from_secs(120);

/// Nodes that are always running.
struct RunningNodes;

#[async_trait]
impl NodeController for RunningNodes {
    async fn start(&self, _: &NodeLaunch, _: &str) -> Result<(), NodeError> {
        Ok(())
    }
    async fn signal(&self, _: &str, _: i32) -> Result<(), NodeError> {
        Err(NodeError::ServantEnded)
    }
    async fn wait_exit(&self, _: &str) -> Exit {
        std::future::pending().await
    }
    async fn is_running(&self, _: &str) -> bool {
        false
    }
    fn parameters(&self, _: &NodeLaunch) -> Vec<(String, ParamValue)> {
        Vec::new()
    }
    fn translate(&self, _: &NodeLaunch, text: &str) -> String {
        text.to_owned()
    }
    fn warn(&self, _: &str, _: &str) {}
    fn output_lines(&self, _: &str) -> mpsc::Receiver<(bool, String)> {
        mpsc::channel(1).1
    }
}

/// A servant with a node.
struct Servant {
    hub: Arc<Hub>,
    bus: Arc<Ros1Bus>,
    node: Arc<Ros1Bus>,
}

async fn servant() -> Servant {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let master = Master::new(MasterOptions::default());
    tokio::spawn(async move { master.serve(listener, Arc::new(HostSockets)).await });
    let join = |name: &'static str| Ros1Bus::connect(Arc::new(HostSockets), address, name);
    let (bus, node) = (join("/bridge").await.unwrap(), join("/node").await.unwrap());
    let registry = Arc::new(Registry::new());
    let options = HubOptions::default();
    Servant { hub: Hub::new("s", bus.clone(), registry, Arc::new(RunningNodes), options), bus, node }
}

/// Messages to the robot's end about services.
#[derive(Debug, PartialEq)]
enum LinkEvent {
    Lookup(String),
    Call(u32, u32, Bytes),
}

struct LinkEventForwarder(mpsc::UnboundedSender<LinkEvent>);

impl SessionHandler<FromCloud> for LinkEventForwarder {
    fn on_record(&self, record: Record<FromCloud>, _held: Permit, _arrived: i64) {
        let told = match record {
            Record::Call(Call { id, service, request }) => LinkEvent::Call(id, service, request),
            Record::Control(FromCloud::Lookup { service }) => LinkEvent::Lookup(service),
            _ => return,
        };
        let _ = self.0.send(told);
    }
}

/// The robot's end of a link.
struct ManualRobot {
    session: Arc<RobotSession>,
    hello: Hello,
    ear: mpsc::UnboundedSender<LinkEvent>,
    told: mpsc::UnboundedReceiver<LinkEvent>,
    running: Option<JoinHandle<()>>,
}

impl ManualRobot {
    fn new(lends: bool) -> Self {
        let options = SessionOptions {
            ping: Duration::from_secs(1),
            silent: Duration::from_secs(2),
            lost: Duration::from_secs(20),
            max_age: None,
        };
        let (ear, told) = mpsc::unbounded_channel();
        Self {
            session: Arc::new(RobotSession::new(options)),
            hello: Hello {
                run: "run".to_owned(),
                node: NodeLaunch { name: "/node".to_owned(), ..NodeLaunch::default() },
                lends,
                ..Hello::default()
            },
            ear,
            told,
            running: None,
        }
    }

    /// Connects or reconnects.
    async fn connect(&mut self, servant: &Servant) {
        let (theirs, ours) = tokio::io::duplex(1 << 16);
        let hub = Arc::clone(&servant.hub);
        tokio::spawn(async move { hub.serve_until(theirs, &[], std::future::pending()).await });
        let mut socket: WebSocket<DuplexStream> = WebSocket::client(ours, &[], MAX_FRAME, MAX_RECORD, 7);
        let (have, ahead, next) = self.session.position();
        self.hello.next = next;
        if let Some(resume) = &mut self.hello.resume {
            (resume.received, resume.ahead) = (have, ahead);
        }
        send_open(&mut socket, &self.hello).await.unwrap();
        let mut held = Budget::without_limit().permit();
        let welcome = receive_open(&mut socket, "welcome", &mut held).await.unwrap();
        let Welcome::Accepted { session, received, ahead, next, .. } = welcome else {
            panic!("{welcome:?}");
        };
        self.hello.resume.get_or_insert_default().session = session;
        self.session.reconnect(received, &ahead, next);
        let (session, ear) = (Arc::clone(&self.session), LinkEventForwarder(self.ear.clone()));
        self.running = Some(tokio::spawn(async move {
            session.run(&mut socket, &ear).await;
        }));
    }

    /// Cuts the connection.
    async fn disconnect(&mut self) {
        if let Some(running) = self.running.take() {
            running.abort();
            let _ = running.await;
        }
    }

    async fn next_event(&mut self) -> LinkEvent {
        let told = timeout(PATIENCE, self.told.recv()).await;
        told.expect("something should be told").unwrap()
    }

    /// Waits for the next call on this channel with this request; returns its id. A repeated lookup may arrive at any
    /// time.
    async fn expect_call(&mut self, channel: u32, request: &str) -> u32 {
        loop {
            match self.next_event().await {
                LinkEvent::Lookup(_) => {}
                LinkEvent::Call(id, of, with) => {
                    assert_eq!((of, &with[..]), (channel, request.as_bytes()));
                    return id;
                }
            }
        }
    }

    /// Reports what it has under `/map`.
    fn send_lent(&self, channel: Option<u32>) {
        let of = channel.map(|channel| ServiceChannel {
            channel,
            name: "/map".to_owned(),
            type_name: "nav_msgs/GetMap".to_owned(),
            md5: "abcd".to_owned(),
            ..ServiceChannel::default()
        });
        let service = "/map".to_owned();
        self.session.send_control(&FromRobot::Lent { service, of });
    }
}

fn lookup() -> LinkEvent {
    LinkEvent::Lookup("/map".to_owned())
}

/// Starts a call of `/map` by the node.
fn call_map(servant: &Servant, request: &'static str) -> JoinHandle<Result<Bytes, BusError>> {
    let node = Arc::clone(&servant.node);
    tokio::spawn(async move { node.call("/map", request.into(), PATIENCE).await })
}

/// Calls `/map` until something provides it, with the robot answering, and returns the response. A node that waits for
/// a service polls fifty times a second (roscpp), because nothing announces one that is lent.
async fn call_until_served(servant: &Servant, request: &'static str, part: impl Future<Output = ()>) -> Bytes {
    let called = async {
        loop {
            match call_map(servant, request).await.unwrap() {
                Err(BusError::NoService(_)) => sleep(Duration::from_millis(20)).await,
                other => return other.unwrap(),
            }
        }
    };
    let both = async { tokio::join!(called, part) };
    timeout(PATIENCE, both).await.expect("it should be served").0
}

#[tokio::test]
async fn a_lookup_goes_to_the_robot_and_calls_follow_it() {
    let servant = servant().await;
    let mut robot = ManualRobot::new(true);
    robot.connect(&servant).await;
    // Concurrent lookups share one request.
    let both = [call_map(&servant, "one"), call_map(&servant, "one")];
    assert_eq!(robot.next_event().await, lookup());
    robot.send_lent(Some(5));
    for _ in &both {
        let id = robot.expect_call(5, "one").await;
        robot.session.answer(id, now(), Ok("two".into()));
    }
    for call in both {
        assert_eq!(call.await.unwrap().unwrap(), "two");
    }
    // Once found, it is not awaited again; failures carry the robot's message.
    let call = call_map(&servant, "three");
    let id = robot.expect_call(5, "three").await;
    let reason = FailureReason::new("not today");
    robot.session.answer(id, now(), Err(reason));
    let error = call.await.unwrap().unwrap_err().to_string();
    assert!(error.contains("not today"), "{error}");
    // A later lookup makes the robot check again, because another server may have replaced it.
    let confirmed = async {
        loop {
            let _ = servant.node.service_type("/map").await;
        }
    };
    let confirmed = async {
        tokio::select! {
            told = robot.next_event() => told,
            () = confirmed => unreachable!("it has no end"),
        }
    };
    assert_eq!(timeout(PATIENCE, confirmed).await.unwrap(), lookup());
    // The same service from another server of the robot: calls go there.
    robot.send_lent(Some(9));
    let call = call_map(&servant, "again");
    let id = robot.expect_call(9, "again").await;
    robot.session.answer(id, now(), Ok("and again".into()));
    assert_eq!(call.await.unwrap().unwrap(), "and again");
    // Once withdrawn, it is looked up again.
    robot.send_lent(None);
    let gone = loop {
        match call_map(&servant, "four").await.unwrap() {
            Err(BusError::NoService(gone)) => break gone,
            // Its connection has not ended yet.
            Err(BusError::CallFailed { reason, .. }) => {
                assert!(reason.contains("any more"), "{reason}");
            }
            other => panic!("{other:?}"),
        }
    };
    assert_eq!(gone, "/map");
    let answering = async {
        assert_eq!(robot.next_event().await, lookup());
        robot.send_lent(Some(6));
        let id = robot.expect_call(6, "five").await;
        robot.session.answer(id, now(), Ok("six".into()));
    };
    // "Not there" is valid for a moment.
    assert_eq!(call_until_served(&servant, "five", answering).await, "six");
}

#[tokio::test]
async fn while_the_link_is_down_one_lookup_waits_and_the_next_do_not() {
    let servant = servant().await;
    let mut robot = ManualRobot::new(true);
    robot.connect(&servant).await;
    robot.disconnect().await;
    let waits = async || {
        let begun = Instant::now();
        let called = call_map(&servant, "x").await.unwrap();
        assert!(matches!(called, Err(BusError::NoService(_))), "{called:?}");
        begun.elapsed()
    };
    let (first, second) = (waits().await, waits().await);
    assert!(second < first / 2, "{first:?}, then {second:?}");
    let mut graph = servant.bus.graph();
    let known = graph.wait_for(|graph| graph.sought.contains_key("/map"));
    timeout(PATIENCE, known).await.unwrap().unwrap();
    assert_eq!(servant.hub.status()[0].unserved, ["/map"]);
    // The lookup was not lost.
    robot.connect(&servant).await;
    assert_eq!(robot.next_event().await, lookup());
    robot.send_lent(Some(1));
    let answering = async {
        let id = robot.expect_call(1, "y").await;
        robot.session.answer(id, now(), Ok("z".into()));
    };
    assert_eq!(call_until_served(&servant, "y", answering).await, "z");
    assert!(servant.hub.status()[0].unserved.is_empty());
}

#[tokio::test]
async fn a_lookup_that_is_not_answered_is_asked_again() {
    let servant = servant().await;
    let mut robot = ManualRobot::new(true);
    robot.connect(&servant).await;
    let answering = async {
        assert_eq!(robot.next_event().await, lookup());
        // That answer is lost.
        assert_eq!(robot.next_event().await, lookup());
        robot.send_lent(Some(1));
        let id = robot.expect_call(1, "x").await;
        robot.session.answer(id, now(), Ok("y".into()));
    };
    assert_eq!(call_until_served(&servant, "x", answering).await, "y");
}

#[tokio::test]
async fn a_call_outlives_a_cut_and_ends_with_the_link() {
    let servant = servant().await;
    let mut robot = ManualRobot::new(true);
    robot.connect(&servant).await;
    let call = call_map(&servant, "one");
    assert_eq!(robot.next_event().await, lookup());
    robot.send_lent(Some(1));
    let id = robot.expect_call(1, "one").await;
    robot.disconnect().await;
    robot.session.answer(id, now(), Ok("two".into()));
    robot.connect(&servant).await;
    assert_eq!(call.await.unwrap().unwrap(), "two");
    // The robot ends its node during the next call.
    let call = call_map(&servant, "three");
    robot.expect_call(1, "three").await;
    robot.session.close(1000, "the robot's node ended");
    let error = timeout(PATIENCE, call).await.unwrap().unwrap().unwrap_err();
    assert!(error.to_string().contains("the link to the robot was lost"), "{error}");
}

#[tokio::test]
async fn a_robot_that_does_not_lend_is_not_asked() {
    let servant = servant().await;
    let mut robot = ManualRobot::new(false);
    robot.connect(&servant).await;
    let called = call_map(&servant, "x").await.unwrap();
    assert!(matches!(called, Err(BusError::NoService(_))), "{called:?}");
    assert!(robot.told.try_recv().is_err());
}
