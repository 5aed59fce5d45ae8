//! The robot's end of a link, made by hand, before a hub whose servant is a network of nodes of ROS 2.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use budget::{Budget, Permit};
use bytes::Bytes;
use link::clock::now;
use link::control::{
    Exit, FromCloud, FromRobot, Graph, Hello, Input, Node, Output, Served, Welcome,
};
use link::record::{Data, Record};
use link::session::{receive_open, send_open};
use link::{Handler, MAX_FRAME, MAX_RECORD, Quality, RobotSession, SessionOptions};
use parking_lot::Mutex;
use reach::links::{Hub, HubOptions, Nodes};
use ros::bus::{Bus, ParamValue, RosVersion, ServiceType};
use ros::schema::Registry;
use tokio::io::DuplexStream;
use tokio::sync::{mpsc, watch};
use tokio::time::timeout;
use ws::WebSocket;

use super::lab::LONG;

/// Nodes that a servant is said to have started; those of the tests run whatever is done with these.
#[derive(Default)]
pub struct Remembered {
    /// Run of each, and how often it was started.
    started: Mutex<HashMap<String, (String, usize)>>,
}

impl Remembered {
    /// How often a node was started.
    pub fn starts(&self, node: &str) -> usize {
        self.started.lock().get(node).map_or(0, |known| known.1)
    }
}

#[async_trait]
impl Nodes for Remembered {
    fn service(&self) -> &str {
        "vision"
    }
    async fn start(&self, node: &Node, run: &str) -> Result<(), String> {
        let mut started = self.started.lock();
        let known = started.entry(node.name.clone()).or_default();
        *known = (run.to_owned(), known.1 + 1);
        Ok(())
    }
    fn run(&self, node: &str) -> Option<String> {
        Some(self.started.lock().get(node)?.0.clone())
    }
    async fn signal(&self, _: &str, _: i32) -> Result<(), String> {
        Err("it is not of this servant".to_owned())
    }
    async fn ended(&self, _: &str) -> Exit {
        std::future::pending().await
    }
    async fn is_running(&self, node: &str) -> bool {
        self.started.lock().contains_key(node)
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

/// A hub before a bus, with these definitions.
pub fn hub(bus: Arc<dyn Bus>, nodes: Arc<dyn Nodes>, definitions: &[(&str, &str)]) -> Arc<Hub> {
    let registry = Registry::of(RosVersion::Two);
    for (key, text) in definitions {
        registry.insert(key, text).expect("a definition");
    }
    Hub::new("s1", bus, Arc::new(registry), nodes, HubOptions::default())
}

/// Says hello on a new connection, and how that is answered.
async fn says(hub: &Arc<Hub>, hello: &Hello) -> (WebSocket<DuplexStream>, Welcome) {
    let (theirs, ours) = tokio::io::duplex(1 << 16);
    let hub = Arc::clone(hub);
    tokio::spawn(async move { hub.serve(theirs, &[]).await });
    let mut socket = WebSocket::client(ours, &[], MAX_FRAME, MAX_RECORD, 7);
    send_open(&mut socket, hello).await.expect("a connection");
    let mut held = Budget::unlimited().permit();
    let welcome = receive_open(&mut socket, "welcome", &mut held).await;
    (socket, welcome.expect("a welcome"))
}

/// The hello of a robot of ROS 2 that stands for this node.
pub fn hello(node: &str) -> Hello {
    Hello {
        ros: 2,
        run: "run".to_owned(),
        next: 1,
        node: Node {
            name: node.to_owned(),
            ..Node::default()
        },
        lends: true,
        ..Hello::default()
    }
}

/// Why a hello is refused, and whether trying again may help.
pub async fn refused(hub: &Arc<Hub>, hello: &Hello) -> (String, bool) {
    match says(hub, hello).await.1 {
        Welcome::Refused { reason, again } => (reason, again),
        welcome => panic!("{welcome:?}"),
    }
}

/// What the cloud asks of the robot.
#[derive(Debug)]
pub enum Asked {
    Lookup(String),
    Call(u32, u32, Bytes),
}

struct Ear {
    graph: watch::Sender<Graph>,
    types: Mutex<HashMap<(String, String), String>>,
    heard: mpsc::UnboundedSender<(u32, Bytes)>,
    answers: mpsc::UnboundedSender<(u32, Result<Bytes, String>)>,
    asked: mpsc::UnboundedSender<Asked>,
}

impl Handler<FromCloud> for Ear {
    fn record(&self, record: Record<FromCloud>, _held: Permit, _arrived: i64) {
        match record {
            Record::Data(data) => drop(self.heard.send((data.channel, data.message))),
            Record::Answer { id, response, .. } => drop(self.answers.send((id, response))),
            Record::Call {
                id,
                service,
                request,
            } => drop(self.asked.send(Asked::Call(id, service, request))),
            Record::Control(FromCloud::Lookup { service }) => {
                drop(self.asked.send(Asked::Lookup(service)));
            }
            Record::Control(FromCloud::Graph(graph)) => drop(self.graph.send_replace(graph)),
            Record::Control(FromCloud::Type {
                name,
                md5,
                definition,
            }) => drop(self.types.lock().insert((name, md5), definition)),
            Record::Control(_) => {}
        }
    }
}

/// The robot's end of a link.
pub struct Robot {
    pub session: Arc<RobotSession>,
    pub asked: mpsc::UnboundedReceiver<Asked>,
    ear: Arc<Ear>,
    heard: mpsc::UnboundedReceiver<(u32, Bytes)>,
    answers: mpsc::UnboundedReceiver<(u32, Result<Bytes, String>)>,
}

impl Robot {
    /// Connects, and stands for the node that the hello names.
    pub async fn links(hub: &Arc<Hub>, hello: &Hello) -> Self {
        let (mut socket, welcome) = says(hub, hello).await;
        let Welcome::Accepted {
            received,
            ahead,
            next,
            ..
        } = welcome
        else {
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
        let ear = Arc::new(Ear {
            graph: watch::Sender::default(),
            types: Mutex::default(),
            heard,
            answers,
            asked: asks,
        });
        let (running, hearing) = (Arc::clone(&session), Arc::clone(&ear));
        tokio::spawn(async move { running.run(&mut socket, &*hearing).await });
        Self {
            session,
            asked,
            ear,
            heard: hears,
            answers: answered,
        }
    }

    /// Waits until the node has this, and says all that it has.
    pub async fn told(&self, wanted: impl Fn(&Graph) -> bool) -> Graph {
        let mut graphs = self.ear.graph.subscribe();
        let told = timeout(LONG, graphs.wait_for(|graph| wanted(graph))).await;
        match told {
            Ok(graph) => graph.expect("the link is there").clone(),
            Err(_) => panic!("{:#?}", self.ear.graph.borrow()),
        }
    }

    /// The definition that was told of a type.
    pub fn definition(&self, name: &str, md5: &str) -> Option<String> {
        let types = self.ear.types.lock();
        types.get(&(name.to_owned(), md5.to_owned())).cloned()
    }

    /// A node of the robot listens to this output.
    pub fn listens(&self, output: &Output) {
        let (channel, count) = (output.channel, 1);
        let listening = FromRobot::Listeners { channel, count };
        self.session.report(&listening);
    }

    /// The next message of any output that is listened to, with its channel.
    pub async fn hears(&mut self) -> (u32, Bytes) {
        let heard = timeout(LONG, self.heard.recv()).await;
        heard.expect("a message").expect("the link is there")
    }

    /// A publisher of the robot comes.
    pub fn opens(&self, input: Input) {
        self.session.report(&FromRobot::Open(input));
    }

    /// It publishes.
    pub fn publishes(&self, channel: u32, message: Bytes) {
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
        self.session.publish(data, Quality::Each);
    }

    /// A node of the robot calls a service.
    pub async fn calls(&mut self, served: &Served, request: Bytes) -> Result<Bytes, String> {
        let called = self.session.call(served.channel, request);
        loop {
            let answer = timeout(LONG, self.answers.recv()).await;
            let (id, response) = answer.expect("an answer").expect("the link is there");
            if id == called {
                return response;
            }
        }
    }

    /// What the cloud asks next.
    pub async fn is_asked(&mut self) -> Asked {
        let asked = timeout(LONG, self.asked.recv()).await;
        asked.expect("a question").expect("the link is there")
    }

    /// Tells what the robot has under a name.
    pub fn has(&self, service: &str, of: Option<(u32, &ServiceType)>) {
        let of = of.map(|(channel, of)| Served::of(channel, service, of));
        let service = service.to_owned();
        self.session.report(&FromRobot::Lent { service, of });
    }
}

/// The one of this name.
pub fn output<'a>(graph: &'a Graph, topic: &str) -> Option<&'a Output> {
    graph.outputs.iter().find(|output| output.topic == topic)
}

/// The one of this name.
pub fn served<'a>(graph: &'a Graph, service: &str) -> Option<&'a Served> {
    graph.services.iter().find(|served| served.name == service)
}
