//! Publishing and logging of matched peers.

use std::collections::HashMap;

use ros_bus::{IncompatiblePeer, MatchedPeers, PeerId, WireType};
use tokio::sync::watch;

/// Publishes the matched peers if they changed. Node names are compared as well, because they may become known later
/// than their endpoints.
pub(super) fn publish_matched(shown: &watch::Sender<MatchedPeers>, now: MatchedPeers) {
    let names = |matched: &MatchedPeers| -> Vec<String> {
        let peers = matched.peers.iter().map(|peer| peer.id.node());
        let refused = matched.refused.iter().map(|refusal| refusal.peer.node());
        peers.chain(refused).map(str::to_owned).collect()
    };
    shown.send_if_modified(|before| {
        let news = *before != now || names(before) != names(&now);
        if news {
            *before = now;
        }
        news
    });
}

/// Describes why endpoints of these types do not match.
pub(super) fn type_mismatch_text(theirs: &WireType, ours: &WireType) -> String {
    format!("its type is {theirs} there and {ours} here")
}

/// Logs incompatible peers, once for each reason.
pub(super) fn log_incompatible(told: &mut HashMap<PeerId, String>, topic: &str, now: &MatchedPeers) {
    let stands = |peer: &PeerId, why: &String| {
        let mut refused = now.refused.iter();
        refused.any(|refusal| refusal.peer == *peer && refusal.why == *why)
    };
    told.retain(|peer, why| stands(peer, why));
    for IncompatiblePeer { peer, why } in &now.refused {
        if !told.contains_key(peer) {
            tracing::warn!(topic, node = peer.node(), why, "no messages pass between it and this process");
            told.insert(peer.clone(), why.clone());
        }
    }
}
