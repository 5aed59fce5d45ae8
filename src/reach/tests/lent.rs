//! Services of the robot for nodes of the servant: a hub before a real Master, and a robot's end made by hand.

use std::sync::Arc;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use budget::{Budget, Permit};
use bytes::Bytes;
use link::clock::now;
use link::control::{Exit, FromCloud, FromRobot, Hello, Node, Served, Welcome};
use link::record::Record;
use link::session::{receive_open, send_open};
use link::{Handler, MAX_FRAME, MAX_RECORD, RobotSession, SessionOptions};
use reach::links::{Hub, HubOptions, Nodes};
use ros::bus::{Bus, BusError, ParamValue};
use ros::net::HostSockets;
use ros::ros1::Ros1Bus;
use ros::ros1::master::{Master, MasterOptions};
use ros::schema::Registry;
use tokio::io::DuplexStream;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};
use ws::WebSocket;

/// Only bounds how long a failing test takes.
const LONG: Duration = Duration::from_secs(120);

/// Nodes that run whatever happens.
struct Still;

#[async_trait]
impl Nodes for Still {
    async fn start(&self, _: &Node, _: &str) -> Result<(), String> {
        Ok(())
    }
    async fn signal(&self, _: &str, _: i32) -> Result<(), String> {
        Err("it does not run".to_owned())
    }
    async fn ended(&self, _: &str) -> Exit {
        std::future::pending().await
    }
    async fn is_running(&self, _: &str) -> bool {
        false
    }
    fn parameters(&self, _: &Node) -> Vec<(String, ParamValue)> {
        Vec::new()
    }
    fn translate(&self, _: &Node, text: &str) -> String {
        text.to_owned()
    }
    fn warn(&self, _: &str, _: &str) {}
    fn lines(&self, _: &str) -> mpsc::Receiver<(bool, String)> {
        mpsc::channel(1).1
    }
}

/// A servant with a node in it.
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
    Servant {
        hub: Hub::new("s", bus.clone(), registry, Arc::new(Still), options),
        bus,
        node,
    }
}

/// What the robot's end is told, that is about services.
#[derive(Debug, PartialEq)]
enum Told {
    Lookup(String),
    Call(u32, u32, Bytes),
}

struct Ear(mpsc::UnboundedSender<Told>);

impl Handler<FromCloud> for Ear {
    fn record(&self, record: Record<FromCloud>, _held: Permit, _arrived: i64) {
        let told = match record {
            Record::Call {
                id,
                service,
                request,
            } => Told::Call(id, service, request),
            Record::Control(FromCloud::Lookup { service }) => Told::Lookup(service),
            _ => return,
        };
        let _ = self.0.send(told);
    }
}

/// The robot's end of a link.
struct Robot {
    session: Arc<RobotSession>,
    hello: Hello,
    ear: mpsc::UnboundedSender<Told>,
    told: mpsc::UnboundedReceiver<Told>,
    running: Option<JoinHandle<()>>,
}

impl Robot {
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
                node: Node {
                    name: "/node".to_owned(),
                    ..Node::default()
                },
                lends,
                ..Hello::default()
            },
            ear,
            told,
            running: None,
        }
    }

    /// Connects, or connects again.
    async fn links(&mut self, servant: &Servant) {
        let (theirs, ours) = tokio::io::duplex(1 << 16);
        let hub = Arc::clone(&servant.hub);
        tokio::spawn(async move { hub.serve(theirs, &[]).await });
        let mut socket: WebSocket<DuplexStream> =
            WebSocket::client(ours, &[], MAX_FRAME, MAX_RECORD, 7);
        let (have, ahead, next) = self.session.position();
        self.hello.next = next;
        if let Some(resume) = &mut self.hello.resume {
            (resume.received, resume.ahead) = (have, ahead);
        }
        send_open(&mut socket, &self.hello).await.unwrap();
        let mut held = Budget::unlimited().permit();
        let welcome = receive_open(&mut socket, "welcome", &mut held)
            .await
            .unwrap();
        let Welcome::Accepted {
            session,
            received,
            ahead,
            next,
            ..
        } = welcome
        else {
            panic!("{welcome:?}");
        };
        self.hello.resume.get_or_insert_default().session = session;
        self.session.reconnect(received, &ahead, next);
        let (session, ear) = (Arc::clone(&self.session), Ear(self.ear.clone()));
        self.running = Some(tokio::spawn(async move {
            session.run(&mut socket, &ear).await;
        }));
    }

    /// The connection is gone.
    async fn is_cut(&mut self) {
        if let Some(running) = self.running.take() {
            running.abort();
            let _ = running.await;
        }
    }

    async fn hears(&mut self) -> Told {
        let told = timeout(LONG, self.told.recv()).await;
        told.expect("something should be told").unwrap()
    }

    /// The next call, by its id: of this channel and with this request. The question whether all is as it was may come
    /// at any time.
    async fn is_called(&mut self, channel: u32, request: &str) -> u32 {
        loop {
            match self.hears().await {
                Told::Lookup(_) => {}
                Told::Call(id, of, with) => {
                    assert_eq!((of, &with[..]), (channel, request.as_bytes()));
                    return id;
                }
            }
        }
    }

    /// Tells what it has under `/map`.
    fn has(&self, channel: Option<u32>) {
        let of = channel.map(|channel| Served {
            channel,
            name: "/map".to_owned(),
            type_name: "nav_msgs/GetMap".to_owned(),
            md5: "abcd".to_owned(),
            ..Served::default()
        });
        let service = "/map".to_owned();
        self.session.report(&FromRobot::Lent { service, of });
    }
}

fn lookup() -> Told {
    Told::Lookup("/map".to_owned())
}

/// A call of `/map` by the node, under way.
fn calls(servant: &Servant, request: &'static str) -> JoinHandle<Result<Bytes, BusError>> {
    let node = Arc::clone(&servant.node);
    tokio::spawn(async move { node.call("/map", request.into(), LONG).await })
}

/// Calls `/map` until something serves it, while the robot does its part: what is answered then. A node that waits for a service
/// looks fifty times a second (roscpp): nothing tells it of one that is lent.
async fn is_served(
    servant: &Servant,
    request: &'static str,
    part: impl Future<Output = ()>,
) -> Bytes {
    let called = async {
        loop {
            match calls(servant, request).await.unwrap() {
                Err(BusError::NoService(_)) => sleep(Duration::from_millis(20)).await,
                other => return other.unwrap(),
            }
        }
    };
    let both = async { tokio::join!(called, part) };
    timeout(LONG, both).await.expect("it should be served").0
}

#[tokio::test]
async fn a_lookup_goes_to_the_robot_and_calls_follow_it() {
    let servant = servant().await;
    let mut robot = Robot::new(true);
    robot.links(&servant).await;
    // Those who look at the same time share one question.
    let both = [calls(&servant, "one"), calls(&servant, "one")];
    assert_eq!(robot.hears().await, lookup());
    robot.has(Some(5));
    for _ in &both {
        let id = robot.is_called(5, "one").await;
        robot.session.answer(id, now(), Ok("two".into()));
    }
    for call in both {
        assert_eq!(call.await.unwrap().unwrap(), "two");
    }
    // Found, it is not waited for again; what fails, fails with the robot's words.
    let call = calls(&servant, "three");
    let id = robot.is_called(5, "three").await;
    let reason = "not today".to_owned();
    robot.session.answer(id, now(), Err(reason));
    let error = call.await.unwrap().unwrap_err().to_string();
    assert!(error.contains("not today"), "{error}");
    // Whoever looks a while later has the robot look, too: another may have taken its place.
    let confirmed = async {
        loop {
            let _ = servant.node.service_type("/map").await;
        }
    };
    let confirmed = async {
        tokio::select! {
            told = robot.hears() => told,
            () = confirmed => unreachable!("it has no end"),
        }
    };
    assert_eq!(timeout(LONG, confirmed).await.unwrap(), lookup());
    // The same from another server of the robot: calls go there.
    robot.has(Some(9));
    let call = calls(&servant, "again");
    let id = robot.is_called(9, "again").await;
    robot.session.answer(id, now(), Ok("and again".into()));
    assert_eq!(call.await.unwrap().unwrap(), "and again");
    // Taken back, it is looked for again.
    robot.has(None);
    let gone = loop {
        match calls(&servant, "four").await.unwrap() {
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
        assert_eq!(robot.hears().await, lookup());
        robot.has(Some(6));
        let id = robot.is_called(6, "five").await;
        robot.session.answer(id, now(), Ok("six".into()));
    };
    // "Not there" holds for a moment.
    assert_eq!(is_served(&servant, "five", answering).await, "six");
}

#[tokio::test]
async fn while_the_link_is_down_one_lookup_waits_and_the_next_do_not() {
    let servant = servant().await;
    let mut robot = Robot::new(true);
    robot.links(&servant).await;
    robot.is_cut().await;
    let waits = async || {
        let begun = Instant::now();
        let called = calls(&servant, "x").await.unwrap();
        assert!(matches!(called, Err(BusError::NoService(_))), "{called:?}");
        begun.elapsed()
    };
    let (first, second) = (waits().await, waits().await);
    assert!(second < first / 2, "{first:?}, then {second:?}");
    let mut graph = servant.bus.graph();
    let known = graph.wait_for(|graph| graph.sought.contains_key("/map"));
    timeout(LONG, known).await.unwrap().unwrap();
    assert_eq!(servant.hub.status()[0].unserved, ["/map"]);
    // The question was not lost.
    robot.links(&servant).await;
    assert_eq!(robot.hears().await, lookup());
    robot.has(Some(1));
    let answering = async {
        let id = robot.is_called(1, "y").await;
        robot.session.answer(id, now(), Ok("z".into()));
    };
    assert_eq!(is_served(&servant, "y", answering).await, "z");
    assert!(servant.hub.status()[0].unserved.is_empty());
}

#[tokio::test]
async fn a_lookup_that_is_not_answered_is_asked_again() {
    let servant = servant().await;
    let mut robot = Robot::new(true);
    robot.links(&servant).await;
    let answering = async {
        assert_eq!(robot.hears().await, lookup());
        // That answer is lost.
        assert_eq!(robot.hears().await, lookup());
        robot.has(Some(1));
        let id = robot.is_called(1, "x").await;
        robot.session.answer(id, now(), Ok("y".into()));
    };
    assert_eq!(is_served(&servant, "x", answering).await, "y");
}

#[tokio::test]
async fn a_call_outlives_a_cut_and_ends_with_the_link() {
    let servant = servant().await;
    let mut robot = Robot::new(true);
    robot.links(&servant).await;
    let call = calls(&servant, "one");
    assert_eq!(robot.hears().await, lookup());
    robot.has(Some(1));
    let id = robot.is_called(1, "one").await;
    robot.is_cut().await;
    robot.session.answer(id, now(), Ok("two".into()));
    robot.links(&servant).await;
    assert_eq!(call.await.unwrap().unwrap(), "two");
    // The robot ends its node in the midst of the next one.
    let call = calls(&servant, "three");
    robot.is_called(1, "three").await;
    robot.session.end(1000, "the robot's node ended");
    let error = timeout(LONG, call).await.unwrap().unwrap().unwrap_err();
    assert!(
        error.to_string().contains("the link to the robot was lost"),
        "{error}"
    );
}

#[tokio::test]
async fn a_robot_that_does_not_lend_is_not_asked() {
    let servant = servant().await;
    let mut robot = Robot::new(false);
    robot.links(&servant).await;
    let called = calls(&servant, "x").await.unwrap();
    assert!(matches!(called, Err(BusError::NoService(_))), "{called:?}");
    assert!(robot.told.try_recv().is_err());
}
