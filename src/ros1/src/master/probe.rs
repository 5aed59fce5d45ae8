//! Detection of dead nodes: registered nodes whose address nobody listens on any more.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use futures_util::StreamExt as _;
use tokio::time::timeout;

use super::MasterCore;
use crate::names::PeerUri;

/// Maximum number of concurrent probes.
const AT_A_TIME: usize = 32;
/// Time limit of a probe; a node that takes longer to accept is hung, but alive.
const ANSWER: Duration = Duration::from_secs(2);

/// Drops the registrations of all dead nodes; returns their names.
pub(super) async fn drop_dead(master: &Arc<MasterCore>) -> Vec<String> {
    let nodes: Vec<(String, String)> = {
        let state = master.state.lock();
        let owned = |(name, api): (&str, &str)| (name.to_owned(), api.to_owned());
        state.registry.nodes().map(owned).collect()
    };
    let dead: Vec<(String, String)> = futures_util::stream::iter(nodes)
        .map(|(name, api)| async move {
            let refused = is_refused(master, &api).await;
            refused.then_some((name, api))
        })
        .buffer_unordered(AT_A_TIME)
        .filter_map(|dead| async { dead })
        .collect()
        .await;
    if dead.is_empty() {
        return Vec::new();
    }
    master.update(|state, notices| {
        let mut dropped = Vec::new();
        for (name, api) in dead {
            // It may have registered again at another address while the others were probed.
            if state.registry.node_api(&name) == Some(api.as_str()) {
                tracing::info!(node = name, api, "the node is gone");
                state.registry.drop_node(&name, notices);
                dropped.push(name);
            }
        }
        dropped
    })
}

async fn is_refused(master: &MasterCore, api: &str) -> bool {
    let Some(uri) = PeerUri::parse(api, "http") else {
        return false;
    };
    let sockets = master.sockets();
    let connect = async {
        let address = sockets.resolve(&uri.host, uri.port).await?;
        sockets.connect(address).await.map(drop)
    };
    match timeout(ANSWER, connect).await {
        Ok(Err(error)) => error.kind() == io::ErrorKind::ConnectionRefused,
        Ok(Ok(())) | Err(_) => false,
    }
}
