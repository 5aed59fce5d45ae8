//! Nodes loaded into one process with others: a component container serves the loading of nodes
//! (`composition_interfaces/srv/LoadNode`;
//! <https://docs.ros.org/en/jazzy/Concepts/Intermediate/About-Composition.html>).
//!
//! ```text
//!  container ──serves load_node?──▶ list_nodes ──▶ load_node for each missing one, in order ──▶ names
//!                  └─ not in time ─────────────────────────┴─ failure ─▶ NotLoaded
//! ```

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use ros_bus::{Bus, BusError, FailureReason, Graph, ServiceType};
use ros_message::codec::{CodecError, FillOptions, JsonOptions, from_json, to_json};
use ros_message::schema::{MessageType, Registry, SchemaError, ServiceDef};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use tokio::time::timeout;

/// Service type that loads a node.
const LOAD: &str = "composition_interfaces/srv/LoadNode";
/// Service type that lists the loaded nodes.
const LIST: &str = "composition_interfaces/srv/ListNodes";
/// Types whose definitions are needed to load nodes; the image must provide them.
pub const SERVICES: [&str; 2] = [LOAD, LIST];

/// A node to be loaded. Its JSON form is the request of `composition_interfaces/srv/LoadNode`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Component {
    /// Package that registers the component.
    #[serde(rename = "package_name")]
    pub package: String,
    /// Class, such as `talkers::Talker`.
    #[serde(rename = "plugin_name")]
    pub plugin: String,
    /// Node name; empty for the name that the program sets.
    #[serde(rename = "node_name", default)]
    pub name: String,
    /// Node namespace; empty for the namespace that the program sets.
    #[serde(rename = "node_namespace", default)]
    pub namespace: String,
    /// Remapping rules, `FROM:=TO`.
    #[serde(default)]
    pub remap_rules: Vec<String>,
    /// Parameters, each a `rcl_interfaces/msg/Parameter`.
    #[serde(default)]
    pub parameters: Vec<Value>,
    /// Arguments for the container, each a `rcl_interfaces/msg/Parameter`.
    #[serde(default)]
    pub extra_arguments: Vec<Value>,
}

impl Component {
    /// Returns the absolute name; `None` if the program determines it.
    pub fn full_name(&self) -> Option<String> {
        let renamed = self.remap_rules.iter().any(|rule| rule.starts_with("__"));
        let known = !self.name.is_empty() && !renamed;
        let above = self.namespace.trim_matches('/');
        known.then(|| match above {
            "" => format!("/{}", self.name),
            above => format!("/{above}/{}", self.name),
        })
    }
}

/// Error of a container that did not load a node.
#[derive(Debug, thiserror::Error)]
#[error("the component container {container} does not load {}: {reason}", describe_component(.name, .plugin, .package))]
pub struct NotLoaded {
    /// Absolute name of the container.
    pub container: String,
    /// Absolute name of the node, if known.
    pub name: Option<String>,
    /// Class of the node.
    pub plugin: String,
    /// Package of the class.
    pub package: String,
    /// The container's reason, or the reason for its silence.
    pub reason: Box<LoadFailure>,
}

/// The reason why a container did not load a node.
#[derive(Debug, thiserror::Error)]
pub enum LoadFailure {
    /// The container does not serve the service that loads nodes.
    #[error(
        "it did not serve {service} within {waited:?}: it is not a component container, or is still waiting (see its \
            log)"
    )]
    NotServed {
        /// Name of the service.
        service: String,
        /// Time waited.
        waited: Duration,
    },
    /// The container refused without a reason.
    #[error("it does not say why (see its log)")]
    Silent,
    /// The container's own reason.
    #[error(transparent)]
    Refused(FailureReason),
    /// The call failed.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// The request or the answer does not fit the image's definition of the service.
    #[error(transparent)]
    Codec(#[from] CodecError),
    /// The answer is not JSON.
    #[error("its answer is not JSON: {0}")]
    Json(#[from] serde_json::Error),
}

fn describe_component(name: &Option<String>, plugin: &str, package: &str) -> String {
    let class = format!("{plugin} of package {package}");
    match name {
        Some(name) => format!("{name} ({class})"),
        None => class,
    }
}

/// A component container: a process into which nodes are loaded.
pub struct ComponentContainer {
    bus: Arc<dyn Bus>,
    node: String,
    load: Arc<ServiceDef>,
    list: Arc<ServiceDef>,
}

impl ComponentContainer {
    /// Returns the container of this absolute name, with the definitions of its image.
    ///
    /// # Errors
    /// The image has no definitions of `composition_interfaces`.
    pub fn new(bus: Arc<dyn Bus>, registry: &Registry, node: &str) -> Result<Self, SchemaError> {
        Ok(Self { bus, node: node.to_owned(), load: registry.service(LOAD)?, list: registry.service(LIST)? })
    }

    /// Loads these components in order, except those that are already loaded; returns their absolute names. The
    /// container may take up to `patience` to serve the loading service, and again for each component: some load what
    /// they need when they are created.
    ///
    /// # Errors
    /// The first component that is not loaded; later ones are not tried.
    pub async fn load_all(&self, components: &[Component], patience: Duration) -> Result<Vec<String>, NotLoaded> {
        let Some(first) = components.first() else {
            return Ok(Vec::new());
        };
        let served = self.wait_until_served(patience).await;
        let there = match served {
            Ok(()) => self.loaded_nodes(patience).await,
            Err(reason) => Err(reason),
        };
        let there = there.map_err(|reason| self.not_loaded(first, reason))?;
        let mut names = there.clone();
        for component in missing_components(components, there) {
            let loaded = self.load(component, patience).await;
            names.push(loaded.map_err(|reason| self.not_loaded(component, reason))?);
        }
        Ok(names)
    }

    fn service(&self, part: &str) -> String {
        format!("{}/_container/{part}", self.node)
    }

    async fn wait_until_served(&self, patience: Duration) -> Result<(), LoadFailure> {
        let service = self.service("load_node");
        // Items hidden from tools are found in the endpoints only.
        let there = |graph: &Arc<Graph>| {
            let ends = graph.ends.get(&self.node);
            ends.is_some_and(|ends| ends.services.contains_key(&service))
        };
        let mut graph = self.bus.graph();
        match timeout(patience, graph.wait_for(there)).await {
            Ok(Ok(_)) => Ok(()),
            Ok(Err(_)) => Err(BusError::Closed.into()),
            Err(_) => Err(LoadFailure::NotServed { service, waited: patience }),
        }
    }

    /// Returns the names of the nodes that the container has loaded, in order.
    async fn loaded_nodes(&self, patience: Duration) -> Result<Vec<String>, LoadFailure> {
        let answer = match self.call("list_nodes", &self.list, b"{}", patience).await {
            Ok(answer) => answer,
            // A container that does not list nodes is of another make and has just started.
            Err(LoadFailure::Bus(BusError::NoService(_))) => return Ok(Vec::new()),
            Err(other) => return Err(other),
        };
        let names = answer["full_node_names"].as_array();
        let names = names.into_iter().flatten().filter_map(Value::as_str);
        Ok(names.map(str::to_owned).collect())
    }

    async fn load(&self, component: &Component, patience: Duration) -> Result<String, LoadFailure> {
        let request = serde_json::to_vec(component).unwrap_or_default();
        let answer = self.call("load_node", &self.load, &request, patience);
        let answer = answer.await?;
        let text = |field: &str| answer[field].as_str().unwrap_or_default().to_owned();
        match (answer["success"].as_bool(), text("error_message")) {
            (Some(true), _) => Ok(text("full_node_name")),
            (_, words) if words.is_empty() => Err(LoadFailure::Silent),
            (_, words) => Err(LoadFailure::Refused(FailureReason::new(words))),
        }
    }

    /// Calls a service once; returns the answer as JSON.
    async fn call(
        &self,
        part: &str,
        of: &ServiceDef,
        request: &[u8],
        patience: Duration,
    ) -> Result<Value, LoadFailure> {
        let mut bytes = Vec::new();
        from_json(&of.request, request, &mut bytes, &FillOptions::default())?;
        let (service, digest) = (self.service(part), ServiceType::from_service(of).digest);
        let answer = self.bus.call_typed(&service, &digest, bytes.into(), patience);
        to_json_value(&of.response, &answer.await?)
    }

    fn not_loaded(&self, component: &Component, reason: LoadFailure) -> NotLoaded {
        NotLoaded {
            container: self.node.clone(),
            name: component.full_name(),
            plugin: component.plugin.clone(),
            package: component.package.clone(),
            reason: Box::new(reason),
        }
    }
}

/// Returns the components that are not among the loaded names. A loaded name that no component sets was chosen by a
/// node itself: that many of the components without a name are taken as loaded, the first ones.
fn missing_components(components: &[Component], mut there: Vec<String>) -> Vec<&Component> {
    let mut take = |name: &String| {
        let found = there.iter().position(|other| other == name);
        found.map(|at| there.swap_remove(at)).is_some()
    };
    let mut left: Vec<&Component> = components.iter().collect();
    left.retain(|component| !component.full_name().is_some_and(|name| take(&name)));
    let mut others = there.len();
    left.retain(|component| {
        let is_there = others > 0 && component.full_name().is_none();
        others -= usize::from(is_there);
        !is_there
    });
    left
}

fn to_json_value(of: &MessageType, answer: &Bytes) -> Result<Value, LoadFailure> {
    let mut json = Vec::new();
    to_json(of, answer, &mut json, &JsonOptions::default())?;
    Ok(serde_json::from_slice(&json)?)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn component(name: &str, namespace: &str) -> Component {
        Component {
            package: "talkers".to_owned(),
            plugin: "talkers::Talker".to_owned(),
            name: name.to_owned(),
            namespace: namespace.to_owned(),
            ..Component::default()
        }
    }

    #[test]
    fn a_node_is_called_as_the_request_says_or_as_nobody_knows() {
        for (name, namespace, expected) in [
            ("see", "", Some("/see")),
            ("see", "/", Some("/see")),
            ("see", "/front/left", Some("/front/left/see")),
            ("", "/front", None),
        ] {
            let told = component(name, namespace).full_name();
            assert_eq!(told.as_deref(), expected, "{name} {namespace}");
        }
        let mut renamed = component("see", "");
        renamed.remap_rules.push("__node:=look".to_owned());
        assert_eq!(renamed.full_name(), None);
    }

    #[test]
    fn what_is_loaded_is_not_loaded_again() {
        let all = [component("a", ""), component("", ""), component("b", "/x"), component("", "")];
        let still = |there: &[&str]| {
            let there = there.iter().map(|&name| name.to_owned()).collect();
            let left = missing_components(&all, there).into_iter();
            left.map(|one| one.full_name()).collect::<Vec<_>>()
        };
        let (a, b) = (Some("/a".to_owned()), Some("/x/b".to_owned()));
        assert_eq!(still(&[]), [a.clone(), None, b.clone(), None]);
        assert_eq!(still(&["/a"]), [None, b.clone(), None]);
        assert_eq!(still(&["/a", "/said_itself"]), [b, None]);
        assert_eq!(still(&["/x/b", "/one", "/two"]), [a]);
        assert!(still(&["/a", "/x/b", "/one", "/two", "/more"]).is_empty());
    }

    #[test]
    fn a_request_is_the_component_and_nothing_else() {
        let mut component = component("see", "/front");
        component.parameters = vec![json!({"name": "rate", "value": {"type": 2}})];
        let text = serde_json::to_value(&component).expect("JSON");
        let expected = json!({
            "package_name": "talkers",
            "plugin_name": "talkers::Talker",
            "node_name": "see",
            "node_namespace": "/front",
            "remap_rules": [],
            "parameters": [{"name": "rate", "value": {"type": 2}}],
            "extra_arguments": [],
        });
        assert_eq!(text, expected);
        let more = json!({"package_name": "p", "plugin_name": "p::C", "shell": "x"});
        assert!(serde_json::from_value::<Component>(more).is_err());
    }

    #[test]
    fn what_is_not_loaded_is_told_by_node_and_class() {
        let words = |name: Option<&str>| {
            let error = NotLoaded {
                container: "/box".to_owned(),
                name: name.map(str::to_owned),
                plugin: "talkers::Talker".to_owned(),
                package: "talkers".to_owned(),
                reason: Box::new(LoadFailure::Refused(FailureReason::new("no such class"))),
            };
            error.to_string()
        };
        assert_eq!(
            words(Some("/see")),
            "the component container /box does not load /see (talkers::Talker of package talkers): no such class"
        );
        assert_eq!(
            words(None),
            "the component container /box does not load talkers::Talker of package talkers: no such class"
        );
    }
}
