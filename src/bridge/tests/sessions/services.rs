//! Services in both directions.

use std::sync::Arc;

use async_trait::async_trait;
use bridge::{BridgeOptions, SessionOptions};
use bytes::Bytes;
use ros::bus::{Digest, FailureReason, RosVersion, ServiceHandler, ServiceType};
use rosbridge::{CallService, Compression, Format, Op, Payload, ProtocolFrame};
use serde_json::{Value, json};
use tokio::sync::Notify;

use super::support::{PATIENCE, World, patient, with_timeout};

/// A service that adds; it can be made to wait first.
struct Add {
    gate: Option<Arc<Notify>>,
    /// Bytes before the values of a message.
    header: usize,
}

impl Add {
    fn new(world: &World, gate: Option<Arc<Notify>>) -> Arc<Self> {
        let header = world.by_version(0, 4);
        Arc::new(Self { gate, header })
    }
}

#[async_trait]
impl ServiceHandler for Add {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        if let Some(gate) = &self.gate {
            gate.notified().await;
        }
        let (header, numbers) = request.split_at(self.header);
        let number = |at: usize| i64::from_le_bytes(numbers[at..at + 8].try_into().unwrap());
        match number(0).checked_add(number(8)) {
            Some(sum) => Ok([header, &sum.to_le_bytes()].concat().into()),
            None => Err(FailureReason::new("too much")),
        }
    }
}

async fn serve_add(world: &World, name: &str, gate: Option<Arc<Notify>>) -> Box<dyn Send + Sync> {
    let guard = world.node.serve(name, world.service_type("x_msgs/Add"), Add::new(world, gate)).await.unwrap();
    world.wait_for_graph(|graph| graph.services.contains_key(name)).await;
    guard
}

#[tokio::test]
async fn a_service_is_called_with_names_by_position_and_with_nothing() {
    let world = World::new().await;
    let _served = serve_add(&world, "/add", None).await;
    let mut client = world.client().await;
    for (args, sum) in [
        (json!({"a": 1, "b": 2}), 3),
        (json!([4, 5]), 9),
        (json!([7]), 7),
        (json!([]), 0),
        // Surplus values are dropped, as in rosbridge.
        (json!([1, 2, 3]), 3),
    ] {
        client.send(json!({"op": "call_service", "id": 5, "service": "add", "args": args, "type": "x_msgs/Add"})).await;
        assert_eq!(
            client.json().await,
            json!({"op": "service_response", "id": 5, "service": "add", "values": {"sum": sum}, "result": true})
        );
    }
    client.send(json!({"op": "call_service", "service": "/add#77"})).await;
    assert_eq!(client.json().await["id"], "77");
    assert_eq!(world.bridge.metrics().calls_failed.get(), 0);
}

#[tokio::test]
async fn calls_fail_with_a_reason() {
    let world = World::new().await;
    let _served = serve_add(&world, "/add", None).await;
    let mut client = world.client().await;
    let max = i64::MAX;
    let no_field = format!("field c of {}: there is no such field", world.request_name("x_msgs/Add"));
    let not_a_name = world.by_version(
        "\"/1add\" is not a ROS name: letters, digits, _ and / are allowed, a letter comes first",
        "\"/1add\" is not a ROS name: letters, digits, _ and / are allowed, no part begins with a digit",
    );
    for (call, reason) in [
        (json!({"service": "/add", "args": {"a": max, "b": max}}), "service /add failed: too much"),
        (json!({"service": "/nothing"}), "service /nothing has no server"),
        (json!({"service": "/add", "args": {"c": 1}}), no_field.as_str()),
        (json!({"service": "/1add"}), not_a_name),
    ] {
        let mut op = call.clone();
        op["op"] = "call_service".into();
        op["id"] = "c".into();
        client.send(op).await;
        let answer = client.json().await;
        assert_eq!((&answer["result"], &answer["id"]), (&json!(false), &json!("c")), "{answer}");
        assert_eq!(answer["values"], reason);
    }
    let metrics = world.bridge.metrics();
    assert_eq!(metrics.calls_failed.get(), 4);
    assert_eq!(metrics.calls_denied.get(), 1, "the others met no node");
}

#[tokio::test]
async fn a_slow_call_holds_up_no_other_and_ends_by_its_timeout() {
    let world = World::new().await;
    let gate = Arc::new(Notify::new());
    let _slow = serve_add(&world, "/slow", Some(gate.clone())).await;
    let _fast = serve_add(&world, "/fast", None).await;
    let mut client = world.client().await;
    client.send(json!({"op": "call_service", "id": "slow", "service": "/slow", "args": [1, 2]})).await;
    client.send(json!({"op": "call_service", "id": "fast", "service": "/fast", "args": [1, 2]})).await;
    assert_eq!(client.json().await["id"], "fast");
    gate.notify_one();
    assert_eq!(client.json().await["id"], "slow");
    client.send(json!({"op": "call_service", "id": "never", "service": "/slow", "timeout": 0.05})).await;
    let answer = client.json().await;
    assert_eq!((&answer["id"], &answer["result"]), (&json!("never"), &json!(false)));
    assert_eq!(answer["values"], "Timeout exceeded while waiting for service response");
}

#[tokio::test]
async fn too_many_calls_at_once_are_refused() {
    let world = World::with_options(BridgeOptions { max_calls: 2, ..patient() }).await;
    let gate = Arc::new(Notify::new());
    let _slow = serve_add(&world, "/slow", Some(gate.clone())).await;
    let mut client = world.client().await;
    for id in 0..3 {
        client.send(json!({"op": "call_service", "id": id, "service": "/slow"})).await;
    }
    let answer = client.json().await;
    assert_eq!(answer["id"], 2);
    assert!(answer["values"].as_str().unwrap().starts_with("2 calls and goals of this client are under way"));
    gate.notify_one();
    gate.notify_one();
    client.json().await;
    gate.notify_one();
    client.json().await;
}

#[tokio::test]
async fn calls_that_hold_too_many_bytes_are_refused_until_others_end() {
    let world = World::with_options(BridgeOptions { max_call_bytes: 10_000, ..patient() }).await;
    let gate = Arc::new(Notify::new());
    let _slow = serve_add(&world, "/slow", Some(gate.clone())).await;
    let _fast = serve_add(&world, "/fast", None).await;
    let mut client = world.client().await;
    let padded = |service: &str, id: &str, padding: usize| {
        let call = json!({"op": "call_service", "id": id, "service": service, "args": [1, 2]});
        call.to_string().replace("[1", &format!("[{}1", " ".repeat(padding)))
    };
    // A single call may have more than that.
    client.send_text(&padded("/slow", "first", 20_000)).await;
    client.send_text(&padded("/fast", "second", 5_000)).await;
    let answer = client.json().await;
    assert_eq!((&answer["id"], &answer["result"]), (&json!("second"), &json!(false)));
    assert_eq!(
        answer["values"],
        "field \"args\" has 5005 bytes, which together with the calls and goals under way is more than 10000; wait for \
            some to end"
    );
    gate.notify_one();
    assert_eq!(client.json().await["values"], json!({"sum": 3}));
    client.send_text(&padded("/fast", "third", 5_000)).await;
    assert_eq!(client.json().await["values"], json!({"sum": 3}));
}

#[tokio::test]
async fn what_waits_for_an_answer_counts_in_the_clients_budget() {
    let world = World::with_options(patient()).await;
    let gate = Arc::new(Notify::new());
    let _slow = serve_add(&world, "/slow", Some(gate.clone())).await;
    let budget = budget::Budget::new("client x", 350_000);
    let mut client = world.client_with(SessionOptions { budget: budget.clone(), ..SessionOptions::default() }).await;
    let call = json!({"op": "call_service", "id": "i", "service": "/slow", "args": [1, 2]});
    let call = call.to_string().replace("[1", &format!("[{}1", " ".repeat(100_000)));
    for _ in 0..10 {
        client.send_text(&call).await;
    }
    // Each answer now is a refusal: nobody has opened the gate.
    for _ in 0..7 {
        let answer = client.json().await;
        assert_eq!(answer["result"], false);
        let words = answer["values"].as_str().expect("a reason");
        assert!(words.contains("memory for client x"), "{words}");
    }
    with_timeout(async {
        while budget.used_bytes() > 0 {
            gate.notify_one();
            tokio::task::yield_now().await;
        }
    })
    .await;
}

#[tokio::test]
async fn a_service_of_another_definition_is_not_called() {
    let world = World::new().await;
    // In ROS 2 endpoints need not announce the digest of the service itself.
    let odd = world.by_version("0123456789abcdef0123456789abcdef".to_owned(), format!("RIHS01_{}", "01".repeat(32)));
    let ours = world.service_type("x_msgs/Add");
    let (service_type, known) = match world.version() {
        RosVersion::One => (ServiceType { digest: Digest::from(&odd), ..ours.clone() }, &ours.digest),
        RosVersion::Two => {
            (ServiceType { digest: Digest::any(), response: Digest::from(&odd), ..ours.clone() }, &ours.response)
        }
    };
    let _served = world.node.serve("/odd", service_type, Add::new(&world, None)).await.unwrap();
    world.wait_for_graph(|graph| graph.services.contains_key("/odd")).await;
    let mut client = world.client().await;
    client.send(json!({"op": "call_service", "service": "/odd", "args": [1, 2]})).await;
    let answer = client.json().await;
    assert_eq!(
        answer["values"],
        format!("service /odd has type {} with {} {odd} there and {known} here", ours.name, world.digest_word())
    );
    client.sync().await;
}

#[tokio::test]
async fn a_call_that_says_another_type_is_answered_with_both_where_it_does_not_fit() {
    let world = World::new().await;
    let _served = serve_add(&world, "/add", None).await;
    let mut client = world.client().await;
    let other = format!(
        "service /add has type {}, not {}; use the type that it has",
        world.full_name("x_msgs/Add", "srv"),
        world.full_name("x_msgs/Say", "srv")
    );
    let call = |args: Value| {
        json!({"op": "call_service", "id": "c", "service": "/add", "type": "x_msgs/Say",
        "args": args})
    };
    client.send(call(json!({"words": "hello"}))).await;
    let answer = client.json().await;
    assert_eq!((&answer["values"], &answer["result"]), (&json!(other), &json!(false)));
    let mut raw = call(json!({"bytes": ""}));
    raw["compression"] = "cbor-raw".into();
    client.send(raw).await;
    let answer = client.binary().await;
    let answer = String::from_utf8_lossy(&answer);
    assert!(answer.contains(&other), "{answer}");
    // As in rosbridge_suite, which ignores the type given by the client.
    client.send(json!({"op": "set_level", "level": "warning"})).await;
    client.send(call(json!({"a": 1, "b": 2}))).await;
    let told = client.json().await;
    assert_eq!((&told["level"], &told["msg"]), (&json!("warning"), &json!(format!("call_service: {other}"))));
    assert_eq!(client.json().await["values"], json!({"sum": 3}));
}

#[tokio::test]
async fn what_a_client_has_advertised_is_there_for_what_it_asks_next() {
    let world = World::new().await;
    let mut client = world.client().await;
    for round in 0..20 {
        // Each service twice: unadvertised and advertised again, as clients do between their tests.
        let (topic, service) = (format!("/topic{round}"), format!("/service{}", round / 2));
        client.send(json!({"op": "advertise", "topic": topic, "type": "std_msgs/String"})).await;
        client.send(json!({"op": "call_service", "id": "topics", "service": "/rosapi/topics"})).await;
        let answer = client.json().await;
        let topics = answer["values"]["topics"].as_array().unwrap();
        assert!(topics.contains(&json!(topic)), "{answer}");
        client.send(json!({"op": "advertise_service", "service": service, "type": "x_msgs/Add"})).await;
        client.send(json!({"op": "call_service", "id": "own", "service": service, "args": [1, 2]})).await;
        let request = client.json().await;
        assert_eq!(request["op"], "call_service", "{request}");
        client
            .send(json!({"op": "service_response", "id": request["id"], "service": service,
                "values": {"sum": 3}, "result": true}))
            .await;
        assert_eq!(client.json().await["values"], json!({"sum": 3}));
        client.send(json!({"op": "unadvertise_service", "service": service})).await;
    }
}

#[tokio::test]
async fn calls_in_cbor_and_ros_bytes_are_answered_alike() {
    let world = World::new().await;
    let _served = serve_add(&world, "/add", None).await;
    let mut client = world.client().await;
    let call = |args: &[u8], compression: Option<Compression>| {
        let mut out = Vec::new();
        Op::from(CallService {
            id: Some("c".into()),
            service: "/add".into(),
            type_name: None,
            args: Some(Payload::cbor(args)),
            timeout: None,
            fragment_size: None,
            compression,
        })
        .print(&mut out, Format::Cbor);
        out
    };
    client.send_binary(call(b"\xa2\x61a\x01\x61b\x02", None)).await;
    let answer = client.binary().await;
    let Op::ServiceResponse(answer) = Op::parse(ProtocolFrame::Binary(&answer)).unwrap() else { panic!("{answer:?}") };
    assert_eq!(answer.values, Some(Payload::cbor(b"\xa1\x63sum\x03")));
    let request = world.serialize(&[1, 0, 0, 0, 0, 0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0]);
    let mut args = b"\xa1\x65bytes".to_vec();
    args.push(0x40 + request.len() as u8);
    args.extend_from_slice(&request);
    client.send_binary(call(&args, Some(Compression::CborRaw))).await;
    let answer = client.binary().await;
    let Op::ServiceResponse(answer) = Op::parse(ProtocolFrame::Binary(&answer)).unwrap() else { panic!("{answer:?}") };
    assert_eq!(answer.compression, Compression::CborRaw);
    assert_eq!(*answer.values.unwrap().raw().unwrap().bytes, world.serialize(&[3, 0, 0, 0, 0, 0, 0, 0]));
    client.send(json!({"op": "call_service", "service": "/add", "args": [1, 2], "compression": "png"})).await;
    let packed = client.json().await;
    let text = rosbridge::decode_png(packed["data"].as_str().unwrap(), 10_000).unwrap();
    assert!(text.contains(r#""values":{"sum":3}"#), "{text}");
    client.send(json!({"op": "call_service", "service": "/add", "args": [1, 2], "fragment_size": 20})).await;
    assert_eq!(client.json().await["op"], "fragment");
}

#[tokio::test]
async fn a_client_serves_and_each_call_is_answered_once() {
    let world = World::new().await;
    let mut server = world.client().await;
    server.send(json!({"op": "set_level", "level": "info"})).await;
    server.send(json!({"op": "advertise_service", "service": "/twice", "type": "x_msgs/Add"})).await;
    assert_eq!(server.json().await["msg"], "advertise_service: advertised /twice");
    server.send(json!({"op": "set_level", "level": "error"})).await;
    let call = |request: &[u8]| {
        let (node, request) = (world.node.clone(), world.serialize(request));
        tokio::spawn(async move { node.call("/twice", request, PATIENCE).await })
    };
    let first = call(&[1; 16]);
    let request = server.json().await;
    assert_eq!(
        request,
        json!({"op": "call_service", "id": "service_request:/twice:1", "service": "/twice",
            "args": {"a": 0x0101010101010101i64, "b": 0x0101010101010101i64}})
    );
    let answer = json!({"op": "service_response", "id": request["id"], "service": "/twice", "values": {"sum": 6},
        "result": true});
    server.send(answer.clone()).await;
    assert_eq!(with_timeout(first).await.unwrap().unwrap(), world.serialize(&[6, 0, 0, 0, 0, 0, 0, 0]));
    server.send(answer).await;
    assert!(server.refusal().await.contains("waits for an answer"));

    let failing = call(&[0; 16]);
    let request = server.json().await;
    server
        .send(json!({"op": "service_response", "id": request["id"], "service": "/twice", "values": "not today",
        "result": false}))
        .await;
    assert!(with_timeout(failing).await.unwrap().unwrap_err().to_string().contains("not today"));

    // As clients of the first rosbridge do: the values count.
    let modest = call(&[0; 16]);
    let request = server.json().await;
    server
        .send(json!({"op": "service_response", "id": request["id"], "service": "/twice", "values": {"sum": 7},
        "result": false}))
        .await;
    let computed = with_timeout(modest).await.unwrap().unwrap();
    assert_eq!(world.values(&computed)[0], 7);

    let misfit = call(&[0; 16]);
    let request = server.json().await;
    server
        .send(json!({"op": "service_response", "id": request["id"], "service": "/twice", "values": {"sum": "x"},
        "result": true}))
        .await;
    let response = world.registry.service("x_msgs/Add").unwrap();
    let expected = format!("field sum of {}", response.response.name());
    assert!(server.refusal().await.contains(&expected));
    assert!(with_timeout(misfit).await.unwrap().is_err());

    let left = call(&[0; 16]);
    server.json().await;
    server.abort().await;
    assert!(with_timeout(left).await.unwrap().unwrap_err().to_string().contains("/twice"));
    world.wait_for_graph(|graph| !graph.services.contains_key("/twice")).await;
}

#[tokio::test]
async fn services_are_advertised_anew_and_taken_back() {
    let world = World::new().await;
    let mut server = world.client().await;
    let mut other = world.client().await;
    server.send(json!({"op": "set_level", "level": "info"})).await;
    let advertise = json!({"op": "advertise_service", "service": "/s", "type": "x_msgs/Nothing"});
    server.send(advertise.clone()).await;
    assert_eq!(server.json().await["level"], "info");
    server.send(advertise.clone()).await;
    assert_eq!(server.json().await["level"], "warning");
    assert_eq!(server.json().await["msg"], "advertise_service: advertised /s");
    other.send(advertise).await;
    assert_eq!(other.refusal().await, "advertise_service: another client serves /s already");
    other.send(json!({"op": "advertise_service", "service": "/s", "type": "x_msgs/Lost"})).await;
    let lost = world.full_name("x_msgs/Lost", "srv");
    let expected = format!("no definition of {lost} is known");
    assert!(other.refusal().await.contains(&expected));
    other.send(json!({"op": "service_response", "id": "1", "service": "/s", "result": true})).await;
    assert!(other.refusal().await.contains("/s is not advertised by this client"));

    // One client calls a service of another.
    other.send(json!({"op": "call_service", "id": "n", "service": "/s"})).await;
    let request = server.json().await;
    server.send(json!({"op": "service_response", "id": request["id"], "service": "/s", "result": true})).await;
    let answer = other.json().await;
    assert_eq!((&answer["values"], &answer["result"]), (&json!({}), &json!(true)));

    other.send(json!({"op": "call_service", "id": "m", "service": "/s"})).await;
    server.json().await;
    server.send(json!({"op": "unadvertise_service", "service": "/s"})).await;
    assert_eq!(other.json().await["result"], false);
    world.wait_for_graph(|graph| !graph.services.contains_key("/s")).await;
}

#[tokio::test]
async fn arguments_that_are_too_many_are_told_as_a_warning() {
    let world = World::new().await;
    let _served = serve_add(&world, "/add", None).await;
    let mut client = world.client().await;
    client.send(json!({"op": "set_level", "level": "warning"})).await;
    client.send(json!({"op": "call_service", "id": "c", "service": "/add", "args": [1, 2, 3, 4]})).await;
    let request = world.request_name("x_msgs/Add");
    assert_eq!(
        client.json().await,
        json!({"op": "status", "id": "c", "level": "warning",
            "msg": format!("call_service: {request} has 2 fields, the last 2 of \"args\" were ignored")})
    );
    assert_eq!(client.json().await["values"], json!({"sum": 3}));
}

#[tokio::test]
async fn a_call_that_cannot_be_read_is_answered_all_the_same() {
    let world = World::new().await;
    let mut client = world.client().await;
    for (call, answer) in [
        (
            json!({"op": "call_service", "id": "c", "service": "/add", "args": 5}),
            json!({"op": "service_response", "id": "c", "service": "/add"}),
        ),
        (
            json!({"op": "call_service", "service": "/add#7", "timeout": "soon"}),
            json!({"op": "service_response", "id": "7", "service": "/add"}),
        ),
        (json!({"op": "call_service", "id": 3}), json!({"op": "service_response", "id": 3})),
        (
            json!({"op": "send_action_goal", "id": "g", "action": "/count", "args": {}}),
            json!({"op": "action_result", "id": "g", "action": "/count", "status": 0}),
        ),
    ] {
        client.send(call).await;
        let reason = client.refusal().await;
        let mut expected = answer;
        expected["result"] = json!(false);
        expected["values"] = json!(reason);
        assert_eq!(client.json().await, expected);
    }
    client.sync().await;
}

#[tokio::test]
async fn who_answers_with_nonsense_keeps_no_caller_waiting() {
    let world = World::new().await;
    let mut server = world.client().await;
    let mut caller = world.client().await;
    server.send(json!({"op": "advertise_service", "service": "/add", "type": "x_msgs/Add"})).await;
    world.wait_for_graph(|graph| graph.services.contains_key("/add")).await;
    for (answer, reason) in [
        (json!({"values": {"sum": 3}}), "field \"result\" is missing"),
        (json!({"values": {"sum": 3}, "result": "yes"}), "field \"result\" is \"yes\""),
        (json!({"service": "/other", "result": true}), "not of /other"),
    ] {
        caller.send(json!({"op": "call_service", "id": "c", "service": "/add"})).await;
        let request = server.json().await;
        let mut response = json!({"op": "service_response", "id": request["id"], "service": "/add"});
        for (field, value) in answer.as_object().unwrap() {
            response[field] = value.clone();
        }
        server.send(response).await;
        assert!(server.refusal().await.contains(reason), "{reason}");
        let heard = caller.json().await;
        assert_eq!((&heard["id"], &heard["result"]), (&json!("c"), &json!(false)));
        let said = heard["values"].as_str().unwrap();
        assert!(said.contains(reason), "{said}");
    }
}

#[tokio::test]
async fn who_takes_over_a_service_of_a_node_is_warned() {
    let world = World::new().await;
    let _served = serve_add(&world, "/add", None).await;
    let mut client = world.client().await;
    client.send(json!({"op": "set_level", "level": "warning"})).await;
    // The bridge sees a change of the graph when the node does, or a moment later.
    let ask = json!({"op": "call_service", "service": "/rosapi/service_node", "args": {"service": "/add"}});
    loop {
        client.send(ask.clone()).await;
        if client.json().await["values"]["node"] == "/node" {
            break;
        }
    }
    let advertise = json!({"op": "advertise_service", "service": "/add", "type": "x_msgs/Add"});
    client.send(advertise).await;
    assert_eq!(
        client.json().await,
        json!({"op": "status", "level": "warning",
            "msg": "advertise_service: /add was served by /node, this client replaces it"})
    );
}
