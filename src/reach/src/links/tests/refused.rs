//! Operations that are refused at first or hang are retried and delay nothing else.

use std::net::SocketAddr;

use bytes::Bytes;
use link::drops::Cause;
use link::record::Data;
use ros::bus::{FailureReason, QosProfile, ServiceHandler, ServiceType, WireType};
use tokio::io::{AsyncReadExt, AsyncWriteExt, copy_bidirectional};
use tokio::net::TcpStream;

use super::*;
use crate::links::state::NodeLink;

/// A servant with a node, and a robot's link to it.
struct RetryScene {
    master: SocketAddr,
    hub: Arc<Hub>,
    node: Arc<Ros1Bus>,
    /// Address by which the Master knows the node.
    _known: Box<dyn Send + Sync>,
    _robot: WebSocket<DuplexStream>,
}

async fn master() -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let master = Master::new(MasterOptions::default());
    tokio::spawn(async move { master.serve(listener, Arc::new(HostSockets)).await });
    address
}

/// Calls a method of a Master and returns the response.
async fn call_master(master: SocketAddr, method: &str, parameters: &[&str]) -> String {
    let parameters = parameters.iter();
    let parameters: String = parameters.map(|text| format!("<param><value>{text}</value></param>")).collect();
    let call = format!(
        "<?xml version=\"1.0\"?><methodCall><methodName>{method}</methodName><params>{parameters}</params></methodCall>"
    );
    let mut stream = TcpStream::connect(master).await.unwrap();
    let length = call.len();
    let head = format!("POST / HTTP/1.1\r\nHost: here\r\nContent-Type: text/xml\r\nContent-Length: {length}\r\n\r\n");
    let request = [head, call].concat();
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = Vec::new();
    while !String::from_utf8_lossy(&answer).contains("</methodResponse>") {
        assert!(stream.read_buf(&mut answer).await.unwrap() > 0, "{method}");
    }
    String::from_utf8(answer).unwrap()
}

impl RetryScene {
    async fn new() -> Self {
        let address = master().await;
        let join = |name: &'static str| Ros1Bus::connect(Arc::new(HostSockets), address, name);
        let (bus, node) = (join("/bridge").await.unwrap(), join("/detect").await.unwrap());
        let known = node.serve("/known", echo_type(), Arc::new(Echo));
        let known = known.await.unwrap();
        let (nodes, registry) = (Arc::new(QuietNodes::default()), Arc::new(Registry::default()));
        let hub = Hub::new("s1", bus, registry, nodes, HubOptions::default());
        let (robot, _) = send_hello(&hub, &hello("/detect", 1)).await;
        Self { master: address, hub, node, _known: known, _robot: robot }
    }

    fn link(&self) -> Arc<NodeLink> {
        self.hub.links.lock()["/detect"].clone()
    }

    fn send_record(&self, record: Record<FromRobot>) {
        self.send_record_with_permit(record, Budget::without_limit().permit());
    }

    fn send_record_with_permit(&self, record: Record<FromRobot>, held: budget::Permit) {
        link::SessionHandler::on_record(&*self.link(), record, held, 0);
    }

    /// Registers a service of the node at this address with the Master.
    async fn register_service(&self, service: &str, at: SocketAddr) {
        let found = call_master(self.master, "lookupNode", &["/test", "/detect"]).await;
        let begin = found.find("http://").expect("its address");
        let node = found[begin..].split('<').next().unwrap();
        let at = format!("rosrpc://{at}");
        let registered = ["/detect", service, &at, node];
        let registered = call_master(self.master, "registerService", &registered).await;
        assert!(registered.contains(">1<"), "{registered}");
    }

    /// Waits until the robot may call this service.
    async fn wait_service(&self, service: &str) {
        let link = self.link();
        while !(link.services.lock().values()).any(|known| known.name == service) {
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    }
}

struct Echo;

#[async_trait]
impl ServiceHandler for Echo {
    async fn call(&self, request: Bytes, _: &str) -> Result<Bytes, FailureReason> {
        Ok(request)
    }
}

fn echo_type() -> ServiceType {
    ServiceType::new("tests/Echo", "0123456789abcdef0123456789abcdef")
}

#[tokio::test]
async fn a_service_that_hangs_keeps_no_other_waiting() {
    let scene = RetryScene::new().await;
    let hangs = TcpListener::bind("127.0.0.1:0").await.unwrap();
    scene.register_service("/a", hangs.local_addr().unwrap()).await;
    let asked = timeout(PATIENCE, hangs.accept()).await;
    let (mut asked, _) = asked.expect("it is asked").unwrap();
    let given_up = async { while asked.read_buf(&mut Vec::new()).await.unwrap_or(0) > 0 {} };
    let serving = scene.node.serve("/b", echo_type(), Arc::new(Echo));
    let _serving = serving.await.unwrap();
    tokio::select! {
        () = given_up => panic!("the one that hangs was waited for"),
        told = timeout(PATIENCE, scene.wait_service("/b")) => told.unwrap(),
    }
}

#[tokio::test]
async fn a_service_that_does_not_tell_its_type_at_first_is_asked_again() {
    let scene = RetryScene::new().await;
    // At another Master, where nobody else has registered it.
    let other = master().await;
    let elsewhere = Ros1Bus::connect(Arc::new(HostSockets), other, "/elsewhere");
    let elsewhere = elsewhere.await.unwrap();
    let serving = elsewhere.serve("/a", echo_type(), Arc::new(Echo));
    let _serving = serving.await.unwrap();
    let found = call_master(other, "lookupService", &["/test", "/a"]).await;
    let begin = found.rfind("rosrpc://").expect("its address") + "rosrpc://".len();
    let real = found[begin..].split(['<', '/', ']']).next().unwrap().to_owned();
    // The node's own service, behind something that refuses at first.
    let before = TcpListener::bind("127.0.0.1:0").await.unwrap();
    scene.register_service("/a", before.local_addr().unwrap()).await;
    let answers = async {
        for _ in 0..2 {
            drop(before.accept().await.unwrap());
        }
        loop {
            let (mut asked, _) = before.accept().await.unwrap();
            let mut server = TcpStream::connect(&real).await.unwrap();
            let _ = copy_bidirectional(&mut asked, &mut server).await;
        }
    };
    tokio::select! {
        () = answers => {}
        told = timeout(PATIENCE, scene.wait_service("/a")) => told.expect("it is asked again"),
    }
}

#[tokio::test]
async fn an_input_that_cannot_be_published_is_tried_again() {
    let scene = RetryScene::new().await;
    // Somebody publishes the topic with another type.
    let other = WireType::new("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1", "string data");
    let qos = QosProfile::keep_last(1);
    let other = scene.hub.bus.advertise("/image", other, qos).await.unwrap();
    let of = WireType::new("std_msgs/UInt8", "7c8164229e7d2c17eb95e9231617fdee", "uint8 data");
    let mut heard = scene.node.subscribe("/image", of.clone(), qos).await.unwrap();
    scene.send_record(Record::Control(FromRobot::Open(InputChannel {
        channel: 1,
        topic: "/image".into(),
        type_name: of.name.clone(),
        md5: of.digest.to_string(),
        definition: of.definition.clone(),
        ..InputChannel::default()
    })));
    let says = |value: u8| {
        scene.send_record(Record::Data(Data {
            channel: 1,
            encoded: false,
            latching: false,
            born: 0,
            left: 0,
            serialise: 0,
            answered: None,
            message: Bytes::from(vec![value]),
        }));
    };
    says(1);
    let refused = async {
        let dropped = || scene.link().status().drops;
        while !(dropped().iter()).any(|drop| drop.cause == Cause::Early && drop.count == 1) {
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    };
    timeout(PATIENCE, refused).await.expect("what waits is too old by the next time");
    drop(other);
    let connected = heard.matched.wait_for(|now| now.connected_count() > 0);
    let connected = timeout(PATIENCE, connected).await;
    assert!(connected.is_ok(), "it is not tried again");
    says(2);
    let message = timeout(PATIENCE, heard.messages.recv()).await.unwrap();
    assert_eq!(message.unwrap().bytes, [2_u8][..]);
}

#[tokio::test]
async fn an_input_that_is_refused_counts_as_its_robots_until_its_channel_is_closed() {
    let scene = RetryScene::new().await;
    let other = WireType::new("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1", "string data");
    let qos = QosProfile::keep_last(1);
    let _other = scene.hub.bus.advertise("/image", other, qos).await.unwrap();
    let told = Budget::new("what robot x tells", 1 << 20);
    let open = Record::Control(FromRobot::Open(InputChannel {
        channel: 1,
        topic: "/image".into(),
        type_name: "std_msgs/UInt8".into(),
        md5: "7c8164229e7d2c17eb95e9231617fdee".into(),
        definition: "uint8 data".into(),
        ..InputChannel::default()
    }));
    scene.send_record_with_permit(open, told.take(1000).unwrap());
    // The next control message is processed after this one was started.
    let (parameters, obeyed) = (Vec::new(), told.take(10).unwrap());
    scene.send_record_with_permit(Record::Control(FromRobot::Parameters(parameters)), obeyed);
    let used = async |bytes: usize| {
        let used = async {
            while told.used_bytes() != bytes {
                tokio::task::yield_now().await;
            }
        };
        let used = timeout(PATIENCE, used).await;
        assert!(used.is_ok(), "{} of {bytes} bytes", told.used_bytes());
    };
    used(1000).await;
    scene.send_record(Record::Control(FromRobot::Close { channel: 1 }));
    used(0).await;
}
