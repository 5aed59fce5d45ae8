//! Tests with a robot's ROS, a servant's ROS, and the two ends of a link between them: a mirror and a hub. Nodes run in
//! this process, except for the local original.

mod ros2;

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use budget::Budget;
use bytes::Bytes;
use futures_util::FutureExt;
use link::control::{self, Exit, Hello, NodeLaunch, OutputChannel, Welcome};
use link::record::Data;
use link::session::{receive_open, send_open};
use link::{DisconnectReason, SessionOptions};
use link::{MAX_FRAME, MAX_RECORD};
use qos::{QosSla, Responder};
use reach::links::{Hub, HubOptions, NodeController, NodeError};
use ros::bus::{
    FailureReason, Graph as Seen, Publisher, QosProfile, RosVersion, ServiceHandler, ServiceType, Subscription,
};
use ros::schema::Registry;
use tokio::task::JoinHandle;
use tokio::time::timeout;
use ws::WebSocket;

use super::diagnostics::Diagnostics;
use super::*;
use crate::farewell;
use crate::local::tests::relay_setup;
use crate::testing::{SOON, World, decode_string, encode_string, message_text, stories, string_message, string_type};

stories! {
    of_ros_1 = One:
        who_leaves_the_robot_leaves_the_servant_and_nothing_is_lost_before,
        the_node_is_connected_before_the_first_message_comes,
        newcomers_are_given_the_last_word_of_who_speaks_for_the_node,
        the_original_stands_in_for_a_cloud_that_was_never_reached_and_hands_back,
        a_link_that_falls_silent_before_the_node_has_registered_leaves_the_original_its_inputs,
        a_stub_that_ends_waits_for_a_cloud_that_gives_signs_and_for_no_other;
    of_ros_2 = Two:
        who_leaves_the_robot_leaves_the_servant_and_nothing_is_lost_before,
        the_node_is_connected_before_the_first_message_comes,
        newcomers_are_given_the_last_word_of_who_speaks_for_the_node,
        the_original_stands_in_for_a_cloud_that_was_never_reached_and_hands_back,
        a_link_that_falls_silent_before_the_node_has_registered_leaves_the_original_its_inputs,
        a_stub_that_ends_waits_for_a_cloud_that_gives_signs_and_for_no_other;
}

/// Nodes that keep running and do nothing.
struct IdleNodes;

#[async_trait]
impl NodeController for IdleNodes {
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

async fn advertise(node: &Arc<dyn Bus>, topic: &str, latch: bool) -> Box<dyn Publisher> {
    let of = string_type(node.version());
    let qos = QosProfile::keep_last(100).latching(latch);
    node.advertise(topic, of, qos).await.unwrap()
}

/// Subscribes to the topic, including latched messages.
async fn subscribe(node: &Arc<dyn Bus>, topic: &str) -> Subscription {
    let of = string_type(node.version());
    let qos = QosProfile::keep_last(100).latching(true);
    node.subscribe(topic, of, qos).await.unwrap()
}

async fn next_text(subscription: &mut Subscription) -> String {
    let next = timeout(SOON, subscription.messages.recv()).await;
    message_text(&next.expect("a message should come").unwrap())
}

async fn wait_for_graph(node: &Arc<dyn Bus>, what: &str, wanted: impl Fn(&Seen) -> bool) {
    let mut graph = node.graph();
    let seen = timeout(SOON, graph.wait_for(|graph| wanted(graph))).await.is_ok();
    assert!(seen, "{what}: {:#?}", node.graph().borrow());
}

/// A robot with a mirror of this node, and its servant, whose node runs in this process.
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
        let (registry, options) = (Arc::new(Registry::for_version(ros)), HubOptions::default());
        let session = Arc::new(RobotSession::new(session_options()));
        let node = robot.node(name).await;
        Self {
            ros,
            mirror: Mirror::start(node, "label".to_owned(), session, SOON),
            name,
            hub: Hub::new("s", bridge, registry, Arc::new(IdleNodes), options),
            real: servant.node(name).await,
            robot,
            servant,
        }
    }

    fn bytes(&self, text: &str) -> Bytes {
        encode_string(self.ros, text)
    }

    /// Connects the two ends; returns the task of the robot's end, which runs until aborted, and that of the cloud's
    /// end.
    async fn connect(&self) -> (JoinHandle<DisconnectReason>, JoinHandle<DisconnectReason>) {
        let (theirs, ours) = tokio::io::duplex(1 << 16);
        let hub = Arc::clone(&self.hub);
        let served = tokio::spawn(async move { hub.serve_until(theirs, &[], std::future::pending()).await });
        let mut socket = WebSocket::client(ours, &[], MAX_FRAME, MAX_RECORD, 7);
        let (_, _, next) = self.mirror.session().position();
        let hello = Hello {
            run: "run".to_owned(),
            ros: self.ros.number(),
            next,
            node: NodeLaunch { name: self.name.to_owned(), ..NodeLaunch::default() },
            ..Hello::default()
        };
        send_open(&mut socket, &hello).await.unwrap();
        let mut held = Budget::without_limit().permit();
        let welcome = receive_open(&mut socket, "welcome", &mut held).await.unwrap();
        let Welcome::Accepted { received, ahead, next, .. } = welcome else {
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
    let mut heard = subscribe(&scene.real, "/map").await;
    let _link = scene.connect().await;
    let newcomer = scene.servant.node("/newcomer").await;
    // One that latches, one that does not, and one that ends without unregistering.
    for (name, latch, ends_well) in [("/map_server", true, true), ("/mapper", false, true), ("/crashed", true, false)] {
        let publisher = scene.robot.node(name).await;
        let map = advertise(&publisher, "/map", latch).await;
        let mut count = map.matched_subscribers();
        count.wait_for(|now| now.connected_count() > 0).await.unwrap();
        for number in 0..20 {
            map.publish(scene.bytes(&format!("{name} {number}")));
        }
        // All of its messages arrive, although it leaves at once.
        if ends_well {
            drop(map);
            publisher.close().await;
        } else {
            while next_text(&mut heard).await != format!("{name} 19") {}
            drop((map, publisher));
        }
        if ends_well {
            for number in 0..20 {
                assert_eq!(next_text(&mut heard).await, format!("{name} {number}"));
            }
        }
        wait_for_graph(&newcomer, name, |graph| !is_published(graph, "/map")).await;
    }
    // A late subscriber receives the latched messages of present publishers only.
    let publisher = scene.robot.node("/new_map_server").await;
    let map = advertise(&publisher, "/map", true).await;
    map.publish(scene.bytes("new"));
    assert_eq!(next_text(&mut heard).await, "new");
    let mut late = subscribe(&newcomer, "/map").await;
    assert_eq!(next_text(&mut late).await, "new");
    map.publish(scene.bytes("newer"));
    assert_eq!(next_text(&mut late).await, "newer");
    let known = scene.mirror.inputs.counts();
    assert_eq!(known, (1, 1), "channels and latched messages");
}

async fn the_node_is_connected_before_the_first_message_comes(ros: RosVersion) {
    let scene = Scene::new(ros, "/node").await;
    let mut heard = subscribe(&scene.real, "/scan").await;
    let robot = scene.robot.node("/laser").await;
    // One publisher exists before the link, the other comes later; neither has published anything.
    let early = advertise(&robot, "/scan", false).await;
    let _link = scene.connect().await;
    let connected = heard.matched.wait_for(|now| now.connected_count() == 1);
    assert!(timeout(SOON, connected).await.is_ok(), "nobody publishes");
    let _other = subscribe(&scene.real, "/camera").await;
    let camera = advertise(&robot, "/camera", false).await;
    wait_for_graph(&scene.real, "the camera", |graph| is_published(graph, "/camera")).await;
    early.publish(scene.bytes("first"));
    assert_eq!(next_text(&mut heard).await, "first");
    assert_eq!(scene.mirror.inputs.counts(), (2, 0));
    // A publisher that leaves without having published leaves the cloud, too.
    drop(camera);
    wait_for_graph(&scene.real, "no camera", |graph| !is_published(graph, "/camera")).await;
}

async fn newcomers_are_given_the_last_word_of_who_speaks_for_the_node(ros: RosVersion) {
    let scene = Scene::new(ros, "/node").await;
    let output = OutputChannel {
        channel: 1,
        topic: "/map".to_owned(),
        type_name: string_type(ros).name,
        md5: string_type(ros).digest.to_string(),
        // In ROS 1 nothing announces it beforehand.
        qos: (ros == RosVersion::Two).then(|| control::WireQos::from_bus(&QosProfile::keep_last(1).latching(true))),
    };
    let key = (output.type_name.clone(), output.md5.clone());
    let (of, _held) = (string_type(ros), None);
    scene.mirror.types.lock().insert(key, KnownType { of, _held });
    let outputs = &scene.mirror.outputs;
    outputs.apply(&scene.mirror, &[output], false).await;
    let app = scene.robot.node("/app").await;
    let mut map = subscribe(&app, "/map").await;
    map.matched.wait_for(|now| now.connected_count() > 0).await.unwrap();
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
    let local = ros::bus::SerializedMessage { latching: true, ..string_message(ros, "the original's") };
    let newcomer = async |name: &str| {
        let newcomer = scene.robot.node(name).await;
        next_text(&mut subscribe(&newcomer, "/map").await).await
    };
    outputs.publish_cloud(&scene.mirror, cloud, 0);
    assert_eq!(next_text(&mut map).await, "the cloud's");
    // It was latched before the original took over and has not been published yet.
    outputs.publish_local("/map", local.clone(), false);
    assert_eq!(newcomer("/first").await, "the cloud's");
    outputs.set_active_side(Responder::Local);
    assert_eq!(next_text(&mut map).await, "the original's");
    assert_eq!(newcomer("/second").await, "the original's");
    outputs.set_active_side(Responder::Cloud);
    assert_eq!(next_text(&mut map).await, "the cloud's");
    assert_eq!(newcomer("/third").await, "the cloud's");
    // After its next start it has latched nothing yet.
    outputs.on_local_ended();
    outputs.set_active_side(Responder::Local);
    assert_eq!(newcomer("/fourth").await, "the cloud's");
    outputs.publish_local("/map", local, true);
    assert_eq!(next_text(&mut map).await, "the original's");
    assert_eq!(newcomer("/fifth").await, "the original's");
}

/// Answers with these bytes.
struct Says(Bytes);

#[async_trait]
impl ServiceHandler for Says {
    async fn call(&self, _: Bytes, _: &str) -> Result<Bytes, FailureReason> {
        Ok(self.0.clone())
    }
}

/// An application beside an original that stands in for a cloud that was never reached.
struct StandIn {
    scene: Scene,
    app: Arc<dyn Bus>,
    input: Box<dyn Publisher>,
    out: Subscription,
}

/// Service of the node.
const ECHO: &str = "/ns/relay/echo";

impl StandIn {
    async fn start(ros: RosVersion) -> Self {
        let scene = Scene::new(ros, "/ns/relay").await;
        let watcher: Arc<dyn Bus> = scene.robot.node("/ns/relay_cloudroid").await;
        let diagnostics = Diagnostics::new(&watcher, "/ns/relay", "robot").await;
        let sla = serde_json::json!({"measure": {"link": {"after": 0.05}}});
        let sla = QosSla::parse(sla).unwrap();
        let relay = relay_setup(&scene.robot, &["patient"]);
        let promised = scene.mirror.start_promise(sla, relay, Vec::new(), diagnostics.unwrap(), &watcher);
        promised.await.unwrap();
        let app = scene.robot.node("/app").await;
        let (input, mut out) = (advertise(&app, "/ns/in", false).await, subscribe(&app, "/absolute/out").await);
        wait_for_graph(&app, "its services", |graph| graph.services.contains_key(ECHO)).await;
        let mut count = input.matched_subscribers();
        count.wait_for(|now| now.connected_count() > 0).await.unwrap();
        out.matched.wait_for(|now| now.connected_count() > 0).await.unwrap();
        Self { scene, app, input, out }
    }

    /// Sends an input, which the original answers.
    async fn expect_answer(&mut self, text: &str) {
        self.input.publish(self.scene.bytes(text));
        assert!(next_text(&mut self.out).await.ends_with(text));
    }

    async fn call_echo(&self) -> String {
        let answer = self.app.call(ECHO, self.scene.bytes("hello"), SOON).await.unwrap();
        decode_string(self.scene.ros, &answer)
    }

    /// Serves the service by the node in the cloud, and connects the link.
    async fn reach_cloud(
        &self,
    ) -> (Box<dyn Send + Sync>, (JoinHandle<DisconnectReason>, JoinHandle<DisconnectReason>)) {
        let of = ServiceType::new("tests/Echo", "0123456789abcdef0123456789abcdef");
        let serving = self.scene.real.serve(ECHO, of, Arc::new(Says(self.scene.bytes("cloud"))));
        (serving.await.unwrap(), self.scene.connect().await)
    }

    /// Waits until the original is asked, or no longer.
    async fn wait_for_local_feed(&self, is_fed: bool) {
        let keeper = self.scene.mirror.keeper().unwrap();
        let reached = async {
            while keeper.is_local_fed() != is_fed {
                tokio::task::yield_now().await;
            }
        };
        timeout(SOON, reached).await.unwrap_or_else(|_| panic!("local: {is_fed}"));
    }
}

async fn the_original_stands_in_for_a_cloud_that_was_never_reached_and_hands_back(ros: RosVersion) {
    let mut stands_in = StandIn::start(ros).await;
    assert_eq!(stands_in.call_echo().await, "hello", "the original's own answer");
    stands_in.expect_answer("scan").await;
    // The cloud is reached for the first time.
    let _linked = stands_in.reach_cloud().await;
    stands_in.wait_for_local_feed(false).await;
    assert_eq!(stands_in.call_echo().await, "cloud");
}

async fn a_link_that_falls_silent_before_the_node_has_registered_leaves_the_original_its_inputs(ros: RosVersion) {
    let mut stands_in = StandIn::start(ros).await;
    // The cloud's node has registered its service, and not yet its topics.
    let (_serving, (link, served)) = stands_in.reach_cloud().await;
    stands_in.wait_for_local_feed(false).await;
    assert_eq!(stands_in.call_echo().await, "cloud");
    link.abort();
    served.abort();
    stands_in.wait_for_local_feed(true).await;
    // Nothing happens that could be awaited: what the graph did not list must still be there after this time.
    tokio::time::sleep(SETTLE + Duration::from_millis(500)).await;
    stands_in.expect_answer("scan").await;
}

async fn a_stub_that_ends_waits_for_a_cloud_that_gives_signs_and_for_no_other(ros: RosVersion) {
    let term = nix::sys::signal::Signal::SIGTERM as i32;
    let scene = Scene::new(ros, "/node").await;
    let (link, left) = scene.connect().await;
    let mirror = &scene.mirror;
    let mut up = mirror.session().watch_up();
    up.wait_for(|up| *up).await.unwrap();
    // The node is slow to end and the cloud is reachable: the stub waits until another event ends that.
    let (other, told) = tokio::sync::oneshot::channel::<()>();
    let waiting = farewell::stop_node(mirror, term, async { drop(told.await) });
    tokio::pin!(waiting);
    let patience = Duration::from_secs(3);
    assert!(timeout(patience, &mut waiting).await.is_err(), "it ended");
    drop(other);
    assert!(timeout(SOON, waiting).await.expect("an end").is_none());
    // The cloud is informed that the robot does not come back.
    let linked = link.fuse();
    timeout(SOON, farewell::close_all(mirror, linked, &[])).await.expect("an end");
    let lost = timeout(SOON, left).await.expect("an end").unwrap();
    assert!(matches!(lost, DisconnectReason::Closed { code: 1000, .. }), "{lost}");

    let scene = Scene::new(ros, "/frozen").await;
    let (_frozen, ours) = tokio::io::duplex(1 << 16);
    let mirror = scene.mirror.clone();
    let mut up = mirror.session().watch_up();
    let linked = tokio::spawn(async move {
        let mut socket = WebSocket::client(ours, &[], MAX_FRAME, MAX_RECORD, 7);
        let session = mirror.session();
        session.reconnect(0, &[], 1);
        session.run(&mut socket, &*mirror).await
    });
    up.wait_for(|up| *up).await.unwrap();
    let buses = [scene.mirror.bus.clone()];
    let ending = async {
        let told = farewell::stop_node(&scene.mirror, term, std::future::pending()).await;
        farewell::close_all(&scene.mirror, linked.fuse(), &buses).await;
        told
    };
    // roslaunch sends its second signal after a longer time than this.
    let ended = timeout(Duration::from_secs(5), ending).await;
    assert!(ended.expect("an end").is_none());
}

#[tokio::test]
async fn a_new_session_is_seen_while_something_still_answers_by_the_old_one() {
    let scene = Scene::new(RosVersion::One, "/node").await;
    let watcher: Arc<dyn Bus> = scene.robot.node("/node_cloudroid").await;
    let diagnostics = Diagnostics::new(&watcher, "/node", "robot").await;
    let sla = serde_json::json!({"measure": {"link": {"after": 0.05}}, "local": "none"});
    let sla = QosSla::parse(sla).unwrap();
    let setting = relay_setup(&scene.robot, &[]);
    let mirror = &scene.mirror;
    let promised = mirror.start_promise(sla, setting, Vec::new(), diagnostics.unwrap(), &watcher);
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
    let (_link, served) = scene.connect().await;
    sees(true).await;
    // A pending call of the node to a service of the robot.
    let old = mirror.session();
    served.abort();
    sees(false).await;
    mirror.replace_session(Arc::new(RobotSession::new(session_options())));
    let _link = scene.connect().await;
    sees(true).await;
    drop(old);
}

#[tokio::test]
async fn what_was_dropped_is_told_once_the_link_is_back_and_not_put_down_for_it_before() {
    let scene = Scene::new(RosVersion::One, "/node").await;
    let mirror = &scene.mirror;
    let next = || mirror.session().position().2;
    let before = next();
    // As many reports as in an hour without a link in which messages are dropped all the time.
    let mut told = dropped::DropReports::default();
    for _ in 0..1800 {
        mirror.drops.add("/scan", Cause::Slow, 1);
        told.report(mirror);
    }
    assert_eq!(next(), before, "records wait");
    let _link = scene.connect().await;
    let mut up = mirror.session().watch_up();
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
