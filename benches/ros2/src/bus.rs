//! The roles of a node on a bus (`ros::bus`), the interface that portal and stub use. `peer.py` has the same roles, so
//! that each side can be either's.

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use async_trait::async_trait;
use bench_report::Process;
use bytes::Bytes;
use ros::JoinOptions;
use ros::bus::{
    ActionHandler, Bus, FailureReason, GoalEnd, GoalError, GoalEvents, GoalOutcome, Publisher, QosProfile,
    QosReliability, RosVersion, ServiceHandler, ServiceType, Subscription, WireType, wait_for_connected,
};
use ros::net::{HostSockets, Sockets};
use ros::schema::ActionDef;
use serde_json::json;
use tokio::sync::mpsc::{UnboundedReceiver, UnboundedSender, unbounded_channel};
use tokio::time::timeout;

use crate::exchanges::{PATIENCE, print_json, print_ready, time_exchanges, wait_for_request};
use crate::messages::{self, Size, TEXT};
use crate::pictures::{FrameStatistics, RATE, SETTLED};

/// Quality of service of the rclpy nodes that these roles communicate with.
const QUALITY: QosProfile = QosProfile::keep_last(10);
/// Maximum time for discovery.
pub(crate) const LONG: Duration = Duration::from_secs(15);

/// Runs the role that `words` names.
pub(crate) async fn run(words: &[&str]) -> Result<()> {
    match words {
        ["relay"] => run_relay(QUALITY).await,
        ["relay", depth] => run_relay(QosProfile::keep_last(depth.parse()?)).await,
        ["trips", count] => time_trips(count.parse()?).await,
        ["calls", count] => time_calls(count.parse()?).await,
        ["goals", count] => time_goals(count.parse()?).await,
        ["joins"] => time_join().await,
        ["rests"] => measure_idle().await,
        ["sends", width, height, frames, reliable] => {
            let size = Size { width: width.parse()?, height: height.parse()? };
            send_pictures(size, frames.parse()?, picture_quality(reliable, 5)).await
        }
        // A second of pictures, so that none is lost between the bus and this role.
        ["takes", reliable] => receive_pictures(picture_quality(reliable, 30)).await,
        _ => bail!("no role is called {words:?}"),
    }
}

/// The types of the benchmark's topics, services and actions.
struct BenchTypes {
    string: WireType,
    image: WireType,
    call: ServiceType,
    goal: Arc<ActionDef>,
}

impl BenchTypes {
    fn new() -> Result<Self> {
        let known = messages::registry()?;
        let message = |name| anyhow::Ok(WireType::from_message(&*known.message(name)?));
        Ok(Self {
            string: message(messages::STRING)?,
            image: message(messages::IMAGE)?,
            call: ServiceType::from_service(&*known.service(messages::CALL)?),
            goal: known.action(messages::GOAL)?,
        })
    }
}

/// Returns the type of a String.
pub(crate) fn string_type() -> Result<WireType> {
    Ok(BenchTypes::new()?.string)
}

/// Joins the nodes of a network.
pub(crate) async fn join(sockets: Arc<dyn Sockets>, node: &str) -> Result<Arc<dyn Bus>> {
    Ok(ros::connect(RosVersion::Two, sockets, JoinOptions::in_domain(0, node)).await?)
}

/// Joins the nodes of this process's network.
async fn join_here(node: &str) -> Result<(BenchTypes, Arc<dyn Bus>)> {
    Ok((BenchTypes::new()?, join(Arc::new(HostSockets), node).await?))
}

struct EchoService;

#[async_trait]
impl ServiceHandler for EchoService {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        Ok(messages::set_bool_response(&request))
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
async fn run_relay(quality: QosProfile) -> Result<()> {
    let (types, bus) = join_here("/relay").await?;
    let mut pings = bus.subscribe("/ping", types.string.clone(), quality).await?;
    let pong = bus.advertise("/pong", types.string, quality).await?;
    let _served = bus.serve("/setbool", types.call, Arc::new(EchoService)).await?;
    let (sender, mut ids) = unbounded_channel();
    let server = bus.serve_action("/fibonacci", &types.goal, Arc::new(GoalQueue(sender)))?;
    print_ready();
    let work = async {
        loop {
            tokio::select! {
                Some(ping) = pings.messages.recv() => pong.publish(ping.bytes),
                Some(id) = ids.recv() => {
                    let result = messages::fibonacci_sequence();
                    server.publish_feedback(&id, result.clone());
                    let outcome = GoalOutcome::Succeeded;
                    server.end_goal(&id, GoalEnd { outcome, text: String::new(), result });
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

/// Opens the topics of [`run_relay`] in both directions and waits until they are connected.
async fn connect_topics(bus: &dyn Bus, of: WireType) -> Result<(Box<dyn Publisher>, Subscription)> {
    let pongs = bus.subscribe("/pong", of.clone(), QUALITY).await?;
    let pings = bus.advertise("/ping", of, QUALITY).await?;
    wait_for_subscriber(&*pings).await?;
    let matched = wait_for_connected(pongs.matched.clone(), 1);
    timeout(LONG, matched).await.context("nobody is at the other end")?;
    Ok((pings, pongs))
}

/// Waits until somebody subscribes to what `publisher` publishes.
pub(crate) async fn wait_for_subscriber(publisher: &dyn Publisher) -> Result<()> {
    let matched = wait_for_connected(publisher.matched_subscribers(), 1);
    timeout(LONG, matched).await.context("nobody is at the other end")
}

/// Measures round trips of Strings, one at a time.
async fn time_trips(count: usize) -> Result<()> {
    let (types, bus) = join_here("/asks").await?;
    let (pings, mut pongs) = connect_topics(&*bus, types.string).await?;
    time_exchanges(count, async |number| {
        let text = messages::string(&format!("{TEXT}, {number}"));
        let begun = Instant::now();
        pings.publish(text.clone());
        let pong = timeout(PATIENCE, pongs.messages.recv()).await;
        let took = begun.elapsed();
        let pong = pong.ok().flatten().context("a pong")?;
        ensure!(pong.bytes == text, "another pong: {:?}", pong.bytes);
        Ok(took)
    })
    .await
}

/// Measures calls, one at a time.
async fn time_calls(count: usize) -> Result<()> {
    let (_, bus) = join_here("/asks").await?;
    let mut graph = bus.graph();
    let known = graph.wait_for(|graph| graph.services.contains_key("/setbool"));
    timeout(LONG, known).await.context("no server")??;
    // The first call waits until the server has discovered our endpoints.
    bus.call("/setbool", messages::set_bool_request(), LONG).await?;
    time_exchanges(count, async |_| {
        let begun = Instant::now();
        bus.call("/setbool", messages::set_bool_request(), PATIENCE).await?;
        Ok(begun.elapsed())
    })
    .await
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

/// Measures goals from sending to result, one at a time; each must have had its feedback.
async fn time_goals(count: usize) -> Result<()> {
    let (types, bus) = join_here("/asks").await?;
    let client = bus.action_client("/fibonacci", &types.goal)?;
    client.wait_for_server(LONG).await?;
    let (ends, mut ended) = unbounded_channel();
    let (feedbacks, mut fed) = unbounded_channel();
    let events: Arc<dyn GoalEvents> = Arc::new(GoalListener { ends, feedbacks });
    time_exchanges(count, async |number| {
        let begun = Instant::now();
        client.send_goal(&number.to_string(), messages::fibonacci_goal(), events.clone());
        let end = next_event(&mut ended).await??;
        let took = begun.elapsed();
        ensure!(end.outcome == GoalOutcome::Succeeded, "{end:?}");
        next_event(&mut fed).await.context("a feedback")?;
        Ok(took)
    })
    .await
}

async fn next_event<T>(events: &mut UnboundedReceiver<T>) -> Result<T> {
    timeout(PATIENCE, events.recv()).await?.context("the bus is closed")
}

/// Joins a running node; measures until its first message arrives, and until one of ours has been returned.
async fn time_join() -> Result<()> {
    print_ready();
    let begun = Instant::now();
    let (types, bus) = join_here("/newcomer").await?;
    let mut beats = bus.subscribe("/beat", types.string.clone(), QUALITY).await?;
    let mut pongs = bus.subscribe("/pong", types.string.clone(), QUALITY).await?;
    let pings = bus.advertise("/ping", types.string, QUALITY).await?;
    let pinging = async {
        loop {
            pings.publish(messages::string("ping"));
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    };
    let since = async |topic: &mut Subscription| {
        let came = timeout(LONG, topic.messages.recv()).await.ok().flatten();
        came.map(|_| begun.elapsed().as_secs_f64() * 1e3).context("nothing comes from the node")
    };
    let both = async { tokio::try_join!(since(&mut beats), since(&mut pongs)) };
    let (beat, pong) = tokio::select! {
        both = both => both?,
        () = pinging => unreachable!("it pings for ever"),
    };
    print_json(&json!({"beat": beat, "pong": pong}));
    Ok(())
}

/// Measures the resources of a matched and idle bus.
async fn measure_idle() -> Result<()> {
    let this = Process::current();
    // The runtime's own threads and descriptors are not the bus's.
    tokio::task::spawn_blocking(|| ()).await?;
    let (memory, descriptors, threads) = (this.resident()?, this.descriptors()?, this.threads()?);
    let (types, bus) = join_here("/rests").await?;
    let _open = connect_topics(&*bus, types.string).await?;
    print_ready();
    while wait_for_request().await? {
        print_json(&json!({
            "memory": this.resident()? - memory, "process": this.resident()?,
            "descriptors": this.descriptors()? - descriptors, "threads": this.threads()? - threads,
        }));
    }
    Ok(())
}

fn picture_quality(reliable: &str, depth: usize) -> QosProfile {
    let reliability = if reliable == "1" { QosReliability::Reliable } else { QosReliability::BestEffort };
    QosProfile { reliability, ..QosProfile::keep_last(depth) }
}

/// Sends pictures once somebody takes them; prints its processor time and how many frames were late.
async fn send_pictures(size: Size, frames: u32, quality: QosProfile) -> Result<()> {
    let (types, bus) = join_here("/sends").await?;
    let camera = bus.advertise("/pictures", types.image, quality).await?;
    print_ready();
    wait_for_subscriber(&*camera).await?;
    tokio::time::sleep(SETTLED).await;
    let this = Process::current();
    let (before, mut due, mut late) = (this.live_thread_time("")?, Instant::now(), 0);
    for number in 0..frames {
        camera.publish(messages::picture(number, size));
        due += Duration::from_secs_f64(1.0 / RATE);
        late += u32::from(Instant::now() > due);
        tokio::time::sleep_until(due.into()).await;
    }
    // Time for retransmissions.
    tokio::time::sleep(Duration::from_secs(2)).await;
    let spent = (this.live_thread_time("")? - before).as_secs_f64() * 1e3;
    print_json(&json!({"processor": spent, "late": late, "peak": this.peak()?}));
    wait_for_request().await.map(drop)
}

/// Takes pictures; prints what was received when asked.
async fn receive_pictures(quality: QosProfile) -> Result<()> {
    let (types, bus) = join_here("/takes").await?;
    let mut pictures = bus.subscribe("/pictures", types.image, quality).await?;
    let this = Process::current();
    let before = this.live_thread_time("")?;
    print_ready();
    let mut seen = FrameStatistics::default();
    let watch = async {
        while let Some(picture) = pictures.messages.recv().await {
            if seen.record(&picture.bytes).is_none() {
                eprintln!("a message of {} bytes is no picture", picture.bytes.len());
            }
        }
    };
    tokio::select! {
        () = watch => {}
        asked = wait_for_request() => drop(asked?),
    }
    let mut told = seen.to_json();
    told["processor"] = ((this.live_thread_time("")? - before).as_secs_f64() * 1e3).into();
    told["peak"] = this.peak()?.into();
    print_json(&told);
    Ok(())
}
