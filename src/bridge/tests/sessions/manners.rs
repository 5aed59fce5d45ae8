//! Limits, slow clients, malformed input, closing.

use std::time::Duration;

use bridge::{BridgeOptions, SessionEnd, refuse};
use serde_json::json;
use tokio_tungstenite::tungstenite::protocol::Message;

use super::support::{World, patient, wait_connected, with_timeout};

#[tokio::test]
async fn rubbish_is_answered_and_the_connection_lives() {
    let world = World::new().await;
    let mut client = world.client().await;
    for (text, reason) in [
        ("rubbish", "invalid JSON at byte 0: an object is expected"),
        ("{\"op\":\"dance\"}", "unknown op \"dance\"; known are "),
        ("{}", "field \"op\" is missing; it must be one of "),
        ("{\"op\":\"png\",\"data\":\"AAAA\"}", "png: field \"data\" is not a PNG picture: "),
        (
            "{\"op\":\"fragment\",\"id\":\"f\",\"data\":\"\",\"num\":0,\"total\":1000000}",
            "fragment: \"total\" is 1000000, at most 65536 fragments are allowed",
        ),
    ] {
        client.send_text(text).await;
        let refusal = client.refusal().await;
        assert!(refusal.starts_with(reason), "{refusal}");
    }
    client.send_text(&format!("{{\"op\":\"publish\",\"topic\":\"/x\",\"msg\":{}", "[".repeat(10_000))).await;
    assert!(client.refusal().await.contains("nested deeper than 128 levels"));
    client.sync().await;
    client.send_binary(vec![0xff; 100]).await;
    client.binary().await;
    client.sync().await;
}

#[tokio::test]
async fn json_is_understood_in_binary_frames_and_answered_in_text() {
    let world = World::new().await;
    let mut client = world.client().await;
    for op in [
        json!({"op": "subscribe", "topic": "/x", "type": "std_msgs/Int32"}),
        json!({"op": "advertise", "topic": "/x", "type": "std_msgs/Int32"}),
        json!({"op": "publish", "topic": "/x", "msg": {"data": 1}}),
    ] {
        client.send_binary(op.to_string().into_bytes()).await;
    }
    assert_eq!(client.json().await["msg"], json!({"data": 1}));
    client.send_binary(b"{}".to_vec()).await;
    assert!(client.refusal().await.starts_with("field \"op\" is missing"));
}

#[tokio::test]
async fn wrapped_messages_are_unwrapped_but_not_for_ever() {
    let world = World::new().await;
    let mut client = world.client().await;
    let call = r#"{"op":"call_service","id":"ü","service":"/rosapi/get_ros_version"}"#;
    let picture = rosbridge::encode_png(call.as_bytes()).unwrap();
    let png = json!({"op": "png", "data": picture}).to_string();
    for (num, data) in rosbridge::split_text(&png, png.len() / 2 + 1).enumerate() {
        client.send(json!({"op": "fragment", "id": "f", "num": num, "total": 2, "data": data})).await;
    }
    assert_eq!(client.json().await["id"], "ü");
    let mut text = call.to_owned();
    for _ in 0..6 {
        text = json!({"op": "png", "data": rosbridge::encode_png(text.as_bytes()).unwrap()}).to_string();
    }
    client.send_text(&text).await;
    assert_eq!(client.refusal().await, "png: messages within messages go 4 deep at most");
}

#[tokio::test]
async fn the_client_hears_what_it_asked_to_hear() {
    let world = World::new().await;
    let mut client = world.client().await;
    client.send(json!({"op": "set_level", "level": "info", "id": "l"})).await;
    client.send(json!({"op": "subscribe", "id": "s", "topic": "/x", "type": "std_msgs/String"})).await;
    let expected = json!({"op": "status", "id": "s", "level": "info", "msg": "subscribe: subscribed to /x"});
    assert_eq!(client.json().await, expected);
    client.send(json!({"op": "set_level", "level": "warning"})).await;
    client.send(json!({"op": "unsubscribe", "topic": "/x", "id": "s", "topik": "/y"})).await;
    let expected = "unsubscribe: field \"topik\" is not known and was ignored";
    assert_eq!(client.json().await, json!({"op": "status", "id": "s", "level": "warning", "msg": expected}));
    client.send(json!({"op": "set_level", "level": "none"})).await;
    client.send_text("rubbish").await;
    client.sync().await;
    client.send(json!({"op": "set_level", "level": "loud"})).await;
    client.sync().await;
}

#[tokio::test]
async fn a_frame_over_the_limit_closes_with_the_reason() {
    let world = World::with_options(BridgeOptions { max_frame: 1000, ..patient() }).await;
    let mut client = world.client().await;
    client.send_text(&"x".repeat(1001)).await;
    assert_eq!(client.refusal().await, "a frame of 1001 bytes is over the limit of 1000");
    assert_eq!(client.expect_close().await, (1009, "a frame of 1001 bytes is over the limit of 1000".into()));
}

#[tokio::test]
async fn text_that_is_not_utf8_closes_with_the_reason() {
    let world = World::new().await;
    let mut client = world.client().await;
    let frame = tokio_tungstenite::tungstenite::protocol::frame::Frame::message(
        vec![0xff, 0xfe],
        tokio_tungstenite::tungstenite::protocol::frame::coding::OpCode::Data(
            tokio_tungstenite::tungstenite::protocol::frame::coding::Data::Text,
        ),
        true,
    );
    client.send_raw(Message::Frame(frame)).await.unwrap();
    assert_eq!(client.expect_close().await, (1007, "a text frame is not UTF-8".into()));
}

#[tokio::test]
async fn a_silent_client_is_pinged_and_then_left() {
    let options = BridgeOptions {
        ping_interval: Duration::from_millis(20),
        idle_timeout: Duration::from_millis(200),
        close_timeout: Duration::from_millis(50),
        ..patient()
    };
    let world = World::with_options(options).await;
    // Never polled, so it answers no ping.
    let silent = world.client().await;
    let end = with_timeout(silent.session).await.unwrap();
    let SessionEnd::Closed { code: 1001, reason } = end else { panic!("{end:?}") };
    assert!(reason.starts_with("nothing was received for "), "{reason}");
}

#[tokio::test]
async fn goodbyes_are_returned() {
    let world = World::new().await;
    let mut sessions = world.bridge.sessions();
    let mut client = world.client().await;
    with_timeout(sessions.wait_for(|count| count.connected == 1)).await.unwrap();
    client.send_raw(Message::Close(None)).await.unwrap();
    assert_eq!(client.expect_close().await, (1005, String::new()));
    let end = with_timeout(client.session).await.unwrap();
    assert_eq!(end, SessionEnd::Client { code: 1005, reason: String::new() });
    with_timeout(sessions.wait_for(|count| count.connected == 0)).await.unwrap();
}

#[tokio::test]
async fn when_the_servant_is_gone_every_session_is_told() {
    let world = World::new().await;
    let mut client = world.client().await;
    client.sync().await;
    world.bridge.close("the servant's node has died");
    assert_eq!(client.refusal().await, "the servant's node has died");
    assert_eq!(client.expect_close().await, (1012, "the servant's node has died".into()));
    let mut late = world.client().await;
    assert_eq!(late.refusal().await, "the servant's node has died");
    assert_eq!(late.expect_close().await.0, 1012);
}

#[tokio::test]
async fn a_connection_without_servant_is_refused_with_a_status() {
    let (ours, theirs) = tokio::io::duplex(4096);
    let refusing = tokio::spawn(refuse(theirs, 1013, "no room for another servant; try again in 5 s"));
    let role = tokio_tungstenite::tungstenite::protocol::Role::Client;
    let mut socket = tokio_tungstenite::WebSocketStream::from_raw_socket(ours, role, None).await;
    let status = with_timeout(futures_util::StreamExt::next(&mut socket)).await.unwrap().unwrap();
    assert!(status.to_text().unwrap().contains("no room for another servant"));
    let Message::Close(Some(close)) = with_timeout(futures_util::StreamExt::next(&mut socket)).await.unwrap().unwrap()
    else {
        panic!("not closed")
    };
    assert_eq!(u16::from(close.code), 1013);
    // The close frame is answered when the client is polled further.
    while with_timeout(futures_util::StreamExt::next(&mut socket)).await.is_some() {}
    with_timeout(refusing).await.unwrap();
}

#[tokio::test]
async fn what_json_takes_counts_for_the_servant_and_is_left_out_beyond() {
    let budget = budget::Budget::new("servant x", 4 << 20);
    let options = BridgeOptions { budget: budget.clone(), max_encoded: 3 << 20, ..patient() };
    let world = World::with_options(options).await;
    let publisher = world.node_publishes("/big", "std_msgs/UInt8MultiArray", false).await;
    let mut client = world.client().await;
    client.send(json!({"op": "subscribe", "topic": "/big"})).await;
    client.sync().await;
    wait_connected(publisher.as_ref(), 1).await;
    let bytes = |length: usize| {
        let mut message = (length as u32).to_le_bytes().to_vec();
        message.resize(4 + length, 7);
        world.serialize(&message)
    };
    publisher.publish(bytes(1 << 20));
    let heard = client.json().await;
    assert!(heard["msg"]["data"].as_str().is_some_and(|data| data.len() > 1 << 20));
    // Too large as base64.
    publisher.publish(bytes(5 << 19));
    let told = client.json().await;
    assert!(told["op"] == "status" && told["msg"].as_str().unwrap().contains("/big"), "{told}");
    // Others use up the servant's budget.
    let others = budget.take(budget.available()).unwrap();
    publisher.publish(bytes(1 << 20));
    publisher.publish(bytes(10));
    let small = client.json().await;
    assert_eq!(small["msg"]["data"], "BwcHBwcHBwcHBw==", "small ones do not count");
    drop(others);
    publisher.publish(bytes(1 << 20));
    let heard = client.json().await;
    assert!(heard["msg"]["data"].as_str().is_some_and(|data| data.len() > 1 << 20));
    drop(client);
    with_timeout(async {
        while budget.used_bytes() > 0 {
            tokio::task::yield_now().await;
        }
    })
    .await;
}

#[tokio::test]
async fn fragments_that_do_not_fit_close_the_connection() {
    let world = World::new().await;
    let budget = budget::Budget::new("client x", 100_000);
    let options = bridge::SessionOptions { budget: budget.clone(), ..bridge::SessionOptions::default() };
    let mut client = world.client_with(options).await;
    for number in 0..3 {
        let part = json!({"op": "fragment", "id": "a", "num": number, "total": 10, "data": "x".repeat(40_000)});
        client.send(part).await;
    }
    let reason = client.refusal().await;
    assert!(reason.contains("the memory for client x"), "{reason}");
    assert_eq!(client.expect_close().await.0, 1013);
    with_timeout(client.session).await.unwrap();
    assert_eq!(budget.used_bytes(), 0);
}

#[tokio::test]
async fn a_client_that_does_not_read_costs_bounded_memory_and_delays_nobody() {
    let options = BridgeOptions { topic_bytes: 1 << 20, session_bytes: 2 << 20, ..patient() };
    let world = World::with_options(options).await;
    let publisher = world.node_publishes("/big", "std_msgs/UInt8MultiArray", false).await;
    let (mut slow, mut quick) = (world.client().await, world.client().await);
    for client in [&mut slow, &mut quick] {
        client.send(json!({"op": "subscribe", "topic": "/big", "compression": "cbor-raw"})).await;
        client.sync().await;
    }
    wait_connected(publisher.as_ref(), 1).await;
    let sizes = 200_000..200_200;
    for size in sizes.clone() {
        let mut message = (size as u32).to_le_bytes().to_vec();
        message.resize(4 + size, 0);
        publisher.publish(message.into());
        let frame = quick.binary().await;
        assert!(frame.len() > size);
    }
    let metrics = world.bridge.metrics();
    // 5 messages of 200 kB are queued for the slow client, one is in its socket.
    assert!(metrics.dropped.get() >= 190, "{}", metrics.dropped.get());
    assert!(metrics.dropped_bytes.get() >= 190 * 200_000);
    let mut last = 0;
    for _ in 0..6 {
        last = slow.binary().await.len();
    }
    assert!(last > sizes.end - 1, "the newest wins");
    slow.sync().await;
}

#[tokio::test]
async fn a_client_that_floods_and_does_not_read_is_held_back_not_fed() {
    let world = World::new().await;
    let mut client = world.client().await;
    let mut sent = 0u32;
    // Answers fill the client's side of the pipe, then the bridge stops reading, then sending blocks.
    while sent < 100_000 {
        let sending = client.send_text("rubbish");
        if tokio::time::timeout(Duration::from_millis(200), sending).await.is_err() {
            break;
        }
        sent += 1;
    }
    assert!(sent < 100_000);
    for _ in 0..sent.min(1000) {
        client.refusal().await;
    }
}

#[tokio::test]
async fn ten_thousand_subscriptions_are_too_many() {
    let world = World::new().await;
    let refusal = "subscribe: this client has 1000 subscriptions already; unsubscribe from one";
    let (mut broad, mut deep) = (world.client().await, world.client().await);
    for number in 0..10_000 {
        let topic = format!("/t{number}");
        let many = json!({"op": "subscribe", "topic": topic, "type": "std_msgs/String"});
        let again = json!({"op": "subscribe", "id": number, "topic": "/t", "type": "std_msgs/String"});
        for (client, subscribe) in [(&mut broad, many), (&mut deep, again)] {
            client.send(subscribe).await;
            if number >= 1000 {
                assert_eq!(client.refusal().await, refusal);
            }
        }
    }
    for client in [&mut broad, &mut deep] {
        client.sync().await;
    }
    // No more of them have reached ROS; a client that gives one up may have another.
    let named = |graph: &ros::bus::Graph| {
        let topics = graph.topics.keys().filter(|topic| topic.starts_with("/t"));
        topics.count()
    };
    world.wait_for_graph(|graph| named(graph) == 1001).await;
    broad.send(json!({"op": "unsubscribe", "topic": "/t0"})).await;
    broad.send(json!({"op": "subscribe", "topic": "/other", "type": "std_msgs/String"})).await;
    broad.sync().await;
}

#[tokio::test]
async fn answers_in_fragments_wait_in_the_queue_that_is_bounded() {
    let options = BridgeOptions { control_messages: 100, close_timeout: Duration::from_secs(60), ..patient() };
    let world = World::with_options(options).await;
    let mut client = world.client().await;
    let call = json!({"op": "call_service", "service": "/rosapi/message_details",
        "args": {"type": "x_msgs/Place"}, "fragment_size": 10});
    let mut asked = 0;
    // It reads two thousand fragments, some twenty answers, for every ninety calls.
    'open: while asked < 2000 {
        for _ in 0..90 {
            // A connection that is being closed may be gone already.
            let _ = client.send_raw(Message::text(call.to_string())).await;
            asked += 1;
        }
        let frames = &world.bridge.metrics().frames_in;
        let taken = async {
            while frames.get() < asked && !client.session.is_finished() {
                tokio::task::yield_now().await;
            }
        };
        // Once it is being closed nothing more is read.
        let _ = tokio::time::timeout(Duration::from_millis(200), taken).await;
        for _ in 0..2000 {
            if let Message::Close(_) = client.next().await {
                break 'open;
            }
        }
    }
    assert!(asked < 2000, "{asked} answers are kept");
    let end = client.abort().await;
    assert!(matches!(end, SessionEnd::Closed { code: 1008, .. }), "{end:?}");
}
