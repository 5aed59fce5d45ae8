//! Component containers in memory: loaded components are probed like any node.

use ros::bus::RosVersion;
use serde_json::json;

use super::memory_bus::MemorySystem;
use super::memory_container::{DEFINITIONS, MemoryContainer};
use super::*;

fn component(plugin: &str, name: &str) -> Component {
    Component { package: "talk".to_owned(), plugin: plugin.to_owned(), name: name.to_owned(), ..Component::default() }
}

async fn run_probe(
    system: &Arc<MemorySystem>,
    components: Vec<Component>,
    patience: Duration,
) -> Result<ProbeResult, ProbeError> {
    let definitions = DEFINITIONS.map(|(key, text)| (key.to_owned(), text.to_owned()));
    let definitions = definitions.into();
    let registry = Registry::with_definitions(RosVersion::Two, &definitions).expect("valid");
    let options = ProbeOptions {
        patience,
        settle: Duration::from_millis(50),
        restless: Duration::from_secs(1),
        components: [("/box".to_owned(), components)].into(),
        ..ProbeOptions::new(vec!["/box".into()], "/looker")
    };
    let bus: Arc<dyn Bus> = system.join("/looker");
    probe(&bus, &registry, &definitions, &options, std::future::pending()).await
}

const PATIENCE: Duration = Duration::from_secs(60);

#[tokio::test]
async fn a_container_loads_its_nodes_before_they_are_looked_at() {
    let system = Arc::default();
    let container = MemoryContainer::start(&system, "/box").await;
    let parameter = json!({"name": "gains", "value": {"type": 8, "double_array_value": [0.5, "Infinity"]}});
    let first = Component {
        namespace: "/front".to_owned(),
        remap_rules: vec!["chatter:=/said".to_owned()],
        parameters: vec![parameter],
        ..component("talk::Talker", "see")
    };
    let components = vec![first, component("talk::Talker", "")];
    run_probe(&system, components, PATIENCE).await.expect("found");
    assert_eq!(container.names(), ["/front/see", "/talker"]);
    let asked = container.loaded.lock().asked[0].clone();
    for (field, expected) in [
        ("package_name", json!("talk")),
        ("plugin_name", json!("talk::Talker")),
        ("node_name", json!("see")),
        ("node_namespace", json!("/front")),
        ("remap_rules", json!(["chatter:=/said"])),
    ] {
        assert_eq!(asked[field], expected, "{field}");
    }
    let gains = &asked["parameters"][0];
    assert_eq!(gains["name"], "gains");
    assert_eq!(gains["value"]["type"], 8);
    assert_eq!(gains["value"]["double_array_value"][0], 0.5);
}

#[tokio::test]
async fn what_is_not_loaded_is_told_with_the_containers_words() {
    let system = Arc::default();
    let container = MemoryContainer::start(&system, "/box").await;
    let components =
        vec![component("talk::Talker", "see"), component("talk::Walker", "go"), component("talk::Talker", "late")];
    let error = run_probe(&system, components, PATIENCE).await.expect_err("refused");
    assert_eq!(
        error.to_string(),
        "the component container /box does not load /go (talk::Walker of package talk): Failed to find class with the \
         requested plugin name."
    );
    assert_eq!(container.names(), ["/see"], "nothing is tried behind it");
}

#[tokio::test]
async fn a_node_that_loads_nothing_is_told_with_how_long_was_waited() {
    let system: Arc<MemorySystem> = Arc::default();
    let _node = system.join("/box");
    let components = vec![component("talk::Talker", "see")];
    let patience = Duration::from_millis(200);
    let error = run_probe(&system, components, patience).await.expect_err("late");
    let words = error.to_string();
    assert!(
        words.contains("/see (talk::Talker of package talk): it did not serve /box/_container/load_node within 200ms"),
        "{words}"
    );
}
