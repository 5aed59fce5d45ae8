//! A component container in memory, with some classes, which creates a node for each component that it is asked to
//! load.

use std::sync::Arc;

use async_trait::async_trait;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{Bus, FailureReason, RosVersion, ServiceHandler, ServiceType};
use ros::codec::{FillOptions, JsonOptions, from_json, to_json};
use ros::schema::{Registry, ServiceDef};
use serde_json::{Value, json};

use super::memory_bus::{MemoryBus, MemorySystem};

/// Definitions of `composition_interfaces` from an image.
pub const DEFINITIONS: [(&str, &str); 4] = [
    (
        "rcl_interfaces/msg/ParameterValue",
        "uint8 type\nbool bool_value\nint64 integer_value\nfloat64 double_value\nstring string_value\n\
         byte[] byte_array_value\nbool[] bool_array_value\nint64[] integer_array_value\n\
         float64[] double_array_value\nstring[] string_array_value\n",
    ),
    ("rcl_interfaces/msg/Parameter", "string name\nParameterValue value\n"),
    (
        "composition_interfaces/srv/LoadNode",
        "string package_name\nstring plugin_name\nstring node_name\nstring node_namespace\nuint8 log_level\n\
         string[] remap_rules\nrcl_interfaces/Parameter[] parameters\nrcl_interfaces/Parameter[] extra_arguments\n\
         ---\nbool success\nstring error_message\nstring full_node_name\nuint64 unique_id\n",
    ),
    ("composition_interfaces/srv/ListNodes", "---\nstring[] full_node_names\nuint64[] unique_ids\n"),
];

/// Returns a registry with the definitions for loading components.
pub fn registry() -> Arc<Registry> {
    let all = DEFINITIONS.map(|(key, text)| (key.to_owned(), text.to_owned()));
    let registry = Registry::with_definitions(RosVersion::Two, &all.into());
    Arc::new(registry.expect("valid"))
}

/// Requests that it received, as JSON, and its nodes.
#[derive(Default)]
pub struct Loaded {
    pub asked: Vec<Value>,
    pub nodes: Vec<(String, Arc<MemoryBus>)>,
}

/// A running container.
pub struct MemoryContainer {
    pub loaded: Arc<Mutex<Loaded>>,
    _node: Arc<MemoryBus>,
    _serving: Vec<Box<dyn Send + Sync>>,
}

impl MemoryContainer {
    /// Starts the container as the node `name`. It can load classes that end in `Talker`; a talker without a name
    /// becomes `/talker`.
    pub async fn start(system: &Arc<MemorySystem>, name: &str) -> Self {
        let (node, registry) = (system.join(name), registry());
        let loaded = Arc::<Mutex<Loaded>>::default();
        let mut serving = Vec::new();
        for (part, of) in [
            ("load_node", "composition_interfaces/srv/LoadNode"),
            ("list_nodes", "composition_interfaces/srv/ListNodes"),
        ] {
            let of = registry.service(of).expect("defined");
            let handler = Part { of: Arc::clone(&of), system: Arc::clone(system), loaded: Arc::clone(&loaded) };
            let service = format!("{name}/_container/{part}");
            let served = node.serve(&service, ServiceType::from_service(&of), Arc::new(handler));
            serving.push(served.await.expect("served"));
        }
        Self { loaded, _node: node, _serving: serving }
    }

    /// Returns the names of the loaded nodes.
    pub fn names(&self) -> Vec<String> {
        let loaded = self.loaded.lock();
        loaded.nodes.iter().map(|(name, _)| name.clone()).collect()
    }
}

impl Drop for MemoryContainer {
    fn drop(&mut self) {
        // Nodes lock the system when they leave it, so they are dropped without holding a lock.
        let nodes = std::mem::take(&mut self.loaded.lock().nodes);
        drop(nodes);
    }
}

struct Part {
    of: Arc<ServiceDef>,
    system: Arc<MemorySystem>,
    loaded: Arc<Mutex<Loaded>>,
}

impl Part {
    fn load(&self, asked: Value) -> Value {
        let text = |field: &str| asked[field].as_str().unwrap_or_default().to_owned();
        let (plugin, name, namespace) = (text("plugin_name"), text("node_name"), text("node_namespace"));
        let mut loaded = self.loaded.lock();
        loaded.asked.push(asked.clone());
        if !plugin.ends_with("Talker") {
            let words = "Failed to find class with the requested plugin name.";
            return json!({"success": false, "error_message": words});
        }
        let name = if name.is_empty() { "talker" } else { &name };
        let name = format!("{}/{name}", namespace.trim_end_matches('/'));
        let node = self.system.join(&name);
        loaded.nodes.push((name.clone(), node));
        json!({"success": true, "full_node_name": name, "unique_id": loaded.nodes.len()})
    }
}

#[async_trait]
impl ServiceHandler for Part {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        let mut asked = Vec::new();
        to_json(&self.of.request, &request, &mut asked, &JsonOptions::default()).expect("a request");
        let asked: Value = serde_json::from_slice(&asked).expect("JSON");
        let answer = match asked.get("plugin_name") {
            Some(_) => self.load(asked),
            None => {
                let loaded = self.loaded.lock();
                let names: Vec<&String> = loaded.nodes.iter().map(|(name, _)| name).collect();
                json!({"full_node_names": names})
            }
        };
        let (text, mut bytes) = (answer.to_string(), Vec::new());
        from_json(&self.of.response, text.as_bytes(), &mut bytes, &FillOptions::default()).expect("fits");
        Ok(bytes.into())
    }
}
