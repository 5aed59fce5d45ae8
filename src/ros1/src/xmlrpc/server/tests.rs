use std::net::SocketAddr;

use ros_bus::net::HostSockets;
use tokio::io::AsyncReadExt as _;

use super::*;
use crate::xmlrpc::{Error, XmlRpcClient, print_call};

const PATIENCE: Duration = Duration::from_secs(120);

/// Answers `echo` with its arguments, `wait` never, anything else with a fault.
struct Echo;

#[async_trait]
impl XmlRpcHandler for Echo {
    async fn call(&self, method: &str, params: Vec<Value>) -> Result<Value, Fault> {
        match method {
            "echo" => Ok(Value::Array(params)),
            "wait" => std::future::pending().await,
            other => Err(Fault::new(format!("no {other} here"))),
        }
    }
}

struct Running {
    address: SocketAddr,
    task: tokio::task::JoinHandle<()>,
}

impl Drop for Running {
    fn drop(&mut self) {
        self.task.abort();
    }
}

async fn start(limits: ServerLimits) -> Running {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let task = tokio::spawn(serve(listener, Arc::new(Echo), limits));
    Running { address, task }
}

fn small() -> ServerLimits {
    ServerLimits { body: 10_000, transfer: PATIENCE, ..ServerLimits::default() }
}

fn client(address: SocketAddr) -> XmlRpcClient {
    XmlRpcClient::new(Arc::new(HostSockets), &format!("http://{address}/")).unwrap()
}

fn request(fields: &str, body: &str) -> String {
    let length = body.len();
    format!("POST / HTTP/1.1\r\nContent-Length: {length}\r\n{fields}\r\n{body}")
}

/// Sends bytes and reads until the server closes.
async fn raw(server: &Running, bytes: &[u8]) -> String {
    let mut stream = TcpStream::connect(server.address).await.unwrap();
    // The server may close before it has read everything.
    let _ = stream.write_all(bytes).await;
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer).await;
    String::from_utf8_lossy(&answer).into_owned()
}

#[tokio::test]
async fn calls_are_answered_and_faults_told() {
    let server = start(ServerLimits::default()).await;
    let client = client(server.address);
    for n in 0..3 {
        let answer = client.call("echo", &[Value::Int(n)], PATIENCE).await.unwrap();
        assert_eq!(answer, Value::Array(vec![Value::Int(n)]));
    }
    let fault = client.call("sing", &[], PATIENCE).await.unwrap_err();
    assert!(fault.to_string().contains("no sing here"), "{fault}");
}

#[tokio::test]
async fn a_long_call_does_not_hold_up_others() {
    let server = start(ServerLimits::default()).await;
    let client = Arc::new(client(server.address));
    let waiting = {
        let client = client.clone();
        tokio::spawn(async move { client.call("wait", &[], PATIENCE).await })
    };
    client.call("echo", &[], PATIENCE).await.unwrap();
    waiting.abort();
}

#[tokio::test]
async fn several_requests_of_one_connection_are_answered_in_order() {
    let server = start(ServerLimits::default()).await;
    let first = request("", &print_call("echo", &["first".into()]));
    let last = request("Connection: close\r\n", &print_call("echo", &["last".into()]));
    let answers = raw(&server, format!("{first}\r\n{last}").as_bytes()).await;
    let place = |text: &str| answers.find(text).expect(text);
    assert!(place("first") < place("last"));
    assert_eq!(answers.matches("HTTP/1.1 200 OK").count(), 2);
}

#[tokio::test]
async fn clients_of_all_kinds_are_served() {
    let server = start(ServerLimits::default()).await;
    let body = print_call("echo", &["hello".into()]);
    let old = format!("POST /RPC2 HTTP/1.0\r\ncontent-length:{}\r\n\r\n{body}", body.len());
    let expecting = request("Expect: 100-continue\r\nConnection: close\r\n", &body);
    let (start, end) = body.split_at(20);
    let chunked = format!(
        "POST / HTTP/1.1\r\nTransfer-Encoding: chunked\r\nConnection: close\r\n\r\n\
         {:x}\r\n{start}\r\n{:X};x=y\r\n{end}\r\n0\r\nTrailer: 1\r\n\r\n",
        start.len(),
        end.len()
    );
    for request in [&old, &expecting, &chunked] {
        let answer = raw(&server, request.as_bytes()).await;
        assert!(answer.contains("hello"), "{request}\n{answer}");
    }
    let answer = raw(&server, expecting.as_bytes()).await;
    assert!(answer.starts_with("HTTP/1.1 100 Continue\r\n\r\nHTTP/1.1 200 OK"));
}

#[tokio::test]
async fn bad_requests_are_refused_with_a_reason() {
    let server = start(small()).await;
    let hasty = start(ServerLimits { transfer: Duration::from_millis(50), ..small() }).await;
    let many = "a: b\r\n".repeat(200);
    let post = "POST / HTTP/1.1\r\n";
    for (request, wanted) in [
        ("GET / HTTP/1.1\r\n\r\n".to_owned(), "405"),
        ("nonsense\r\n\r\n".to_owned(), "400"),
        (format!("{post}no colon\r\n\r\n"), "400"),
        (format!("{post}\r\n"), "411"),
        (format!("{post}Content-Length: -1\r\n\r\n"), "400"),
        (format!("{post}Content-Length: 10001\r\n\r\n"), "413"),
        (format!("{post}Transfer-Encoding: chunked\r\n\r\nffffffff\r\n"), "413"),
        (format!("{post}Transfer-Encoding: chunked\r\n\r\nzz\r\n"), "400"),
        (format!("{post}{many}\r\n"), "431"),
        (format!("POST /{}", "x".repeat(16_400)), "431"),
        // Slow: the rest never arrives.
        ("POST / HT".to_owned(), "408"),
        (format!("{post}Content-Length: 100\r\n\r\n<"), "408"),
    ] {
        let server = if wanted == "408" { &hasty } else { &server };
        let answer = raw(server, request.as_bytes()).await;
        let status = answer.split_whitespace().nth(1).unwrap_or_default();
        let shown: String = request.chars().take(60).collect();
        assert_eq!(status, wanted, "{shown}: {answer}");
    }
    // None of them has harmed the server.
    let client = client(server.address);
    client.call("echo", &[], PATIENCE).await.unwrap();
}

#[tokio::test]
async fn what_is_no_xml_rpc_is_answered_with_a_fault() {
    let server = start(small()).await;
    let answer = raw(&server, request("Connection: close\r\n", "{}").as_bytes()).await;
    assert!(answer.contains("<fault>") && answer.contains("malformed"), "{answer}");
}

#[tokio::test]
async fn an_idle_connection_is_closed_in_the_end() {
    let limits = ServerLimits { idle: Duration::from_millis(50), ..small() };
    let server = start(limits).await;
    assert_eq!(raw(&server, b"").await, "");
}

#[tokio::test]
async fn connections_beyond_the_limit_wait_their_turn() {
    let limits = ServerLimits { connections: 1, ..ServerLimits::default() };
    let server = start(limits).await;
    let first = client(server.address);
    first.call("echo", &[], PATIENCE).await.unwrap();
    let second = client(server.address);
    let late = second.call("echo", &[], Duration::from_millis(100)).await;
    assert!(matches!(late, Err(Error::Timeout { .. })));
    drop(first);
    second.call("echo", &[], PATIENCE).await.unwrap();
}

/// A server that answers the first request on each connection, promises to keep it, and closes it all the same.
#[tokio::test]
async fn the_client_survives_a_connection_closed_between_calls() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let task = tokio::spawn(async move {
        let body = print_response(&Value::Int(1));
        let answer = format!("HTTP/1.1 200 OK\r\nContent-Length: {}\r\n\r\n{body}", body.len());
        while let Ok((mut stream, _)) = listener.accept().await {
            let _ = stream.read(&mut [0; 4096]).await;
            let _ = stream.write_all(answer.as_bytes()).await;
        }
    });
    let client = client(address);
    for _ in 0..20 {
        client.call("echo", &[], PATIENCE).await.unwrap();
    }
    task.abort();
}

/// A server that sends `answer` to any request, and closes.
async fn fixed_server(answer: impl Into<String>) -> SocketAddr {
    let answer = answer.into();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    tokio::spawn(async move {
        while let Ok((mut stream, _)) = listener.accept().await {
            let _ = stream.read(&mut [0; 4096]).await;
            let _ = stream.write_all(answer.as_bytes()).await;
        }
    });
    address
}

#[tokio::test]
async fn the_client_names_what_the_server_does_wrong() {
    for (answer, wanted) in [
        ("", "end of file"),
        ("HTTP/1.1 404 Not Found\r\n\r\n", "404"),
        ("SSH-2.0-x\r\n\r\n", "SSH"),
        ("HTTP/1.1 200 OK\r\nContent-Length: 999999999999\r\n\r\n", "over"),
        ("HTTP/1.1 200 OK\r\nContent-Length: 10\r\n\r\n<a", "end of file"),
        ("HTTP/1.1 200 OK\r\nContent-Length: 3\r\n\r\n<a>", "malformed"),
    ] {
        let address = fixed_server(answer).await;
        let error = client(address).call("echo", &[], PATIENCE).await.unwrap_err();
        assert!(error.to_string().contains(wanted), "{answer}: {error}");
    }
    // Without a length, the answer ends with the connection.
    let address = fixed_server(
        "HTTP/1.0 200 OK\r\n\r\n\
         <methodResponse><params><param><value>x</value></param></params></methodResponse>",
    )
    .await;
    let answer = client(address).call("echo", &[], PATIENCE).await.unwrap();
    assert_eq!(answer, "x".into());
}

#[tokio::test]
async fn an_answer_is_read_if_what_it_becomes_has_room() {
    let one = "<value><struct><member><name/><value/></member></struct></value>";
    let answer = |count: usize| {
        format!(
            "HTTP/1.0 200 OK\r\n\r\n\
             <methodResponse><params><param><value><array><data>{}\
             </data></array></value></param></params></methodResponse>",
            one.repeat(count)
        )
    };
    let budget = Budget::new("node x", 4 << 20);
    let few = client(fixed_server(answer(2_000)).await).with_budget(&budget);
    assert!(few.call("echo", &[], PATIENCE).await.is_ok());
    // 640 KB of text.
    let many = client(fixed_server(answer(10_000)).await).with_budget(&budget);
    let error = many.call("echo", &[], PATIENCE).await.expect_err("no room");
    assert!(error.to_string().contains("memory for node x"), "{error}");
    assert_eq!(budget.used_bytes(), 0);
}

#[tokio::test]
async fn a_server_that_hangs_costs_no_more_than_the_time_out() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let hung = client(listener.local_addr().unwrap());
    let error = hung.call("echo", &[], Duration::from_millis(50)).await;
    assert!(matches!(error, Err(Error::Timeout { .. })));
    for bad in ["http://host/", "ftp://host:1/", ""] {
        let error = XmlRpcClient::new(Arc::new(HostSockets), bad).unwrap_err();
        assert!(matches!(error, Error::BadUri(_)), "{bad}");
    }
}

#[tokio::test]
async fn who_waits_for_memory_in_vain_is_told_so() {
    let limits = ServerLimits { body: 1 << 20, budget: Budget::new("XML-RPC", 1 << 20), ..small() };
    let held = limits.budget.take(1 << 20).unwrap();
    let hasty = ServerLimits { transfer: Duration::from_millis(200), ..limits.clone() };
    let (server, hasty) = (start(limits).await, start(hasty).await);
    let answer = raw(&hasty, request("", &"x".repeat(200_000)).as_bytes()).await;
    let status = answer.split_whitespace().nth(1);
    assert_eq!(status, Some("503"), "{answer}");
    assert!(answer.contains("the memory for XML-RPC"), "{answer}");
    drop(held);
    let answer = raw(&server, request("Connection: close\r\n", &"x".repeat(200_000)).as_bytes()).await;
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
}
