//! A robot's ROS, a servant's, and the two ends of a link between them: a mirror and a hub. Nodes are real ones of this
//! process, but for the local original.

mod ros2;

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use budget::Budget;
use bytes::Bytes;
use futures_util::FutureExt;
use link::control::{self, Exit, Hello, Node, Output, Welcome};
use link::record::Data;
use link::session::{receive_open, send_open};
use link::{Lost, SessionOptions};
use link::{MAX_FRAME, MAX_RECORD};
use qos::{Side, Sla};
use reach::links::{Hub, HubOptions, Nodes};
use ros::bus::{
    Graph as Seen, Publisher, Qos, RosVersion, ServiceHandler, ServiceType, Subscription,
};
use ros::schema::Registry;
use tokio::task::JoinHandle;
use tokio::time::timeout;
use ws::WebSocket;

use super::diagnostics::Diagnostics;
use super::*;
use crate::farewell;
use crate::local::tests::setting;
use crate::testing::{SOON, World, read, stories, string, string_type, text, written};

stories! {
    of_ros_1 = One:
        who_leaves_the_robot_leaves_the_servant_and_nothing_is_lost_before,
        the_node_is_connected_before_the_first_message_comes,
        newcomers_are_given_the_last_word_of_who_speaks_for_the_node,
        the_original_stands_in_for_a_cloud_that_was_never_reached_and_hands_back,
        a_stub_that_ends_waits_for_a_cloud_that_gives_signs_and_for_no_other;
    of_ros_2 = Two:
        who_leaves_the_robot_leaves_the_servant_and_nothing_is_lost_before,
        the_node_is_connected_before_the_first_message_comes,
        newcomers_are_given_the_last_word_of_who_speaks_for_the_node,
        the_original_stands_in_for_a_cloud_that_was_never_reached_and_hands_back,
        a_stub_that_ends_waits_for_a_cloud_that_gives_signs_and_for_no_other;
}

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

async fn says(node: &Arc<dyn Bus>, topic: &str, latch: bool) -> Box<dyn Publisher> {
    let of = string_type(node.version());
    let qos = Qos::keep_last(100).latching(latch);
    node.advertise(topic, of, qos).await.unwrap()
}

/// Hears what was said before, too.
async fn hears(node: &Arc<dyn Bus>, topic: &str) -> Subscription {
    let of = string_type(node.version());
    let qos = Qos::keep_last(100).latching(true);
    node.subscribe(topic, of, qos).await.unwrap()
}

async fn next(subscription: &mut Subscription) -> String {
    let next = timeout(SOON, subscription.messages.recv()).await;
    text(&next.expect("a message should come").unwrap())
}

async fn until(node: &Arc<dyn Bus>, what: &str, wanted: impl Fn(&Seen) -> bool) {
    let mut graph = node.graph();
    let seen = timeout(SOON, graph.wait_for(|graph| wanted(graph)))
        .await
        .is_ok();
    assert!(seen, "{what}: {:#?}", node.graph().borrow());
}

/// A robot with a mirror of this node, and its servant, where that node is of this process.
struct Scene {
    ros: RosVersion,
    robot: World,
    mirror: Arc<Mirror>,
    name: &'static str,
    servant: World,
    hub: Arc<Hub>,
    real: Arc<dyn Bus>,
}

fn session_options() -> SessionOptions {
    SessionOptions {
        ping: Duration::from_secs(1),
        silent: Duration::from_secs(10),
        lost: Duration::from_secs(20),
        max_age: None,
    }
}

impl Scene {
    async fn new(ros: RosVersion, name: &'static str) -> Self {
        let (robot, servant) = (World::new(ros).await, World::new(ros).await);
        let bridge = servant.node("/bridge").await;
        let (registry, options) = (Arc::new(Registry::of(ros)), HubOptions::default());
        let session = Arc::new(RobotSession::new(session_options()));
        let node = robot.node(name).await;
        Self {
            ros,
            mirror: Mirror::start(node, "label".to_owned(), session, SOON),
            name,
            hub: Hub::new("s", bridge, registry, Arc::new(Still), options),
            real: servant.node(name).await,
            robot,
            servant,
        }
    }

    fn bytes(&self, text: &str) -> Bytes {
        written(self.ros, text)
    }

    /// The link, until its task is aborted; and the cloud's end of it.
    async fn links(&self) -> (JoinHandle<Lost>, JoinHandle<Lost>) {
        let (theirs, ours) = tokio::io::duplex(1 << 16);
        let hub = Arc::clone(&self.hub);
        let served = tokio::spawn(async move { hub.serve(theirs, &[]).await });
        let mut socket = WebSocket::client(ours, &[], MAX_FRAME, MAX_RECORD, 7);
        let (_, _, next) = self.mirror.session().position();
        let hello = Hello {
            run: "run".to_owned(),
            ros: self.ros.number(),
            next,
            node: Node {
                name: self.name.to_owned(),
                ..Node::default()
            },
            ..Hello::default()
        };
        send_open(&mut socket, &hello).await.unwrap();
        let mut held = Budget::unlimited().permit();
        let welcome = receive_open(&mut socket, "welcome", &mut held)
            .await
            .unwrap();
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
        let carried = tokio::spawn(async move {
            let session = mirror.session();
            session.run(&mut socket, &*mirror).await
        });
        (carried, served)
    }
}

fn is_published(graph: &Seen, topic: &str) -> bool {
    let ends = graph.topics.get(topic);
    ends.is_some_and(|ends| !ends.publishers.is_empty())
}

async fn who_leaves_the_robot_leaves_the_servant_and_nothing_is_lost_before(ros: RosVersion) {
    let scene = Scene::new(ros, "/node").await;
    let mut heard = hears(&scene.real, "/map").await;
    let _link = scene.links().await;
    let newcomer = scene.servant.node("/newcomer").await;
    // One that latches, one that does not, and one that ends without taking anything back.
    for (name, latch, ends_well) in [
        ("/map_server", true, true),
        ("/mapper", false, true),
        ("/crashed", true, false),
    ] {
        let publisher = scene.robot.node(name).await;
        let map = says(&publisher, "/map", latch).await;
        let mut count = map.matched();
        count.wait_for(|now| now.connected() > 0).await.unwrap();
        for number in 0..20 {
            map.publish(scene.bytes(&format!("{name} {number}")));
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
    let publisher = scene.robot.node("/new_map_server").await;
    let map = says(&publisher, "/map", true).await;
    map.publish(scene.bytes("new"));
    assert_eq!(next(&mut heard).await, "new");
    let mut late = hears(&newcomer, "/map").await;
    assert_eq!(next(&mut late).await, "new");
    map.publish(scene.bytes("newer"));
    assert_eq!(next(&mut late).await, "newer");
    let known = scene.mirror.inputs.known();
    assert_eq!(known, (1, 1), "channels and latched messages");
}

async fn the_node_is_connected_before_the_first_message_comes(ros: RosVersion) {
    let scene = Scene::new(ros, "/node").await;
    let mut heard = hears(&scene.real, "/scan").await;
    let robot = scene.robot.node("/laser").await;
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
    early.publish(scene.bytes("first"));
    assert_eq!(next(&mut heard).await, "first");
    assert_eq!(scene.mirror.inputs.known(), (2, 0));
    // Who leaves without a word leaves the cloud, too.
    drop(camera);
    until(&scene.real, "no camera", |graph| {
        !is_published(graph, "/camera")
    })
    .await;
}

async fn newcomers_are_given_the_last_word_of_who_speaks_for_the_node(ros: RosVersion) {
    let scene = Scene::new(ros, "/node").await;
    let output = Output {
        channel: 1,
        topic: "/map".to_owned(),
        type_name: string_type(ros).name,
        md5: string_type(ros).digest.to_string(),
        // In ROS 1 nobody says it beforehand.
        qos: (ros == RosVersion::Two).then(|| control::Qos::of(&Qos::keep_last(1).latching(true))),
    };
    let key = (output.type_name.clone(), output.md5.clone());
    let (of, _held) = (string_type(ros), None);
    scene
        .mirror
        .types
        .lock()
        .insert(key, KnownType { of, _held });
    let outputs = &scene.mirror.outputs;
    outputs.apply(&scene.mirror, &[output], false).await;
    let app = scene.robot.node("/app").await;
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
        message: scene.bytes("the cloud's"),
    };
    let local = ros::bus::Message {
        latching: true,
        ..string(ros, "the original's")
    };
    let newcomer = async |name: &str| {
        let newcomer = scene.robot.node(name).await;
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
struct Says(Bytes);

#[async_trait]
impl ServiceHandler for Says {
    async fn call(&self, _: Bytes, _: &str) -> Result<Bytes, String> {
        Ok(self.0.clone())
    }
}

async fn the_original_stands_in_for_a_cloud_that_was_never_reached_and_hands_back(ros: RosVersion) {
    let scene = Scene::new(ros, "/ns/relay").await;
    let watcher: Arc<dyn Bus> = scene.robot.node("/ns/relay_cloudroid").await;
    let diagnostics = Diagnostics::new(&watcher, "/ns/relay", "robot").await;
    let sla = serde_json::json!({"measure": {"link": {"after": 0.05}}});
    let sla = Sla::parse(sla).unwrap();
    let relay = setting(&scene.robot, &["patient"]);
    let promised = scene
        .mirror
        .promise(sla, relay, Vec::new(), diagnostics.unwrap(), &watcher);
    promised.await.unwrap();
    let app = scene.robot.node("/app").await;
    let (input, mut out) = (
        says(&app, "/ns/in", false).await,
        hears(&app, "/absolute/out").await,
    );
    let echo = "/ns/relay/echo";
    until(&app, "its services", |graph| {
        graph.services.contains_key(echo)
    })
    .await;
    let echoed = app.call(echo, scene.bytes("hello"), SOON).await.unwrap();
    assert_eq!(read(ros, &echoed), "hello", "the original's own answer");
    let mut count = input.matched();
    count.wait_for(|now| now.connected() > 0).await.unwrap();
    out.matched
        .wait_for(|now| now.connected() > 0)
        .await
        .unwrap();
    input.publish(scene.bytes("scan"));
    assert!(next(&mut out).await.ends_with("scan"));
    // The cloud is reached for the first time.
    let of = ServiceType::new("tests/Echo", "0123456789abcdef0123456789abcdef");
    let serving = scene
        .real
        .serve(echo, of, Arc::new(Says(scene.bytes("cloud"))));
    let _serving = serving.await.unwrap();
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
    let answer = app.call(echo, scene.bytes("hello"), SOON).await.unwrap();
    assert_eq!(read(ros, &answer), "cloud");
}

async fn a_stub_that_ends_waits_for_a_cloud_that_gives_signs_and_for_no_other(ros: RosVersion) {
    let term = nix::sys::signal::Signal::SIGTERM as i32;
    let scene = Scene::new(ros, "/node").await;
    let (link, left) = scene.links().await;
    let mirror = &scene.mirror;
    let mut up = mirror.session().up();
    up.wait_for(|up| *up).await.unwrap();
    // The node takes its time, and the cloud is there: it is waited for until something else ends that.
    let (other, told) = tokio::sync::oneshot::channel::<()>();
    let waiting = farewell::of_the_node(mirror, term, async { drop(told.await) });
    tokio::pin!(waiting);
    let patience = Duration::from_secs(3);
    assert!(timeout(patience, &mut waiting).await.is_err(), "it ended");
    drop(other);
    assert!(timeout(SOON, waiting).await.expect("an end").is_none());
    // The cloud is told that nobody comes back.
    let linked = link.fuse();
    timeout(SOON, farewell::of_all(mirror, linked, &[]))
        .await
        .expect("an end");
    let lost = timeout(SOON, left).await.expect("an end").unwrap();
    assert!(matches!(lost, Lost::Closed { code: 1000, .. }), "{lost}");

    let scene = Scene::new(ros, "/frozen").await;
    let (_frozen, ours) = tokio::io::duplex(1 << 16);
    let mirror = scene.mirror.clone();
    let mut up = mirror.session().up();
    let linked = tokio::spawn(async move {
        let mut socket = WebSocket::client(ours, &[], MAX_FRAME, MAX_RECORD, 7);
        let session = mirror.session();
        session.reconnect(0, &[], 1);
        session.run(&mut socket, &*mirror).await
    });
    up.wait_for(|up| *up).await.unwrap();
    let buses = [scene.mirror.bus.clone()];
    let ending = async {
        let told = farewell::of_the_node(&scene.mirror, term, std::future::pending()).await;
        farewell::of_all(&scene.mirror, linked.fuse(), &buses).await;
        told
    };
    // As launch has it before it sends a second signal.
    let ended = timeout(Duration::from_secs(5), ending).await;
    assert!(ended.expect("an end").is_none());
}

#[tokio::test]
async fn a_new_session_is_seen_while_something_still_answers_by_the_old_one() {
    let scene = Scene::new(RosVersion::One, "/node").await;
    let watcher: Arc<dyn Bus> = scene.robot.node("/node_cloudroid").await;
    let diagnostics = Diagnostics::new(&watcher, "/node", "robot").await;
    let sla = serde_json::json!({"measure": {"link": {"after": 0.05}}, "local": "none"});
    let sla = Sla::parse(sla).unwrap();
    let setting = setting(&scene.robot, &[]);
    let mirror = &scene.mirror;
    let promised = mirror.promise(sla, setting, Vec::new(), diagnostics.unwrap(), &watcher);
    promised.await.unwrap();
    let keeper = mirror.keeper().unwrap();
    let sees = async |is_up: bool| {
        let seen = async {
            while keeper.report().link != is_up {
                tokio::task::yield_now().await;
            }
        };
        let seen = timeout(SOON, seen).await;
        assert!(seen.is_ok(), "up: {is_up}");
    };
    let (_link, served) = scene.links().await;
    sees(true).await;
    // A service of the robot that the node has called, and that takes its time.
    let old = mirror.session();
    served.abort();
    sees(false).await;
    mirror.renew(Arc::new(RobotSession::new(session_options())));
    let _link = scene.links().await;
    sees(true).await;
    drop(old);
}

#[tokio::test]
async fn what_was_dropped_is_told_once_the_link_is_back_and_not_put_down_for_it_before() {
    let scene = Scene::new(RosVersion::One, "/node").await;
    let mirror = &scene.mirror;
    let next = || mirror.session().position().2;
    let before = next();
    // As many looks as there were in an hour of an outage in which something is dropped all the time.
    let mut told = dropped::Told::default();
    for _ in 0..1800 {
        mirror.drops.add("/scan", Cause::Slow, 1);
        told.report(mirror);
    }
    assert_eq!(next(), before, "records wait");
    let _link = scene.links().await;
    let mut up = mirror.session().up();
    up.wait_for(|up| *up).await.unwrap();
    told.report(mirror);
    let seen = async {
        loop {
            let status = scene.hub.status();
            let dropped = status.iter().flat_map(|link| &link.dropped);
            if dropped.map(|drop| drop.count).sum::<u64>() == 1800 {
                return;
            }
            tokio::task::yield_now().await;
        }
    };
    timeout(SOON, seen).await.expect("all of it");
}
