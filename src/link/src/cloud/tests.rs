use ros::net::HostSockets;
use ros::ros1::Ros1Bus;
use ros::ros1::master::{Master, MasterOptions};
use tokio::io::{DuplexStream, duplex};
use tokio::net::TcpListener;

use super::*;
use crate::control::Resume;

/// A servant whose nodes run from when they are started, and say nothing.
#[derive(Default)]
struct Quiet {
    running: Mutex<BTreeSet<String>>,
    warnings: Mutex<Vec<String>>,
}

#[async_trait]
impl Nodes for Quiet {
    async fn start(&self, node: &Node, _: &Sla) -> Result<(), String> {
        self.running.lock().insert(node.name.clone());
        Ok(())
    }
    async fn signal(&self, node: &str, _: i32) -> Result<(), String> {
        self.running.lock().remove(node);
        Ok(())
    }
    async fn ended(&self, node: &str) -> Exit {
        if self.is_running(node).await {
            std::future::pending::<()>().await;
        }
        Exit::default()
    }
    async fn is_running(&self, node: &str) -> bool {
        self.running.lock().contains(node)
    }
    fn parameters(&self, _: &Node) -> Vec<(String, ParamValue)> {
        Vec::new()
    }
    fn translate(&self, _: &Node, text: &str) -> String {
        text.to_owned()
    }
    fn lines(&self, _: &str) -> mpsc::Receiver<(bool, String)> {
        mpsc::channel(1).1
    }
    fn warn(&self, _: &str, text: &str) {
        self.warnings.lock().push(text.to_owned());
    }
}

async fn hub() -> (Arc<Hub>, Arc<Quiet>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let master = Master::new(MasterOptions::default());
    tokio::spawn(async move { master.serve(listener, Arc::new(HostSockets)).await });
    let bus = Ros1Bus::connect(Arc::new(HostSockets), address, "/bridge");
    let bus: Arc<dyn Bus> = bus.await.unwrap();
    let nodes = Arc::new(Quiet::default());
    let options = HubOptions::default();
    let registry = Arc::new(Registry::default());
    (Hub::new("s1", bus, registry, nodes.clone(), options), nodes)
}

fn hello(node: &str, attempt: u64) -> Hello {
    Hello {
        run: "life".into(),
        attempt,
        machine: "m1".into(),
        host: "rover".into(),
        node: Node {
            name: node.into(),
            ..Node::default()
        },
        next: 1,
        ..Hello::default()
    }
}

/// Says hello on a new connection; how that is answered.
async fn says(hub: &Arc<Hub>, hello: &Hello) -> (WebSocket<DuplexStream>, Welcome) {
    let (robot, cloud) = duplex(1 << 16);
    let hub = Arc::clone(hub);
    tokio::spawn(async move { hub.serve(cloud, b"").await });
    let mut socket = WebSocket::client(robot, b"", MAX_FRAME, MAX_RECORD, 7);
    send_open(&mut socket, hello).await.unwrap();
    let welcome = receive_open(&mut socket, "welcome").await.unwrap();
    (socket, welcome)
}

fn resuming(attempt: u64, welcome: &Welcome) -> Hello {
    let Welcome::Accepted { session, next, .. } = welcome else {
        panic!("{welcome:?}");
    };
    let resume = Resume {
        session: session.clone(),
        received: next - 1,
        ahead: Vec::new(),
    };
    Hello {
        resume: Some(resume),
        ..hello("/detect", attempt)
    }
}

/// Reads until the cloud closes the connection; its words.
async fn closed(mut socket: WebSocket<DuplexStream>) -> String {
    loop {
        match std::future::poll_fn(|cx| socket.poll_next(cx)).await {
            Ok(ws::Message::Close(_, reason)) => return reason,
            Ok(_) => {}
            Err(error) => return error.to_string(),
        }
    }
}

#[tokio::test]
async fn a_hello_that_was_overtaken_does_not_displace_the_later_one() {
    let (hub, _nodes) = hub().await;
    let (first, welcome) = says(&hub, &hello("/detect", 1)).await;
    // The robot gives up its second connection and makes a third; the hello of the second comes last.
    let (third, welcome) = says(&hub, &resuming(3, &welcome)).await;
    assert!(matches!(welcome, Welcome::Accepted { resumed: true, .. }));
    closed(first).await;
    let (_, late) = says(&hub, &resuming(2, &welcome)).await;
    assert!(
        matches!(late, Welcome::Refused { again: true, .. }),
        "{late:?}"
    );
    // One that knew of no session yet would have begun another one.
    let (_, late) = says(&hub, &hello("/detect", 2)).await;
    assert!(matches!(late, Welcome::Refused { .. }), "{late:?}");
    let link = hub.links.lock()["/detect"].clone();
    assert!(link.is_connected(), "the third carries it");
    let (_fourth, welcome) = says(&hub, &resuming(4, &welcome)).await;
    assert!(matches!(welcome, Welcome::Accepted { resumed: true, .. }));
    closed(third).await;
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
    let (_one, _) = says(&hub, &of("/one", "rover1", "a")).await;
    let (_two, _) = says(&hub, &of("/two", "rover1", "a")).await;
    let (_arm, _) = says(&hub, &of("/arm", "computer in the arm", "a")).await;
    assert!(nodes.warnings.lock().is_empty(), "they are one robot");
    assert!(hub.status().iter().all(|link| link.twins.is_empty()));
    let (_copy, welcome) = says(&hub, &of("/other", "rover2", "b")).await;
    assert!(matches!(welcome, Welcome::Accepted { .. }));
    let warnings = nodes.warnings.lock().clone();
    assert_eq!(
        warnings.len(),
        2,
        "one for each other machine: {warnings:?}"
    );
    let told = "rover1 runs /one, rover2 runs /other";
    assert!(
        warnings.iter().any(|text| text.contains(told)),
        "{warnings:?}"
    );
    for link in hub.status() {
        let twins = match link.node.as_str() {
            "/other" => vec!["computer in the arm", "rover1"],
            _ => vec!["rover2"],
        };
        assert_eq!(link.twins, twins, "{}", link.node);
    }
    // The same node is refused.
    let (_, refused) = says(&hub, &of("/one", "rover2", "b")).await;
    let Welcome::Refused { reason, again } = refused else {
        panic!("{refused:?}");
    };
    assert!(
        reason.contains("another machine (rover1)") && !again,
        "{reason}"
    );
}
