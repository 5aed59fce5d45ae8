//! Data queued for clients that do not read counts in budgets until it is written.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bridge::{BridgeOptions, SessionOptions};
use budget::Budget;
use bytes::Bytes;
use ros::bus::{FailureReason, ServiceHandler, ServiceType};
use serde_json::{Value, json};

use super::support::{Client, World, patient, wait_connected, with_timeout};

const MIB: usize = 1 << 20;

/// Budgets of the daemon, a servant and a client.
struct Budgets {
    daemon: Budget,
    servant: Budget,
    client: Budget,
}

impl Budgets {
    fn new(client: usize) -> Self {
        let daemon = Budget::new("the daemon", 64 * MIB);
        Self { servant: daemon.child("servant x", 32 * MIB), client: daemon.child("client x", client), daemon }
    }

    async fn world(&self) -> World {
        World::with_options(BridgeOptions { budget: self.servant.clone(), ..patient() }).await
    }

    async fn client(&self, world: &World) -> Client {
        let options = SessionOptions { budget: self.client.clone(), ..SessionOptions::default() };
        world.client_with(options).await
    }

    async fn assert_empty(&self) {
        wait_until(|| self.daemon.used_bytes() == 0).await;
        assert_eq!((self.client.used_bytes(), self.servant.used_bytes()), (0, 0));
    }
}

/// Polls, since budgets have no events.
async fn wait_until(condition: impl Fn() -> bool) {
    with_timeout(async {
        while !condition() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    })
    .await;
}

fn bytes(world: &World, length: usize) -> Bytes {
    let mut message = (length as u32).to_le_bytes().to_vec();
    message.resize(4 + length, 7);
    world.serialize(&message)
}

fn length(message: &Value) -> usize {
    message["msg"]["data"].as_str().map_or(0, str::len)
}

async fn subscribe_big(client: &mut Client, fragment_size: Option<usize>) {
    let mut subscribe = json!({"op": "subscribe", "topic": "/big"});
    if let Some(size) = fragment_size {
        subscribe["fragment_size"] = size.into();
    }
    client.send(subscribe).await;
    client.sync().await;
}

#[tokio::test]
async fn a_message_counts_for_its_client_until_it_is_read() {
    let budgets = Budgets::new(8 * MIB);
    let world = budgets.world().await;
    let publisher = world.node_publishes("/big", "std_msgs/UInt8MultiArray", false).await;
    for fragment_size in [None, Some(10_000), Some(MIB)] {
        let mut client = budgets.client(&world).await;
        subscribe_big(&mut client, fragment_size).await;
        wait_connected(publisher.as_ref(), 1).await;
        publisher.publish(bytes(&world, 2 * MIB));
        wait_until(|| budgets.client.used_bytes() > 2 * MIB).await;
        // The servant's budget only counted the message while it was being encoded.
        wait_until(|| budgets.servant.used_bytes() == 0).await;
        assert!(budgets.daemon.used_bytes() > 2 * MIB);
        match fragment_size {
            None => assert!(length(&client.json().await) > 2 * MIB),
            Some(_) => loop {
                let fragment = client.json().await;
                assert_eq!(fragment["op"], "fragment");
                if fragment["num"].as_u64().unwrap() + 1 == fragment["total"] {
                    break;
                }
            },
        }
        client.sync().await;
        budgets.assert_empty().await;
    }
}

#[tokio::test]
async fn connections_that_read_nothing_hold_no_more_than_their_clients_budget() {
    let budgets = Budgets::new(8 * MIB);
    let world = budgets.world().await;
    let publisher = world.node_publishes("/big", "std_msgs/UInt8MultiArray", false).await;
    let mut slow = Vec::new();
    for _ in 0..6 {
        slow.push(budgets.client(&world).await);
    }
    let mut quick = world.client().await;
    for client in slow.iter_mut().chain([&mut quick]) {
        subscribe_big(client, None).await;
    }
    wait_connected(publisher.as_ref(), 1).await;
    publisher.publish(bytes(&world, 2 * MIB));
    assert!(length(&quick.json().await) > 2 * MIB);
    // In base64 it is 2.7 MiB: there is room for two. Messages of the others were dropped, from their queue or before
    // it.
    wait_until(|| budgets.client.refusal_count() >= 4).await;
    assert!(budgets.client.used_bytes() <= 8 * MIB);
    // Clients that have it hold the same bytes.
    wait_until(|| budgets.daemon.used_bytes() < 3 * MIB).await;
    let mut whole = 0;
    for client in &mut slow {
        let call = json!({"op": "call_service", "id": "end", "service": "/rosapi/get_ros_version"});
        client.send(call).await;
        loop {
            let heard = client.json().await;
            match heard["op"].as_str() {
                Some("publish") => whole += 1,
                Some("status") => {
                    let told = heard["msg"].as_str().unwrap_or_default();
                    assert!(told.contains("the memory for client x"), "{told}");
                }
                _ => break assert_eq!(heard["id"], "end", "{heard}"),
            }
        }
    }
    assert!((1..=2).contains(&whole), "{whole}");
    budgets.assert_empty().await;
}

#[tokio::test]
async fn messages_that_wait_for_a_client_give_way_to_each_other_within_its_budget() {
    let budgets = Budgets::new(2 * MIB);
    let world = budgets.world().await;
    let publisher = world.node_publishes("/big", "std_msgs/UInt8MultiArray", false).await;
    let (mut slow, mut quick) = (budgets.client(&world).await, world.client().await);
    for client in [&mut slow, &mut quick] {
        client.send(json!({"op": "subscribe", "topic": "/big", "compression": "cbor-raw"})).await;
        client.sync().await;
    }
    wait_connected(publisher.as_ref(), 1).await;
    // Some count for the daemon by themselves, some do not.
    let mut newest = 0;
    for size in (0..200).map(|number| 10_000 + number + number % 2 * 100_000) {
        publisher.publish(bytes(&world, size));
        newest = quick.binary().await.len();
        assert!(newest > size);
    }
    assert!(budgets.client.used_bytes() > MIB);
    assert!(world.bridge.metrics().dropped.get() > 0);
    assert!(budgets.client.used_bytes() <= 2 * MIB);
    // The newest is among those that were kept.
    while slow.next().await.into_data().len() < newest {}
    slow.sync().await;
    budgets.assert_empty().await;
}

/// A service with a constant answer.
struct Says(Bytes);

#[async_trait]
impl ServiceHandler for Says {
    async fn call(&self, _request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        Ok(self.0.clone())
    }
}

#[tokio::test]
async fn who_asks_and_does_not_read_the_answers_loses_the_connection() {
    // Answers that count by themselves, and those that count together: some are in the pipe, some fit, then one does
    // not.
    for (size, calls) in [(200_000, 8), (30_000, 40)] {
        let budgets = Budgets::new(300_000);
        let world = budgets.world().await;
        let mut client = budgets.client(&world).await;
        let words = json!({"words": "x".repeat(size)});
        let say = world.registry.service("x_msgs/Say").unwrap();
        let words = world.message(say.response.name(), words);
        let of = ServiceType::from_service(&say);
        let served = world.node.serve("/long", of, Arc::new(Says(words)));
        let _served = served.await.unwrap();
        world.wait_for_graph(|graph| graph.services.contains_key("/long")).await;
        for _ in 0..calls {
            client.send(json!({"op": "call_service", "service": "/long"})).await;
        }
        wait_until(|| budgets.client.refusal_count() > 0).await;
        let (code, reason) = client.expect_close().await;
        assert_eq!(code, 1013, "{reason}");
        assert!(reason.contains("the memory for client x"), "{reason}");
        with_timeout(client.session).await.unwrap();
        budgets.assert_empty().await;
    }
}
