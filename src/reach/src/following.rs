//! Runs one task for each node of interest in a servant, for as long as the node exists.

use std::collections::HashMap;
use std::sync::Arc;

use ros::bus::Graph;
use tokio::sync::watch;
use tokio::task::{AbortHandle, JoinSet};
use tracing::Instrument;

/// Starts a task when a node named by `of_interest` appears, except the node `ours`, and aborts it when the node is
/// gone, after which `gone` is called. Returns when the graph is no longer updated; dropping the future aborts all
/// tasks.
pub(crate) async fn run_for_each_node<F>(
    mut graph: watch::Receiver<Arc<Graph>>,
    ours: &str,
    of_interest: impl Fn(&Graph) -> Vec<String>,
    begin: impl Fn(String) -> F,
    gone: impl Fn(&str),
) where
    F: Future<Output = ()> + Send + 'static,
{
    // Keyed by name and address, so that a restarted node gets a new task.
    let mut known: HashMap<(String, String), AbortHandle> = HashMap::new();
    // Dropped, and thereby aborted, together with this future.
    let mut tasks = JoinSet::new();
    loop {
        let now = Arc::clone(&graph.borrow_and_update());
        let there = of_interest(&now).into_iter().filter_map(|node| {
            let address = now.nodes.get(&node)?.clone();
            (node != ours).then_some((node, address))
        });
        let there: Vec<_> = there.collect();
        known.retain(|one, task| {
            let stays = there.contains(one);
            if !stays {
                task.abort();
                gone(&one.0);
            }
            stays
        });
        while tasks.try_join_next().is_some() {}
        for one in there {
            let node = one.0.clone();
            known.entry(one).or_insert_with(|| {
                let span = tracing::error_span!("node", node);
                tasks.spawn(begin(node).instrument(span))
            });
        }
        if graph.changed().await.is_err() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use tokio::sync::mpsc;
    use tokio::time::timeout;

    use super::*;

    /// Only limits the duration of a failing test.
    const PATIENCE: Duration = Duration::from_secs(60);

    fn graph(nodes: &[(&str, &str)]) -> Arc<Graph> {
        let nodes = nodes.iter();
        let nodes = nodes.map(|(name, address)| ((*name).to_owned(), (*address).to_owned()));
        Arc::new(Graph { nodes: nodes.collect(), ..Graph::default() })
    }

    /// Reports when it is dropped.
    struct TaskProbe(String, mpsc::UnboundedSender<String>);

    impl Drop for TaskProbe {
        fn drop(&mut self) {
            let _ = self.1.send(format!("ended {}", self.0));
        }
    }

    #[tokio::test]
    async fn a_node_that_was_started_again_begins_again() {
        let shown = watch::Sender::new(graph(&[("/ours", "1"), ("/box", "1"), ("/other", "1")]));
        let (sender, mut told) = mpsc::unbounded_channel();
        let (seen, begun, left) = (shown.subscribe(), sender.clone(), sender);
        let following = tokio::spawn(async move {
            let of_interest = |graph: &Graph| {
                let nodes = graph.nodes.keys();
                nodes.filter(|name| *name != "/other").cloned().collect()
            };
            let begin = |node: String| {
                let runs = TaskProbe(node, begun.clone());
                async move {
                    let _ = runs.1.send(format!("began {}", runs.0));
                    std::future::pending().await
                }
            };
            let gone = |node: &str| {
                let _ = left.send(format!("gone {node}"));
            };
            run_for_each_node(seen, "/ours", of_interest, begin, gone).await;
        });
        let mut next = async |count: usize| {
            let mut heard = Vec::new();
            while heard.len() < count {
                heard.push(timeout(PATIENCE, told.recv()).await.expect("told").expect("open"));
            }
            heard.sort();
            heard
        };
        assert_eq!(next(1).await, ["began /box"]);
        // Another address is another process.
        shown.send_replace(graph(&[("/box", "2")]));
        assert_eq!(next(3).await, ["began /box", "ended /box", "gone /box"]);
        shown.send_replace(graph(&[("/box", "2"), ("/late", "1")]));
        assert_eq!(next(1).await, ["began /late"]);
        shown.send_replace(graph(&[]));
        assert_eq!(next(4).await, ["ended /box", "ended /late", "gone /box", "gone /late"]);
        drop(shown);
        timeout(PATIENCE, following).await.expect("it ends").expect("it does not panic");
    }
}
