//! Watches for hung nodes, reports them, and restarts them if configured.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Duration;

use api::{Phase, Sla, Stated, Terms};
use tokio::time::Instant;
use tracing::Instrument;

use super::ChoreographerInner;
use super::visits::Visits;
use crate::decide::hung::{Flow, FlowWatch, HungNodes, observe_flow};
use crate::lives::handle::Handle;
use crate::options::{self, ClassOptions};

/// Interval between two rounds.
const LOOK: Duration = Duration::from_secs(1);

/// Runs the watch forever.
pub(crate) async fn watch(inner: Arc<ChoreographerInner>) {
    if inner.options.hung == options::HungPolicy::Ignore {
        return;
    }
    let mut watched: HashMap<(String, String), (FlowWatch, String)> = HashMap::new();
    let mut kills = Visits::default();
    loop {
        tokio::time::sleep(LOOK).await;
        kills.take_finished();
        let servants: Vec<Arc<Handle>> = {
            let servants = inner.servants.lock();
            servants.all.values().cloned().collect()
        };
        let mut next = HashMap::with_capacity(watched.len());
        for handle in servants {
            if handle.life().phase != Phase::Ready {
                continue;
            }
            let terms = handle.terms();
            let by_class = class_sla(&terms, &inner.options.classes);
            // Without a T_max there is no criterion.
            let accepted = |who: &str| {
                let own = terms.stated.get(who).map(|stated| stated.sla);
                let sla = own.filter(|sla| !sla.is_empty()).or(by_class)?;
                sla.max_rrt.or(sla.rrt)
            };
            let mut hanging = BTreeMap::new();
            let flows = handle.reach().map(|reach| reach.flows());
            for flow in flows.unwrap_or_default() {
                let Some(max) = accepted(&flow.node) else {
                    continue;
                };
                let patience = max.duration().mul_f64(inner.options.hung_after);
                let key = (handle.id.clone(), flow.node);
                let seen = Flow { inputs: flow.inputs, outputs: flow.outputs, starts: handle.starts(&key.1) };
                let (before, mut words) = watched.remove(&key).unzip();
                let (after, hung) = observe_flow(before, seen, patience, Instant::now().into_std());
                if let Some(hung) = hung {
                    let span = handle.span(None);
                    let tidings = span.in_scope(|| handle_hung(&inner, &handle, &key.1, hung));
                    if let Some(killed) = tidings.kills {
                        let span = tracing::error_span!(parent: &span, "node", node = killed);
                        // Several nodes of a servant may hang at once.
                        let visit = format!("{} {}", handle.id, key.1);
                        let killing = kill(Arc::clone(&handle), killed).instrument(span);
                        kills.begin(&visit, killing);
                    }
                    words = Some(tidings.words);
                }
                let words = words.unwrap_or_default();
                if after.is_reported_hung() {
                    hanging.insert(key.1.clone(), words.clone());
                }
                next.insert(key, (after, words));
            }
            handle.set_hung(hanging);
        }
        watched = next;
    }
}

/// Returns the class's SLA, for a robot that states neither an SLA nor resources.
fn class_sla(terms: &Terms, classes: &BTreeMap<String, ClassOptions>) -> Option<Sla> {
    let says = |one: &Stated| !one.sla.is_empty() || one.cpus.is_some() || one.memory.is_some();
    let class = classes.get(terms.class.as_ref()?)?;
    (!terms.stated.values().any(says)).then_some(class.sla)
}

/// Consequence of a detected hang.
struct HungAction {
    /// Description of what hangs.
    words: String,
    /// The node to kill, if any.
    kills: Option<String>,
}

/// Reports hung nodes. `node`: the node of a stub; empty for those used by rosbridge clients.
fn handle_hung(inner: &ChoreographerInner, handle: &Handle, node: &str, hung: HungNodes) -> HungAction {
    let own = &handle.revision.plan.nodes;
    let nodes: Vec<&str> = match node {
        "" => own.iter().map(|node| &*node.name).collect(),
        node => vec![node],
    };
    let restarts = inner.options.hung == options::HungPolicy::Restart;
    // The stub's robot decides whether its node is restarted.
    let again = |name: &str| {
        let known = own.iter().find(|node| node.name == name);
        !node.is_empty() || handle.revision.plan.restart || known.is_some_and(|it| it.respawn)
    };
    let kills = restarts && matches!(&*nodes, [one] if again(one));
    let next = match &*nodes {
        _ if !restarts => "see its log, or have hung nodes restarted: hung = \"restart\" in [servant]",
        [_] if kills => "it is killed and restarted as after a failure",
        [_] => "it is not killed, because its launch file does not set respawn and it would not be restarted",
        _ => "it is unknown which of them hangs, so none is restarted",
    };
    let what =
        format!("{} answered none of {} inputs in {:.1} s", nodes.join(", "), hung.inputs, hung.since.as_secs_f64());
    let message = format!("servant {}: {what}; {next}", handle.id);
    inner.journal.warning("node-hung", &message, &handle.event_context());
    if let Some(reach) = handle.reach() {
        reach.warn_flow(node, &format!("servant {}: {what}", handle.id));
    }
    let killed = nodes.first().filter(|_| kills);
    HungAction { kills: killed.map(|node| (*node).to_owned()), words: what }
}

async fn kill(handle: Arc<Handle>, node: String) {
    let Some(container) = handle.container() else {
        return;
    };
    if let Err(error) = container.signal_node(&node, libc::SIGKILL).await {
        tracing::warn!("a node hangs and cannot be killed: {error}");
    }
}
