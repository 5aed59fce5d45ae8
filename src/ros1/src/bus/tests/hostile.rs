//! Peers that lie, stall and break off.

use budget::{Budget, WorkLimit};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpListener;

use super::*;
use crate::tcpros::Header;
use crate::testing::TestNode;
use crate::xmlrpc::{Value, XmlRpcClient};

/// A hand-made publisher, with the bytes it sends on each successive connection.
async fn publisher(master: &TestMaster, scripts: Vec<Vec<u8>>) -> TestNode {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = i32::from(listener.local_addr().unwrap().port());
    let place = Value::Array(vec!["TCPROS".into(), "127.0.0.1".into(), port.into()]);
    let node = TestNode::start_answering(place).await;
    let list = ["/liar", "/chat", "std_msgs/String", &node.uri].map(Value::from);
    master.call("registerPublisher", &list).await;
    tokio::spawn(async move {
        for script in scripts {
            let (mut stream, _) = listener.accept().await.unwrap();
            let mut buffer = bytes::BytesMut::new();
            Header::read(&mut stream, &mut buffer).await.unwrap();
            stream.write_all(&script).await.unwrap();
        }
        std::future::pending::<()>().await;
        drop(listener);
    });
    node
}

fn script(after_header: &[u8]) -> Vec<u8> {
    let header = Header::new([("type", "std_msgs/String"), ("md5sum", "992c")]);
    let mut bytes = header.encode();
    bytes.extend_from_slice(after_header);
    bytes
}

#[tokio::test]
async fn a_publisher_that_breaks_off_or_lies_is_tried_again() {
    let master = TestMaster::start().await;
    let bus = join(&master, "/one").await;
    let scripts = vec![
        Header::error("not you").encode(),
        // Not a header; a message longer than allowed; one that is cut off; and finally a good one.
        vec![0xff; 8],
        script(&u32::MAX.to_le_bytes()),
        script(b"\x05\0\0\0abc"),
        script(b"\x04\0\0\0good"),
    ];
    let node = publisher(&master, scripts).await;
    let mut subscription = subscribe_text(&bus, "/chat").await;
    let message = next(&mut subscription.messages).await;
    assert_eq!(message.bytes, "good");
    // It did not give its name: then its address is used.
    assert_eq!(message.publisher.node(), node.uri);
}

#[tokio::test]
async fn a_publisher_that_does_not_check_types_is_checked() {
    let master = TestMaster::start().await;
    let bus = join(&master, "/one").await;
    let node = publisher(&master, vec![script(b"")]).await;
    let met = link::connect(&bus.inner, "/chat", &node.uri, &text_type("0000")).await;
    let error = met.err().unwrap();
    assert!(matches!(error, BusError::TypeMismatch { .. }), "{error}");
}

#[tokio::test]
async fn a_publisher_that_stalls_holds_up_no_other() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    // It accepts and then is silent; another one's XML-RPC hangs.
    let _stalled = publisher(&master, vec![vec![]]).await;
    let hung = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let hung_uri = format!("http://{}/", hung.local_addr().unwrap());
    let list = ["/hung", "/chat", "std_msgs/String", &hung_uri].map(Value::from);
    master.call("registerPublisher", &list).await;
    let mut subscription = subscribe_text(&one, "/chat").await;
    let good = advertise_text(&two, "/chat", true).await;
    good.publish("here".into());
    assert_eq!(next_text(&mut subscription.messages).await, "here");
}

#[tokio::test]
async fn a_subscriber_that_does_not_read_holds_up_no_other() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let qos = QosProfile::keep_last(2);
    let publisher = one.advertise("/chat", text_type("992c"), qos).await.unwrap();
    let address: SocketAddr = ([127, 0, 0, 1], one.inner.port).into();
    let mut lazy = tokio::net::TcpStream::connect(address).await.unwrap();
    let header = Header::new([("topic", "/chat"), ("md5sum", "*"), ("callerid", "/lazy")]);
    header.write(&mut lazy).await.unwrap();
    let mut subscription = subscribe_text(&two, "/chat").await;
    wait_for_subscribers(&*publisher, 2).await;
    let big = Bytes::from(vec![7; 1 << 20]);
    for _ in 0..100 {
        publisher.publish(big.clone());
        next(&mut subscription.messages).await;
    }
    // Messages it does not take are dropped and counted, not kept.
    assert!(publisher.dropped_count() > 50, "{}", publisher.dropped_count());
    drop(publisher);
    // If it reads at last, it gets what is still queued, and is then disconnected.
    let mut rest = Vec::new();
    let read = tokio::time::timeout(PATIENCE, lazy.read_to_end(&mut rest)).await;
    assert!(read.is_ok() && rest.len() > 1 << 20);
    // A publisher that ends waits for such a subscriber no longer than the farewell time.
    let publisher = advertise_text(&one, "/chat", false).await;
    let mut lazy = tokio::net::TcpStream::connect(address).await.unwrap();
    header.write(&mut lazy).await.unwrap();
    wait_for_subscribers(&*publisher, 2).await;
    (0..20).for_each(|_| publisher.publish(big.clone()));
    let closed = tokio::time::timeout(PATIENCE, one.close()).await;
    assert!(closed.is_ok());
}

#[tokio::test]
async fn a_master_that_refuses_is_quoted() {
    let refusing = TestNode::start_answering(Value::Int(0)).await;
    let address: SocketAddr = refusing.uri["http://".len()..refusing.uri.len() - 1].parse().unwrap();
    // Its answers are not a graph.
    let sockets = Arc::new(HostSockets);
    let error = Ros1Bus::connect(sockets.clone(), address, "/one").await;
    let error = error.err().unwrap().to_string();
    assert!(error.contains("waitGraph"), "{error}");
    // Nobody listens at all.
    let nobody = Ros1Bus::connect(sockets, ([127, 0, 0, 1], 1).into(), "/one").await;
    assert!(nobody.err().unwrap().to_string().contains("ROS Master at"));
    // A single call is refused.
    let master = TestMaster::start().await;
    let bus = join(&master, "/one").await;
    let error = bus.set("/", ParamValue::Int(1)).await.unwrap_err();
    assert!(error.to_string().contains("refused setParam"), "{error}");
    assert!(error.to_string().contains("dictionary"), "{error}");
}

#[tokio::test]
async fn a_failed_registration_leaves_nothing_behind() {
    let master = TestMaster::start().await;
    let bus = join(&master, "/one").await;
    let address = master.stop().await;
    assert!(bus.subscribe("/chat", WireType::any(), QosProfile::keep_last(100)).await.is_err());
    assert!(bus.advertise("/chat", text_type("992c"), QosProfile::keep_last(100)).await.is_err());
    assert_eq!(bus.inner.subscriptions.lock().len(), 0);
    assert_eq!(bus.inner.publications.lock().len(), 0);
    let fresh = crate::master::Master::new(Default::default());
    let master = TestMaster::start_at(fresh, Some(address)).await;
    let _subscription = subscribe_text(&bus, "/chat").await;
    master.wait_until(|graph| graph.topics.contains_key("/chat")).await;
}

#[tokio::test]
async fn the_slave_api_answers_what_tools_ask() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let publisher = advertise_text(&one, "/chat", false).await;
    let _subscription = subscribe_text(&two, "/chat").await;
    wait_for_subscribers(&*publisher, 1).await;
    let client = XmlRpcClient::new(Arc::new(HostSockets), one.uri()).unwrap();
    let ask = async |method: &str, args: &[Value]| {
        let answer = client.call(method, args, PATIENCE).await.unwrap();
        answer.as_array().unwrap().to_vec()
    };
    let caller = [Value::from("/tool")];
    let publications = ask("getPublications", &caller).await;
    let wanted = Value::Array(vec![Value::strings(["/chat", "std_msgs/String"])]);
    assert_eq!(publications[2], wanted);
    let info = ask("getBusInfo", &caller).await;
    let row = info[2].as_array().unwrap()[0].as_array().unwrap();
    assert_eq!(row[1..5], ["/two", "o", "TCPROS", "/chat"].map(Value::from));
    assert_eq!(ask("getBusStats", &caller).await[0], 1.into());
    assert_eq!(ask("getPid", &caller).await[0], 1.into());
    let master_uri = ask("getMasterUri", &caller).await;
    assert_eq!(master_uri[2], format!("http://{}/", master.address).into());
    let udp = Value::Array(vec![Value::strings(["UDPROS"])]);
    let declined = ask("requestTopic", &["/tool".into(), "/chat".into(), udp.clone()]).await;
    assert_eq!(declined[0], 0.into());
    let unknown = ask("requestTopic", &["/tool".into(), "/none".into(), udp]).await;
    assert!(unknown[1].as_str().unwrap().contains("does not publish"));
    assert_eq!(ask("publisherUpdate", &caller).await[0], (-1).into());
    // Asked to shut down, the bus reports it and keeps running.
    ask("shutdown", &["/tool".into(), "enough".into()]).await;
    let mut asked = one.shutdown_requested().unwrap();
    let reason = asked.wait_for(Option::is_some).await.unwrap().clone();
    assert_eq!(reason.as_deref(), Some("enough"));
    assert_eq!(ask("getPid", &caller).await[0], 1.into());
}

#[tokio::test]
async fn a_graph_that_grows_without_end_is_read_seldom() {
    const REGISTRATIONS: usize = 3000;
    let master = TestMaster::start().await;
    let bus = join(&master, "/one").await;
    let mut graph = bus.graph();
    let reading = tokio::spawn(async move {
        let mut read = 0;
        loop {
            let topics = graph.borrow_and_update().topics.len();
            read += topics;
            if topics >= REGISTRATIONS {
                return read;
            }
            graph.changed().await.unwrap();
        }
    });
    for number in 0..REGISTRATIONS {
        let topic = format!("/topic{number}");
        let list = ["/greedy", &topic, "std_msgs/String", "http://127.0.0.1:9/"];
        master.call("registerPublisher", &list.map(Value::from)).await;
    }
    // If it were read after each change, that would be a thousand parts each time on average.
    let read = reading.await.unwrap() / REGISTRATIONS;
    assert!(read < REGISTRATIONS / 10, "{read} topics for each registration");
}

#[tokio::test]
async fn what_nodes_make_the_bus_do_is_charged_to_its_servant() {
    let master = TestMaster::start().await;
    let limit = WorkLimit { cores: 1.0, burst: PATIENCE };
    let servant = Budget::new("the daemon", 1 << 30).child_with_work("a servant", 1 << 30, limit);
    let options = JoinOptions { budget: servant.clone(), ..JoinOptions::new(master.address, "/one") };
    let bus = Ros1Bus::connect_with(Arc::new(HostSockets), options).await.unwrap();
    let client = XmlRpcClient::new(Arc::new(HostSockets), bus.uri()).unwrap();
    let before = servant.work_time();
    for _ in 0..20 {
        client.call("getBusInfo", &["/tool".into()], PATIENCE).await.unwrap();
    }
    let answered = servant.work_time();
    assert!(answered > before, "{answered:?}");
    let mut graph = bus.graph();
    master.call("registerPublisher", &["/n", "/busy", "std_msgs/String", "http://127.0.0.1:9/"].map(Value::from)).await;
    graph.wait_for(|graph| graph.topics.contains_key("/busy")).await.unwrap();
    assert!(servant.work_time() > answered);
}
