//! Nodes of a servant that have a lifecycle (ROS 2): those that nobody else drives are had to configure and activate
//! themselves as they appear, and in which state each is can be told.
//!
//! ```text
//!  graph ─▶ a node with a lifecycle ─▶ started by a stub? driven by a manager? past unconfigured? ─yes─▶ left alone ─┐
//!                                                   │ no                                                           ▼
//!                                                   └─▶ configure ─▶ activate ─▶ or the event lifecycle-refused ─▶ state
//! ```

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ros::bus::{Bus, RosVersion};
use ros::ros2::lifecycle::{Begun, LifecycleNode, State};
use tokio::sync::watch;
use tokio::task::AbortHandle;

use crate::links::Nodes;
use crate::{Linked, Observer, following};

/// For one transition: nodes load what they need then.
const PATIENCE: Duration = Duration::from_secs(120);
/// What the names of the daemon's own nodes begin with.
const OURS: &str = "/cloudroid_";

/// Where a node is in its lifecycle.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Stage {
    /// In ROS's own word: `active`.
    pub state: String,
    /// Why it is not active: it was told to be, and did not become it.
    pub refused: Option<String>,
    /// It is being told to be: until it is, or somebody else drives it, its robot has nothing of it.
    pub begins: bool,
}

/// Nodes that have a lifecycle, by name.
pub type Stages = BTreeMap<String, Stage>;

/// Has nodes begin until it is dropped.
pub(crate) struct Lifecycles {
    shown: watch::Receiver<Stages>,
    task: AbortHandle,
}

impl Drop for Lifecycles {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Lifecycles {
    /// Follows the nodes of a servant; none where its ROS has no lifecycles. `nodes`: those that stubs have started are for the
    /// robot to drive.
    pub(crate) fn follow(
        bus: &Arc<dyn Bus>,
        nodes: &Arc<dyn Nodes>,
        observer: &Arc<dyn Observer>,
    ) -> Option<Lifecycles> {
        if bus.version() == RosVersion::One {
            return None;
        }
        let shown = watch::Sender::default();
        let followed = Followed {
            bus: Arc::clone(bus),
            nodes: Arc::clone(nodes),
            observer: Arc::clone(observer),
            shown,
        };
        Some(Lifecycles {
            shown: followed.shown.subscribe(),
            task: tokio::spawn(Arc::new(followed).run()).abort_handle(),
        })
    }

    /// Those that there are, now and later.
    pub(crate) fn stages(&self) -> watch::Receiver<Stages> {
        self.shown.clone()
    }
}

struct Followed {
    bus: Arc<dyn Bus>,
    nodes: Arc<dyn Nodes>,
    observer: Arc<dyn Observer>,
    shown: watch::Sender<Stages>,
}

impl Followed {
    async fn run(self: Arc<Self>) {
        let begin = |node: String| Arc::clone(&self).one(node);
        let gone = |node: &str| self.shown.send_modify(|all| drop(all.remove(node)));
        let (graph, ours) = (self.bus.graph(), self.bus.node());
        following::each_node(graph, ours, LifecycleNode::all, begin, gone).await;
    }

    /// Has one node begin, if that is ours to do, and tells its states from then on.
    async fn one(self: Arc<Self>, name: String) {
        let node = LifecycleNode::of(Arc::clone(&self.bus), &name);
        let linked = self.nodes.running().await;
        let graph = self.bus.graph().borrow().clone();
        let has = |linked: &Linked| graph.is_of_process(&linked.node.name, &name);
        if !linked.iter().any(has) {
            self.put(&name, |stage| stage.begins = true);
            self.begin(&node, &name).await;
            self.put(&name, |stage| stage.begins = false);
        }
        let changes = node.watch().await;
        match node.state().await {
            Ok(state) => self.show(&name, state),
            Err(error) => tracing::debug!(node = name, %error, "its state is not known"),
        }
        match changes {
            Ok(mut changes) => {
                while let Some(change) = changes.next().await {
                    self.show(&name, change.to);
                }
            }
            Err(error) => tracing::debug!(node = name, %error, "it tells no changes of its state"),
        }
    }

    async fn begin(&self, node: &LifecycleNode, name: &str) {
        let ours = |other: &str| other.starts_with(OURS);
        match node.begin(&ours, PATIENCE).await {
            Ok(Begun::Now) => self.show(name, State::Active),
            Ok(Begun::Left(state)) => self.show(name, state),
            Ok(Begun::DrivenBy(driver)) => {
                tracing::debug!(node = name, driver, "somebody drives it");
            }
            Err(refused) => {
                let why = refused.to_string();
                let observer = &self.observer;
                observer.event(api::Level::Error, "lifecycle-refused", &why, None);
                self.put(name, |stage| stage.refused = Some(why));
            }
        }
    }

    /// What was refused stands until the node is active: somebody else may have it become that.
    fn show(&self, name: &str, state: State) {
        self.put(name, |stage| {
            stage.state = state.to_string();
            if state == State::Active {
                stage.refused = None;
            }
        });
    }

    /// Changes what is shown of a node, and tells of it if it is another.
    fn put(&self, name: &str, change: impl FnOnce(&mut Stage)) {
        self.shown.send_if_modified(|all| {
            let before = all.get(name);
            let mut now = before.cloned().unwrap_or_else(|| Stage {
                state: State::Unknown.to_string(),
                refused: None,
                begins: false,
            });
            change(&mut now);
            let news = before != Some(&now);
            if news {
                all.insert(name.to_owned(), now);
            }
            news
        });
    }
}

#[cfg(test)]
mod tests;
