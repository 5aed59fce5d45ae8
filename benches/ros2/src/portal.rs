//! What a daemon has before a servant of ROS 2: a bus in the servant's network, the tap, the bridge; and a WebSocket for each
//! client. Only what comes before a session is not here: HTTP, the policy, and finding the servant.

use std::net::SocketAddr;
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use bridge::{Bridge, BridgeOptions, SessionEnd, SessionOptions};
use reach::tap::Tap;
use ros::JoinOptions;
use ros::bus::RosVersion;
use ros::schema::Registry;
use serde_json::json;
use servant::netns::NetNs;
use tokio::net::{TcpListener, TcpStream};

use crate::lost;
use crate::place::Within;
use crate::roles::{say, until_asked};
use crate::types;

/// Where every server of rosbridge listens that is measured, each in a network of its own.
pub(crate) const ADDRESS: &str = "127.0.0.1:9090";
/// The name of a daemon's node in its servants.
const NODE: &str = "/cloudroid_bridge";

/// `portal kept`: one bridge, which is there before its clients; `portal fresh`: one for each client, made when it comes, as
/// for the first robot of a servant that runs. When asked, the kept one tells how many messages it has passed on, and left out.
pub(crate) fn play(words: &[&str]) -> Result<()> {
    let kept = match words {
        ["kept"] => true,
        ["fresh"] => false,
        _ => bail!("a portal is kept or fresh, not {words:?}"),
    };
    // Threads as a daemon's portal has them.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .thread_name("portal")
        .build()?;
    let served = runtime.block_on(async {
        let known = Arc::new(types::registry()?);
        let bridge = match kept {
            true => Some(bridge_in(NetNs::current()?, &known).await?),
            false => None,
        };
        let listener = TcpListener::bind(ADDRESS).await?;
        say(&json!({}));
        tokio::spawn(listens(listener, bridge.clone(), known));
        while until_asked().await? {
            say(&bridge
                .as_ref()
                .map_or(json!({}), |bridge| lost::counts(bridge.metrics())));
        }
        anyhow::Ok(())
    });
    // Sessions end with the process, as whoever measures has ended.
    runtime.shutdown_background();
    served
}

/// A bridge to the nodes of this network, as a daemon makes it for a servant.
pub(crate) async fn bridge_in(network: NetNs, known: &Arc<Registry>) -> Result<Arc<Bridge>> {
    let options = JoinOptions::in_domain(0, NODE);
    let bus = ros::connect(RosVersion::Two, Arc::new(Within(network)), options).await?;
    let bus = Arc::new(Tap::default()).before(bus);
    Ok(Bridge::new(bus, known.clone(), BridgeOptions::default()))
}

async fn listens(listener: TcpListener, bridge: Option<Arc<Bridge>>, known: Arc<Registry>) {
    while let Ok((stream, from)) = listener.accept().await {
        let (bridge, known) = (bridge.clone(), known.clone());
        tokio::spawn(async move {
            match serve(stream, from, bridge, &known).await {
                Ok(SessionEnd::Closed { code, reason }) => {
                    eprintln!("the portal closed a session: {code} {reason}");
                }
                Ok(SessionEnd::Client { .. } | SessionEnd::Lost(_)) => {}
                Err(error) => eprintln!("a session failed: {error:#}"),
            }
        });
    }
}

async fn serve(
    stream: TcpStream,
    from: SocketAddr,
    bridge: Option<Arc<Bridge>>,
    known: &Arc<Registry>,
) -> Result<SessionEnd> {
    stream.set_nodelay(true)?;
    let socket = tokio_tungstenite::accept_async(stream)
        .await
        .context("the client's handshake")?;
    let bridge = match bridge {
        Some(bridge) => bridge,
        None => bridge_in(NetNs::current()?, known).await?,
    };
    let options = SessionOptions {
        client: from.to_string(),
        ..SessionOptions::default()
    };
    // A client says nothing before it has read the answer to its handshake: nothing was read ahead.
    Ok(bridge.serve(socket.into_inner(), options).await)
}
