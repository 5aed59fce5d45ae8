//! A simulated robot's end of a link, connected to a hub whose servant is a network of ROS 2 nodes.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use budget::{Budget, Permit};
use bytes::Bytes;
use link::clock::now;
use link::control::{
    Exit, FromCloud, FromRobot, Graph, Hello, InputChannel, NodeLaunch, OutputChannel, ServiceChannel, Welcome,
};
use link::record::{Call, Data, Record};
use link::session::{receive_open, send_open};
use link::{DeliveryMode, MAX_FRAME, MAX_RECORD, RobotSession, SessionHandler, SessionOptions};
use parking_lot::Mutex;
use reach::links::{Hub, HubOptions, NodeController, NodeError};
use ros::bus::{Bus, FailureReason, ParamChange, ParamValue, RosVersion, ServiceType};
use ros::schema::Registry;
use tokio::io::DuplexStream;
use tokio::sync::{mpsc, watch};
use tokio::time::timeout;
use ws::WebSocket;

use super::lab::LONG;

/// Nodes that a servant is assumed to have started; those of the tests run independently.
#[derive(Default)]
pub struct RunTracker {
    /// Run of each node, and how often it was started.
    started: Mutex<HashMap<String, (String, usize)>>,
}

impl RunTracker {
    /// Returns how often a node was started.
    pub fn starts(&self, node: &str) -> usize {
        self.started.lock().get(node).map_or(0, |known| known.1)
    }
}

#[async_trait]
impl NodeController for RunTracker {
    fn service(&self) -> &str {
        "vision"
    }
    async fn start(&self, node: &NodeLaunch, run: &str) -> Result<(), NodeError> {
        let mut started = self.started.lock();
        let known = started.entry(node.name.clone()).or_default();
        *known = (run.to_owned(), known.1 + 1);
        Ok(())
    }
    fn last_run(&self, node: &str) -> Option<String> {
        Some(self.started.lock().get(node)?.0.clone())
    }
    async fn signal(&self, _: &str, _: i32) -> Result<(), NodeError> {
        Err(NodeError::ServantEnded)
    }
    async fn wait_exit(&self, _: &str) -> Exit {
        std::future::pending().await
    }
    async fn is_running(&self, node: &str) -> bool {
        self.started.lock().contains_key(node)
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

/// Creates a hub on a bus with these definitions.
pub fn hub(bus: Arc<dyn Bus>, nodes: Arc<dyn NodeController>, definitions: &[(&str, &str)]) -> Arc<Hub> {
    let registry = Registry::for_version(RosVersion::Two);
    for (key, text) in definitions {
        registry.insert(key, text).expect("a definition");
    }
    Hub::new("s1", bus, Arc::new(registry), nodes, HubOptions::default())
}

/// Sends a hello on a new connection; returns the welcome.
async fn send_hello(hub: &Arc<Hub>, hello: &Hello) -> (WebSocket<DuplexStream>, Welcome) {
    let (theirs, ours) = tokio::io::duplex(1 << 16);
    let hub = Arc::clone(hub);
    tokio::spawn(async move { hub.serve_until(theirs, &[], std::future::pending()).await });
    let mut socket = WebSocket::client(ours, &[], MAX_FRAME, MAX_RECORD, 7);
    send_open(&mut socket, hello).await.expect("a connection");
    let mut held = Budget::without_limit().permit();
    let welcome = receive_open(&mut socket, "welcome", &mut held).await;
    (socket, welcome.expect("a welcome"))
}

/// Creates the hello of a ROS 2 robot for this node.
pub fn hello(node: &str) -> Hello {
    Hello {
        ros: 2,
        run: "run".to_owned(),
        next: 1,
        node: NodeLaunch { name: node.to_owned(), ..NodeLaunch::default() },
        lends: true,
        ..Hello::default()
    }
}

/// Returns the reason why a hello is refused, and whether retrying may help.
pub async fn expect_refusal(hub: &Arc<Hub>, hello: &Hello) -> (String, bool) {
    match send_hello(hub, hello).await.1 {
        Welcome::Refused { reason, again } => (reason, again),
        welcome => panic!("{welcome:?}"),
    }
}

/// Requests of the cloud to the robot.
#[derive(Debug)]
pub enum CloudRequest {
    Lookup(String),
    Call(u32, u32, Bytes),
}

struct CloudRequestForwarder {
    graph: watch::Sender<Graph>,
    types: Mutex<HashMap<(String, String), String>>,
    notices: watch::Sender<Vec<String>>,
    /// Changed parameters, in order.
    changes: watch::Sender<Vec<ParamChange>>,
    /// Number of messages that late subscribers are given, by channel.
    kept: watch::Sender<HashMap<u32, usize>>,
    heard: mpsc::UnboundedSender<(u32, Bytes)>,
    answers: mpsc::UnboundedSender<(u32, Result<Bytes, FailureReason>)>,
    asked: mpsc::UnboundedSender<CloudRequest>,
}

impl SessionHandler<FromCloud> for CloudRequestForwarder {
    fn on_record(&self, record: Record<FromCloud>, _held: Permit, _arrived: i64) {
        match record {
            Record::Data(data) => drop(self.heard.send((data.channel, data.message))),
            Record::Answer { id, response, .. } => drop(self.answers.send((id, response))),
            Record::Call(Call { id, service, request }) => {
                drop(self.asked.send(CloudRequest::Call(id, service, request)))
            }
            Record::Control(FromCloud::Lookup { service }) => {
                drop(self.asked.send(CloudRequest::Lookup(service)));
            }
            Record::Control(FromCloud::Graph(graph)) => drop(self.graph.send_replace(graph)),
            Record::Control(FromCloud::Type { name, md5, definition }) => {
                drop(self.types.lock().insert((name, md5), definition))
            }
            Record::Control(FromCloud::Parameters(changes)) => self.changes.send_modify(|all| all.extend(changes)),
            Record::Control(FromCloud::Notice { text, .. }) => self.notices.send_modify(|all| all.push(text)),
            Record::Control(FromCloud::Kept { channel, messages }) => {
                self.kept.send_modify(|kept| {
                    kept.insert(channel, messages);
                });
            }
            Record::Control(_) => {}
        }
    }
}

/// The robot's end of a link.
pub struct LinkedRobot {
    pub session: Arc<RobotSession>,
    pub asked: mpsc::UnboundedReceiver<CloudRequest>,
    ear: Arc<CloudRequestForwarder>,
    heard: mpsc::UnboundedReceiver<(u32, Bytes)>,
    answers: mpsc::UnboundedReceiver<(u32, Result<Bytes, FailureReason>)>,
}

impl LinkedRobot {
    /// Connects for the node that the hello names.
    pub async fn connect(hub: &Arc<Hub>, hello: &Hello) -> Self {
        let (mut socket, welcome) = send_hello(hub, hello).await;
        let Welcome::Accepted { received, ahead, next, .. } = welcome else {
            panic!("{welcome:?}");
        };
        let session = Arc::new(RobotSession::new(SessionOptions {
            ping: Duration::from_secs(1),
            silent: Duration::from_secs(2),
            lost: Duration::from_secs(20),
            max_age: None,
        }));
        session.reconnect(received, &ahead, next);
        let (heard, hears) = mpsc::unbounded_channel();
        let (answers, answered) = mpsc::unbounded_channel();
        let (asks, asked) = mpsc::unbounded_channel();
        let ear = Arc::new(CloudRequestForwarder {
            graph: watch::Sender::default(),
            types: Mutex::default(),
            notices: watch::Sender::default(),
            changes: watch::Sender::default(),
            kept: watch::Sender::default(),
            heard,
            answers,
            asked: asks,
        });
        let (running, hearing) = (Arc::clone(&session), Arc::clone(&ear));
        tokio::spawn(async move { running.run(&mut socket, &*hearing).await });
        Self { session, asked, ear, heard: hears, answers: answered }
    }

    /// Waits until the node's graph satisfies a condition; returns the graph.
    pub async fn wait_graph(&self, wanted: impl Fn(&Graph) -> bool) -> Graph {
        let mut graphs = self.ear.graph.subscribe();
        let told = timeout(LONG, graphs.wait_for(|graph| wanted(graph))).await;
        match told {
            Ok(graph) => graph.expect("the link is there").clone(),
            Err(_) => panic!("{:#?}", self.ear.graph.borrow()),
        }
    }

    /// Returns the definition received for a type.
    pub fn definition(&self, name: &str, md5: &str) -> Option<String> {
        let types = self.ear.types.lock();
        types.get(&(name.to_owned(), md5.to_owned())).cloned()
    }

    /// Waits until the cloud has said this; returns how often it did.
    #[allow(dead_code, reason = "not every test that includes this file waits for words")]
    pub async fn wait_notice(&self, words: &str) -> usize {
        let mut notices = self.ear.notices.subscribe();
        let count = |all: &Vec<String>| all.iter().filter(|text| text.contains(words)).count();
        match timeout(LONG, notices.wait_for(|all| count(all) > 0)).await {
            Ok(all) => count(&all.expect("the link is there")),
            Err(_) => panic!("{words}: {:#?}", self.ear.notices.borrow()),
        }
    }

    /// Waits until the cloud has told this change of a parameter.
    #[allow(dead_code, reason = "not every test that includes this file has parameters")]
    pub async fn wait_change(&self, key: &str, value: Option<&ParamValue>) {
        let mut changes = self.ear.changes.subscribe();
        let is_told = |all: &Vec<ParamChange>| all.iter().any(|(told, to)| told == key && to.as_ref() == value);
        if timeout(LONG, changes.wait_for(|all| is_told(all))).await.is_err() {
            panic!("{key} = {value:?}: {:#?}", self.ear.changes.borrow());
        }
    }

    /// Returns the number of messages of an output that late subscribers are given, if the cloud has told it.
    #[allow(dead_code, reason = "not every test that includes this file has late subscribers")]
    pub fn kept_count(&self, output: &OutputChannel) -> Option<usize> {
        self.ear.kept.borrow().get(&output.channel).copied()
    }

    /// Subscribes to an output on behalf of a node of the robot.
    pub fn listen(&self, output: &OutputChannel) {
        let (channel, count) = (output.channel, 1);
        let listening = FromRobot::Listeners { channel, count, latching: true };
        self.session.send_control(&listening);
    }

    /// Returns the next message of any subscribed output with its channel.
    pub async fn next_message(&mut self) -> (u32, Bytes) {
        let heard = timeout(LONG, self.heard.recv()).await;
        heard.expect("a message").expect("the link is there")
    }

    /// Announces a publisher of the robot.
    pub fn open_input(&self, input: InputChannel) {
        self.session.send_control(&FromRobot::Open(input));
    }

    /// Publishes a message.
    pub fn publish(&self, channel: u32, message: Bytes) {
        let data = Data {
            channel,
            encoded: false,
            latching: false,
            born: now(),
            left: 0,
            serialise: 0,
            answered: None,
            message,
        };
        self.session.publish(data, DeliveryMode::Each);
    }

    /// Calls a service on behalf of a node of the robot.
    pub async fn call(&mut self, served: &ServiceChannel, request: Bytes) -> Result<Bytes, FailureReason> {
        let called = self.session.call(served.channel, request);
        loop {
            let answer = timeout(LONG, self.answers.recv()).await;
            let (id, response) = answer.expect("an answer").expect("the link is there");
            if id == called {
                return response;
            }
        }
    }

    /// Returns the next request of the cloud.
    pub async fn next_request(&mut self) -> CloudRequest {
        let asked = timeout(LONG, self.asked.recv()).await;
        asked.expect("a question").expect("the link is there")
    }

    /// Reports what the robot has under a name.
    pub fn send_lent(&self, service: &str, of: Option<(u32, &ServiceType)>) {
        let of = of.map(|(channel, of)| ServiceChannel::new(channel, service, of));
        let service = service.to_owned();
        self.session.send_control(&FromRobot::Lent { service, of });
    }
}

/// Finds the output of this topic.
pub fn find_output<'a>(graph: &'a Graph, topic: &str) -> Option<&'a OutputChannel> {
    graph.outputs.iter().find(|output| output.topic == topic)
}

/// Finds the service of this name.
pub fn find_service<'a>(graph: &'a Graph, service: &str) -> Option<&'a ServiceChannel> {
    graph.services.iter().find(|served| served.name == service)
}
