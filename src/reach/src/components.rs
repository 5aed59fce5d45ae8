//! Component containers of a servant (ROS 2): what its revision loads into them is loaded as they appear, whenever they do.
//!
//! ```text
//!  graph ─▶ a container of the revision ─▶ started by a stub? ─yes─▶ left alone
//!                    ▲                          │ no
//!                    │ it was started again     └─▶ Loading ─▶ Loaded, or Refused and the event component-refused
//!                    └───────────────────────────────────────────┘
//! ```

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ros::bus::{Bus, Graph};
use ros::ros2::composition::{Component, Container};
use ros::schema::Registry;
use tokio::sync::watch;
use tokio::task::AbortHandle;

use crate::links::Nodes;
use crate::{Linked, Observer, following};

/// For a container to serve what loads nodes, and for each node to be made: some load what they need then.
const PATIENCE: Duration = Duration::from_secs(120);

/// How far a container is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Load {
    /// Not all is loaded.
    Loading,
    /// These nodes are, by their absolute names.
    Loaded(Vec<String>),
    /// One is not, and why.
    Refused(String),
}

/// Containers that run, by name.
pub type Loads = BTreeMap<String, Load>;

/// What is loaded into a servant's containers.
pub(crate) struct Wanted {
    /// By the container's name.
    pub(crate) components: BTreeMap<String, Vec<Component>>,
    /// Definitions of the image.
    pub(crate) registry: Arc<Registry>,
    /// For what [`Load`] waits for, each time.
    pub(crate) patience: Duration,
}

impl Wanted {
    pub(crate) fn new(
        components: BTreeMap<String, Vec<Component>>,
        registry: Arc<Registry>,
    ) -> Self {
        Self {
            components,
            registry,
            patience: PATIENCE,
        }
    }
}

/// Has containers load nodes until it is dropped.
pub(crate) struct Components {
    shown: watch::Receiver<Loads>,
    task: AbortHandle,
}

impl Drop for Components {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Components {
    /// Follows the containers of a servant; none where nothing is loaded. `nodes`: those that stubs have started hold what the
    /// robot loads into them.
    pub(crate) fn follow(
        bus: &Arc<dyn Bus>,
        nodes: &Arc<dyn Nodes>,
        observer: &Arc<dyn Observer>,
        wanted: Wanted,
    ) -> Option<Components> {
        if wanted.components.is_empty() {
            return None;
        }
        let shown = watch::Sender::default();
        let followed = Arc::new(Followed {
            bus: Arc::clone(bus),
            nodes: Arc::clone(nodes),
            observer: Arc::clone(observer),
            wanted,
            shown,
        });
        Some(Components {
            shown: followed.shown.subscribe(),
            task: tokio::spawn(followed.run()).abort_handle(),
        })
    }

    /// How far they are, now and later.
    pub(crate) fn loads(&self) -> watch::Receiver<Loads> {
        self.shown.clone()
    }
}

struct Followed {
    bus: Arc<dyn Bus>,
    nodes: Arc<dyn Nodes>,
    observer: Arc<dyn Observer>,
    wanted: Wanted,
    shown: watch::Sender<Loads>,
}

impl Followed {
    async fn run(self: Arc<Self>) {
        let containers = |graph: &Graph| {
            let all = self.wanted.components.keys();
            let there = all.filter(|name| graph.nodes.contains_key(*name));
            there.cloned().collect()
        };
        let begin = |container: String| Arc::clone(&self).one(container);
        let gone = |container: &str| {
            self.shown.send_modify(|all| drop(all.remove(container)));
        };
        let (graph, ours) = (self.bus.graph(), self.bus.node());
        following::each_node(graph, ours, containers, begin, gone).await;
    }

    async fn one(self: Arc<Self>, name: String) {
        let linked = self.nodes.running().await;
        let graph = self.bus.graph().borrow().clone();
        let has = |linked: &Linked| graph.is_of_process(&linked.node.name, &name);
        if linked.iter().any(has) {
            return;
        }
        self.show(&name, Load::Loading);
        let load = match self.load(&name).await {
            Ok(loaded) => {
                tracing::debug!(container = name, ?loaded, "its nodes are loaded");
                Load::Loaded(loaded)
            }
            Err(why) => {
                let observer = &self.observer;
                observer.event(api::Level::Error, "component-refused", &why, None);
                Load::Refused(why)
            }
        };
        self.show(&name, load);
    }

    async fn load(&self, name: &str) -> Result<Vec<String>, String> {
        let Wanted {
            components,
            registry,
            patience,
        } = &self.wanted;
        let container = Container::of(Arc::clone(&self.bus), registry, name);
        let container = container
            .map_err(|error| format!("nothing can be loaded into the container {name}: {error}"))?;
        let components = components.get(name).map_or(&[][..], Vec::as_slice);
        let loaded = container.load_all(components, *patience).await;
        loaded.map_err(|error| error.to_string())
    }

    fn show(&self, name: &str, load: Load) {
        self.shown
            .send_modify(|all| drop(all.insert(name.to_owned(), load)));
    }
}

#[cfg(test)]
mod tests;
