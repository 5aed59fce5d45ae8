//! The roles of `roles.rs` once more, played by a bus (`ros::bus`), which is what the portal and the stub hold; and actions, which only a
//! bus has.

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use async_trait::async_trait;
use bytes::Bytes;
use ros::JoinOptions;
use ros::bus::{
    ActionHandler, Bus, GoalEnd, GoalEvents, Outcome, Publisher, Qos, RosVersion, ServiceHandler,
    ServiceType, Subscription, WireType, reaches,
};
use ros::net::HostSockets;
use ros::schema::ActionDef;
use serde_json::json;
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};

use crate::message::{self, TEXT};
use crate::roles::{PATIENCE, WARM, quantiles, say, until_asked};
use crate::types;

/// As rclpy's nodes have it that these roles meet.
const QUALITY: Qos = Qos::keep_last(10);
/// Discovery takes no longer.
const LONG: Duration = Duration::from_secs(15);

/// Plays the role.
pub(crate) async fn play(words: &[&str]) -> Result<()> {
    match words {
        ["relay"] => relay().await,
        ["trips", count] => trips(count.parse()?).await,
        ["calls", count] => calls(count.parse()?).await,
        ["goals", count] => goals(count.parse()?).await,
        _ => bail!("no role of a bus is called {words:?}"),
    }
}

/// What the types are.
struct Types {
    string: WireType,
    call: ServiceType,
    goal: Arc<ActionDef>,
}

impl Types {
    fn new() -> Result<Self> {
        let known = types::registry()?;
        Ok(Self {
            string: WireType::of(&*known.message(types::STRING)?),
            call: ServiceType::of(&*known.service(types::CALL)?),
            goal: known.action(types::GOAL)?,
        })
    }
}

async fn join(node: &str) -> Result<Arc<dyn Bus>> {
    let options = JoinOptions::in_domain(0, node);
    Ok(ros::connect(RosVersion::Two, Arc::new(HostSockets), options).await?)
}

struct Answers;

#[async_trait]
impl ServiceHandler for Answers {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, String> {
        Ok(message::response(&request))
    }
}

struct Takes(UnboundedSender<String>);

impl ActionHandler for Takes {
    fn goal(&self, id: &str, _goal: Bytes) -> Result<(), String> {
        self.0
            .send(id.to_owned())
            .map_err(|_| "nobody carries it out".to_owned())
    }

    fn cancel(&self, _id: &str) {}

    fn failed(&self, reason: &str) {
        eprintln!("the action is not served: {reason}");
    }
}

/// Brings every ping back, answers calls, and ends each goal after one feedback.
async fn relay() -> Result<()> {
    let (types, bus) = (Types::new()?, join("/relay").await?);
    let mut pings = bus
        .subscribe("/ping", types.string.clone(), QUALITY)
        .await?;
    let pong = bus.advertise("/pong", types.string, QUALITY).await?;
    let _served = bus.serve("/setbool", types.call, Arc::new(Answers)).await?;
    let (sender, mut ids) = unbounded_channel();
    let server = bus.serve_action("/fibonacci", &types.goal, Arc::new(Takes(sender)))?;
    say(&json!({}));
    let work = async {
        loop {
            tokio::select! {
                Some(ping) = pings.messages.recv() => pong.publish(ping.bytes),
                Some(id) = ids.recv() => {
                    server.feedback(&id, message::numbers());
                    server.end(&id, GoalEnd {
                        outcome: Outcome::Succeeded,
                        text: String::new(),
                        result: message::numbers(),
                    });
                }
            }
        }
    };
    tokio::select! {
        () = work => {}
        asked = until_asked() => drop(asked?),
    }
    bus.close().await;
    Ok(())
}

/// The other side of [`relay`]'s topics, connected in both directions.
async fn connected(bus: &dyn Bus, of: WireType) -> Result<(Box<dyn Publisher>, Subscription)> {
    let pongs = bus.subscribe("/pong", of.clone(), QUALITY).await?;
    let pings = bus.advertise("/ping", of, QUALITY).await?;
    let both = async {
        reaches(pings.matched(), 1).await;
        reaches(pongs.matched.clone(), 1).await;
    };
    tokio::time::timeout(LONG, both)
        .await
        .context("nobody is at the other end")?;
    Ok((pings, pongs))
}

/// Strings there and back, one at a time.
async fn trips(count: usize) -> Result<()> {
    let (types, bus) = (Types::new()?, join("/asks").await?);
    let (pings, mut pongs) = connected(&*bus, types.string).await?;
    say(&json!({}));
    let mut times = Vec::with_capacity(count);
    for number in 0..count + WARM {
        let text = message::string(&format!("{TEXT}, {number}"));
        let begun = Instant::now();
        pings.publish(text.clone());
        let pong = tokio::time::timeout(PATIENCE, pongs.messages.recv()).await;
        let pong = pong.ok().flatten().context("a pong")?;
        ensure!(pong.bytes == text, "another pong: {:?}", pong.bytes);
        if number >= WARM {
            times.push(begun.elapsed());
        }
    }
    say(&quantiles(&times));
    Ok(())
}

/// Calls, one at a time.
async fn calls(count: usize) -> Result<()> {
    let bus = join("/asks").await?;
    let mut graph = bus.graph();
    let known = graph.wait_for(|graph| graph.services.contains_key("/setbool"));
    tokio::time::timeout(LONG, known)
        .await
        .context("no server")??;
    // The first call waits until the server knows of our ends.
    bus.call("/setbool", message::request(true), LONG).await?;
    say(&json!({}));
    let mut times = Vec::with_capacity(count);
    for number in 0..count + WARM {
        let begun = Instant::now();
        bus.call("/setbool", message::request(true), PATIENCE)
            .await?;
        if number >= WARM {
            times.push(begun.elapsed());
        }
    }
    say(&quantiles(&times));
    Ok(())
}

struct Hears {
    ends: UnboundedSender<Result<GoalEnd, String>>,
    feedbacks: UnboundedSender<()>,
}

impl GoalEvents for Hears {
    fn feedback(&self, _feedback: Bytes) {
        // Counted where the goal has not been given up.
        let _ = self.feedbacks.send(());
    }

    fn ended(&self, end: Result<GoalEnd, String>) {
        let _ = self.ends.send(end);
    }
}

/// Goals from their sending to their result, one at a time.
async fn goals(count: usize) -> Result<()> {
    let (types, bus) = (Types::new()?, join("/asks").await?);
    let client = bus.action_client("/fibonacci", &types.goal)?;
    client.ready(LONG).await?;
    let (ends, mut ended) = unbounded_channel();
    let (feedbacks, mut fed) = unbounded_channel();
    let events: Arc<dyn GoalEvents> = Arc::new(Hears { ends, feedbacks });
    say(&json!({}));
    let mut times = Vec::with_capacity(count);
    for number in 0..count + WARM {
        let begun = Instant::now();
        client.send(&number.to_string(), message::order(), events.clone());
        let end = next(&mut ended).await?.map_err(anyhow::Error::msg)?;
        ensure!(end.outcome == Outcome::Succeeded, "{end:?}");
        if number >= WARM {
            times.push(begun.elapsed());
        }
    }
    // Each was told once how it gets on.
    for _ in 0..count + WARM {
        next(&mut fed).await.context("a feedback")?;
    }
    say(&quantiles(&times));
    Ok(())
}

async fn next<T>(events: &mut UnboundedReceiver<T>) -> Result<T> {
    tokio::time::timeout(PATIENCE, events.recv())
        .await?
        .context("the bus is closed")
}
