//! Component containers of a servant (ROS 2): loads the revision's components into containers whenever they appear.
//!
//! ```text
//!  graph ─▶ a container of the revision ─▶ started by a stub? ─yes─▶ left alone
//!                    ▲                          │ no
//!                    │ it was restarted         └─▶ Loading ─▶ Loaded, or Refused and the event component-refused
//!                    └───────────────────────────────────────────┘
//! ```

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use budget::Budget;
use link::control::NodeLaunch;
use ros::bus::{Bus, Graph};
use ros::ros2::composition::{Component, ComponentContainer, NotLoaded};
use ros::schema::{Registry, SchemaError};
use tokio::sync::watch;
use tokio::task::AbortHandle;
use tracing::Instrument;

use crate::links::NodeController;
use crate::{Observer, following};

/// Timeout for a container to provide its load service, and for each component to be created; some components load data
/// then.
const PATIENCE: Duration = Duration::from_secs(120);

/// Loading state of a container.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ContainerLoad {
    /// Some components are not loaded yet.
    Loading,
    /// All components are loaded; contains the absolute names of the nodes.
    Loaded(Vec<String>),
    /// A component could not be loaded, for this reason.
    Refused(String),
}

/// Error of loading the components of a container.
#[derive(Debug, thiserror::Error)]
enum ContainerLoadError {
    /// The image has no definitions of what a container is asked.
    #[error("nothing can be loaded into the container {container}: {source}")]
    NoDefinitions {
        /// Absolute name of the container.
        container: String,
        /// Error of the definitions.
        source: SchemaError,
    },
    /// The container does not load a component.
    #[error(transparent)]
    NotLoaded(Box<NotLoaded>),
}

/// Running containers by name.
pub type Loads = BTreeMap<String, ContainerLoad>;

/// Components to load into the containers of a servant.
pub(crate) struct ComponentPlan {
    /// Components by container name.
    pub(crate) components: BTreeMap<String, Vec<Component>>,
    /// Type definitions of the image.
    pub(crate) registry: Arc<Registry>,
    /// Timeout of each step; see [`ContainerLoad`].
    pub(crate) patience: Duration,
}

impl ComponentPlan {
    pub(crate) fn new(components: BTreeMap<String, Vec<Component>>, registry: Arc<Registry>) -> Self {
        Self { components, registry, patience: PATIENCE }
    }
}

/// Loads components into containers until it is dropped.
pub(crate) struct ComponentLoader {
    shown: watch::Receiver<Loads>,
    task: AbortHandle,
}

impl Drop for ComponentLoader {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl ComponentLoader {
    /// Starts following the containers of a servant; `None` if there is nothing to load. Containers in `nodes` were
    /// started by stubs and hold what the robot loads into them. The processor time for following is charged to
    /// `budget`.
    pub(crate) fn start(
        bus: &Arc<dyn Bus>,
        nodes: &Arc<dyn NodeController>,
        observer: &Arc<dyn Observer>,
        wanted: ComponentPlan,
        budget: &Budget,
    ) -> Option<ComponentLoader> {
        if wanted.components.is_empty() {
            return None;
        }
        let shown = watch::Sender::default();
        let followed = Arc::new(ContainerFollower {
            bus: Arc::clone(bus),
            nodes: Arc::clone(nodes),
            observer: Arc::clone(observer),
            wanted,
            shown,
        });
        Some(ComponentLoader {
            shown: followed.shown.subscribe(),
            task: tokio::spawn(budget.meter(followed.run()).in_current_span()).abort_handle(),
        })
    }

    /// Returns a watch on the loading states.
    pub(crate) fn loads(&self) -> watch::Receiver<Loads> {
        self.shown.clone()
    }
}

struct ContainerFollower {
    bus: Arc<dyn Bus>,
    nodes: Arc<dyn NodeController>,
    observer: Arc<dyn Observer>,
    wanted: ComponentPlan,
    shown: watch::Sender<Loads>,
}

impl ContainerFollower {
    async fn run(self: Arc<Self>) {
        let containers = |graph: &Graph| {
            let all = self.wanted.components.keys();
            let there = all.filter(|name| graph.nodes.contains_key(*name));
            there.cloned().collect()
        };
        let begin = |container: String| Arc::clone(&self).load_container(container);
        let gone = |container: &str| {
            self.shown.send_modify(|all| drop(all.remove(container)));
        };
        let (graph, ours) = (self.bus.graph(), self.bus.node());
        following::run_for_each_node(graph, ours, containers, begin, gone).await;
    }

    async fn load_container(self: Arc<Self>, name: String) {
        let linked = self.nodes.running_nodes().await;
        let graph = self.bus.graph().borrow().clone();
        let has = |linked: &NodeLaunch| graph.is_in_process(&linked.name, &name);
        if linked.iter().any(has) {
            return;
        }
        self.show_load(&name, ContainerLoad::Loading);
        let load = match self.load_components(&name).await {
            Ok(loaded) => {
                tracing::debug!(?loaded, "its nodes are loaded");
                ContainerLoad::Loaded(loaded)
            }
            Err(error) => {
                let why = error.to_string();
                let observer = &self.observer;
                observer.record_event(api::Level::Error, "component-refused", &why, None);
                ContainerLoad::Refused(why)
            }
        };
        self.show_load(&name, load);
    }

    async fn load_components(&self, name: &str) -> Result<Vec<String>, ContainerLoadError> {
        let ComponentPlan { components, registry, patience } = &self.wanted;
        let container = ComponentContainer::new(Arc::clone(&self.bus), registry, name);
        let container =
            container.map_err(|source| ContainerLoadError::NoDefinitions { container: name.to_owned(), source })?;
        let components = components.get(name).map_or(&[][..], Vec::as_slice);
        let loaded = container.load_all(components, *patience).await;
        loaded.map_err(|error| ContainerLoadError::NotLoaded(Box::new(error)))
    }

    fn show_load(&self, name: &str, load: ContainerLoad) {
        self.shown.send_modify(|all| drop(all.insert(name.to_owned(), load)));
    }
}

#[cfg(test)]
mod tests;
