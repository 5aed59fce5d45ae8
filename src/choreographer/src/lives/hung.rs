//! Looks for nodes that hang, tells of them, and starts them again where the operator wants that.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Duration;

use api::{Phase, Sla, Stated, Terms};
use tokio::time::Instant;

use super::Inner;
use super::visits::Visits;
use crate::decide::hung::{Flow, Hung, Watched, look};
use crate::lives::handle::Handle;
use crate::options::{self, Class};

/// Between two looks.
const LOOK: Duration = Duration::from_secs(1);

/// Looks, for ever.
pub(crate) async fn keep(inner: Arc<Inner>) {
    if inner.options.hung == options::Hung::Ignore {
        return;
    }
    let mut watched: HashMap<(String, String), (Watched, String)> = HashMap::new();
    let mut kills = Visits::default();
    loop {
        tokio::time::sleep(LOOK).await;
        kills.take_over();
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
            let by_class = by_class(&terms, &inner.options.classes);
            // Without a time there is nothing to measure by.
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
                let seen = Flow {
                    inputs: flow.inputs,
                    outputs: flow.outputs,
                    starts: handle.starts(&key.1),
                };
                let (before, mut words) = watched.remove(&key).unzip();
                let (after, hung) = look(before, seen, patience, Instant::now().into_std());
                if let Some(hung) = hung {
                    let tidings = act(&inner, &handle, &key.1, hung);
                    if let Some(killed) = tidings.kills {
                        // Several nodes of a servant may hang at once.
                        let visit = format!("{} {}", handle.id, key.1);
                        kills.begin(&visit, kill(Arc::clone(&handle), killed));
                    }
                    words = Some(tidings.words);
                }
                let words = words.unwrap_or_default();
                if after.hangs() {
                    hanging.insert(key.1.clone(), words.clone());
                }
                next.insert(key, (after, words));
            }
            handle.set_hung(hanging);
        }
        watched = next;
    }
}

/// The SLA of a robot that states neither one nor resources.
fn by_class(terms: &Terms, classes: &BTreeMap<String, Class>) -> Option<Sla> {
    let says = |one: &Stated| !one.sla.is_empty() || one.cpus.is_some() || one.memory.is_some();
    let class = classes.get(terms.class.as_ref()?)?;
    (!terms.stated.values().any(says)).then_some(class.sla)
}

/// Nodes hang.
struct Tidings {
    /// What hangs.
    words: String,
    /// The node that is to be killed for it.
    kills: Option<String>,
}

/// Tells that nodes hang. `node`: that of a stub; nothing: those that rosbridge clients use.
fn act(inner: &Inner, handle: &Handle, node: &str, hung: Hung) -> Tidings {
    let own = &handle.revision.plan.nodes;
    let nodes: Vec<&str> = match node {
        "" => own.iter().map(|node| &*node.name).collect(),
        node => vec![node],
    };
    let restarts = inner.options.hung == options::Hung::Restart;
    // A stub's node is its robot's, which starts it again or not.
    let again = |name: &str| {
        let known = own.iter().find(|node| node.name == name);
        !node.is_empty() || handle.revision.plan.restart || known.is_some_and(|it| it.respawn)
    };
    let kills = restarts && matches!(&*nodes, [one] if again(one));
    let next = match &*nodes {
        _ if !restarts => {
            "look at its log, or let such nodes be started again: hung = \"restart\" in [servant]"
        }
        [_] if kills => "it is killed, and started again as after any failure",
        [_] => {
            "it is not killed, since its launch file says nothing of respawn and it would stay away"
        }
        _ => "which of them hangs is not known, and none is started again",
    };
    let what = format!(
        "{} answered none of {} inputs in {:.1} s",
        nodes.join(", "),
        hung.inputs,
        hung.since.as_secs_f64()
    );
    let message = format!("servant {}: {what}; {next}", handle.id);
    inner
        .journal
        .warning("node-hung", &message, &handle.about());
    if let Some(reach) = handle.reach() {
        reach.report(node, &format!("servant {}: {what}", handle.id));
    }
    let killed = nodes.first().filter(|_| kills);
    Tidings {
        kills: killed.map(|node| (*node).to_owned()),
        words: what,
    }
}

async fn kill(handle: Arc<Handle>, node: String) {
    let Some(container) = handle.container() else {
        return;
    };
    if let Err(error) = container.signal_node(&node, libc::SIGKILL).await {
        let id = &handle.id;
        tracing::warn!("{node} of {id} hangs and cannot be killed: {error}");
    }
}
