use std::sync::atomic::AtomicUsize;

use ros_bus::FailureReason;
use tokio::io::AsyncWriteExt as _;
use tokio::net::TcpListener;
use tokio::sync::Barrier;

use super::*;
use crate::tcpros::{self, Header};
use crate::testing::TestNode;
use crate::xmlrpc::Value;

/// Answers with the request; `fail` fails, `meet` waits for a second call.
struct Echo {
    meeting: Barrier,
}

#[async_trait]
impl ServiceHandler for Echo {
    async fn call(&self, request: Bytes, caller: &str) -> Result<Bytes, FailureReason> {
        match &request[..] {
            b"fail" => Err(FailureReason::new(format!("not for {caller}"))),
            b"meet" => {
                self.meeting.wait().await;
                Ok(request)
            }
            b"wait" => std::future::pending().await,
            _ => Ok(request),
        }
    }
}

fn add_type() -> ServiceType {
    ServiceType::new("pkg/Add", "abcd")
}

async fn serve(bus: &Ros1Bus) -> Box<dyn Send + Sync> {
    let handler = Arc::new(Echo { meeting: Barrier::new(2) });
    bus.serve("/echo", add_type(), handler).await.unwrap()
}

#[tokio::test]
async fn calls_are_answered_or_failed_with_the_servers_words() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let guard = serve(&one).await;
    assert_eq!(two.service_type("/echo").await.unwrap(), add_type());
    assert_eq!(one.service_type("/echo").await.unwrap(), add_type());
    for size in [0, 1, 100_000, 3_000_000] {
        let request = Bytes::from(vec![b'x'; size]);
        let response = two.call("/echo", request.clone(), PATIENCE).await.unwrap();
        assert_eq!(response, request);
    }
    let failed = two.call("/echo", "fail".into(), PATIENCE).await.unwrap_err();
    assert!(failed.to_string().contains("not for /two"), "{failed}");
    // The connection is still good for the next call.
    assert_eq!(two.call("/echo", "ok".into(), PATIENCE).await.unwrap(), "ok");
    assert_eq!(one.call("/echo", "self".into(), PATIENCE).await.unwrap(), "self");
    let taken = one.serve("/echo", add_type(), Arc::new(Echo { meeting: Barrier::new(1) }));
    assert!(matches!(taken.await, Err(BusError::AlreadyServed(_))));
    drop(guard);
    master.wait_until(|graph| graph.services.is_empty()).await;
    let gone = two.call("/echo", "x".into(), PATIENCE).await.unwrap_err();
    assert!(matches!(gone, BusError::NoService(_)), "{gone}");
    // And served again.
    let _guard = serve(&one).await;
    assert_eq!(two.call("/echo", "back".into(), PATIENCE).await.unwrap(), "back");
}

#[tokio::test]
async fn calls_run_at_the_same_time_and_end_in_time() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let _guard = serve(&one).await;
    let meet = || two.call("/echo", "meet".into(), PATIENCE);
    let (first, second) = tokio::join!(meet(), meet());
    assert!(first.is_ok() && second.is_ok());
    let short = Duration::from_millis(50);
    let late = two.call("/echo", "wait".into(), short).await.unwrap_err();
    assert!(matches!(late, BusError::Timeout { .. }), "{late}");
    // A late answer is not mistaken for the next call's.
    assert_eq!(two.call("/echo", "next".into(), PATIENCE).await.unwrap(), "next");
}

/// A hand-made server: each connection is answered by the next of `scripts`.
async fn scripted_server(master: &TestMaster, scripts: Vec<Script>) -> (TestNode, Arc<AtomicUsize>) {
    let node = TestNode::start().await;
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let uri = format!("rosrpc://{}", listener.local_addr().unwrap());
    let list = ["/server", "/echo", &uri, &node.uri].map(Value::from);
    master.call("registerService", &list).await;
    let taken = Arc::new(AtomicUsize::new(0));
    let count = taken.clone();
    tokio::spawn(async move {
        for script in scripts {
            let (mut stream, _) = listener.accept().await.unwrap();
            let mut buffer = bytes::BytesMut::new();
            Header::read(&mut stream, &mut buffer).await.unwrap();
            let header = Header::new([("callerid", "/server"), ("md5sum", "x"), ("type", "a/B")]);
            match script {
                Script::Refuse => {
                    Header::error("go away").write(&mut stream).await.unwrap();
                    continue;
                }
                _ => header.write(&mut stream).await.unwrap(),
            }
            let mut frames = tcpros::FrameReader::new(buffer, 1000);
            if let Script::HangUp = script {
                frames.next(&mut stream).await.unwrap();
                count.fetch_add(1, Ordering::Relaxed);
                continue;
            }
            let slams = matches!(script, Script::AnswerAndSlam(_));
            let (Script::Answer(answers) | Script::AnswerAndSlam(answers)) = script else {
                continue;
            };
            for bytes in answers {
                frames.next(&mut stream).await.unwrap();
                count.fetch_add(1, Ordering::Relaxed);
                stream.write_all(bytes).await.unwrap();
            }
            if slams {
                stream.readable().await.unwrap();
            }
        }
    });
    (node, taken)
}

enum Script {
    /// Answers that many calls with these bytes, then closes.
    Answer(Vec<&'static [u8]>),
    /// Answers likewise, but closes only when the next request has arrived, without reading it.
    AnswerAndSlam(Vec<&'static [u8]>),
    /// Takes the request and closes.
    HangUp,
    /// Refuses the header.
    Refuse,
}

const OK: &[u8] = b"\x01\x02\0\0\0ok";

#[tokio::test]
async fn a_kept_connection_that_was_closed_is_replaced_unnoticed() {
    let master = TestMaster::start().await;
    let one = join(&master, "/one").await;
    let scripts = (0..20).map(|n| match n % 2 {
        0 => Script::Answer(vec![OK]),
        _ => Script::AnswerAndSlam(vec![OK]),
    });
    let scripts = scripts.collect();
    let (_node, taken) = scripted_server(&master, scripts).await;
    for _ in 0..20 {
        assert_eq!(one.call("/echo", "x".into(), PATIENCE).await.unwrap(), "ok");
    }
    assert_eq!(taken.load(Ordering::Relaxed), 20);
}

#[tokio::test]
async fn a_call_that_was_taken_is_not_made_twice() {
    let master = TestMaster::start().await;
    let one = join(&master, "/one").await;
    let scripts = vec![Script::HangUp, Script::Answer(vec![OK])];
    let (_node, taken) = scripted_server(&master, scripts).await;
    let error = one.call("/echo", "x".into(), PATIENCE).await.unwrap_err();
    assert!(error.to_string().contains("during the call"), "{error}");
    assert_eq!(taken.load(Ordering::Relaxed), 1);
}

#[tokio::test]
async fn servers_that_misbehave_are_told_apart() {
    let master = TestMaster::start().await;
    let one = join(&master, "/one").await;
    let scripts = vec![
        Script::Refuse,
        Script::Answer(vec![b"\x01\xff\xff\xff\xff"]),
        Script::Answer(vec![b"\x01\x05\0\0\0ok"]),
        Script::Answer(vec![b"\0\x03\0\0\0bad"]),
    ];
    let _server = scripted_server(&master, scripts).await;
    for wanted in ["go away", "limit", "ended inside", "failed: bad"] {
        let error = one.call("/echo", "x".into(), PATIENCE).await.unwrap_err();
        assert!(error.to_string().contains(wanted), "{wanted}: {error}");
    }
    // A server that is registered but not running.
    let list = ["/server", "/gone", "rosrpc://127.0.0.1:1", "http://127.0.0.1:1/"].map(Value::from);
    master.call("registerService", &list).await;
    let error = one.call("/gone", "x".into(), PATIENCE).await.unwrap_err();
    assert!(error.to_string().contains("refused"), "{error}");
}

#[tokio::test]
async fn callers_that_misbehave_are_refused_and_harm_nobody() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let _guard = serve(&one).await;
    let address: SocketAddr = ([127, 0, 0, 1], one.inner.port).into();
    for (fields, wanted) in [
        (Header::new([("service", "/echo"), ("md5sum", "0000")]), "0000"),
        (Header::new([("service", "/none"), ("md5sum", "*")]), "does not serve"),
        (Header::new([("topic", "/none"), ("md5sum", "*")]), "does not publish"),
        (Header::new([("callerid", "/x")]), "neither"),
    ] {
        let opened = tcpros::ServiceConnection::open(&HostSockets, address, &fields, 1000).await;
        let error = opened.unwrap_err().to_string();
        assert!(error.contains(wanted), "{wanted}: {error}");
    }
    for garbage in [&b"GET / HTTP/1.1\r\n\r\n"[..], &[0xff; 64], &[3, 0, 0, 0, 9, 9, 9]] {
        let mut stream = tokio::net::TcpStream::connect(address).await.unwrap();
        let _ = stream.write_all(garbage).await;
        let mut answer = Vec::new();
        let _ = tokio::io::AsyncReadExt::read_to_end(&mut stream, &mut answer).await;
        assert_eq!(answer, b"");
    }
    assert_eq!(two.call("/echo", "fine".into(), PATIENCE).await.unwrap(), "fine");
}

#[tokio::test]
async fn two_that_serve_one_service_do_not_fight_for_it_for_ever() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let first = serve(&one).await;
    let second = serve(&two).await;
    let generation = || one.graph().borrow().generation;
    let before = generation();
    // They may register again now and then, with pauses that double: not each time they see the other's registration.
    for _ in 0..2000 {
        master.call("getPid", &["/asks".into()]).await;
    }
    let changes = generation() - before;
    assert!(changes < 60, "{changes} changes");
    let three = join(&master, "/three").await;
    assert_eq!(three.call("/echo", "x".into(), PATIENCE).await.unwrap(), "x");
    // The remaining one gets it at once.
    let (gone, left) = match one.graph().borrow().services["/echo"].as_str() {
        "/one" => (first, "/two"),
        _ => (second, "/one"),
    };
    drop(gone);
    wait_for_graph(&three, |graph| graph.services.get("/echo").is_some_and(|node| node == left)).await;
}
