//! A robot's ROS, a servant's, and the two ends of a link between them: a mirror and a hub. Nodes are real ones of this
//! process, but for the local original.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bytes::Bytes;
use link::SessionOptions;
use link::control::{Exit, Hello, Node, Output, Welcome};
use link::record::Data;
use link::session::{receive_open, send_open};
use link::{MAX_FRAME, MAX_RECORD};
use qos::{Side, Sla};
use reach::links::{Hub, HubOptions, Nodes};
use ros::bus::{Graph as Seen, Publisher, Qos, ServiceHandler, ServiceType, Subscription};
use ros::net::HostSockets;
use ros::ros1::Ros1Bus;
use ros::ros1::master::{Master, MasterOptions};
use ros::schema::Registry;
use tokio::task::JoinHandle;
use tokio::time::timeout;
use ws::WebSocket;

use super::diagnostics::Diagnostics;
use super::*;
use crate::local::tests::{SOON, setting, string, string_type, text};

/// Nodes that run whatever happens.
struct Still;

#[async_trait]
impl Nodes for Still {
    async fn start(&self, _: &Node) -> Result<(), String> {
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

async fn master() -> SocketAddr {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let master = Master::new(MasterOptions::default());
    tokio::spawn(async move { master.serve(listener, Arc::new(HostSockets)).await });
    address
}

async fn node(at: SocketAddr, name: &str) -> Arc<Ros1Bus> {
    let joined = Ros1Bus::connect(Arc::new(HostSockets), at, name);
    joined.await.unwrap()
}

async fn says(node: &Ros1Bus, topic: &str, latch: bool) -> Box<dyn Publisher> {
    node.advertise(topic, string_type(), Qos::keep_last(100).latching(latch))
        .await
        .unwrap()
}

async fn hears(node: &Ros1Bus, topic: &str) -> Subscription {
    node.subscribe(topic, string_type(), Qos::keep_last(100))
        .await
        .unwrap()
}

async fn next(subscription: &mut Subscription) -> String {
    let next = timeout(SOON, subscription.messages.recv()).await;
    text(&next.expect("a message should come").unwrap())
}

async fn until(node: &Ros1Bus, what: &str, wanted: impl Fn(&Seen) -> bool) {
    let mut graph = node.graph();
    let seen = timeout(SOON, graph.wait_for(|graph| wanted(graph)))
        .await
        .is_ok();
    assert!(seen, "{what}: {:#?}", node.graph().borrow());
}

fn bytes(text: &str) -> Bytes {
    string(text).bytes
}

/// A robot with a mirror of this node, and its servant, where that node is of this process.
struct Scene {
    robot: SocketAddr,
    mirror: Arc<Mirror>,
    name: &'static str,
    servant: SocketAddr,
    hub: Arc<Hub>,
    real: Arc<Ros1Bus>,
}

impl Scene {
    async fn new(name: &'static str) -> Self {
        let (robot, servant) = (master().await, master().await);
        let bridge = node(servant, "/bridge").await;
        let (registry, options) = (Arc::new(Registry::new()), HubOptions::default());
        let session = SessionOptions {
            ping: Duration::from_secs(1),
            silent: Duration::from_secs(10),
            lost: Duration::from_secs(20),
            max_age: None,
        };
        let session = Arc::new(RobotSession::new(session));
        Self {
            robot,
            mirror: Mirror::start(node(robot, name).await, "label".to_owned(), session, SOON),
            name,
            servant,
            hub: Hub::new("s", bridge, registry, Arc::new(Still), options),
            real: node(servant, name).await,
        }
    }

    /// The link, until its task is aborted.
    async fn links(&self) -> JoinHandle<()> {
        let (theirs, ours) = tokio::io::duplex(1 << 16);
        let hub = Arc::clone(&self.hub);
        tokio::spawn(async move { hub.serve(theirs, &[]).await });
        let mut socket = WebSocket::client(ours, &[], MAX_FRAME, MAX_RECORD, 7);
        let (_, _, next) = self.mirror.session().position();
        let hello = Hello {
            run: "run".to_owned(),
            next,
            node: Node {
                name: self.name.to_owned(),
                ..Node::default()
            },
            ..Hello::default()
        };
        send_open(&mut socket, &hello).await.unwrap();
        let welcome = receive_open(&mut socket, "welcome").await.unwrap();
        let Welcome::Accepted {
            received,
            ahead,
            next,
            ..
        } = welcome
        else {
            panic!("{welcome:?}");
        };
        let mirror = self.mirror.clone();
        mirror.session().reconnect(received, &ahead, next);
        tokio::spawn(async move {
            let session = mirror.session();
            session.run(&mut socket, &*mirror).await;
        })
    }
}

fn is_published(graph: &Seen, topic: &str) -> bool {
    let ends = graph.topics.get(topic);
    ends.is_some_and(|ends| !ends.publishers.is_empty())
}

#[tokio::test]
async fn who_leaves_the_robot_leaves_the_servant_and_nothing_is_lost_before() {
    let scene = Scene::new("/node").await;
    let mut heard = hears(&scene.real, "/map").await;
    let _link = scene.links().await;
    let newcomer = node(scene.servant, "/newcomer").await;
    // One that latches, one that does not, and one that ends without taking anything back.
    for (name, latch, ends_well) in [
        ("/map_server", true, true),
        ("/mapper", false, true),
        ("/crashed", true, false),
    ] {
        let publisher = node(scene.robot, name).await;
        let map = says(&publisher, "/map", latch).await;
        let mut count = map.matched();
        count.wait_for(|now| now.connected() > 0).await.unwrap();
        for number in 0..20 {
            map.publish(bytes(&format!("{name} {number}")));
        }
        // All that it has said, though it leaves at once.
        if ends_well {
            drop(map);
            publisher.close().await;
        } else {
            while next(&mut heard).await != format!("{name} 19") {}
            drop((map, publisher));
        }
        if ends_well {
            for number in 0..20 {
                assert_eq!(next(&mut heard).await, format!("{name} {number}"));
            }
        }
        until(&newcomer, name, |graph| !is_published(graph, "/map")).await;
    }
    // Who comes now is given what is latched by those who are there, and nothing of the others.
    let publisher = node(scene.robot, "/new_map_server").await;
    let map = says(&publisher, "/map", true).await;
    map.publish(bytes("new"));
    assert_eq!(next(&mut heard).await, "new");
    let mut late = hears(&newcomer, "/map").await;
    assert_eq!(next(&mut late).await, "new");
    map.publish(bytes("newer"));
    assert_eq!(next(&mut late).await, "newer");
    let known = scene.mirror.inputs.known();
    assert_eq!(known, (1, 1), "channels and latched messages");
}

#[tokio::test]
async fn the_node_is_connected_before_the_first_message_comes() {
    let scene = Scene::new("/node").await;
    let mut heard = hears(&scene.real, "/scan").await;
    let robot = node(scene.robot, "/laser").await;
    // One is there before the link is, the other comes later; neither has said anything.
    let early = says(&robot, "/scan", false).await;
    let _link = scene.links().await;
    let connected = heard.matched.wait_for(|now| now.connected() == 1);
    assert!(timeout(SOON, connected).await.is_ok(), "nobody publishes");
    let _other = hears(&scene.real, "/camera").await;
    let camera = says(&robot, "/camera", false).await;
    until(&scene.real, "the camera", |graph| {
        is_published(graph, "/camera")
    })
    .await;
    early.publish(bytes("first"));
    assert_eq!(next(&mut heard).await, "first");
    assert_eq!(scene.mirror.inputs.known(), (2, 0));
    // Who leaves without a word leaves the cloud, too.
    drop(camera);
    until(&scene.real, "no camera", |graph| {
        !is_published(graph, "/camera")
    })
    .await;
}

#[tokio::test]
async fn newcomers_are_given_the_last_word_of_who_speaks_for_the_node() {
    let scene = Scene::new("/node").await;
    let output = Output {
        channel: 1,
        topic: "/map".to_owned(),
        type_name: string_type().name,
        md5: string_type().digest.to_string(),
        ..Output::default()
    };
    let key = (output.type_name.clone(), output.md5.clone());
    scene.mirror.types.lock().insert(key, string_type());
    let outputs = &scene.mirror.outputs;
    outputs.apply(&scene.mirror, &[output], false).await;
    let app = node(scene.robot, "/app").await;
    let mut map = hears(&app, "/map").await;
    map.matched
        .wait_for(|now| now.connected() > 0)
        .await
        .unwrap();
    let cloud = Data {
        channel: 1,
        encoded: false,
        latching: true,
        born: 0,
        left: 0,
        serialise: 0,
        answered: None,
        message: bytes("the cloud's"),
    };
    let local = ros::bus::Message {
        latching: true,
        ..string("the original's")
    };
    let newcomer = async |name: &str| {
        let newcomer = node(scene.robot, name).await;
        next(&mut hears(&newcomer, "/map").await).await
    };
    outputs.take(&scene.mirror, cloud, 0);
    assert_eq!(next(&mut map).await, "the cloud's");
    // It was latched before the original stood in: nobody has heard it yet.
    outputs.take_local("/map", local.clone(), false);
    assert_eq!(newcomer("/first").await, "the cloud's");
    outputs.speaks(Side::Local);
    assert_eq!(next(&mut map).await, "the original's");
    assert_eq!(newcomer("/second").await, "the original's");
    outputs.speaks(Side::Cloud);
    assert_eq!(next(&mut map).await, "the cloud's");
    assert_eq!(newcomer("/third").await, "the cloud's");
    // Its next life has latched nothing yet.
    outputs.local_ended();
    outputs.speaks(Side::Local);
    assert_eq!(newcomer("/fourth").await, "the cloud's");
    outputs.take_local("/map", local, true);
    assert_eq!(next(&mut map).await, "the original's");
    assert_eq!(newcomer("/fifth").await, "the original's");
}

/// Answers with these words.
struct Says(&'static str);

#[async_trait]
impl ServiceHandler for Says {
    async fn call(&self, _: Bytes, _: &str) -> Result<Bytes, String> {
        Ok(self.0.into())
    }
}

#[tokio::test]
async fn the_original_stands_in_for_a_cloud_that_was_never_reached_and_hands_back() {
    let scene = Scene::new("/ns/relay").await;
    let watcher: Arc<dyn Bus> = node(scene.robot, "/ns/relay_cloudroid").await;
    let diagnostics = Diagnostics::new(&watcher, "/ns/relay", "robot").await;
    let sla = serde_json::json!({"measure": {"link": {"after": 0.05}}});
    let sla = Sla::parse(sla).unwrap();
    let promised = scene
        .mirror
        .promise(sla, setting(&["patient"]), diagnostics.unwrap(), &watcher);
    promised.await.unwrap();
    let app = node(scene.robot, "/app").await;
    let (input, mut out) = (
        says(&app, "/ns/in", false).await,
        hears(&app, "/absolute/out").await,
    );
    let echo = "/ns/relay/echo";
    until(&app, "its services", |graph| {
        graph.services.contains_key(echo)
    })
    .await;
    let echoed = app.call(echo, "hello".into(), SOON).await.unwrap();
    assert_eq!(echoed, "hello", "the original's own answer");
    let mut count = input.matched();
    count.wait_for(|now| now.connected() > 0).await.unwrap();
    out.matched
        .wait_for(|now| now.connected() > 0)
        .await
        .unwrap();
    input.publish(bytes("scan"));
    assert_eq!(next(&mut out).await, "scan");
    // The cloud is reached for the first time.
    let of = ServiceType::new("tests/Echo", "0123456789abcdef0123456789abcdef");
    let _serving = scene.real.serve(echo, of, Arc::new(Says("cloud"))).await;
    let _link = scene.links().await;
    let deadline = tokio::time::Instant::now() + SOON;
    let keeper = scene.mirror.keeper().unwrap();
    while keeper.is_local_fed() {
        assert!(
            tokio::time::Instant::now() < deadline,
            "it should hand back"
        );
        tokio::task::yield_now().await;
    }
    let answer = app.call(echo, "hello".into(), SOON).await.unwrap();
    assert_eq!(answer, "cloud");
}
