//! Many servants at once, as a daemon has them: a namespace per servant with a node in it, and outside a participant of
//! ours, or everything that a daemon sets up for a servant, with a robot's session. The nodes are implemented here;
//! fifty rclpy nodes would need gigabytes.

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use bench_report::Process;
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

use crate::ends::{create_listener, create_reader, create_writer, join_namespace, wait_until_matched};
use crate::measuring::print_json;
use crate::message::{self, STRING};
use crate::portal;
use crate::types;

/// Topics of a node in each direction: an rclpy node has seven services, `/rosout` and `/parameter_events`.
const TOPICS: usize = 9;
/// Names of the threads of either side.
const OURS: &str = "ours";
const NODES: &str = "nodes";
/// Time until discovery has finished.
const SETTLED: Duration = Duration::from_secs(5);

/// Maximum time for a message.
const LONG: Duration = Duration::from_secs(15);

/// Endpoints that stay open until drop.
type OpenEndpoints = Box<dyn Send>;

fn build_runtime(name: &str) -> Result<Runtime> {
    let mut builder = Builder::new_multi_thread();
    Ok(builder
        .worker_threads(1)
        .thread_name(name)
        // A thread that ended would take its processor time with it.
        .thread_keep_alive(Duration::from_secs(3600))
        .enable_all()
        .build()?)
}

/// Buffer size of a session's pipe.
const PIPE: usize = 64 << 10;

/// Runs the role `crowd participants|servants COUNT SECONDS`; prints the resources of each while idle.
pub(crate) fn run(what: &str, count: usize, seconds: u64) -> Result<()> {
    let servants = match what {
        "participants" => false,
        "servants" => true,
        _ => bail!("a crowd is of participants or servants, not of {what}"),
    };
    // Shared by servants of the same revision.
    let known = Arc::new(types::registry()?);
    let (nodes, ours) = (build_runtime(NODES)?, build_runtime(OURS)?);
    let networks = (0..count).map(|_| NetNs::create()).collect::<Result<Vec<_>, _>>()?;
    let same = |network: &NetNs| anyhow::Ok(network.run(NetNs::current)??);
    let mut held: Vec<OpenEndpoints> = Vec::new();
    for network in &networks {
        let network = same(network)?;
        held.push(nodes.block_on(open_node(network))?);
    }
    let this = Process::current();
    // Afterwards the runtime's threads have their stacks.
    ours.block_on(async { tokio::spawn(async {}).await })?;
    std::thread::sleep(SETTLED);
    let (memory, descriptors, threads) = (this.resident()?, this.descriptors()?, this.threads()?);
    let all = networks.iter().map(same).collect::<Result<Vec<_>>>()?;
    held.extend(if servants {
        // Concurrently, because a bus waits a moment for the name of a node that sends its first message.
        ours.block_on(try_join_all(all.into_iter().map(|network| open_session(network, &known, nodes.handle()))))?
    } else {
        ours.block_on(try_join_all(all.into_iter().map(open_client)))?
    });
    print_json(&json!({}));
    std::thread::sleep(SETTLED);
    let (before, begun) = (this.live_thread_time(OURS)?, Instant::now());
    std::thread::sleep(Duration::from_secs(seconds));
    let spent = this.live_thread_time(OURS)? - before;
    let share = spent.as_secs_f64() / begun.elapsed().as_secs_f64() * 100.0;
    let each = |more: f64| more / count as f64;
    print_json(&json!({
        "share": each(share),
        "memory": each(this.resident()? - memory),
        "descriptors": each((this.descriptors()? - descriptors) as f64),
        "threads": this.threads()? - threads,
    }));
    Ok(())
}

async fn open_node(network: NetNs) -> Result<OpenEndpoints> {
    let participant = join_namespace(network).await?;
    let ends: Vec<_> = (0..TOPICS)
        .map(|number| {
            let (asked, told) = (format!("rt/asked_{number}"), format!("rt/told_{number}"));
            let reader = create_listener(&participant, (&asked, STRING), EndpointQos::default(), drop);
            (reader, create_writer(&participant, (&told, STRING), EndpointQos::default()))
        })
        .collect();
    Ok(Box::new((participant, ends)))
}

/// Opens a participant like a portal's: it reads one topic of the node and writes another.
async fn open_client(network: NetNs) -> Result<OpenEndpoints> {
    let participant: Participant = join_namespace(network).await?;
    let (reader, samples) = create_reader(&participant, ("rt/told_0", STRING), EndpointQos::default());
    let writer = create_writer(&participant, ("rt/asked_0", STRING), EndpointQos::default());
    wait_until_matched(reader.watch_matches()).await?;
    wait_until_matched(writer.watch_matches()).await?;
    Ok(Box::new((participant, reader, samples, writer)))
}

/// Opens everything that a daemon has for a servant: a bus, a bridge, and a robot that subscribes to one topic of the
/// node and advertises another.
async fn open_session(network: NetNs, known: &Arc<Registry>, nodes: &Handle) -> Result<OpenEndpoints> {
    let same = network.run(NetNs::current)??;
    let bridge = portal::join_bridge(network, known).await?;
    let (end, served) = tokio::io::duplex(PIPE);
    let serving = bridge.clone();
    tokio::spawn(async move { serving.serve(served, SessionOptions::default()).await });
    let mut robot = nodes.spawn(connect_robot(same, end)).await??;
    // The robot answers pings.
    nodes.spawn(async move { while robot.next().await.is_some_and(|next| next.is_ok()) {} });
    Ok(Box::new(bridge))
}

/// Connects the robot's end of a session and waits for a message, which shows that the session works.
async fn connect_robot(network: NetNs, end: DuplexStream) -> Result<WebSocketStream<DuplexStream>> {
    // A second node in the network, which leaves again.
    let other = join_namespace(network).await?;
    let told = create_writer(&other, ("rt/told_0", STRING), EndpointQos::default());
    let mut robot = WebSocketStream::from_raw_socket(end, Role::Client, None).await;
    for op in [
        json!({"op": "subscribe", "topic": "/told_0", "type": types::STRING}),
        json!({"op": "advertise", "topic": "/asked_0", "type": types::STRING}),
    ] {
        robot.send(Message::text(op.to_string())).await?;
    }
    wait_until_matched(told.watch_matches()).await?;
    told.write(message::string("heard"));
    let heard = tokio::time::timeout(LONG, robot.next()).await;
    let heard = heard.context("the robot hears nothing")?.context("the session has ended")??;
    ensure!(heard.to_text()?.contains("heard"), "the robot hears {heard}");
    Ok(robot)
}
