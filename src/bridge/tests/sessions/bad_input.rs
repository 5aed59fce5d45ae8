//! Fields that are missing, of the wrong kind, unknown or far too long; fragments that make no sense; pictures that are
//! bombs. All are answered by name and reason, and the connection lives.

use serde_json::{Value, json};

use crate::support::{Client, World};

/// A correct message of each op, without an id.
fn messages() -> Vec<Value> {
    vec![
        json!({"op": "advertise", "topic": "/a", "type": "std_msgs/String", "latch": false, "queue_size": 1}),
        json!({"op": "unadvertise", "topic": "/a"}),
        json!({"op": "publish", "topic": "/a", "msg": {"data": "x"}}),
        json!({"op": "subscribe", "topic": "/a", "type": "std_msgs/String", "throttle_rate": 1, "queue_length": 1,
            "fragment_size": 100, "compression": "none"}),
        json!({"op": "unsubscribe", "topic": "/a"}),
        json!({"op": "call_service", "service": "/rosapi/get_time", "fragment_size": 1000, "compression": "none",
            "timeout": 1.0}),
        json!({"op": "advertise_service", "service": "/s", "type": "x_msgs/Add"}),
        json!({"op": "unadvertise_service", "service": "/s"}),
        json!({"op": "service_response", "service": "/s", "values": {}, "result": true}),
        json!({"op": "send_action_goal", "action": "/f", "action_type": "x_msgs/Count", "feedback": true}),
        json!({"op": "cancel_action_goal", "action": "/f"}),
        json!({"op": "action_feedback", "action": "/f", "values": {}}),
        json!({"op": "action_result", "action": "/f", "values": {}, "status": 3, "result": true}),
        json!({"op": "advertise_action", "action": "/f", "type": "x_msgs/Count"}),
        json!({"op": "unadvertise_action", "action": "/f"}),
        json!({"op": "fragment", "data": "x", "num": 0, "total": 2}),
        json!({"op": "png", "data": "x", "num": 0, "total": 2}),
        json!({"op": "set_level", "level": "error"}),
        json!({"op": "status", "level": "error", "msg": "x"}),
    ]
}

/// Fields without which an op means nothing.
fn is_needed(op: &str, field: &str) -> bool {
    match field {
        "topic" | "service" | "action" | "action_type" | "level" | "data" => true,
        "msg" => op == "status" || op == "publish",
        "num" | "total" => op == "fragment",
        "type" => op.starts_with("advertise"),
        "values" => op == "action_feedback",
        _ => false,
    }
}

/// Sends it, and gives the status messages that came of it.
async fn answers(client: &mut Client, message: &Value, marker: usize) -> Vec<String> {
    client.send(message.clone()).await;
    let id = format!("marker {marker}");
    client
        .send(json!({"op": "call_service", "id": id, "service": "/rosapi/get_ros_version"}))
        .await;
    let mut said = Vec::new();
    loop {
        let heard = client.json().await;
        if heard["id"] == id.as_str() {
            return said;
        }
        if heard["op"] == "status" {
            said.push(heard["msg"].as_str().unwrap().to_owned());
        }
    }
}

#[tokio::test]
async fn every_field_that_is_missing_or_of_another_kind_is_named() {
    let world = World::new().await;
    let mut client = world.client().await;
    let mut marker = 0;
    for message in messages() {
        let op = message["op"].as_str().unwrap();
        let fields = message.as_object().unwrap();
        for field in fields.keys().filter(|field| *field != "op") {
            let mut cases = Vec::new();
            let mut lacking = message.clone();
            lacking.as_object_mut().unwrap().remove(field);
            lacking["id"] = "q".into();
            if is_needed(op, field) {
                cases.push(lacking.clone());
            }
            // An object is wrong for every field but those that are payloads, and a number is wrong for these.
            let payload = matches!(field.as_str(), "values") || (op == "publish" && field == "msg");
            if !payload {
                lacking[field] = json!({"x": [1, 2]});
                cases.push(lacking);
            }
            for case in cases {
                marker += 1;
                let said = answers(&mut client, &case, marker).await;
                let named = said.iter().any(|text| {
                    text.starts_with(&format!("{op}: ")) && text.contains(&format!("{field:?}"))
                });
                assert!(named, "{case} was answered with {said:?}");
            }
        }
    }
}

#[tokio::test]
async fn a_field_too_many_is_told_as_a_warning_and_a_huge_one_is_refused() {
    let world = World::new().await;
    let mut client = world.client().await;
    let long = "x".repeat(100_000);
    let mut marker = 0;
    for message in messages() {
        let op = message["op"].as_str().unwrap().to_owned();
        for field in ["topic", "service", "action", "type", "action_type", "id"] {
            if field != "id" && message.get(field).is_none() {
                continue;
            }
            let mut huge = message.clone();
            huge["id"] = "q".into();
            huge[field] = format!("/{long}").into();
            marker += 1;
            let said = answers(&mut client, &huge, marker).await;
            let told = said
                .iter()
                .find(|text| text.starts_with(&format!("{op}: ")));
            let told = told.unwrap_or_else(|| panic!("{op}: a huge {field:?}: {said:?}"));
            assert!(told.len() < 1000, "{op}: {} bytes of answer", told.len());
        }
    }
    client
        .send(json!({"op": "set_level", "level": "warning"}))
        .await;
    for mut message in messages() {
        let op = message["op"].as_str().unwrap().to_owned();
        if op == "set_level" {
            continue;
        }
        message["id"] = "q".into();
        message["colour"] = "red".into();
        marker += 1;
        let said = answers(&mut client, &message, marker).await;
        let told = format!("{op}: field \"colour\" is not known and was ignored");
        assert!(said.contains(&told), "{op}: {said:?}");
    }
}

#[tokio::test]
async fn fragments_that_make_no_sense_cost_only_themselves() {
    let world = World::new().await;
    let mut client = world.client().await;
    let call = r#"{"op":"call_service","id":"whole","service":"/rosapi/get_ros_version"}"#;
    let part = |num: u64, total: u64, data: &str| json!({"op": "fragment", "id": "f", "num": num, "total": total, "data": data});
    let (first, second) = call.split_at(20);
    // Out of order, and one of them twice.
    client.send(part(1, 2, second)).await;
    client.send(part(1, 2, second)).await;
    client.send(part(0, 2, first)).await;
    assert_eq!(client.json().await["id"], "whole");
    for (message, reason) in [
        (part(2, 2, "x"), "must be below"),
        (part(0, 1_000_000, "x"), "at most 65536"),
    ] {
        client.send(message).await;
        assert!(client.refusal().await.contains(reason));
    }
    client.send(part(0, 3, "a")).await;
    client.send(part(0, 3, "b")).await;
    assert!(client.refusal().await.contains("twice with different data"));
    client.send(part(0, 3, "a")).await;
    client.send(part(1, 4, "a")).await;
    assert!(
        client
            .refusal()
            .await
            .contains("the earlier fragments said")
    );
    // Begun a thousand times and never ended: the oldest are forgotten, nothing grows.
    for number in 0..1000 {
        let id = format!("never {number}");
        client
            .send(json!({"op": "fragment", "id": id, "num": 0, "total": 1000, "data": "x".repeat(1000)}))
            .await;
    }
    client.send(part(0, 2, first)).await;
    client.send(part(1, 2, second)).await;
    assert_eq!(client.json().await["id"], "whole");
    // What they hold together makes no message.
    client.send(part(0, 1, "{\"op\":")).await;
    assert!(client.refusal().await.contains("invalid JSON"));
    client.settled().await;
}

#[tokio::test]
async fn a_picture_that_unpacks_to_gigabytes_is_refused_unread() {
    let world = World::new().await;
    let mut client = world.client().await;
    // 2 GB of line feeds in two megabytes of base64 are not needed: the header alone says how much it would be.
    let small = rosbridge::encode_png(b"{}").unwrap();
    let mut file = base64::Engine::decode(&base64::prelude::BASE64_STANDARD, small).unwrap();
    file[16..24].copy_from_slice(&[0, 0, 0x75, 0x30, 0, 0, 0x75, 0x30]);
    let check = crc32(&file[12..29]);
    file[29..33].copy_from_slice(&check.to_be_bytes());
    let bomb = base64::Engine::encode(&base64::prelude::BASE64_STANDARD, file);
    client.send(json!({"op": "png", "data": bomb})).await;
    let refusal = client.refusal().await;
    assert!(
        refusal.starts_with("png: ") && refusal.contains("2700000000 bytes"),
        "{refusal}"
    );
    client.settled().await;
}

/// As PNG's chunks end with it.
fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(u32::MAX, |sum, &byte| {
        (0..8).fold(sum ^ u32::from(byte), |sum, _| {
            (sum >> 1) ^ (0xedb8_8320 & (sum & 1).wrapping_neg())
        })
    })
}

#[tokio::test]
async fn deep_nesting_is_refused_in_json_and_in_cbor() {
    let world = World::new().await;
    let mut client = world.client().await;
    client
        .send(json!({"op": "advertise", "topic": "/a", "type": "std_msgs/String"}))
        .await;
    let deep = format!(
        r#"{{"op":"publish","topic":"/a","msg":{}{}}}"#,
        r#"{"data":"#.repeat(50_000),
        "}".repeat(50_000)
    );
    client.send_text(&deep).await;
    assert!(client.refusal().await.contains("nested deeper"));
    let mut deep = b"\xa3\x62op\x67publish\x65topic\x62/a\x63msg".to_vec();
    deep.extend(std::iter::repeat_n(0x81, 100_000));
    client.send_binary(deep).await;
    let refusal = String::from_utf8_lossy(&client.binary().await).into_owned();
    assert!(refusal.contains("nested deeper"), "{refusal}");
    client.settled().await;
}
