//! Lifecycle nodes of a servant (ROS 2): configures and activates those that nobody else manages when they appear, and
//! publishes the state of each.
//!
//! ```text
//!  graph ─▶ a lifecycle node ─▶ started by a stub, managed, or past unconfigured? ─yes─▶ left alone ─────────────┐
//!                                               │ no                                                             ▼
//!                                               └─▶ configure ─▶ activate ─▶ or the event lifecycle-refused ─▶ state
//! ```

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use budget::Budget;
use link::control::NodeLaunch;
use ros::bus::{Bus, RosVersion};
use ros::ros2::lifecycle::{BeginOutcome, LifecycleNode, State};
use tokio::sync::watch;
use tokio::task::AbortHandle;
use tracing::Instrument;

use crate::links::NodeController;
use crate::{Observer, following};

/// Timeout of one transition; nodes load data then.
const PATIENCE: Duration = Duration::from_secs(120);
/// Prefix of the names of the daemon's own nodes.
const OURS: &str = "/cloudroid_";

/// Lifecycle state of a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LifecycleStage {
    /// Name of the state in ROS: `active`.
    pub state: String,
    /// Reason why it did not become active when it was told to.
    pub refused: Option<String>,
    /// It is being activated; until it is active or somebody else manages it, its robot gets nothing from it.
    pub begins: bool,
}

/// Lifecycle nodes by name.
pub type Stages = BTreeMap<String, LifecycleStage>;

/// Activates lifecycle nodes until it is dropped.
pub(crate) struct LifecycleDriver {
    shown: watch::Receiver<Stages>,
    task: AbortHandle,
}

impl Drop for LifecycleDriver {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl LifecycleDriver {
    /// Starts following the nodes of a servant; `None` if its ROS version has no lifecycles. Those in `nodes` were
    /// started by stubs and are managed by the robot. The processor time for following is charged to `budget`.
    pub(crate) fn start(
        bus: &Arc<dyn Bus>,
        nodes: &Arc<dyn NodeController>,
        observer: &Arc<dyn Observer>,
        budget: &Budget,
    ) -> Option<LifecycleDriver> {
        if bus.version() == RosVersion::One {
            return None;
        }
        let shown = watch::Sender::default();
        let followed =
            LifecycleFollower { bus: Arc::clone(bus), nodes: Arc::clone(nodes), observer: Arc::clone(observer), shown };
        Some(LifecycleDriver {
            shown: followed.shown.subscribe(),
            task: tokio::spawn(budget.meter(Arc::new(followed).run()).in_current_span()).abort_handle(),
        })
    }

    /// Returns a watch on the lifecycle nodes.
    pub(crate) fn stages(&self) -> watch::Receiver<Stages> {
        self.shown.clone()
    }
}

struct LifecycleFollower {
    bus: Arc<dyn Bus>,
    nodes: Arc<dyn NodeController>,
    observer: Arc<dyn Observer>,
    shown: watch::Sender<Stages>,
}

impl LifecycleFollower {
    async fn run(self: Arc<Self>) {
        let begin = |node: String| Arc::clone(&self).drive_node(node);
        let gone = |node: &str| self.shown.send_modify(|all| drop(all.remove(node)));
        let (graph, ours) = (self.bus.graph(), self.bus.node());
        following::run_for_each_node(graph, ours, LifecycleNode::all, begin, gone).await;
    }

    /// Activates one node, if that is our task, and publishes its states from then on.
    async fn drive_node(self: Arc<Self>, name: String) {
        let node = LifecycleNode::new(Arc::clone(&self.bus), &name);
        let linked = self.nodes.running_nodes().await;
        let graph = self.bus.graph().borrow().clone();
        let has = |linked: &NodeLaunch| graph.is_in_process(&linked.name, &name);
        if !linked.iter().any(has) {
            self.update_stage(&name, |stage| stage.begins = true);
            self.activate(&node, &name).await;
            self.update_stage(&name, |stage| stage.begins = false);
        }
        let changes = node.watch().await;
        match node.state().await {
            Ok(state) => self.show_state(&name, state),
            Err(error) => tracing::debug!(%error, "its state is unknown"),
        }
        match changes {
            Ok(mut changes) => {
                while let Some(change) = changes.next().await {
                    self.show_state(&name, change.to);
                }
            }
            Err(error) => {
                tracing::debug!(%error, "it does not report changes of its state")
            }
        }
    }

    async fn activate(&self, node: &LifecycleNode, name: &str) {
        let ours = |other: &str| other.starts_with(OURS);
        match node.begin(&ours, PATIENCE).await {
            Ok(BeginOutcome::Now) => self.show_state(name, State::Active),
            Ok(BeginOutcome::Left(state)) => self.show_state(name, state),
            Ok(BeginOutcome::DrivenBy(driver)) => {
                tracing::debug!(driver, "another program drives it");
            }
            Err(refused) => {
                let why = refused.to_string();
                let observer = &self.observer;
                observer.record_event(api::Level::Error, "lifecycle-refused", &why, None);
                self.update_stage(name, |stage| stage.refused = Some(why));
            }
        }
    }

    /// Shows a state. A refusal is shown until the node is active, which somebody else may achieve.
    fn show_state(&self, name: &str, state: State) {
        self.update_stage(name, |stage| {
            stage.state = state.to_string();
            if state == State::Active {
                stage.refused = None;
            }
        });
    }

    /// Changes what is shown of a node, and notifies watchers if it differs.
    fn update_stage(&self, name: &str, change: impl FnOnce(&mut LifecycleStage)) {
        self.shown.send_if_modified(|all| {
            let before = all.get(name);
            let mut now = before.cloned().unwrap_or_else(|| LifecycleStage {
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
