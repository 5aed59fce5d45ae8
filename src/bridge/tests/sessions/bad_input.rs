//! Fields that are missing, of the wrong type, unknown or far too long; fragments that make no sense; PNG bombs. All
//! are answered with the field's name and the reason, and the connection stays open.

use rosbridge::Format;
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::Message;

use super::support::{Client, World};

/// Returns a correct message of each op with all its fields except the id; and its required fields.
fn messages() -> Vec<(Value, &'static [&'static str])> {
    vec![
        (
            json!({"op": "advertise", "topic": "/a", "type": "std_msgs/String", "latch": false, "queue_size": 1,
                "md5sum": "*", "qos": {"depth": 1}}),
            &["topic", "type"],
        ),
        (json!({"op": "unadvertise", "topic": "/a"}), &["topic"]),
        (
            json!({"op": "publish", "topic": "/a", "msg": {"data": "x"}, "type": "std_msgs/String", "latch": false,
                "compression": "none", "qos": {"depth": 1}}),
            &["topic"],
        ),
        (
            json!({"op": "subscribe", "topic": "/a", "type": "std_msgs/String", "throttle_rate": 1, "queue_length": 1,
                "fragment_size": 100, "compression": "none", "qos": {"depth": 1}}),
            &["topic"],
        ),
        (json!({"op": "unsubscribe", "topic": "/a"}), &["topic"]),
        (
            json!({"op": "call_service", "service": "/rosapi/get_time", "type": "rosapi/GetTime", "args": {},
                "fragment_size": 1000, "compression": "none", "timeout": 1.0}),
            &["service"],
        ),
        (
            json!({"op": "advertise_service", "service": "/s", "type": "x_msgs/Add", "compression": "none"}),
            &["service", "type"],
        ),
        (json!({"op": "unadvertise_service", "service": "/s"}), &["service"]),
        (
            json!({"op": "service_response", "service": "/s", "values": {}, "result": true, "compression": "none"}),
            &["service", "result"],
        ),
        (
            json!({"op": "send_action_goal", "action": "/f", "action_type": "x_msgs/Count", "args": {},
                "feedback": true,
                "fragment_size": 1000, "compression": "none"}),
            &["action", "action_type"],
        ),
        (json!({"op": "cancel_action_goal", "action": "/f"}), &["action", "id"]),
        (
            json!({"op": "action_feedback", "action": "/f", "values": {}, "compression": "none"}),
            &["action", "values", "id"],
        ),
        (
            json!({"op": "action_result", "action": "/f", "values": {}, "status": 4, "result": true,
                "compression": "none"}),
            &["action", "result"],
        ),
        (
            json!({"op": "advertise_action", "action": "/f", "type": "x_msgs/Count", "compression": "none"}),
            &["action", "type"],
        ),
        (json!({"op": "unadvertise_action", "action": "/f"}), &["action"]),
        (json!({"op": "fragment", "data": "x", "num": 0, "total": 2}), &["data", "num", "total", "id"]),
        (json!({"op": "png", "data": "x", "num": 0, "total": 2}), &["data", "num", "total"]),
        (json!({"op": "set_level", "level": "error"}), &["level"]),
        (json!({"op": "status", "level": "error", "msg": "x"}), &["level", "msg"]),
        (
            json!({"op": "auth", "mac": "a", "client": "b", "dest": "c", "rand": "d", "t": 1, "level": "e", "end": 2}),
            &["mac", "client", "dest", "rand", "t", "end"],
        ),
    ]
}

/// Returns whether a field contains a message, which is checked by its type.
fn is_payload(op: &str, field: &str) -> bool {
    matches!(field, "values" | "args") || (op == "publish" && field == "msg")
}

/// Returns the message with an id, and with this value of a field.
fn with_field(message: &Value, field: &str, value: Value) -> Value {
    let mut changed = message.clone();
    changed["id"] = "q".into();
    changed[field] = value;
    changed
}

/// Sends a message, and returns the status messages that answer it.
async fn answers(client: &mut Client, message: &Value, format: Format) -> Vec<String> {
    let marker = json!({"op": "call_service", "id": "marker", "service": "/rosapi/get_ros_version"});
    for message in [message, &marker] {
        match format {
            Format::Json => client.send(message.clone()).await,
            Format::Cbor => {
                let mut bytes = Vec::new();
                ciborium::into_writer(message, &mut bytes).unwrap();
                client.send_binary(bytes).await;
            }
        }
    }
    let mut said = Vec::new();
    loop {
        let heard: Value = match client.next().await {
            Message::Text(text) => serde_json::from_str(&text).unwrap(),
            Message::Binary(bytes) => {
                // Statuses only: the marker's answer may contain what JSON cannot express.
                ciborium::from_reader(&*bytes).unwrap()
            }
            other => panic!("{other:?}"),
        };
        if heard["id"] == "marker" {
            return said;
        }
        if heard["op"] == "status" {
            said.push(heard["msg"].as_str().unwrap().to_owned());
        }
    }
}

/// Sends each message, and checks that a status names op and field and shows only a useful part of the value.
async fn assert_refused_by_name(cases: Vec<(Value, &str)>) {
    let world = World::new().await;
    for format in [Format::Json, Format::Cbor] {
        let mut client = world.client().await;
        for (case, field) in &cases {
            let op = case["op"].as_str().unwrap();
            let said = answers(&mut client, case, format).await;
            let named =
                said.iter().any(|text| text.starts_with(&format!("{op}: ")) && text.contains(&format!("{field:?}")));
            let sent = case.to_string();
            let shown: String = sent.chars().take(300).collect();
            assert!(named, "{shown} was answered with {said:?}");
            assert!(said.iter().all(|text| text.len() < 500), "{said:?}");
        }
    }
}

#[tokio::test]
async fn a_field_that_is_missing_is_named() {
    let messages = messages();
    let mut cases = Vec::new();
    for (message, needed) in &messages {
        for field in *needed {
            cases.push((with_field(message, field, Value::Null), *field));
            let mut lacking = with_field(message, field, Value::Null);
            lacking.as_object_mut().unwrap().remove(*field);
            cases.push((lacking, field));
        }
    }
    assert_refused_by_name(cases).await;
}

#[tokio::test]
async fn a_field_of_another_kind_is_named() {
    let messages = messages();
    let mut cases = Vec::new();
    for (message, _) in &messages {
        let op = message["op"].as_str().unwrap();
        let fields = message.as_object().unwrap().keys();
        for field in fields.map(String::as_str).chain(["id"]).filter(|field| *field != "op") {
            // An object is wrong for every field but payloads, and a number is wrong for these. The reason of a failed
            // response may be anything.
            let wrong = match field {
                "values" if op != "action_feedback" => continue,
                field if is_payload(op, field) => json!(7),
                // Unknown names are ignored in this field, too.
                "qos" => json!([{"depth": 1}]),
                _ => json!({"x": [1, 2]}),
            };
            cases.push((with_field(message, field, wrong), field));
        }
    }
    assert_refused_by_name(cases).await;
}

#[tokio::test]
async fn a_policy_that_cannot_be_meant_is_named() {
    let messages = messages();
    let mut cases = Vec::new();
    let able = |op: &&(Value, _)| op.0.get("qos").is_some();
    for (message, _) in messages.iter().filter(able) {
        for (policy, value, field) in [
            ("history", json!("keep_some"), "qos.history"),
            ("depth", json!(-1), "qos.depth"),
            ("reliability", json!(7), "qos.reliability"),
            ("durability", json!(["volatile"]), "qos.durability"),
            ("deadline", json!("soon"), "qos.deadline"),
            ("lifespan", json!({"sec": 1}), "qos.lifespan"),
            ("liveliness", json!(true), "qos.liveliness"),
        ] {
            let mut qos = json!({});
            qos[policy] = value;
            cases.push((with_field(message, "qos", qos), field));
        }
    }
    assert_eq!(cases.len(), 3 * 7);
    assert_refused_by_name(cases).await;
}

#[tokio::test]
async fn a_number_out_of_range_is_named() {
    let messages = messages();
    let mut cases = Vec::new();
    for (message, _) in &messages {
        for (field, value) in message.as_object().unwrap() {
            if !value.is_number() {
                continue;
            }
            let mut wrong = vec![json!(-1), json!(-1e300)];
            if !matches!(field.as_str(), "throttle_rate" | "timeout") {
                // These may be fractional and arbitrarily large.
                wrong.extend([json!(0.5), json!(1e300), json!(u64::MAX)]);
            }
            if message["op"] == "auth" {
                wrong.retain(|value| !value.is_i64());
            }
            for value in wrong {
                cases.push((with_field(message, field, value), field.as_str()));
            }
        }
    }
    assert!(cases.len() > 30, "{}", cases.len());
    assert_refused_by_name(cases).await;
}

#[tokio::test]
async fn a_huge_field_is_refused_and_not_repeated() {
    let long = format!("/{}", "x".repeat(100_000));
    let messages = messages();
    let mut cases = Vec::new();
    for (message, _) in &messages {
        let op = message["op"].as_str().unwrap();
        let fields = message.as_object().unwrap();
        for (field, value) in fields {
            // Pieces of messages may be long. A client's own status is not answered.
            let told = !matches!(field.as_str(), "op" | "data") && op != "status";
            if told && value.is_string() {
                cases.push((with_field(message, field, long.clone().into()), field.as_str()));
            }
        }
        cases.push((with_field(message, "id", long.clone().into()), "id"));
        // Instead of a number, or of a message.
        for (field, value) in fields.iter().filter(|(_, value)| !value.is_string()) {
            if op != "status" && !(field == "values" && op != "action_feedback") {
                let _ = value;
                cases.push((with_field(message, field, long.clone().into()), field.as_str()));
            }
        }
    }
    assert_refused_by_name(cases).await;
}

#[tokio::test]
async fn a_field_too_many_is_told_as_a_warning() {
    let world = World::new().await;
    let mut client = world.client().await;
    client.send(json!({"op": "set_level", "level": "warning"})).await;
    let long = "y".repeat(10_000);
    for (message, _) in messages() {
        let op = message["op"].as_str().unwrap();
        if op == "set_level" {
            continue;
        }
        let said = answers(&mut client, &with_field(&message, "colour", "red".into()), Format::Json).await;
        let told = format!("{op}: field \"colour\" is not known and was ignored");
        assert!(said.contains(&told), "{op}: {said:?}");
        let said = answers(&mut client, &with_field(&message, &long, 1.into()), Format::Json).await;
        let told = format!("{op}: field \"{}\" is not known", &long[..48]);
        assert!(said.iter().any(|text| text.starts_with(&told)), "{op}: {said:?}");
    }
}

#[tokio::test]
async fn fragments_that_make_no_sense_cost_only_themselves() {
    let world = World::new().await;
    let mut client = world.client().await;
    let call = r#"{"op":"call_service","id":"whole","service":"/rosapi/get_ros_version"}"#;
    let part = |num: u64, total: u64, data: &str| {
        json!({"op": "fragment", "id": "f", "num": num, "total": total,
        "data": data})
    };
    let (first, second) = call.split_at(20);
    // Out of order, and one of them twice.
    client.send(part(1, 2, second)).await;
    client.send(part(1, 2, second)).await;
    client.send(part(0, 2, first)).await;
    assert_eq!(client.json().await["id"], "whole");
    for (message, reason) in [(part(2, 2, "x"), "must be below"), (part(0, 1_000_000, "x"), "at most 65536")] {
        client.send(message).await;
        assert!(client.refusal().await.contains(reason));
    }
    client.send(part(0, 3, "a")).await;
    client.send(part(0, 3, "b")).await;
    assert!(client.refusal().await.contains("twice with different data"));
    client.send(part(0, 3, "a")).await;
    client.send(part(1, 4, "a")).await;
    assert!(client.refusal().await.contains("the earlier fragments said"));
    // Started a thousand times and never completed: the oldest are dropped, nothing grows.
    for number in 0..1000 {
        let id = format!("never {number}");
        client.send(json!({"op": "fragment", "id": id, "num": 0, "total": 1000, "data": "x".repeat(1000)})).await;
    }
    client.send(part(0, 2, first)).await;
    client.send(part(1, 2, second)).await;
    assert_eq!(client.json().await["id"], "whole");
    // Together they do not form a valid message.
    client.send(part(0, 1, "{\"op\":")).await;
    assert!(client.refusal().await.contains("invalid JSON"));
    client.sync().await;
}

#[tokio::test]
async fn a_picture_that_unpacks_to_gigabytes_is_refused_unread() {
    let world = World::new().await;
    let mut client = world.client().await;
    // 2 GB of line feeds in two megabytes of base64 are not needed: the header alone announces the size.
    let small = rosbridge::encode_png(b"{}").unwrap();
    let mut file = base64_simd::STANDARD.decode_to_vec(small).unwrap();
    file[16..24].copy_from_slice(&[0, 0, 0x75, 0x30, 0, 0, 0x75, 0x30]);
    let check = crc32(&file[12..29]);
    file[29..33].copy_from_slice(&check.to_be_bytes());
    let bomb = base64_simd::STANDARD.encode_to_string(file);
    client.send(json!({"op": "png", "data": bomb})).await;
    let refusal = client.refusal().await;
    assert!(refusal.starts_with("png: ") && refusal.contains("2700000000 bytes"), "{refusal}");
    client.sync().await;
}

/// The checksum at the end of a PNG chunk.
fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(u32::MAX, |sum, &byte| {
        (0..8).fold(sum ^ u32::from(byte), |sum, _| (sum >> 1) ^ (0xedb8_8320 & (sum & 1).wrapping_neg()))
    })
}

#[tokio::test]
async fn deep_nesting_is_refused_in_json_and_in_cbor() {
    let world = World::new().await;
    let mut client = world.client().await;
    client.send(json!({"op": "advertise", "topic": "/a", "type": "std_msgs/String"})).await;
    let deep =
        format!(r#"{{"op":"publish","topic":"/a","msg":{}{}}}"#, r#"{"data":"#.repeat(50_000), "}".repeat(50_000));
    client.send_text(&deep).await;
    assert!(client.refusal().await.contains("nested deeper"));
    let mut deep = b"\xa3\x62op\x67publish\x65topic\x62/a\x63msg".to_vec();
    deep.extend(std::iter::repeat_n(0x81, 100_000));
    client.send_binary(deep).await;
    let refusal = String::from_utf8_lossy(&client.binary().await).into_owned();
    assert!(refusal.contains("nested deeper"), "{refusal}");
    client.sync().await;
}
