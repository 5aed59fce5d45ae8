use budget::Budget;
use ros_bus::net::HostSockets;
use tokio::io::AsyncWriteExt as _;
use tokio::net::TcpStream;

use super::*;
use crate::testing::{PATIENCE, TestMaster, TestNode, args};
use crate::xmlrpc::XmlRpcClient;

/// An address at which nobody listens.
const NOWHERE: &str = "http://127.0.0.1:1/";

fn strings(texts: &[&str]) -> Value {
    Value::strings(texts.iter().copied())
}

#[tokio::test]
async fn registrations_are_seen_by_all_lookups() {
    let master = TestMaster::start().await;
    let call = |method: &'static str, list: Vec<Value>| {
        let master = &master;
        async move { master.call(method, &list).await }
    };
    let subscribe = args(["/s", "/t", "*", "http://127.0.0.1:2/"]);
    let answer = call("registerSubscriber", subscribe.into()).await;
    assert_eq!((answer.0, answer.2), (1, strings(&[])));
    let publish = args(["/p", "t", "std_msgs/String", NOWHERE]);
    let answer = call("registerPublisher", publish.into()).await;
    assert_eq!(answer.2, strings(&["http://127.0.0.1:2/"]));
    let service = args(["/p", "/p/do", "rosrpc://127.0.0.1:9", NOWHERE]);
    call("registerService", service.into()).await;

    let pair = Value::Array(vec![strings(&["/t", "std_msgs/String"])]);
    let topics = call("getPublishedTopics", args(["/x", ""]).into()).await;
    assert_eq!(topics.2, pair);
    let none = call("getPublishedTopics", args(["/x", "/other"]).into()).await;
    assert_eq!(none.2, Value::Array(vec![]));
    assert_eq!(call("getTopicTypes", args(["/x"]).into()).await.2, pair);
    let state = call("getSystemState", args(["/x"]).into()).await.2;
    let row = |name: &str, node: &str| Value::Array(vec![Value::Array(vec![name.into(), strings(&[node])])]);
    let wanted = [row("/t", "/p"), row("/t", "/s"), row("/p/do", "/p")];
    assert_eq!(state, Value::Array(wanted.into()));
    let node = call("lookupNode", args(["/x", "/p"]).into()).await;
    assert_eq!((node.0, node.2), (1, NOWHERE.into()));
    assert_eq!(call("lookupNode", args(["/x", "/q"]).into()).await.0, -1);
    let found = call("lookupService", args(["/x", "/p/do"]).into()).await;
    assert_eq!(found.2, "rosrpc://127.0.0.1:9".into());
    assert_eq!(call("lookupService", args(["/x", "/no"]).into()).await.0, -1);

    let graph = master.master.graph();
    assert_eq!(graph.topics["/t"].publishers, ["/p"]);
    assert_eq!(graph.services["/p/do"], "/p");

    let gone = call("unregisterService", args(["/p", "/p/do", "rosrpc://other:9"]).into()).await;
    assert_eq!((gone.0, gone.2), (1, 0.into()));
    let gone = call("unregisterService", args(["/p", "/p/do", "rosrpc://127.0.0.1:9"]).into());
    assert_eq!(gone.await.2, 1.into());
    let gone = call("unregisterPublisher", args(["/p", "/t", "http://127.0.0.1:7/"]).into());
    assert_eq!(gone.await.2, 0.into());
    let gone = call("unregisterPublisher", args(["/p", "/t", NOWHERE]).into());
    assert_eq!(gone.await.2, 1.into());
    assert!(!master.master.graph().nodes.contains_key("/p"));
}

#[tokio::test]
async fn the_callers_mistakes_are_named() {
    let master = TestMaster::start().await;
    for (method, list, wanted) in [
        ("registerPublisher", vec![], "caller_id is missing"),
        ("registerPublisher", vec![Value::Int(1)], "must be a string"),
        ("registerPublisher", args(["/p", "/t", "a/B", "not an address"]).into(), "http:// address"),
        ("registerPublisher", args(["/p", "/t", "a/B", NOWHERE, "more"]).into(), "arity"),
        ("registerService", args(["/p", "/s", "http://h:1", NOWHERE]).into(), "rosrpc://"),
        ("registerSubscriber", args(["/p", "", "*", NOWHERE]).into(), "empty"),
        ("lookupNode", args(["/p", "/a\nb"]).into(), "not a ROS name"),
        ("setParam", args(["/p", "/"]).into(), "value is missing"),
        ("setParam", args(["/p", "/", "x"]).into(), "dictionary"),
        ("getParam", args(["/p", "/nothing"]).into(), "not set"),
        ("deleteParam", args(["/p", "/nothing"]).into(), "not set"),
        ("searchParam", args(["/p", "~x"]).into(), "cannot search"),
        ("shutdown", args(["/p", "now"]).into(), "nodes cannot shut it down"),
    ] {
        let (code, message, _) = master.call(method, &list).await;
        assert_eq!(code, -1, "{method} {list:?}");
        assert!(message.contains(wanted), "{method}: {message}");
    }
    let uri = format!("http://{}/", master.address);
    let client = XmlRpcClient::new(Arc::new(HostSockets), &uri).unwrap();
    let fault = client.call("sing", &[], PATIENCE).await.unwrap_err();
    assert!(fault.to_string().contains("sing is not known"), "{fault}");
    assert_eq!(master.master.graph().nodes.len(), 0);
}

#[tokio::test]
async fn subscribers_hear_of_publishers_that_come_and_go() {
    let master = TestMaster::start().await;
    let mut node = TestNode::start().await;
    master.call("registerSubscriber", &args(["/s", "/t", "*", &node.uri])).await;
    master.call("registerPublisher", &args(["/p", "/t", "a/B", NOWHERE])).await;
    let update = |publishers: &[&str]| {
        let list = vec!["/master".into(), "/t".into(), strings(publishers)];
        ("publisherUpdate".to_owned(), list)
    };
    assert_eq!(node.next().await, update(&[NOWHERE]));
    master.call("unregisterPublisher", &args(["/p", "/t", NOWHERE])).await;
    assert_eq!(node.next().await, update(&[]));
}

#[tokio::test]
async fn a_hung_node_delays_nobody_else_and_gets_the_newest_in_the_end() {
    let master = TestMaster::start().await;
    let mut node = TestNode::start().await;
    // It has a listening socket, but does not answer.
    let hung = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let hung_uri = format!("http://{}/", hung.local_addr().unwrap());
    master.call("registerSubscriber", &args(["/hung", "/t", "*", &hung_uri])).await;
    master.call("registerSubscriber", &args(["/s", "/t", "*", &node.uri])).await;
    for port in 10..20 {
        let (name, uri) = (format!("/p{port}"), format!("http://127.0.0.1:{port}/"));
        master.call("registerPublisher", &args([&name, "/t", "a/B", &uri])).await;
    }
    let ten = |list: &[Value]| list[2].as_array().unwrap().len() == 10;
    while !ten(&node.next().await.1) {}
    // After ten changes, the hung node is owed the call in progress and the newest state, not ten calls.
    let queues = master.master.inner.notifier.waiting(&hung_uri);
    assert!(queues <= 1, "{queues} notices wait");
}

#[tokio::test]
async fn a_name_belongs_to_who_came_last() {
    let master = TestMaster::start().await;
    let mut old = TestNode::start().await;
    let mut new = TestNode::start().await;
    let mut watcher = TestNode::start().await;
    master.call("registerSubscriber", &args(["/w", "/t", "*", &watcher.uri])).await;
    master.call("registerPublisher", &args(["/n", "/t", "a/B", &old.uri])).await;
    master.call("registerSubscriber", &args(["/n", "/other", "a/B", &new.uri])).await;
    let (method, list) = old.next().await;
    assert_eq!(method, "shutdown");
    assert!(list[1].as_str().unwrap().contains("same name"));
    let first = watcher.next().await.1[2].clone();
    let last = if first == strings(&[]) { first } else { watcher.next().await.1[2].clone() };
    assert_eq!(last, strings(&[]), "the old one's topic is gone");
    // The old node registers once more while it shuts down: that must not end the new one.
    let (code, message, _) = master.call("subscribeParam", &args(["/n", &old.uri, "/p"])).await;
    assert_eq!(code, -1, "{message}");
    assert_eq!(master.master.graph().nodes["/n"], new.uri);
    assert!(new.calls.try_recv().is_err());
    // Once the new one is gone, the address is free again.
    master.call("unregisterSubscriber", &args(["/n", "/other", &new.uri])).await;
    let again = args(["/n", "/t", "a/B", &old.uri]);
    assert_eq!(master.call("registerPublisher", &again).await.0, 1);
}

#[tokio::test]
async fn a_successor_may_have_the_address_of_one_who_is_dead() {
    let master = TestMaster::start().await;
    let new = TestNode::start().await;
    let register = async |api: &str| {
        let registration = args(["/n", "/t", "a/B", api]);
        master.call("registerPublisher", &registration).await.0
    };
    // A bridge is killed, the next one has another port and is killed too, and the one after that gets the first one's
    // port.
    assert_eq!(register(NOWHERE).await, 1);
    assert_eq!(register(&new.uri).await, 1);
    tokio::time::timeout(PATIENCE, async {
        while register(NOWHERE).await != 1 {
            tokio::task::yield_now().await;
        }
    })
    .await
    .expect("taken for the dead one for ever");
}

#[tokio::test]
async fn the_dead_are_dropped_and_the_living_stay() {
    let master = TestMaster::start().await;
    let mut living = TestNode::start().await;
    let dying = TestNode::start().await;
    let hung = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let hung_uri = format!("http://{}/", hung.local_addr().unwrap());
    master.call("registerSubscriber", &args(["/living", "/t", "*", &living.uri])).await;
    master.call("registerPublisher", &args(["/dying", "/t", "a/B", &dying.uri])).await;
    master.call("registerSubscriber", &args(["/dying", "/u", "a/B", &dying.uri])).await;
    let service = ["/dying", "/do", "rosrpc://127.0.0.1:9", &dying.uri];
    master.call("registerService", &args(service)).await;
    master.call("subscribeParam", &args(["/dying", &dying.uri, "/k"])).await;
    master.call("registerPublisher", &args(["/hung", "/v", "a/B", &hung_uri])).await;
    assert_eq!(living.next().await.1[2], strings(&[&dying.uri]));
    assert_eq!(master.master.on_process_exit().await, Vec::<String>::new());
    dying.die().await;
    assert_eq!(master.master.on_process_exit().await, ["/dying"]);
    assert_eq!(living.next().await.1[2], strings(&[]));
    let graph = master.master.graph();
    let nodes: Vec<_> = graph.nodes.keys().collect();
    assert_eq!(nodes, ["/hung", "/living"]);
    assert_eq!(graph.services.len(), 0);
    assert!(!graph.topics.contains_key("/u"));
    let watchers = master.master.inner.state.lock().registry.parameter_watchers();
    assert_eq!(watchers.len(), 0);
}

#[tokio::test]
async fn parameters_are_kept_told_and_their_use_remembered() {
    let master = TestMaster::start().await;
    let mut node = TestNode::start().await;
    let subscribed = master.call("subscribeParam", &args(["/ns/n", &node.uri, "~speed"])).await;
    assert_eq!(subscribed.2, Value::Struct(BTreeMap::new()));
    let set = ["/setter".into(), "/ns/n/speed".into(), Value::Double(1.5)];
    assert_eq!(master.call("setParam", &set).await.0, 1);
    let update = vec!["/master".into(), "/ns/n/speed/".into(), Value::Double(1.5)];
    assert_eq!(node.next().await, ("paramUpdate".to_owned(), update));
    let get = |caller: &'static str, key: &'static str| {
        let master = &master;
        async move { master.call("getParam", &args([caller, key])).await }
    };
    assert_eq!(get("/ns/n", "~speed").await.2, Value::Double(1.5));
    assert_eq!(get("/ns/x", "n/speed").await.2, Value::Double(1.5));
    let whole = get("/x", "/ns").await.2;
    assert_eq!(whole.get("n").unwrap().get("speed"), Some(&Value::Double(1.5)));
    let has = master.call("hasParam", &args(["/x", "/nothing"])).await;
    assert_eq!(has.2, false.into());
    let found = master.call("searchParam", &args(["/ns/n/deep", "speed"])).await;
    assert_eq!(found.2, "/ns/n/speed".into());
    let names = master.call("getParamNames", &args(["/x"])).await.2.to_strings();
    assert_eq!(names, ["/ns/n/speed", "/rosdistro", "/rosversion", "/run_id"]);
    master.call("deleteParam", &args(["/setter", "/ns"])).await;
    assert_eq!(node.next().await.1[2], Value::Struct(BTreeMap::new()));

    let uses = master.master.graph().parameters;
    assert_eq!(uses["/ns/n/speed"].written_by, ["/setter"]);
    assert_eq!(uses["/ns/n/speed"].read_by, ["/ns/n", "/ns/x", "/ns/n/deep"]);
    assert_eq!(uses["/nothing"].read_by, ["/x"]);
}

#[tokio::test]
async fn many_calls_in_one_are_answered_one_by_one() {
    let master = TestMaster::start().await;
    let one = |method: &str, list: Vec<Value>| {
        let members = [("methodName".to_owned(), Value::from(method)), ("params".to_owned(), Value::Array(list))];
        Value::Struct(members.into())
    };
    let calls = Value::Array(vec![
        one("setParam", args(["/x", "/a", "b"]).into()),
        one("getParam", args(["/x", "/a"]).into()),
        one("system.multicall", vec![Value::Array(vec![])]),
        Value::Int(1),
    ]);
    let uri = format!("http://{}/", master.address);
    let client = XmlRpcClient::new(Arc::new(HostSockets), &uri).unwrap();
    let answers = client.call("system.multicall", &[calls], PATIENCE).await.unwrap();
    let answers = answers.as_array().unwrap();
    let got = answers[1].as_array().unwrap()[0].as_array().unwrap();
    assert_eq!(got[2], "b".into());
    assert!(answers[2].get("faultString").is_some());
    assert!(answers[3].get("faultString").is_some());
    let methods = client.call("system.listMethods", &[], PATIENCE).await.unwrap();
    assert!(methods.to_strings().contains(&"registerPublisher".to_owned()));
}

/// Waits for another generation of the graph than the known one.
async fn wait_graph(master: &TestMaster, known: i32, seconds: i32, run_id: &str) -> GraphAnswer {
    let list = ["/b".into(), known.into(), seconds.into(), run_id.into()];
    let (_, _, value) = master.call(graph::WAIT_GRAPH, &list).await;
    GraphAnswer::from_value(&value).unwrap()
}

#[tokio::test]
async fn the_graph_is_waited_for() {
    let master = TestMaster::start().await;
    let now = wait_graph(&master, -1, 60, "").await;
    assert_eq!(now.run_id, master.master.run_id());
    let known = wire_generation(now.graph.generation);
    let list = args(["/p", "/t", "a/B", NOWHERE]);
    let (later, _) = tokio::join!(wait_graph(&master, known, 60, ""), master.call("registerPublisher", &list));
    assert_eq!(later.graph.topics["/t"].type_name, "a/B");
    let known = wire_generation(later.graph.generation);
    // Registering the same again is not a change, so the call times out and answers with the whole state.
    let (same, _) = tokio::join!(wait_graph(&master, known, 1, ""), master.call("registerPublisher", &list));
    assert_eq!(same, later);
}

/// Returns a graph without its number, which grows a moment after a parameter was used.
fn without_generation(graph: Graph) -> Graph {
    Graph { generation: 0, ..graph }
}

#[tokio::test]
async fn who_knows_the_graph_is_told_what_has_changed_alone() {
    let master = TestMaster::start().await;
    let run_id = master.master.run_id().to_owned();
    for number in 0..100 {
        master.call("registerPublisher", &args(["/p", &format!("/t{number}"), "a/B", NOWHERE])).await;
    }
    let whole = wait_graph(&master, -1, 0, &run_id).await;
    assert_eq!((whole.since, whole.graph.topics.len()), (None, 100));
    let known = wire_generation(whole.graph.generation);
    master.call("unregisterPublisher", &args(["/p", "/t7", NOWHERE])).await;
    master.call("registerService", &args(["/q", "/s", "rosrpc://127.0.0.1:9", "http://127.0.0.1:10/"])).await;
    master.call("getParam", &args(["/q", "/k"])).await;
    master.call("lookupService", &args(["/q", "/nowhere"])).await;
    let news = wait_graph(&master, known, 60, &run_id).await;
    assert_eq!((news.since, &news.gone), (Some(known), &[GraphPart::Topic("/t7".to_owned())].into()));
    let parts = (news.graph.topics.len(), news.graph.services.len(), news.graph.sought.len());
    assert_eq!(parts, (0, 1, 1), "{news:#?}");
    assert!(news.graph.nodes.contains_key("/q") && news.graph.parameters.contains_key("/k"), "{news:#?}");
    let now = wait_graph(&master, -1, 0, &run_id).await.graph;
    let added = news.clone().into_whole(&whole.graph).map(without_generation);
    assert_eq!(added, Some(without_generation(now.clone())));
    // They do not belong to another generation, and another Master's caller gets the whole.
    assert_eq!(news.into_whole(&now), None);
    assert_eq!(wait_graph(&master, known, 0, "another").await.since, None);
}

#[tokio::test]
async fn differences_add_up_to_the_graph_whatever_happens() {
    let master = TestMaster::start().await;
    let run_id = master.master.run_id().to_owned();
    let mut known = wait_graph(&master, -1, 0, "").await.graph;
    let mut dice = 7_u64;
    let mut throw = |sides: u64| {
        dice = dice.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (dice >> 33) % sides
    };
    for _ in 0..300 {
        let (node, name) = (format!("/n{}", throw(4)), format!("/x{}", throw(6)));
        // A node that comes with another address replaces the one before.
        let api = format!("http://127.0.0.1:{}/", 9 + throw(12) / 11);
        let by = [node.as_str(), name.as_str()];
        match throw(8) {
            0 | 1 => master.call("registerPublisher", &args([by[0], by[1], "a/B", &api])).await,
            2 => master.call("registerSubscriber", &args([by[0], by[1], "a/C", &api])).await,
            3 => master.call("registerService", &args([by[0], by[1], "rosrpc://127.0.0.1:9", &api])).await,
            4 => master.call("unregisterPublisher", &args([by[0], by[1], &api])).await,
            5 => master.call("unregisterSubscriber", &args([by[0], by[1], &api])).await,
            6 => master.call("unregisterService", &args([by[0], by[1], "rosrpc://127.0.0.1:9"])).await,
            _ => master.call("hasParam", &args(by)).await,
        };
        if throw(3) == 0 {
            let news = wait_graph(&master, wire_generation(known.generation), 0, &run_id).await;
            assert!(news.since.is_some(), "{news:#?}");
            known = news.into_whole(&known).unwrap();
            let whole = wait_graph(&master, -1, 0, "").await.graph;
            assert_eq!(without_generation(known.clone()), without_generation(whole));
        }
    }
}

#[tokio::test]
async fn a_node_gone_wild_finds_the_end_of_our_patience() {
    let mut registry = Registry::default();
    let mut notices = Vec::new();
    let mut register = |number: usize| {
        let name = format!("/t{number}");
        let by = ("/n", NOWHERE);
        registry.register(registry::Kind::Publisher, &name, "a/B", by, "", &mut notices)
    };
    let refused = (0..100_000).find_map(|number| register(number).err());
    assert_eq!(refused, Some(registry::RegistrationError::Full));
    let reason = refused.unwrap().to_string();
    assert!(reason.contains("50000"), "{reason}");
}

/// Requests all parameters on its own connection, and does not read the answer.
async fn ask_for_all(master: &TestMaster) -> TcpStream {
    let body = xmlrpc::print_call("getParam", &args(["/x", "/"]));
    let length = body.len();
    let request = format!("POST / HTTP/1.1\r\nContent-Length: {length}\r\n\r\n{body}");
    let mut stream = TcpStream::connect(master.address).await.unwrap();
    stream.write_all(request.as_bytes()).await.unwrap();
    stream
}

/// Returns the connections that have received some of their answer.
fn answered_streams(streams: &[TcpStream]) -> Vec<usize> {
    let has = |stream: &TcpStream| stream.try_read(&mut [0]).is_ok();
    (0..streams.len()).filter(|at| has(&streams[*at])).collect()
}

#[tokio::test]
async fn answers_that_nobody_reads_take_no_more_than_their_share() {
    let budget = Budget::new("the Master", 32 << 20);
    let limits = ServerLimits { budget: budget.clone(), ..ServerLimits::default() };
    let options = MasterOptions { limits, ..MasterOptions::default() };
    let master = TestMaster::start_at(Master::new(options), None).await;
    // More than the kernel buffers for a connection that nobody reads.
    let big = Value::from("x".repeat(9 << 20));
    let set = ["/n".into(), "/big".into(), big];
    assert_eq!(master.call("setParam", &set).await.0, 1);
    let mut streams = Vec::new();
    for _ in 0..10 {
        streams.push(ask_for_all(&master).await);
    }
    let first = tokio::time::timeout(PATIENCE, async {
        loop {
            if let Some(first) = answered_streams(&streams).first() {
                break *first;
            }
            tokio::task::yield_now().await;
        }
    });
    let first = first.await.expect("one has an answer");
    // The others wait, while other nodes are answered as usual.
    for _ in 0..20 {
        assert_eq!(master.call("hasParam", &args(["/y", "/big"])).await.0, 1);
        assert!(budget.used_bytes() <= 32 << 20);
    }
    streams.remove(first);
    // A peer that reads nothing and disconnects makes room for the next.
    let next = tokio::time::timeout(PATIENCE, async {
        while answered_streams(&streams).is_empty() {
            tokio::task::yield_now().await;
        }
    });
    next.await.expect("the next has an answer");
    drop(streams);
    let given_back = tokio::time::timeout(PATIENCE, async {
        while budget.used_bytes() > 0 {
            tokio::task::yield_now().await;
        }
    });
    given_back.await.expect("all is given back");
}

#[tokio::test]
async fn what_can_never_be_answered_is_a_fault_at_once() {
    let limits = ServerLimits { budget: Budget::new("the Master", 1 << 20), ..ServerLimits::default() };
    let options = MasterOptions {
        limits,
        parameters: [("/big".to_owned(), ParamValue::String("x".repeat(1 << 20)))].into(),
        ..MasterOptions::default()
    };
    let master = TestMaster::start_at(Master::new(options), None).await;
    let uri = format!("http://{}/", master.address);
    let client = XmlRpcClient::new(Arc::new(HostSockets), &uri).unwrap();
    let calls = |count: usize| {
        let call = [("methodName".to_owned(), "getParam".into()), ("params".to_owned(), strings(&["/x", "/big"]))];
        Value::Array(vec![Value::Struct(call.into()); count])
    };
    for (method, params) in [("getParam", args(["/x", "/"]).to_vec()), ("system.multicall", vec![calls(1)])] {
        let fault = client.call(method, &params, PATIENCE).await.unwrap_err();
        assert!(fault.to_string().contains("the memory for the Master"), "{fault}");
    }
}

#[tokio::test]
async fn parameters_used_one_by_one_are_told_together() {
    let master = TestMaster::start().await;
    let mut generation = master.master.generation();
    let before = *generation.borrow_and_update();
    let count = 300;
    for number in 0..count {
        let key = format!("/p{number}");
        master.call("hasParam", &args(["/n", &key])).await;
    }
    master.wait_until(|graph| graph.parameters.len() == count).await;
    let told = tokio::time::timeout(PATIENCE, generation.changed()).await;
    told.expect("it is told").unwrap();
    let grown = *generation.borrow() - before;
    assert!(grown < count as u64 / 2, "{grown} generations");
}
