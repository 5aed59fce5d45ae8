//! What a daemon sets up for a servant of ROS 2 (bus, tap, bridge) and a WebSocket per client, without HTTP and policy.

use std::net::SocketAddr;
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use bridge::{Bridge, BridgeOptions, SessionEnd, SessionOptions};
use reach::tap::Tap;
use ros::net::{HostSockets, Sockets};
use ros::schema::Registry;
use serde_json::json;
use tokio::net::{TcpListener, TcpStream};

use crate::exchanges::{print_json, print_ready, wait_for_request};
use crate::pictures::metrics_json;
use crate::{bus, messages};

/// Address of every rosbridge server under measurement, each in a network of its own.
pub(crate) const ADDRESS: &str = "127.0.0.1:9090";
/// Name of a daemon's node in its servants.
const NODE: &str = "/cloudroid_bridge";

/// Runs the role `portal kept`, with one bridge that exists before its clients and tells its counters, or `portal
/// fresh`, with a bridge for each client.
pub(crate) fn run(words: &[&str]) -> Result<()> {
    let kept = match words {
        ["kept"] => true,
        ["fresh"] => false,
        _ => bail!("a portal is kept or fresh, not {words:?}"),
    };
    // The same threads as in a daemon's portal.
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().thread_name("portal").build()?;
    let served = runtime.block_on(async {
        let known = Arc::new(messages::registry()?);
        let bridge = if kept { Some(join_bridge(Arc::new(HostSockets), &known).await?) } else { None };
        let listener = TcpListener::bind(ADDRESS).await?;
        print_ready();
        tokio::spawn(accept_clients(listener, bridge.clone(), known));
        while wait_for_request().await? {
            print_json(&bridge.as_ref().map_or(json!({}), |bridge| metrics_json(bridge.metrics())));
        }
        anyhow::Ok(())
    });
    // Sessions end with the process, because the measurement is over.
    runtime.shutdown_background();
    served
}

/// Creates a bridge to the nodes of this network, as a daemon does for a servant.
pub(crate) async fn join_bridge(sockets: Arc<dyn Sockets>, known: &Arc<Registry>) -> Result<Arc<Bridge>> {
    let bus = Arc::new(Tap::default()).wrap(bus::join(sockets, NODE).await?);
    Ok(Bridge::new(bus, known.clone(), BridgeOptions::default()))
}

async fn accept_clients(listener: TcpListener, bridge: Option<Arc<Bridge>>, known: Arc<Registry>) {
    while let Ok((stream, from)) = listener.accept().await {
        let (bridge, known) = (bridge.clone(), known.clone());
        tokio::spawn(async move {
            match serve_client(stream, from, bridge, &known).await {
                Ok(SessionEnd::Closed { code, reason }) => {
                    eprintln!("the portal closed a session: {code} {reason}");
                }
                Ok(SessionEnd::Client { .. } | SessionEnd::Lost(_)) => {}
                Err(error) => eprintln!("a session failed: {error:#}"),
            }
        });
    }
}

async fn serve_client(
    stream: TcpStream,
    from: SocketAddr,
    bridge: Option<Arc<Bridge>>,
    known: &Arc<Registry>,
) -> Result<SessionEnd> {
    stream.set_nodelay(true)?;
    let socket = tokio_tungstenite::accept_async(stream).await.context("the client's handshake")?;
    let bridge = match bridge {
        Some(bridge) => bridge,
        None => join_bridge(Arc::new(HostSockets), known).await?,
    };
    let options = SessionOptions { client: from.to_string(), ..SessionOptions::default() };
    // A client sends nothing before it has read the handshake's response, so nothing was read ahead.
    Ok(bridge.serve(socket.into_inner(), options).await)
}
