//! Many servants at once, as a daemon has them: in each namespace a node of ours, and outside everything that a daemon
//! sets up for a servant, with a robot's session.

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bench_report::Process;
use bridge::{Bridge, SessionOptions};
use futures_util::future::try_join_all;
use futures_util::{SinkExt as _, StreamExt as _};
use reach::ServantSockets;
use ros::bus::{Bus, Publisher, QosProfile, Subscription};
use ros::schema::Registry;
use serde_json::json;
use servant::netns::NetNs;
use tokio::runtime::{Builder, Handle, Runtime};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::Role;

use crate::bus::{self, LONG};
use crate::exchanges::{print_json, print_ready};
use crate::{messages, portal};

/// Topics of a node in each direction: an rclpy node has seven services, `/rosout` and `/parameter_events`.
const TOPICS: usize = 9;
/// Names of the threads of either side.
const OURS: &str = "ours";
const NODES: &str = "nodes";
/// Time until discovery has finished.
const SETTLED: Duration = Duration::from_secs(5);
/// Buffer size of a session's pipe.
const PIPE: usize = 64 << 10;

/// A servant's network with a node in it.
struct CrowdNode {
    sockets: Arc<ServantSockets>,
    _bus: Arc<dyn Bus>,
    _asked: Vec<Subscription>,
    told: Vec<Box<dyn Publisher>>,
}

fn build_runtime(name: &str) -> Result<Runtime> {
    let mut builder = Builder::new_multi_thread();
    // A thread that ended would take its processor time with it.
    builder.worker_threads(1).thread_name(name).thread_keep_alive(Duration::from_secs(3600));
    Ok(builder.enable_all().build()?)
}

/// Runs the role `crowd COUNT SECONDS`; prints the resources of each servant while idle.
pub(crate) fn run(count: usize, seconds: u64) -> Result<()> {
    // Shared by servants of the same revision.
    let known = Arc::new(messages::registry()?);
    let (nodes, ours) = (build_runtime(NODES)?, build_runtime(OURS)?);
    let crowd = (0..count).map(|_| nodes.block_on(CrowdNode::open())).collect::<Result<Vec<_>>>()?;
    let this = Process::current();
    // Afterwards the runtime's threads have their stacks.
    ours.block_on(async { tokio::spawn(async {}).await })?;
    std::thread::sleep(SETTLED);
    let (memory, descriptors, threads) = (this.resident()?, this.descriptors()?, this.threads()?);
    // Concurrently, because a bus waits a moment for the name of a node that sends its first message.
    let sessions = crowd.iter().map(|node| node.open_session(&known, nodes.handle()));
    let _bridges = ours.block_on(try_join_all(sessions))?;
    print_ready();
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

impl CrowdNode {
    async fn open() -> Result<Self> {
        let sockets = Arc::new(ServantSockets::new(&Arc::new(NetNs::create()?)));
        let bus = bus::join(sockets.clone(), "/node").await?;
        let (of, quality) = (bus::string_type()?, QosProfile::keep_last(10));
        let (mut asked, mut told) = (Vec::new(), Vec::new());
        for number in 0..TOPICS {
            asked.push(bus.subscribe(&format!("/asked_{number}"), of.clone(), quality).await?);
            told.push(bus.advertise(&format!("/told_{number}"), of.clone(), quality).await?);
        }
        Ok(Self { sockets, _bus: bus, _asked: asked, told })
    }

    /// Opens a bus, a bridge, and a robot that uses two topics of the node. A message shows that the session works.
    async fn open_session(&self, known: &Arc<Registry>, nodes: &Handle) -> Result<Arc<Bridge>> {
        let bridge = portal::join_bridge(self.sockets.clone(), known).await?;
        let (end, served) = tokio::io::duplex(PIPE);
        let serving = bridge.clone();
        tokio::spawn(async move { serving.serve(served, SessionOptions::default()).await });
        let mut robot = WebSocketStream::from_raw_socket(end, Role::Client, None).await;
        for (op, topic) in [("subscribe", "/told_0"), ("advertise", "/asked_0")] {
            let op = json!({"op": op, "topic": topic, "type": messages::STRING});
            robot.send(Message::text(op.to_string())).await?;
        }
        bus::wait_for_subscriber(&*self.told[0]).await?;
        self.told[0].publish(messages::string("heard"));
        let heard = tokio::time::timeout(LONG, robot.next()).await;
        let heard = heard.context("the robot hears nothing")?.context("the session has ended")??;
        ensure!(heard.to_text()?.contains("heard"), "the robot hears {heard}");
        // The robot answers pings.
        nodes.spawn(async move { while robot.next().await.is_some_and(|next| next.is_ok()) {} });
        Ok(bridge)
    }
}
