use budget::WorkLimit;
use tokio::time::timeout;

use super::*;
use crate::doubles::{RecordedEvents, StubNodesDouble};
use crate::memory_bus::MemorySystem;
use crate::memory_container::{MemoryContainer, registry};

/// Only limits the duration of a failing test.
const PATIENCE: Duration = Duration::from_secs(60);

/// A servant whose revision loads components into `/box`.
struct ComponentWorld {
    system: Arc<MemorySystem>,
    events: Arc<RecordedEvents>,
    components: ComponentLoader,
    budget: Budget,
}

impl ComponentWorld {
    fn new(plugins: &[&str], started: StubNodesDouble, patience: Duration) -> Self {
        Self::with_nodes(Arc::default(), plugins, started, patience)
    }

    /// Creates a servant in which nodes are already running.
    fn with_nodes(system: Arc<MemorySystem>, plugins: &[&str], started: StubNodesDouble, patience: Duration) -> Self {
        let component = |plugin: &&str| Component {
            package: "talk".to_owned(),
            plugin: (*plugin).to_owned(),
            ..Component::default()
        };
        let components = plugins.iter().map(component).collect();
        let wanted =
            ComponentPlan { patience, ..ComponentPlan::new([("/box".to_owned(), components)].into(), registry()) };
        let events = Arc::<RecordedEvents>::default();
        let bus: Arc<dyn Bus> = system.join("/cloudroid_bridge");
        let (nodes, observer): (Arc<dyn NodeController>, Arc<dyn Observer>) = (Arc::new(started), events.clone());
        // More than these tests take.
        let work = WorkLimit { cores: 1.0, burst: PATIENCE };
        let budget = Budget::new("the daemon", 1 << 20).child_with_work("servant x", 1 << 20, work);
        let components = ComponentLoader::start(&bus, &nodes, &observer, wanted, &budget);
        Self { system, events, components: components.expect("something is loaded"), budget }
    }

    /// Waits until the container is past loading and returns its state.
    async fn load(&self) -> ContainerLoad {
        let mut loads = self.components.loads();
        let over = |all: &Loads| all.get("/box").is_some_and(|it| *it != ContainerLoad::Loading);
        let all = timeout(PATIENCE, loads.wait_for(over)).await.expect("in time");
        all.expect("followed")["/box"].clone()
    }
}

#[tokio::test]
async fn what_the_revision_loads_is_loaded_when_its_container_appears() {
    let world = ComponentWorld::new(&["talk::Talker"], StubNodesDouble::default(), PATIENCE);
    assert!(world.components.loads().borrow().is_empty());
    let container = MemoryContainer::start(&world.system, "/box").await;
    assert_eq!(world.load().await, ContainerLoad::Loaded(vec!["/talker".to_owned()]));
    assert_eq!(container.names(), ["/talker"]);
    assert!(world.budget.work_time() > Duration::ZERO, "the servant pays for it");
    // The daemon was restarted while the servant went on.
    let again =
        ComponentWorld::with_nodes(world.system.clone(), &["talk::Talker"], StubNodesDouble::default(), PATIENCE);
    assert_eq!(again.load().await, ContainerLoad::Loaded(vec!["/talker".to_owned()]));
    assert_eq!(container.loaded.lock().asked.len(), 1, "it was there");
}

#[tokio::test]
async fn what_is_not_loaded_is_an_event_with_the_containers_words() {
    let world = ComponentWorld::new(&["talk::Talker", "talk::Walker"], StubNodesDouble::default(), PATIENCE);
    let _container = MemoryContainer::start(&world.system, "/box").await;
    let words = "the component container /box does not load talk::Walker of package talk: Failed to find class with \
                 the \
                 requested plugin name.";
    assert_eq!(world.load().await, ContainerLoad::Refused(words.to_owned()));
    let events = world.events.0.lock().clone();
    assert_eq!(events, [("component-refused".to_owned(), words.to_owned())]);
}

#[tokio::test]
async fn a_container_that_serves_nothing_is_told_with_how_long_was_waited() {
    let patience = Duration::from_millis(100);
    let world = ComponentWorld::new(&["talk::Talker"], StubNodesDouble::default(), patience);
    let _node = world.system.join("/box");
    let ContainerLoad::Refused(words) = world.load().await else {
        panic!("it loads nothing");
    };
    assert!(words.contains("did not serve /box/_container/load_node within 100ms"), "{words}");
}

#[tokio::test]
async fn a_container_that_a_stub_has_started_is_left_to_the_robot() {
    let world = ComponentWorld::new(&["talk::Talker"], StubNodesDouble::node("/box"), PATIENCE);
    let container = MemoryContainer::start(&world.system, "/box").await;
    // The follower has seen the container by the time it has seen the later node, and its task has run: there is only
    // one thread.
    for _ in 0..100 {
        tokio::task::yield_now().await;
    }
    assert!(world.components.loads().borrow().is_empty());
    assert!(container.loaded.lock().asked.is_empty());
}
