use std::net::SocketAddr;

use bytes::Bytes;
use parking_lot::Mutex as SyncMutex;
use ros::bus::{DoubleRange, Graph, Publisher, QosProfile, ServiceHandler, ServiceType, WireType};
use ros::codec::{FillOptions, from_json};
use ros::net::HostSockets;
use ros::ros1::master::{Master, MasterOptions};
use ros::{JoinOptions, schema::Registry};
use tokio::net::TcpListener;
use tokio_util::task::AbortOnDropHandle;

use super::super::reconfigure::{message as message_type, service as service_type};
use super::*;

const SEE: &str = "/camera/see";

/// A servant of ROS 1 with a real Master and a node, and its parameters as a robot of ROS 2 sees them.
struct Servant {
    _master: AbortOnDropHandle<()>,
    node: Arc<dyn Bus>,
    bus: Arc<dyn Bus>,
    view: NodeParameterView,
}

impl Servant {
    async fn start() -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("an address");
        let master = Master::new(MasterOptions { uri: format!("http://{address}/"), ..MasterOptions::default() });
        let serving = tokio::spawn(async move {
            let _ = master.serve(listener, Arc::new(HostSockets)).await;
        });
        let node = join(address, SEE).await;
        let bus = join(address, "/cloudroid").await;
        let servant =
            Self { _master: AbortOnDropHandle::new(serving), node, view: NodeParameterView::new(bus.clone()), bus };
        // A node is in the graph once it has registered something.
        servant.node.parameters().expect("a Master").set("/camera/see/rate", value("0.5")).await.expect("a Master");
        servant
    }

    /// Has the node publish something, so that the graph has it.
    async fn register(&self) -> Box<dyn Publisher> {
        let registry = Registry::new();
        registry.insert("std_msgs/msg/Bool", "bool data").expect("a definition");
        let of = WireType::from_message(&registry.message("std_msgs/Bool").expect("a type"));
        let publisher = self.node.advertise("/alive", of, QosProfile::keep_last(1)).await.expect("advertised");
        self.wait_graph(|graph| graph.has_node(SEE)).await;
        publisher
    }

    async fn wait_graph(&self, wanted: impl Fn(&Graph) -> bool) {
        let mut graph = self.bus.graph();
        graph.wait_for(|graph| wanted(graph)).await.expect("a graph");
    }

    async fn set_at_master(&self, key: &str, json: &str) {
        self.node.parameters().expect("a Master").set(key, value(json)).await.expect("a Master");
    }

    async fn at_master(&self, key: &str) -> Option<ParamValue> {
        self.node.parameter(key).await.ok()
    }

    async fn values(&self, names: &[&str]) -> Vec<Option<ParamValue>> {
        self.view.get(SEE, &texts(names)).await.expect("values")
    }

    /// Sets one parameter; returns the reason of a refusal.
    async fn set(&self, name: &str, json: &str) -> Result<(), String> {
        let set = self.view.set(SEE, vec![(name.to_owned(), Some(value(json)))]).await.expect("an answer");
        set.into_iter().next().expect("one answer").map_err(FailureReason::into_string)
    }
}

async fn join(address: SocketAddr, node: &str) -> Arc<dyn Bus> {
    let options = JoinOptions::new(address, node);
    ros::connect(ros::bus::RosVersion::One, Arc::new(HostSockets), options).await.expect("a Master")
}

fn value(json: &str) -> ParamValue {
    serde_json::from_str(json).expect(json)
}

fn texts(names: &[&str]) -> Vec<String> {
    names.iter().map(|name| (*name).to_owned()).collect()
}

/// A dynamic_reconfigure server: it takes what it is given, except that its gain is at most 1.
struct Server {
    asked: SyncMutex<Vec<Config>>,
}

#[async_trait]
impl ServiceHandler for Server {
    async fn call(&self, request: Bytes, _: &str) -> Result<Bytes, FailureReason> {
        let mut config = Config::parse(&request).ok_or_else(|| FailureReason::new("a request"))?;
        self.asked.lock().push(config.clone());
        if let Some(ParamValue::Double(gain)) = config.values.get_mut("gain") {
            *gain = gain.min(1.0);
        }
        if config.values.get("mode") == Some(&ParamValue::Int(3)) {
            return Err(FailureReason::new("mode 3 is broken"));
        }
        Ok(config.serialize())
    }
}

const DESCRIPTION: &str = r#"{
    "groups": [{"name": "Default", "parameters": [
        {"name": "gain", "type": "double", "description": "how much"}, {"name": "mode", "type": "int"}
    ]}],
    "max": {"ints": [{"name": "mode", "value": 3}], "doubles": [{"name": "gain", "value": 2}]},
    "min": {"ints": [{"name": "mode"}], "doubles": [{"name": "gain"}]}
}"#;

/// Has the node serve dynamic_reconfigure at `/camera/see/filter`, until the returned values are dropped.
async fn reconfigurable(servant: &Servant) -> (Arc<Server>, impl Sized) {
    let server = Arc::new(Server { asked: SyncMutex::default() });
    let of = ServiceType::from_service(&service_type().expect("a type"));
    let serving = servant.node.serve("/camera/see/filter/set_parameters", of, server.clone()).await.expect("served");
    let of = message_type("dynamic_reconfigure/ConfigDescription").expect("a type");
    let mut bytes = Vec::new();
    from_json(&of, DESCRIPTION.as_bytes(), &mut bytes, &FillOptions::default()).expect("a message");
    let topic = "/camera/see/filter/parameter_descriptions";
    let latching = QosProfile::keep_last(1).latching(true);
    let described = servant.node.advertise(topic, WireType::from_message(&of), latching).await.expect("advertised");
    described.publish(bytes.into());
    servant
        .wait_graph(|graph| {
            graph.topics.contains_key(topic) && graph.services.contains_key("/camera/see/filter/set_parameters")
        })
        .await;
    servant.set_at_master("/camera/see/filter", r#"{"gain": 0.5, "mode": 1}"#).await;
    (server, (serving, described))
}

#[tokio::test]
async fn an_answer_has_a_limit_however_often_a_parameter_is_asked_for() {
    let servant = Servant::start().await;
    let _alive = servant.register().await;
    servant.set_at_master("/camera/see/text", &format!("{:?}", "x".repeat(1 << 20))).await;
    let names = vec!["text".to_owned(); 1000];
    for refused in [
        servant.view.get(SEE, &names).await.err(),
        servant.view.describe(SEE, &names).await.err(),
        servant.view.get(SEE, &vec!["none".to_owned(); (MAX_ANSWER / PARAMETER_OVERHEAD) + 1]).await.err(),
    ] {
        let refused = refused.expect("it is too long").to_string();
        assert!(refused.contains("ask for fewer parameters at once"), "{refused}");
    }
    let values = servant.view.get(SEE, &names[..2]).await.expect("an answer");
    assert!(values.iter().all(Option::is_some));
}

#[tokio::test]
async fn private_parameters_at_the_master_are_the_nodes() {
    let servant = Servant::start().await;
    let _alive = servant.register().await;
    servant.set_at_master("/camera/see/gains", r#"{"p": 1, "i": [1, 2.5]}"#).await;
    servant.set_at_master("/camera/seen", "7").await;
    let read = servant.values(&["gains.p", "gains.i", "rate", "gains", "missing", "use_sim_time", "a/b"]).await;
    let expected =
        [Some(value("1")), Some(value("[1, 2.5]")), Some(value("0.5")), None, None, Some(value("false")), None];
    assert_eq!(read, expected);
    let listed = servant.view.list(SEE, &[], 0).await.expect("names");
    assert_eq!(listed.names, ["gains.i", "gains.p", "rate", "use_sim_time"]);
    assert_eq!(listed.prefixes, ["gains"]);
    assert_eq!(servant.view.list(SEE, &[], 1).await.expect("names").names, ["rate", "use_sim_time"]);
    let below = servant.view.list(SEE, &texts(&["gains", "rat"]), 1).await.expect("names");
    assert_eq!(below.names, ["gains.i", "gains.p"]);
    let names = texts(&["gains.i", "rate", "missing", "use_sim_time"]);
    let described = servant.view.describe(SEE, &names).await.expect("descriptions");
    let kinds: Vec<_> = described.iter().map(|it| it.as_ref().map(|it| (it.kind, it.dynamic_typing))).collect();
    let expected = [
        Some((ParameterKind::Doubles, true)),
        Some((ParameterKind::Double, true)),
        None,
        Some((ParameterKind::Bool, false)),
    ];
    assert_eq!(kinds, expected);
    for error in [
        servant.view.get("/other", &[]).await.expect_err("no node"),
        servant.view.list("/other", &[], 0).await.expect_err("no node"),
        servant.view.watch(Some("/other")).await.err().expect("no node"),
    ] {
        assert!(matches!(error, BusError::NoService(_)), "{error}");
    }
}

#[tokio::test]
async fn parameters_are_set_at_the_master_unless_it_could_not_hold_them() {
    let servant = Servant::start().await;
    let _alive = servant.register().await;
    servant.set_at_master("/camera/see/gains", r#"{"p": 1}"#).await;
    assert_eq!(servant.set("gains.i", "2").await, Ok(()));
    assert_eq!(servant.at_master("/camera/see/gains").await, Some(value(r#"{"p": 1, "i": 2}"#)));
    for (name, json, reason) in [
        ("wide", "3000000000", "3000000000 does not fit into the 32 bits of a ROS 1 parameter"),
        ("gains", "1", "there are parameters below it, and ROS 1 cannot hold both"),
        ("rate.x", "1", "rate above it has a value, and ROS 1 cannot hold both"),
        ("a/b", "1", "\"~/a/b\" cannot be the name of a ROS 1 parameter"),
        ("use_sim_time", "true", "nodes of ROS 1 read use_sim_time only when they start; start the node with it"),
    ] {
        assert_eq!(servant.set(name, json).await, Err(reason.to_owned()), "{name}");
    }
    assert_eq!(servant.set("use_sim_time", "false").await, Ok(()), "it is so");
    let deleted = ["gains.p", "gains.p", "gains", "missing"].map(|name| (name.to_owned(), None)).to_vec();
    let answers = servant.view.set(SEE, deleted).await.expect("answers");
    assert_eq!(answers.iter().map(Result::is_ok).collect::<Vec<_>>(), [true, false, false, false]);
    assert_eq!(servant.at_master("/camera/see/gains").await, Some(value(r#"{"i": 2}"#)));
    // All or none.
    let changes = |wide: &str| vec![("rate".to_owned(), Some(value("9"))), ("wide".to_owned(), Some(value(wide)))];
    let refused = servant.view.set_atomically(SEE, changes("3000000000")).await.expect_err("refused");
    assert!(refused.to_string().starts_with("parameter wide cannot be sent: 3000000000"), "{refused}");
    assert_eq!(servant.at_master("/camera/see/rate").await, Some(value("0.5")));
    servant.view.set_atomically(SEE, changes("3")).await.expect("set");
    assert_eq!(servant.at_master("/camera/see/rate").await, Some(value("9")));
}

#[tokio::test]
async fn parameters_of_dynamic_reconfigure_have_ranges_and_are_set_at_their_server() {
    let servant = Servant::start().await;
    let (server, _serving) = reconfigurable(&servant).await;
    let names = texts(&["filter.gain", "filter.mode", "rate"]);
    let described = servant.view.describe(SEE, &names).await.expect("descriptions");
    let gain = described[0].as_ref().expect("a description");
    assert_eq!(
        (gain.double_range, &*gain.description),
        (Some(DoubleRange { from: 0.0, to: 2.0, step: 0.0 }), "how much")
    );
    let mode = described[1].as_ref().expect("a description");
    assert_eq!((mode.kind, mode.integer_range.map(|range| range.to)), (ParameterKind::Integer, Some(3)));
    assert_eq!(servant.values(&["filter.gain"]).await, [Some(value("0.5"))]);
    // Together in one call, with the right types.
    let changes = vec![("filter.gain".to_owned(), Some(value("1"))), ("filter.mode".to_owned(), Some(value("2")))];
    assert_eq!(servant.view.set(SEE, changes).await.expect("answers"), [Ok(()), Ok(())]);
    let values = [("gain".to_owned(), value("1.0")), ("mode".to_owned(), value("2"))].into();
    assert_eq!(*server.asked.lock(), [Config { values }]);
    for (name, json, reason) in [
        ("filter.gain", "2.5", "it takes values from 0 to 2"),
        ("filter.gain", "1.5", "the node has set it to 1.0"),
        ("filter.gain", "true", "it is of the type double"),
        ("filter.mode", "3", "mode 3 is broken"),
    ] {
        let refused = servant.set(name, json).await.expect_err(reason);
        assert!(refused.contains(reason), "{refused}");
    }
    let deleted = servant.view.set(SEE, vec![("filter.gain".to_owned(), None)]).await.expect("an answer");
    assert!(deleted[0].as_ref().expect_err("refused").as_str().contains("cannot be deleted"), "{deleted:?}");
}

#[tokio::test]
async fn a_change_at_the_master_is_an_event_of_the_node() {
    let servant = Servant::start().await;
    let _alive = servant.register().await;
    let mut events = servant.view.watch(Some(SEE)).await.expect("a watch");
    let mut all = servant.view.watch(None).await.expect("a watch");
    servant.set_at_master("/camera/see/gains/p", "3").await;
    let event = events.next().await.expect("an event");
    assert_eq!((&*event.node, &*event.changed), (SEE, &[("gains.p".to_owned(), value("3"))][..]));
    assert_eq!(all.next().await, Some(event));
    servant.set_at_master("/use_sim_time", "true").await;
    let event = events.next().await.expect("an event");
    assert_eq!(event.changed, [("use_sim_time".to_owned(), value("true"))]);
    assert_eq!(servant.values(&["use_sim_time"]).await, [Some(value("true"))]);
    // Another watcher of the Master hears the same.
    let mut other = servant.bus.parameters().expect("a Master").watch().await.expect("a watch");
    servant.set_at_master("/camera/see/rate", "4").await;
    assert_eq!(events.next().await.expect("an event").changed, [("rate".to_owned(), value("4"))]);
    assert_eq!(other.recv().await, Some(("/camera/see/rate".to_owned(), Some(value("4")))));
    // What dynamic_reconfigure writes again has not changed.
    servant.set_at_master("/camera/see", r#"{"rate": 4, "gains": {"p": 3}, "mode": 1}"#).await;
    assert_eq!(events.next().await.expect("an event").changed, [("mode".to_owned(), value("1"))]);
    servant.bus.close().await;
    assert!(events.next().await.is_none());
    assert!(servant.view.watch(Some(SEE)).await.is_err());
}
