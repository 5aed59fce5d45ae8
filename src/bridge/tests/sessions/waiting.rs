//! Connections whose servant is not ready yet.

use std::sync::Arc;
use std::time::Duration;

use bridge::{BridgeOptions, SessionEnd, SessionOptions, WaitingConnection};
use futures_util::{SinkExt, StreamExt};
use serde_json::{Value, json};
use tokio::io::DuplexStream;
use tokio::sync::oneshot;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::protocol::{Message, Role};

use super::support::{World, with_timeout};

type Socket = WebSocketStream<DuplexStream>;

/// Creates a waiting connection, and its client's end.
async fn connection(options: &BridgeOptions) -> (WaitingConnection<DuplexStream>, Socket) {
    let (ours, theirs) = tokio::io::duplex(64 * 1024);
    let client = WebSocketStream::from_raw_socket(theirs, Role::Client, None).await;
    (WaitingConnection::new(ours, b"", options), client)
}

async fn next(client: &mut Socket) -> Message {
    with_timeout(client.next()).await.expect("a message").unwrap()
}

#[tokio::test]
async fn who_leaves_is_answered_at_once_and_needs_nothing_any_more() {
    let (mut waiting, mut client) = connection(&BridgeOptions::default()).await;
    // The servant never becomes ready; `given_up` completes when nobody waits for it any more.
    let (place, given_up) = oneshot::channel::<()>();
    let waits = tokio::spawn(async move {
        let servant = async {
            let _place = place;
            std::future::pending::<()>().await
        };
        waiting.wait_for(servant).await
    });
    client.send(Message::Ping("p".into())).await.unwrap();
    assert_eq!(next(&mut client).await, Message::Pong("p".into()));
    client.close(None).await.unwrap();
    assert_eq!(next(&mut client).await, Message::Close(None));
    let end = with_timeout(waits).await.unwrap().unwrap_err();
    assert!(matches!(end, SessionEnd::Client { code: 1005, .. }), "{end:?}");
    assert!(with_timeout(given_up).await.is_err());
}

#[tokio::test]
async fn who_is_gone_without_a_word_needs_nothing_any_more() {
    let (mut waiting, client) = connection(&BridgeOptions::default()).await;
    let waits = tokio::spawn(async move { waiting.wait_for(std::future::pending::<()>()).await });
    drop(client);
    let end = with_timeout(waits).await.unwrap().unwrap_err();
    assert!(matches!(end, SessionEnd::Lost(_)), "{end:?}");

    // Nor does one whose line is dead.
    let impatient = BridgeOptions {
        ping_interval: Duration::from_millis(10),
        idle_timeout: Duration::from_millis(100),
        close_timeout: Duration::from_millis(10),
        ..BridgeOptions::default()
    };
    let (mut waiting, _silent) = connection(&impatient).await;
    let end = with_timeout(waiting.wait_for(std::future::pending::<()>())).await;
    assert!(matches!(end, Err(SessionEnd::Closed { code: 1001, .. })), "{end:?}");
}

#[tokio::test]
async fn what_was_said_meanwhile_is_carried_out_in_order() {
    let world = World::new().await;
    let mut heard = world.node_subscribes("/text", "std_msgs/String").await;
    let (mut waiting, mut client) = connection(&BridgeOptions::default()).await;
    let (come, servant) = oneshot::channel();
    let bridge = world.bridge.clone();
    let session = tokio::spawn(async move {
        let bridge: Arc<bridge::Bridge> = waiting.wait_for(servant).await.unwrap().unwrap();
        bridge.serve_waiting(waiting, SessionOptions::default()).await
    });
    let say = |message: Value| Message::text(message.to_string());
    client.send(say(json!({"op": "advertise", "topic": "/text", "type": "std_msgs/String"}))).await.unwrap();
    // More than the socket holds: none of it is lost.
    let padding = "x".repeat(40_000);
    let messages = 60;
    let (mut sending, mut receiving) = client.split();
    let talk = tokio::spawn(async move {
        for number in 0..messages {
            let data = format!("{number}{padding}");
            let publish = json!({"op": "publish", "topic": "/text", "msg": {"data": data}});
            sending.send(say(publish)).await.unwrap();
        }
        sending
    });
    // It is read before the servant is ready: a ping in the middle would be answered, too.
    let mut ahead = world.client().await;
    ahead.sync().await;
    come.send(bridge).ok().unwrap();
    for number in 0..messages {
        let message = with_timeout(heard.messages.recv()).await.unwrap();
        let data = world.json("std_msgs/String", &message.bytes)["data"].clone();
        let data = data.as_str().unwrap();
        assert_eq!(data.trim_end_matches('x'), number.to_string());
    }
    let mut sending = with_timeout(talk).await.unwrap();
    sending.send(Message::Close(None)).await.unwrap();
    let closed = with_timeout(receiving.next()).await.unwrap().unwrap();
    assert_eq!(closed, Message::Close(None));
    with_timeout(session).await.unwrap();
}

#[tokio::test]
async fn who_cannot_have_a_servant_is_told_why() {
    let (waiting, mut client) = connection(&BridgeOptions::default()).await;
    let refusing = tokio::spawn(waiting.refuse(1013, "the machine is full"));
    let status = next(&mut client).await;
    assert!(status.to_text().unwrap().contains("the machine is full"));
    let Message::Close(Some(close)) = next(&mut client).await else { panic!("not closed") };
    assert_eq!(u16::from(close.code), 1013);
    while with_timeout(client.next()).await.is_some() {}
    with_timeout(refusing).await.unwrap();
}

/// Sends the same message this many times.
async fn say(client: &mut Socket, message: &Value, times: usize) {
    for _ in 0..times {
        let message = Message::text(message.to_string());
        with_timeout(client.send(message)).await.unwrap();
    }
}

#[tokio::test]
async fn who_has_said_much_is_heard_all_the_same() {
    let world = World::new().await;
    let mut heard = world.node_subscribes("/text", "std_msgs/String").await;
    let (mut waiting, mut client) = connection(&BridgeOptions::default()).await;
    let (ready, readiness) = oneshot::channel::<()>();
    let bridge = Arc::clone(&world.bridge);
    let served = tokio::spawn(async move {
        waiting.wait_for(readiness).await.unwrap().unwrap();
        bridge.serve_waiting(waiting, SessionOptions::default()).await
    });
    let advertise = json!({"op": "advertise", "topic": "/text", "type": "std_msgs/String"});
    say(&mut client, &advertise, 1).await;
    let publish = json!({"op": "publish", "topic": "/text", "msg": {"data": "x"}});
    say(&mut client, &publish, 11_000).await;
    client.send(Message::Ping("p".into())).await.unwrap();
    let told = next(&mut client).await.into_text().unwrap();
    assert!(told.contains("publish: too many messages wait"), "{told}");
    assert_eq!(next(&mut client).await, Message::Pong("p".into()));
    ready.send(()).unwrap();
    let message = with_timeout(heard.messages.recv()).await.unwrap();
    assert_eq!(world.json("std_msgs/String", &message.bytes)["data"], "x");
    client.close(None).await.unwrap();
    while with_timeout(client.next()).await.is_some() {}
    with_timeout(served).await.unwrap();

    // And may leave.
    let (mut waiting, mut client) = connection(&BridgeOptions::default()).await;
    let waits = tokio::spawn(async move { waiting.wait_for(std::future::pending::<()>()).await });
    say(&mut client, &publish, 11_000).await;
    client.close(None).await.unwrap();
    let end = with_timeout(waits).await.unwrap().unwrap_err();
    assert!(matches!(end, SessionEnd::Client { .. }), "{end:?}");
}

#[tokio::test]
async fn who_asks_for_more_than_is_kept_is_refused_with_a_reason() {
    let budget = budget::Budget::new("client x", 1 << 20);
    for (length, times, reason) in [(10, 10_001, "10000 messages of "), (400_000, 4, "the memory for client x")] {
        let (waiting, mut client) = connection(&BridgeOptions::default()).await;
        let mut waiting = waiting.with_budget(&budget);
        let waits = tokio::spawn(async move { waiting.wait_for(std::future::pending::<()>()).await });
        let call = json!({"op": "call_service", "service": "/s", "args": {"x": "x".repeat(length)}});
        say(&mut client, &call, times).await;
        let told = next(&mut client).await.into_text().unwrap();
        assert!(told.contains(reason), "{told}");
        let end = with_timeout(async {
            while let Some(Ok(_)) = client.next().await {}
            waits.await.unwrap().unwrap_err()
        })
        .await;
        assert!(matches!(end, SessionEnd::Closed { code: 1013, .. }), "{end:?}");
        assert_eq!(budget.used_bytes(), 0);
    }
}
