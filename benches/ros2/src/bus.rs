//! The roles of `roles.rs` on a bus (`ros::bus`), which is the interface that portal and stub use; and actions, which
//! only a bus provides.

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use async_trait::async_trait;
use bytes::Bytes;
use ros::JoinOptions;
use ros::bus::{
    ActionHandler, Bus, FailureReason, GoalEnd, GoalError, GoalEvents, GoalOutcome, Publisher, QosProfile, RosVersion,
    ServiceHandler, ServiceType, Subscription, WireType, wait_for_connected,
};
use ros::net::HostSockets;
use ros::schema::ActionDef;
use serde_json::json;
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};

use crate::measuring::{PATIENCE, WARM, print_json, quantiles, wait_for_request};
use crate::message::{self, TEXT};
use crate::types;

/// Quality of service of the rclpy nodes that these roles communicate with.
const QUALITY: QosProfile = QosProfile::keep_last(10);
/// Maximum time for discovery.
const LONG: Duration = Duration::from_secs(15);

/// Runs the role that `words` names.
pub(crate) async fn run(words: &[&str]) -> Result<()> {
    match words {
        ["relay"] => run_relay().await,
        ["trips", count] => time_trips(count.parse()?).await,
        ["calls", count] => time_calls(count.parse()?).await,
        ["goals", count] => time_goals(count.parse()?).await,
        _ => bail!("no role of a bus is called {words:?}"),
    }
}

/// The types of the benchmark's topics, services and actions.
struct BenchTypes {
    string: WireType,
    call: ServiceType,
    goal: Arc<ActionDef>,
}

impl BenchTypes {
    fn new() -> Result<Self> {
        let known = types::registry()?;
        Ok(Self {
            string: WireType::from_message(&*known.message(types::STRING)?),
            call: ServiceType::from_service(&*known.service(types::CALL)?),
            goal: known.action(types::GOAL)?,
        })
    }
}

async fn join_bus(node: &str) -> Result<Arc<dyn Bus>> {
    let options = JoinOptions::in_domain(0, node);
    Ok(ros::connect(RosVersion::Two, Arc::new(HostSockets), options).await?)
}

struct EchoService;

#[async_trait]
impl ServiceHandler for EchoService {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        Ok(message::set_bool_response(&request))
    }
}

struct GoalQueue(UnboundedSender<String>);

impl ActionHandler for GoalQueue {
    fn on_goal(&self, id: &str, _goal: Bytes) -> Result<(), FailureReason> {
        self.0.send(id.to_owned()).map_err(|_| FailureReason::new("nobody carries it out"))
    }

    fn on_cancel(&self, _id: &str) {}

    fn on_failed(&self, reason: &str) {
        eprintln!("the action is not served: {reason}");
    }
}

/// Runs the role `relay`: returns every ping, answers calls, and ends each goal after one feedback.
async fn run_relay() -> Result<()> {
    let (types, bus) = (BenchTypes::new()?, join_bus("/relay").await?);
    let mut pings = bus.subscribe("/ping", types.string.clone(), QUALITY).await?;
    let pong = bus.advertise("/pong", types.string, QUALITY).await?;
    let _served = bus.serve("/setbool", types.call, Arc::new(EchoService)).await?;
    let (sender, mut ids) = unbounded_channel();
    let server = bus.serve_action("/fibonacci", &types.goal, Arc::new(GoalQueue(sender)))?;
    print_json(&json!({}));
    let work = async {
        loop {
            tokio::select! {
                Some(ping) = pings.messages.recv() => pong.publish(ping.bytes),
                Some(id) = ids.recv() => {
                    server.publish_feedback(&id, message::fibonacci_sequence());
                    server.end_goal(&id, GoalEnd {
                        outcome: GoalOutcome::Succeeded,
                        text: String::new(),
                        result: message::fibonacci_sequence(),
                    });
                }
            }
        }
    };
    tokio::select! {
        () = work => {}
        asked = wait_for_request() => drop(asked?),
    }
    bus.close().await;
    Ok(())
}

/// Connects to the topics of [`run_relay`] in both directions.
async fn connect_topics(bus: &dyn Bus, of: WireType) -> Result<(Box<dyn Publisher>, Subscription)> {
    let pongs = bus.subscribe("/pong", of.clone(), QUALITY).await?;
    let pings = bus.advertise("/ping", of, QUALITY).await?;
    let both = async {
        wait_for_connected(pings.matched_subscribers(), 1).await;
        wait_for_connected(pongs.matched.clone(), 1).await;
    };
    tokio::time::timeout(LONG, both).await.context("nobody is at the other end")?;
    Ok((pings, pongs))
}

/// Measures round trips of Strings, one at a time.
async fn time_trips(count: usize) -> Result<()> {
    let (types, bus) = (BenchTypes::new()?, join_bus("/asks").await?);
    let (pings, mut pongs) = connect_topics(&*bus, types.string).await?;
    print_json(&json!({}));
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
    print_json(&quantiles(&times));
    Ok(())
}

/// Measures calls, one at a time.
async fn time_calls(count: usize) -> Result<()> {
    let bus = join_bus("/asks").await?;
    let mut graph = bus.graph();
    let known = graph.wait_for(|graph| graph.services.contains_key("/setbool"));
    tokio::time::timeout(LONG, known).await.context("no server")??;
    // The first call waits until the server has discovered our endpoints.
    bus.call("/setbool", message::set_bool_request(true), LONG).await?;
    print_json(&json!({}));
    let mut times = Vec::with_capacity(count);
    for number in 0..count + WARM {
        let begun = Instant::now();
        bus.call("/setbool", message::set_bool_request(true), PATIENCE).await?;
        if number >= WARM {
            times.push(begun.elapsed());
        }
    }
    print_json(&quantiles(&times));
    Ok(())
}

struct GoalListener {
    ends: UnboundedSender<Result<GoalEnd, GoalError>>,
    feedbacks: UnboundedSender<()>,
}

impl GoalEvents for GoalListener {
    fn on_feedback(&self, _feedback: Bytes) {
        // The receiver is gone if the goal has been given up.
        let _ = self.feedbacks.send(());
    }

    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        let _ = self.ends.send(end);
    }
}

/// Measures goals from sending to result, one at a time.
async fn time_goals(count: usize) -> Result<()> {
    let (types, bus) = (BenchTypes::new()?, join_bus("/asks").await?);
    let client = bus.action_client("/fibonacci", &types.goal)?;
    client.wait_for_server(LONG).await?;
    let (ends, mut ended) = unbounded_channel();
    let (feedbacks, mut fed) = unbounded_channel();
    let events: Arc<dyn GoalEvents> = Arc::new(GoalListener { ends, feedbacks });
    print_json(&json!({}));
    let mut times = Vec::with_capacity(count);
    for number in 0..count + WARM {
        let begun = Instant::now();
        client.send_goal(&number.to_string(), message::fibonacci_goal(), events.clone());
        let end = next_event(&mut ended).await??;
        ensure!(end.outcome == GoalOutcome::Succeeded, "{end:?}");
        if number >= WARM {
            times.push(begun.elapsed());
        }
    }
    // Every goal has had one feedback.
    for _ in 0..count + WARM {
        next_event(&mut fed).await.context("a feedback")?;
    }
    print_json(&quantiles(&times));
    Ok(())
}

async fn next_event<T>(events: &mut UnboundedReceiver<T>) -> Result<T> {
    tokio::time::timeout(PATIENCE, events.recv()).await?.context("the bus is closed")
}
