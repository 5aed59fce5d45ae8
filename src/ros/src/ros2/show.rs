//! Telling whoever holds one end of a topic who is at the other.

use std::collections::HashMap;

use tokio::sync::watch;

use crate::bus::{Matched, PeerId, Refusal, WireType};

/// Tells it if it is news. The names of nodes are compared, too: they may become known later than their ends.
pub(super) fn matched(shown: &watch::Sender<Matched>, now: Matched) {
    let names = |matched: &Matched| -> Vec<String> {
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

/// Why no messages pass between ends of these types.
pub(super) fn other_type(theirs: &WireType, ours: &WireType) -> String {
    format!("its type is {theirs} there and {ours} here")
}

/// Logs with whom no messages pass, once for each reason.
pub(super) fn refusals(told: &mut HashMap<PeerId, String>, topic: &str, now: &Matched) {
    let stands = |peer: &PeerId, why: &String| {
        let mut refused = now.refused.iter();
        refused.any(|refusal| refusal.peer == *peer && refusal.why == *why)
    };
    told.retain(|peer, why| stands(peer, why));
    for Refusal { peer, why } in &now.refused {
        if !told.contains_key(peer) {
            tracing::warn!(
                topic,
                node = peer.node(),
                why,
                "no messages pass between it and us"
            );
            told.insert(peer.clone(), why.clone());
        }
    }
}
