//! Looks for nodes that hang, tells of them, and starts them again where the operator wants that.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use api::Phase;
use tokio::time::Instant;

use super::Inner;
use crate::decide::hung::{Flow, Hung, Watched, look};
use crate::handle::Handle;
use crate::options;

/// Between two looks.
const LOOK: Duration = Duration::from_secs(1);

/// Looks, for ever.
pub(crate) async fn keep(inner: Arc<Inner>) {
    if inner.options.hung == options::Hung::Ignore {
        return;
    }
    let mut watched: HashMap<(String, String), Watched> = HashMap::new();
    loop {
        tokio::time::sleep(LOOK).await;
        let servants: Vec<Arc<Handle>> = {
            let servants = inner.servants.lock();
            servants.all.values().cloned().collect()
        };
        let mut next = HashMap::with_capacity(watched.len());
        for handle in servants {
            if handle.life().phase != Phase::Ready {
                continue;
            }
            // Without a time there is nothing to measure by.
            let terms = handle.terms();
            let stated = |who: &str| {
                let sla = terms.stated.get(who)?.sla;
                sla.max_rrt.or(sla.rrt)
            };
            let flows = handle.reach().map(|reach| reach.flows());
            for flow in flows.unwrap_or_default() {
                let Some(max) = stated(&flow.node) else {
                    continue;
                };
                let patience = max.duration().mul_f64(inner.options.hung_after);
                let key = (handle.id.clone(), flow.node);
                let seen = Flow {
                    inputs: flow.inputs,
                    outputs: flow.outputs,
                    starts: handle.starts(&key.1),
                };
                let before = watched.remove(&key);
                let (after, hung) = look(before, seen, patience, Instant::now().into_std());
                if let Some(hung) = hung {
                    act(&inner, &handle, &key.1, hung).await;
                }
                next.insert(key, after);
            }
        }
        watched = next;
    }
}

/// `node`: that of a stub; nothing: those that rosbridge clients use.
async fn act(inner: &Inner, handle: &Handle, node: &str, hung: Hung) {
    let own = &handle.revision.plan.nodes;
    let nodes: Vec<&str> = match node {
        "" => own.iter().map(|node| &*node.name).collect(),
        node => vec![node],
    };
    let restarts = inner.options.hung == options::Hung::Restart;
    let next = match &*nodes {
        _ if !restarts => {
            "look at its log, or let such nodes be started again: hung = \"restart\" in [servant]"
        }
        [_] => "it is killed, and started again as after any failure",
        _ => "which of them hangs is not known, and none is started again",
    };
    let message = format!(
        "servant {}: {} answered none of {} inputs in {:.1} s; {next}",
        handle.id,
        nodes.join(", "),
        hung.inputs,
        hung.since.as_secs_f64()
    );
    inner
        .journal
        .warning("node-hung", &message, &handle.about());
    if let ([node], true, Some(container)) = (&*nodes, restarts, handle.container())
        && let Err(error) = container.signal_node(node, libc::SIGKILL).await
    {
        tracing::warn!(
            "{node} of {} hangs and cannot be killed: {error}",
            handle.id
        );
    }
}
