//! Many servants at once, as one daemon is beside them: each a namespace with a node in it and a participant of ours from outside. The nodes
//! are of our making here and not rclpy's, of which fifty would need gigabytes.

use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use rtps::{EndpointQos, Participant};
use serde_json::json;
use servant::netns::NetNs;
use tokio::runtime::{Builder, Runtime};

use crate::ends::{hears, join_in, matched, reads, writes};
use crate::message::STRING;
use crate::process::Process;
use crate::roles::say;

/// How many topics a node has in each direction: rclpy's nodes have seven services, `/rosout` and `/parameter_events`.
const TOPICS: usize = 9;
/// Names of the threads of either side.
const OURS: &str = "ours";
const NODES: &str = "nodes";
/// What discovery takes is over by then.
const SETTLED: Duration = Duration::from_secs(5);

/// Ends stay open until it is dropped.
type Held = Box<dyn Send>;

fn runtime(name: &str) -> Result<Runtime> {
    let mut builder = Builder::new_multi_thread();
    Ok(builder
        .worker_threads(1)
        .thread_name(name)
        .enable_all()
        .build()?)
}

/// `crowd COUNT SECONDS`: what each participant of ours takes while nothing happens.
pub(crate) fn play(count: usize, seconds: u64) -> Result<()> {
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
    for network in &networks {
        let network = same(network)?;
        held.push(
            ours.block_on(client(network))
                .context("a participant of ours")?,
        );
    }
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
