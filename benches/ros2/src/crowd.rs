//! Many servants at once, as one daemon is beside them: each a namespace with a node in it, and from outside a participant of ours, or all that a
//! daemon has before a servant, with a robot's session. The nodes are of our making here and not rclpy's, of which fifty would need gigabytes.

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use bridge::SessionOptions;
use futures_util::future::try_join_all;
use futures_util::{SinkExt as _, StreamExt as _};
use ros::schema::Registry;
use rtps::{EndpointQos, Participant};
use serde_json::json;
use servant::netns::NetNs;
use tokio::io::DuplexStream;
use tokio::runtime::{Builder, Handle, Runtime};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::Role;

use crate::ends::{hears, join_in, matched, reads, writes};
use crate::message::{self, STRING};
use crate::portal;
use crate::process::Process;
use crate::roles::say;
use crate::types;

/// How many topics a node has in each direction: rclpy's nodes have seven services, `/rosout` and `/parameter_events`.
const TOPICS: usize = 9;
/// Names of the threads of either side.
const OURS: &str = "ours";
const NODES: &str = "nodes";
/// What discovery takes is over by then.
const SETTLED: Duration = Duration::from_secs(5);

/// The longest that a message may take.
const LONG: Duration = Duration::from_secs(15);

/// Ends stay open until it is dropped.
type Held = Box<dyn Send>;

fn runtime(name: &str) -> Result<Runtime> {
    let mut builder = Builder::new_multi_thread();
    Ok(builder
        .worker_threads(1)
        .thread_name(name)
        // A thread that ends would take its time with it.
        .thread_keep_alive(Duration::from_secs(3600))
        .enable_all()
        .build()?)
}

/// What the end of a session can hold that is not read.
const PIPE: usize = 64 << 10;

/// `crowd participants|servants COUNT SECONDS`: what each takes while nothing happens.
pub(crate) fn play(what: &str, count: usize, seconds: u64) -> Result<()> {
    let servants = match what {
        "participants" => false,
        "servants" => true,
        _ => bail!("a crowd is of participants or servants, not of {what}"),
    };
    // Servants of one revision share it.
    let known = Arc::new(types::registry()?);
    let (nodes, ours) = (runtime(NODES)?, runtime(OURS)?);
    let networks = (0..count)
        .map(|_| NetNs::create())
        .collect::<Result<Vec<_>, _>>()?;
    let same = |network: &NetNs| anyhow::Ok(network.run(NetNs::current)??);
    let mut held: Vec<Held> = Vec::new();
    for network in &networks {
        let network = same(network)?;
        held.push(nodes.block_on(node(network))?);
    }
    let this = Process::this();
    // The threads of the runtime have their stacks by then.
    ours.block_on(async { tokio::spawn(async {}).await })?;
    std::thread::sleep(SETTLED);
    let (memory, descriptors, threads) = (this.resident()?, this.descriptors()?, this.threads()?);
    let all = networks.iter().map(same).collect::<Result<Vec<_>>>()?;
    held.extend(match servants {
        // Together: the bus waits a moment for the name of whoever sends a first message.
        true => ours.block_on(try_join_all(
            all.into_iter()
                .map(|network| session(network, &known, nodes.handle())),
        ))?,
        false => ours.block_on(try_join_all(all.into_iter().map(client)))?,
    });
    say(&json!({}));
    std::thread::sleep(SETTLED);
    let (before, begun) = (this.processor(OURS)?, Instant::now());
    std::thread::sleep(Duration::from_secs(seconds));
    let spent = this.processor(OURS)? - before;
    let share = spent.as_secs_f64() / begun.elapsed().as_secs_f64() * 100.0;
    let each = |more: f64| more / count as f64;
    say(&json!({
        "share": each(share),
        "memory": each(this.resident()? - memory),
        "descriptors": each((this.descriptors()? - descriptors) as f64),
        "threads": this.threads()? - threads,
    }));
    Ok(())
}

async fn node(network: NetNs) -> Result<Held> {
    let participant = join_in(network).await?;
    let ends: Vec<_> = (0..TOPICS)
        .map(|number| {
            let (asked, told) = (format!("rt/asked_{number}"), format!("rt/told_{number}"));
            let reader = hears(&participant, (&asked, STRING), EndpointQos::default(), drop);
            (
                reader,
                writes(&participant, (&told, STRING), EndpointQos::default()),
            )
        })
        .collect();
    Ok(Box::new((participant, ends)))
}

/// As a portal's: it reads one topic of the node and writes another.
async fn client(network: NetNs) -> Result<Held> {
    let participant: Participant = join_in(network).await?;
    let (reader, samples) = reads(&participant, ("rt/told_0", STRING), EndpointQos::default());
    let writer = writes(&participant, ("rt/asked_0", STRING), EndpointQos::default());
    matched(reader.ends()).await?;
    matched(writer.ends()).await?;
    Ok(Box::new((participant, reader, samples, writer)))
}

/// As a daemon's of a servant: a bus, a bridge, and a robot that subscribes to one topic of the node and advertises another.
async fn session(network: NetNs, known: &Arc<Registry>, nodes: &Handle) -> Result<Held> {
    let same = network.run(NetNs::current)??;
    let bridge = portal::bridge_in(network, known).await?;
    let (end, served) = tokio::io::duplex(PIPE);
    let serving = bridge.clone();
    tokio::spawn(async move { serving.serve(served, SessionOptions::default()).await });
    let mut robot = nodes.spawn(robot(same, end)).await??;
    // It answers pings.
    nodes.spawn(async move { while robot.next().await.is_some_and(|next| next.is_ok()) {} });
    Ok(Box::new(bridge))
}

/// The robot's end of a session, when it has heard a message: so the session is known to work.
async fn robot(network: NetNs, end: DuplexStream) -> Result<WebSocketStream<DuplexStream>> {
    // A second node of the network, which leaves again.
    let other = join_in(network).await?;
    let told = writes(&other, ("rt/told_0", STRING), EndpointQos::default());
    let mut robot = WebSocketStream::from_raw_socket(end, Role::Client, None).await;
    for op in [
        json!({"op": "subscribe", "topic": "/told_0", "type": types::STRING}),
        json!({"op": "advertise", "topic": "/asked_0", "type": types::STRING}),
    ] {
        robot.send(Message::text(op.to_string())).await?;
    }
    matched(told.ends()).await?;
    told.write(message::string("heard"));
    let heard = tokio::time::timeout(LONG, robot.next()).await;
    let heard = heard
        .context("the robot hears nothing")?
        .context("the session has ended")??;
    ensure!(
        heard.to_text()?.contains("heard"),
        "the robot hears {heard}"
    );
    Ok(robot)
}
