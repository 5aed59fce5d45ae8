use std::collections::BTreeMap;

use async_trait::async_trait;
use ros::net::HostSockets;
use ros::ros1::Ros1Bus;
use ros::ros1::master::{Master, MasterOptions};
use tokio::io::{DuplexStream, duplex};
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

use super::*;
use link::control::{Exit, FromRobot, InputChannel, NodeLaunch, Resume};
use link::record::Record;

mod node_time;
mod refused;
mod setup;

/// A servant whose nodes run once started and do nothing.
#[derive(Default)]
struct QuietNodes {
    running: Mutex<BTreeSet<String>>,
    warnings: Mutex<Vec<String>>,
    /// Nodes that neither start nor end.
    stuck: Mutex<BTreeSet<String>>,
    signals: watch::Sender<Vec<(String, i32)>>,
    /// Parameters that the push gave them.
    given: Mutex<Vec<(String, ParamValue)>>,
}

impl QuietNodes {
    fn is_stuck(&self, node: &str) -> bool {
        self.stuck.lock().contains(node)
    }
}

#[async_trait]
impl NodeController for QuietNodes {
    async fn start(&self, node: &NodeLaunch, _: &str) -> Result<(), NodeError> {
        if self.is_stuck(&node.name) {
            std::future::pending::<()>().await;
        }
        self.running.lock().insert(node.name.clone());
        Ok(())
    }
    async fn signal(&self, node: &str, signal: i32) -> Result<(), NodeError> {
        let sent = (node.to_owned(), signal);
        self.signals.send_modify(|signals| signals.push(sent));
        if self.is_stuck(node) {
            std::future::pending::<()>().await;
        }
        self.running.lock().remove(node);
        Ok(())
    }
    async fn wait_exit(&self, node: &str) -> Exit {
        if self.is_running(node).await {
            std::future::pending::<()>().await;
        }
        Exit::default()
    }
    async fn is_running(&self, node: &str) -> bool {
        self.running.lock().contains(node)
    }
    async fn running_nodes(&self) -> Vec<NodeLaunch> {
        let running = self.running.lock();
        running.iter().map(|name| NodeLaunch { name: name.clone(), ..NodeLaunch::default() }).collect()
    }
    fn parameters(&self, _: &NodeLaunch) -> Vec<(String, ParamValue)> {
        self.given.lock().clone()
    }
    fn translate(&self, _: &NodeLaunch, text: &str) -> String {
        text.to_owned()
    }
    fn output_lines(&self, _: &str) -> mpsc::Receiver<(bool, String)> {
        mpsc::channel(1).1
    }
    fn warn(&self, _: &str, text: &str) {
        self.warnings.lock().push(text.to_owned());
    }
}

async fn hub() -> (Arc<Hub>, Arc<QuietNodes>) {
    hub_with(HubOptions::default()).await
}

async fn hub_with(options: HubOptions) -> (Arc<Hub>, Arc<QuietNodes>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let master = Master::new(MasterOptions::default());
    tokio::spawn(async move { master.serve(listener, Arc::new(HostSockets)).await });
    let bus = Ros1Bus::connect(Arc::new(HostSockets), address, "/bridge");
    let bus: Arc<dyn Bus> = bus.await.unwrap();
    let nodes = Arc::new(QuietNodes::default());
    let registry = Arc::new(Registry::default());
    (Hub::new("s1", bus, registry, nodes.clone(), options), nodes)
}

fn hello(node: &str, attempt: u64) -> Hello {
    Hello {
        run: "life".into(),
        attempt,
        machine: "m1".into(),
        host: "rover".into(),
        node: NodeLaunch { name: node.into(), ..NodeLaunch::default() },
        next: 1,
        ..Hello::default()
    }
}

/// Sends a hello on a new connection; returns the welcome.
async fn send_hello(hub: &Arc<Hub>, hello: &Hello) -> (WebSocket<DuplexStream>, Welcome) {
    let (socket, welcome, _) = serve_hello(hub, hello).await;
    (socket, welcome)
}

/// As above; also returns the task that serves the connection.
async fn serve_hello(
    hub: &Arc<Hub>,
    hello: &Hello,
) -> (WebSocket<DuplexStream>, Welcome, JoinHandle<DisconnectReason>) {
    let (robot, cloud) = duplex(1 << 16);
    let hub = Arc::clone(hub);
    let serving = tokio::spawn(async move { hub.serve_until(cloud, b"", std::future::pending()).await });
    let mut socket = WebSocket::client(robot, b"", MAX_FRAME, MAX_RECORD, 7);
    send_open(&mut socket, hello).await.unwrap();
    let mut held = Budget::without_limit().permit();
    let welcome = receive_open(&mut socket, "welcome", &mut held).await.unwrap();
    (socket, welcome, serving)
}

fn resuming(attempt: u64, welcome: &Welcome) -> Hello {
    let Welcome::Accepted { session, next, .. } = welcome else {
        panic!("{welcome:?}");
    };
    let resume = Resume { session: session.clone(), received: next - 1, ahead: Vec::new() };
    Hello { resume: Some(resume), ..hello("/detect", attempt) }
}

/// Reads until the cloud closes the connection; returns the reason.
async fn read_until_close(mut socket: WebSocket<DuplexStream>) -> String {
    loop {
        match std::future::poll_fn(|cx| socket.poll_next(cx)).await {
            Ok(ws::WsMessage::Close(_, reason)) => return reason,
            Ok(_) => {}
            Err(error) => return error.to_string(),
        }
    }
}

/// Returns parameters with a text of a hundred kilobytes: maps with one entry.
fn many_parameters() -> BTreeMap<String, ParamValue> {
    let one = || ParamValue::Map([("b".to_owned(), ParamValue::Int(1))].into());
    let all = (0..10_000).map(|n| (format!("a{n}"), one())).collect();
    [("all".to_owned(), ParamValue::Map(all))].into()
}

#[tokio::test]
async fn parameters_of_a_hello_count_until_they_are_set() {
    let budget = Budget::new("robot x", 64 << 20);
    let options = HubOptions { budget: budget.clone(), ..HubOptions::default() };
    let (hub, _nodes) = hub_with(options).await;
    let mut hello = hello("/detect", 1);
    hello.parameters = many_parameters();
    let (_socket, welcome) = send_hello(&hub, &hello).await;
    assert!(matches!(welcome, Welcome::Accepted { .. }), "{welcome:?}");
    assert!(budget.used_bytes() < 1 << 20, "{} bytes are held", budget.used_bytes());
}

#[tokio::test]
async fn parameters_that_are_set_before_there_is_a_link_are_paid_for() {
    let budget = Budget::new("servant s1", 1 << 20);
    let options = HubOptions { budget: budget.clone(), ..HubOptions::default() };
    let (hub, _nodes) = hub_with(options).await;
    let parameters = &hub.own_view.parameters;
    let text = || Some(ParamValue::String("x".repeat(10_000)));
    for _ in 0..1000 {
        parameters.report_change(&hub, "/again".into(), text());
    }
    assert!(budget.used_bytes() < 20_000, "{} bytes: one is kept", budget.used_bytes());
    for number in 0..1000 {
        parameters.report_change(&hub, format!("/more/{number}"), text());
    }
    assert!(budget.refusal_count() > 800, "{} were refused", budget.refusal_count());
    let untold = parameters.take_pending();
    assert!((90..=104).contains(&untold.len()), "{}", untold.len());
    assert_eq!(budget.used_bytes(), 0, "whoever tells them pays for them");
}

#[tokio::test]
async fn following_the_graph_for_a_link_is_charged_to_the_servant() {
    let work = budget::WorkLimit { cores: 1.0, burst: PATIENCE };
    let budget = Budget::new("the daemon", 1 << 30).child_with_work("servant s1", 1 << 30, work);
    let options = HubOptions { budget: budget.clone(), ..HubOptions::default() };
    let (hub, _nodes) = hub_with(options).await;
    assert_eq!(budget.work_time(), Duration::ZERO);
    let _linked = send_hello(&hub, &hello("/detect", 1)).await;
    let charged = async {
        while budget.work_time().is_zero() {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(PATIENCE, charged).await.expect("its graph is followed");
}

#[tokio::test]
async fn a_hello_that_has_no_room_is_refused_with_the_reason() {
    let mut long = hello("/detect", 1);
    long.parameters = many_parameters();
    let mut wordy = hello("/detect", 1);
    wordy.host = "x".repeat(MAX_CONTROL);
    for (room, hello, words) in [
        (4 << 20, long, "do not fit into the memory for robot x"),
        (64 << 20, wordy, "a hello without parameters of 104"),
    ] {
        let options = HubOptions { budget: Budget::new("robot x", room), ..HubOptions::default() };
        let (hub, nodes) = hub_with(options).await;
        let (robot, cloud) = duplex(1 << 16);
        tokio::spawn(async move { hub.serve_until(cloud, b"", std::future::pending()).await });
        let mut socket = WebSocket::client(robot, b"", MAX_FRAME, MAX_RECORD, 7);
        send_open(&mut socket, &hello).await.unwrap();
        let reason = read_until_close(socket).await;
        assert!(reason.contains(words), "{reason}");
        assert!(nodes.running.lock().is_empty());
    }
}

#[tokio::test]
async fn a_hello_that_was_overtaken_does_not_displace_the_later_one() {
    let (hub, _nodes) = hub().await;
    let (first, welcome) = send_hello(&hub, &hello("/detect", 1)).await;
    // The robot gives up its second connection and makes a third; the hello of the second arrives last.
    let (third, welcome) = send_hello(&hub, &resuming(3, &welcome)).await;
    assert!(matches!(welcome, Welcome::Accepted { resumed: true, .. }));
    read_until_close(first).await;
    let (_, late) = send_hello(&hub, &resuming(2, &welcome)).await;
    assert!(matches!(late, Welcome::Refused { again: true, .. }), "{late:?}");
    // A hello without a session would have started another one.
    let (_, late) = send_hello(&hub, &hello("/detect", 2)).await;
    assert!(matches!(late, Welcome::Refused { .. }), "{late:?}");
    let link = hub.links.lock()["/detect"].clone();
    assert!(link.is_connected(), "the third carries it");
    let (_fourth, welcome) = send_hello(&hub, &resuming(4, &welcome)).await;
    assert!(matches!(welcome, Welcome::Accepted { resumed: true, .. }));
    read_until_close(third).await;
}

#[tokio::test]
async fn a_robot_of_an_unknown_ros_is_refused_for_good() {
    let (hub, nodes) = hub().await;
    for (ros, refused) in [(0, false), (1, false), (2, false), (3, true)] {
        let hello = Hello { ros, run: format!("life in ROS {ros}"), ..hello("/detect", 1) };
        match send_hello(&hub, &hello).await.1 {
            Welcome::Accepted { .. } => assert!(!refused, "{ros}"),
            Welcome::Refused { reason, again } => {
                assert!(refused && !again, "{reason}");
                assert!(reason.contains("this robot uses ROS 3"), "{reason}");
            }
        }
    }
    assert!(nodes.is_running("/detect").await, "it is not ended for them");
}

#[tokio::test]
async fn machines_of_two_robots_are_told_of_each_other_and_those_of_one_are_not() {
    let (hub, nodes) = hub().await;
    let of = |node: &str, machine: &str, roscore: &str| Hello {
        run: format!("life of {node} on {machine}"),
        machine: machine.into(),
        host: machine.into(),
        roscore: roscore.into(),
        ..hello(node, 1)
    };
    let (_one, _) = send_hello(&hub, &of("/one", "rover1", "a")).await;
    let (_two, _) = send_hello(&hub, &of("/two", "rover1", "a")).await;
    let (_arm, _) = send_hello(&hub, &of("/arm", "computer in the arm", "a")).await;
    assert!(nodes.warnings.lock().is_empty(), "they are one robot");
    assert!(hub.status().iter().all(|link| link.duplicates.is_empty()));
    let (_copy, welcome) = send_hello(&hub, &of("/other", "rover2", "b")).await;
    assert!(matches!(welcome, Welcome::Accepted { .. }));
    let warnings = nodes.warnings.lock().clone();
    assert_eq!(warnings.len(), 2, "one for each other machine: {warnings:?}");
    let told = "rover1 runs /one, rover2 runs /other";
    assert!(warnings.iter().any(|text| text.contains(told)), "{warnings:?}");
    for link in hub.status() {
        let duplicates = match link.node.as_str() {
            "/other" => vec!["computer in the arm", "rover1"],
            _ => vec!["rover2"],
        };
        assert_eq!(link.duplicates, duplicates, "{}", link.node);
    }
    // The same node is refused.
    let (_, refused) = send_hello(&hub, &of("/one", "rover2", "b")).await;
    let Welcome::Refused { reason, again } = refused else {
        panic!("{refused:?}");
    };
    assert!(reason.contains("another machine (rover1)") && !again, "{reason}");
}

/// Only reports a test that hangs.
const PATIENCE: Duration = Duration::from_secs(120);

#[tokio::test]
async fn a_link_is_taken_up_while_other_nodes_start_and_end() {
    let (hub, nodes) = hub().await;
    let (_detect, welcome) = send_hello(&hub, &hello("/detect", 1)).await;
    // One node never finishes starting …
    nodes.stuck.lock().insert("/starting".into());
    let starting = Hello { run: "another life".into(), ..hello("/starting", 1) };
    let (robot, cloud) = duplex(1 << 16);
    let serving = Arc::clone(&hub);
    tokio::spawn(async move { serving.serve_until(cloud, b"", std::future::pending()).await });
    let mut starting_socket = WebSocket::client(robot, b"", MAX_FRAME, MAX_RECORD, 7);
    send_open(&mut starting_socket, &starting).await.unwrap();
    // … and another never finishes ending, after its robot has left it.
    let another = Hello { run: "a third life".into(), ..hello("/ending", 1) };
    let begun = timeout(PATIENCE, send_hello(&hub, &another)).await;
    let (mut ending, _) = begun.expect("others hold it up");
    nodes.stuck.lock().insert("/ending".into());
    ending.queue_close(1000, "");
    let _ = std::future::poll_fn(|cx| ending.poll_flush(cx)).await;
    let mut signals = nodes.signals.subscribe();
    let told = signals.wait_for(|signals| signals.contains(&("/ending".into(), 2)));
    timeout(PATIENCE, told).await.expect("it is asked to end").unwrap();
    let back = resuming(2, &welcome);
    let resumed = send_hello(&hub, &back);
    let (_, welcome) = timeout(PATIENCE, resumed).await.expect("others hold it up");
    assert!(matches!(welcome, Welcome::Accepted { resumed: true, .. }));
}

#[tokio::test]
async fn a_link_whose_connection_is_dropped_ends_with_its_node() {
    let options = HubOptions { grace: Duration::ZERO, ..HubOptions::default() };
    let (hub, nodes) = hub_with(options).await;
    let (_socket, _, serving) = serve_hello(&hub, &hello("/detect", 1)).await;
    let link = hub.links.lock()["/detect"].clone();
    let (mut up, mut signals) = (link.session.watch_up(), nodes.signals.subscribe());
    let is_up = timeout(PATIENCE, up.wait_for(|up| *up)).await;
    drop(is_up.expect("it is carried").unwrap());
    // Like a place whose robot may be gone.
    serving.abort();
    let is_down = timeout(PATIENCE, up.wait_for(|up| !*up)).await;
    drop(is_down.expect("nothing carries it").unwrap());
    let told = signals.wait_for(|signals| signals.contains(&("/detect".into(), 2)));
    let told = timeout(PATIENCE, told).await;
    told.expect("the node is ended").unwrap();
}

#[tokio::test]
async fn robots_are_told_why_their_links_are_closed() {
    let (hub, _nodes) = hub().await;
    let (socket, _) = send_hello(&hub, &hello("/detect", 1)).await;
    let link = hub.links.lock()["/detect"].clone();
    let mut up = link.session.watch_up();
    let is_up = timeout(PATIENCE, up.wait_for(|up| *up)).await;
    drop(is_up.expect("it is carried").unwrap());
    hub.close("the service was taken back");
    let reason = timeout(PATIENCE, read_until_close(socket)).await;
    assert_eq!(reason.expect("it is closed"), "the service was taken back");
}

#[tokio::test]
async fn a_link_that_is_taken_up_as_its_grace_ends_goes_on() {
    let (hub, nodes) = hub().await;
    let (_first, welcome) = send_hello(&hub, &hello("/detect", 1)).await;
    let link = hub.links.lock()["/detect"].clone();
    let turn = *link.kick.borrow();
    let (_second, welcome) = send_hello(&hub, &resuming(2, &welcome)).await;
    assert!(matches!(welcome, Welcome::Accepted { resumed: true, .. }));
    // The pending end comes too late for it.
    hub.end_link(&link, turn).await;
    assert!(hub.links.lock().contains_key("/detect"));
    assert!(nodes.is_running("/detect").await);
}

#[tokio::test]
async fn a_signal_does_not_wait_for_what_the_node_does_not_answer() {
    // The node does not connect to its input, like a stopped process.
    let (hub, nodes) = hub_with(HubOptions { warm_up: PATIENCE * 10, ..HubOptions::default() }).await;
    let (_robot, _) = send_hello(&hub, &hello("/detect", 1)).await;
    let link = hub.links.lock()["/detect"].clone();
    let held = || Budget::without_limit().permit();
    let tell = |order| link::SessionHandler::on_record(&*link, Record::Control(order), held(), 0);
    tell(FromRobot::Open(InputChannel {
        channel: 1,
        topic: "/image".into(),
        type_name: "std_msgs/Empty".into(),
        md5: "d41d8cd98f00b204e9800998ecf8427e".into(),
        ..InputChannel::default()
    }));
    for signal in [2, 15] {
        tell(FromRobot::Signal { signal });
    }
    let mut signals = nodes.signals.subscribe();
    let both = signals.wait_for(|signals| signals.len() == 2);
    let both = timeout(PATIENCE, both).await.expect("they wait").unwrap();
    assert_eq!(*both, [("/detect".to_owned(), 2), ("/detect".to_owned(), 15)]);
}

#[tokio::test]
async fn asking_how_a_link_is_doing_holds_up_no_connection() {
    let (hub, _nodes) = hub().await;
    let (_robot, _) = send_hello(&hub, &hello("/detect", 1)).await;
    let link = hub.links.lock()["/detect"].clone();
    // The status query gets as far as the links of other machines …
    let held = hub.links.lock();
    let (sender, thread) = std::sync::mpsc::channel();
    let asked = Arc::clone(&link);
    let asking = std::thread::spawn(move || {
        let own = std::fs::read_link("/proc/thread-self").expect("this thread");
        sender.send(own).expect("it is awaited");
        asked.status()
    });
    let state = std::path::Path::new("/proc").join(thread.recv().expect("it runs")).join("stat");
    let asleep = || std::fs::read_to_string(&state).is_ok_and(|state| state.contains(") S "));
    while !asleep() {
        std::thread::yield_now();
    }
    // … while a connection begins and ends.
    let (sender, over) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        let (_, cloud) = duplex(1 << 16);
        let mut socket = WebSocket::new(cloud, b"", MAX_FRAME, MAX_RECORD);
        runtime.expect("a runtime").block_on(link.session.run(&mut socket, &*link));
        let _ = sender.send(());
    });
    over.recv_timeout(PATIENCE).expect("the connection waits for whoever asks");
    drop(held);
    assert_eq!(asking.join().expect("no panic").node, "/detect");
}

#[test]
fn a_robot_may_tell_any_number_for_its_t_max() {
    let max_age = |max| session_options(&SlaTargets { max: Some(max), ..SlaTargets::default() }).max_age;
    assert_eq!(max_age(0.3), Some(Duration::from_millis(300)));
    for max in [1e300, f64::INFINITY, f64::NAN, -1.0, 0.0, 1e-300] {
        assert_eq!(max_age(max), None, "{max}");
    }
}

#[tokio::test]
async fn a_robot_that_may_no_longer_be_served_is_told_why() {
    let (hub, _nodes) = hub().await;
    let (robot, cloud) = duplex(1 << 16);
    let (revoke, revoked) = tokio::sync::oneshot::channel::<String>();
    let serving = tokio::spawn(async move { hub.serve_until(cloud, b"", async { revoked.await.unwrap() }).await });
    let mut socket = WebSocket::client(robot, b"", MAX_FRAME, MAX_RECORD, 7);
    send_open(&mut socket, &hello("/detect", 1)).await.unwrap();
    let mut held = Budget::without_limit().permit();
    let welcome = receive_open(&mut socket, "welcome", &mut held).await.unwrap();
    assert!(matches!(welcome, Welcome::Accepted { .. }), "{welcome:?}");
    revoke.send("its token was revoked".to_owned()).unwrap();
    assert_eq!(read_until_close(socket).await, "its token was revoked");
    let ended = serving.await.unwrap();
    assert!(matches!(ended, DisconnectReason::Closed { code: 1008, .. }), "{ended:?}");
}
