//! Answers of the bridge about the ROS system.

use ros::bus::RosVersion;
use rosbridge::{CallService, Compression, Format, Op, ProtocolFrame};
use serde_json::{Value, json};

use super::support::{Client, World};

pub(super) async fn ask(client: &mut Client, service: &str, args: Value) -> Value {
    client.send(json!({"op": "call_service", "service": format!("/rosapi/{service}"), "args": args})).await;
    let answer = client.json().await;
    assert_eq!((&answer["op"], &answer["result"]), (&json!("service_response"), &json!(true)), "{answer}");
    answer["values"].clone()
}

pub(super) fn holds(list: &Value, item: &str) -> bool {
    list.as_array().unwrap().iter().any(|other| other == item)
}

#[tokio::test]
async fn topics_nodes_and_services_are_found() {
    let world = World::new().await;
    let _publisher = world.node_publishes("/text", "std_msgs/String", false).await;
    let _subscriber = world.node_subscribes("/number", "std_msgs/Int32").await;
    let mut client = world.client().await;
    client.send(json!({"op": "set_level", "level": "info"})).await;
    client.send(json!({"op": "advertise_service", "service": "/add", "type": "x_msgs/Add"})).await;
    client.json().await;
    client.send(json!({"op": "set_level", "level": "error"})).await;
    world.wait_for_graph(|graph| graph.services.contains_key("/add") && graph.topics.contains_key("/number")).await;
    // The bridge sees a change of the graph when the node does, or a moment later.
    while !holds(&ask(&mut client, "services", json!({})).await["services"], "/add") {}

    let topics = ask(&mut client, "topics", json!({})).await;
    // Includes the bridge's own, as if nodes of rosbridge published them.
    let shown = [
        "/client_count",
        "/connected_clients",
        "/number",
        "/rosout",
        "/text",
        "/tf2_web_republisher/cancel",
        "/tf2_web_republisher/feedback",
        "/tf2_web_republisher/goal",
        "/tf2_web_republisher/result",
        "/tf2_web_republisher/status",
    ];
    // In ROS 2 actions are not topics.
    assert_eq!(topics["topics"], json!(shown[..world.by_version(10, 5)]));
    assert_eq!(topics["types"][2], world.message_name("std_msgs/Int32"));
    if world.version() == RosVersion::One {
        assert_eq!(topics["types"][9], "actionlib_msgs/GoalStatusArray");
    }
    let raw = ask(&mut client, "topics_and_raw_types", json!({})).await;
    assert_eq!(raw["typedefs_full_text"][2], "int32 data\n");
    assert_eq!(raw["typedefs_full_text"][4], "string data\n");
    assert_eq!(
        ask(&mut client, "topic_type", json!({"topic": "/text"})).await,
        json!({"type": world.message_name("std_msgs/String")})
    );
    assert_eq!(ask(&mut client, "topic_type", json!({"topic": "/none"})).await, json!({"type": ""}));
    for name in ["std_msgs/String", "std_msgs/msg/String"] {
        let of_type = ask(&mut client, "topics_for_type", json!({"type": name})).await;
        assert_eq!(of_type, json!({"topics": ["/text"]}));
    }
    assert_eq!(ask(&mut client, "publishers", json!({"topic": "/text"})).await, json!({"publishers": ["/node"]}));
    assert_eq!(ask(&mut client, "subscribers", json!({"topic": "/number"})).await, json!({"subscribers": ["/node"]}));

    let nodes = ask(&mut client, "nodes", json!({})).await;
    assert!(holds(&nodes["nodes"], "/node") && holds(&nodes["nodes"], "/rosapi"));
    let details = ask(&mut client, "node_details", json!({"node": "/node"})).await;
    assert_eq!(details, json!({"subscribing": ["/number"], "publishing": ["/text"], "services": []}));

    let services = ask(&mut client, "services", json!({})).await;
    assert!(holds(&services["services"], "/add") && holds(&services["services"], "/rosapi/topics"));
    assert_eq!(
        ask(&mut client, "service_type", json!({"service": "/add"})).await,
        json!({"type": world.full_name("x_msgs/Add", "srv")})
    );
    assert_eq!(
        ask(&mut client, "service_type", json!(["/rosapi/topics"])).await,
        json!({"type": world.by_version("rosapi/Topics", "rosapi_msgs/srv/Topics")})
    );
    assert_eq!(ask(&mut client, "service_type", json!({"service": "/no"})).await, json!({"type": ""}));
    let node = ask(&mut client, "service_node", json!({"service": "/add"})).await;
    assert_eq!(node, json!({"node": "/cloudroid_bridge"}));
    assert_eq!(ask(&mut client, "service_host", json!({"service": "/add"})).await, json!({"host": world.host()}));
    for name in ["x_msgs/Add", "x_msgs/srv/Add"] {
        let of_type = ask(&mut client, "services_for_type", json!({"type": name})).await;
        assert_eq!(of_type, json!({"services": ["/add"]}));
    }
    let providers = ask(&mut client, "service_providers", json!({"service": "x_msgs/Add"})).await;
    assert_eq!(providers, json!({"providers": ["/cloudroid_bridge"]}));

    let request = ask(&mut client, "service_request_details", json!({"type": "x_msgs/Add"})).await;
    assert_eq!(request["typedefs"][0]["fieldnames"], json!(["a", "b"]));
    let response = ask(&mut client, "service_response_details", json!({"type": "x_msgs/Add"})).await;
    assert_eq!(response["typedefs"][0]["fieldtypes"], json!(["int64"]));
    let message = ask(&mut client, "message_details", json!({"type": "x_msgs/Place"})).await;
    assert_eq!(message["typedefs"].as_array().unwrap().len(), 4);
    assert_eq!(
        ask(&mut client, "action_servers", json!({})).await,
        json!({"action_servers": ["/tf2_web_republisher"]})
    );
    assert_eq!(
        ask(&mut client, "get_ros_version", json!({})).await,
        json!({"version": world.node.version().number(), "distro": world.node.distribution().await})
    );
    let time = ask(&mut client, "get_time", json!({})).await;
    assert!(world.seconds(&time["time"]) > 1_500_000_000);
    // By roslibpy's names in either ROS.
    assert!(time["time"]["secs"].as_u64().unwrap() > 1_500_000_000);
}

#[tokio::test]
async fn actions_and_interfaces_are_found() {
    let world = World::new().await;
    let (mut server, mut client) = (world.client().await, world.client().await);
    super::actions::serve(&mut server).await;
    // The bridge sees a change of the graph when the node does, or a moment later.
    let of_action = json!({"action": "/count"});
    let mut told = ask(&mut client, "action_type", of_action.clone()).await;
    while told["type"] == "" {
        told = ask(&mut client, "action_type", of_action.clone()).await;
    }
    assert_eq!(told["type"], world.full_name("x_msgs/Count", "action"));
    let unknown = ask(&mut client, "action_type", json!({"action": "/no"})).await;
    assert_eq!(unknown, json!({"type": ""}));
    let servers = ask(&mut client, "action_servers", json!({})).await;
    assert_eq!(servers, json!({"action_servers": ["/count", "/tf2_web_republisher"]}));
    for (part, field) in [("goal", "to"), ("result", "all"), ("feedback", "at")] {
        for name in ["x_msgs/Count", "x_msgs/action/Count"] {
            let service = format!("action_{part}_details");
            let told = ask(&mut client, &service, json!({"type": name})).await;
            assert_eq!(told["typedefs"][0]["fieldnames"], json!([field]));
        }
    }
    let interfaces = ask(&mut client, "interfaces", json!({})).await;
    for name in [
        "std_msgs/msg/String",
        "x_msgs/srv/Add",
        "x_msgs/action/Count",
        world.by_version("rosapi/srv/Topics", "rosapi_msgs/srv/Topics"),
    ] {
        assert!(holds(&interfaces["interfaces"], name), "{name}");
    }
}

#[tokio::test]
async fn who_is_connected_can_be_followed() {
    let world = World::new().await;
    let named = |name: &str| bridge::SessionOptions { client: name.to_owned(), ..Default::default() };
    let mut client = world.client_with(named("10.0.0.1")).await;
    client.send(json!({"op": "subscribe", "topic": "/client_count", "type": "std_msgs/Int32"})).await;
    assert_eq!(client.json().await["msg"], json!({"data": 1}));
    let mut other = world.client_with(named("10.0.0.2")).await;
    assert_eq!(client.json().await["msg"], json!({"data": 2}));
    other.send(json!({"op": "subscribe", "topic": "/connected_clients"})).await;
    let clients = other.json().await["msg"]["clients"].clone();
    assert_eq!((&clients[0]["ip_address"], &clients[1]["ip_address"]), (&json!("10.0.0.1"), &json!("10.0.0.2")));
    other.abort().await;
    assert_eq!(client.json().await["msg"], json!({"data": 1}));
}

#[tokio::test]
async fn questions_that_make_no_sense_are_answered_with_the_reason() {
    let world = World::new().await;
    let mut client = world.client().await;
    let parameter = world.by_version("/p", "/node:p");
    let unknown = format!("no definition of {} is known", world.message_name("x_msgs/Lost"));
    for (service, args, reason) in [
        ("set_param", json!({"name": parameter, "value": "{"}), "field \"value\" is \"{\", JSON text"),
        (
            "set_param",
            json!({"name": parameter, "value": "null"}),
            "field \"value\" is null, which no ROS parameter can be; call delete_param to remove one",
        ),
        (
            "set_param",
            json!({"name": parameter, "value": r#"{"arms": [1, null]}"#}),
            "field \"value\" holds null at /arms/1, which no ROS parameter can; leave it out",
        ),
        ("get_param", json!({}), "field \"name\" is missing"),
        ("get_param", json!({"name": 5}), "args: invalid type: integer `5`, expected a string"),
        ("message_details", json!({"type": "x_msgs/Lost"}), unknown.as_str()),
        ("no_such", json!({}), "service /rosapi/no_such has no server"),
    ] {
        let service = format!("/rosapi/{service}");
        client.send(json!({"op": "call_service", "id": 1, "service": service, "args": args})).await;
        let answer = client.json().await;
        assert_eq!(answer["result"], false);
        assert!(answer["values"].as_str().unwrap().starts_with(reason), "{answer}");
    }
}

#[tokio::test]
async fn rosapi_speaks_cbor_and_ros_bytes_too() {
    let world = World::new().await;
    let mut client = world.client().await;
    for compression in [Compression::Cbor, Compression::CborRaw] {
        let mut out = Vec::new();
        Op::from(CallService {
            id: None,
            service: "/rosapi/get_ros_version".into(),
            type_name: None,
            args: None,
            timeout: None,
            fragment_size: None,
            compression: Some(compression),
        })
        .print(&mut out, Format::Cbor);
        client.send_binary(out).await;
        let answer = client.binary().await;
        let Op::ServiceResponse(answer) = Op::parse(ProtocolFrame::Binary(&answer)).unwrap() else {
            panic!("{answer:?}")
        };
        let values = answer.values.unwrap();
        let version = [world.node.version().number()];
        let distro = world.node.distribution().await;
        let (version, distro) = (&version[..], distro.as_bytes());
        match compression {
            Compression::CborRaw => {
                // In ROS 2 lengths are aligned, and include the terminating zero of a string.
                let length = world.by_version(&b"\x06\0\0\0"[..], &b"\0\0\0\x07\0\0\0"[..]);
                let end = world.by_version(&b""[..], &b"\0"[..]);
                let expected = world.serialize(&[version, length, distro, end].concat());
                assert_eq!(&*values.raw().unwrap().bytes, expected);
            }
            _ => {
                let parts = [b"\xa2\x67version", version, b"\x66distro\x66", distro];
                assert_eq!(values.bytes, parts.concat());
            }
        }
    }
}

#[tokio::test]
async fn rosapi_tells_its_log_as_every_node_does() {
    let world = World::new().await;
    let mut client = world.client().await;
    let rosout = json!({"topic": "/rosout"});
    let publishers = ask(&mut client, "publishers", rosout.clone()).await;
    assert_eq!(publishers["publishers"], json!(["/rosapi"]));
    let log = world.by_version("rosgraph_msgs/Log", "rcl_interfaces/msg/Log");
    assert_eq!(ask(&mut client, "topic_type", rosout).await["type"], log);
    let found = ask(&mut client, "topics_for_type", json!({"type": log})).await;
    assert_eq!(found["topics"], json!(["/rosout"]));
}
