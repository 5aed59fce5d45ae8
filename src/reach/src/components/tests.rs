use tokio::time::timeout;

use super::*;
use crate::doubles::{Events, Started};
use crate::memory_bus::MemorySystem;
use crate::memory_container::{MemoryContainer, registry};

/// Only bounds how long a failing test takes.
const LONG: Duration = Duration::from_secs(60);

/// A servant whose revision loads something into `/box`.
struct World {
    system: Arc<MemorySystem>,
    events: Arc<Events>,
    components: Components,
}

impl World {
    fn new(plugins: &[&str], started: Started, patience: Duration) -> Self {
        Self::beside(Arc::default(), plugins, started, patience)
    }

    /// Where nodes run already.
    fn beside(
        system: Arc<MemorySystem>,
        plugins: &[&str],
        started: Started,
        patience: Duration,
    ) -> Self {
        let component = |plugin: &&str| Component {
            package: "talk".to_owned(),
            plugin: (*plugin).to_owned(),
            ..Component::default()
        };
        let components = plugins.iter().map(component).collect();
        let wanted = Wanted {
            patience,
            ..Wanted::new([("/box".to_owned(), components)].into(), registry())
        };
        let events = Arc::<Events>::default();
        let bus: Arc<dyn Bus> = system.join("/cloudroid_bridge");
        let (nodes, observer): (Arc<dyn Nodes>, Arc<dyn Observer>) =
            (Arc::new(started), events.clone());
        let components = Components::follow(&bus, &nodes, &observer, wanted);
        Self {
            system,
            events,
            components: components.expect("something is loaded"),
        }
    }

    /// How far the container is when it is past loading.
    async fn load(&self) -> Load {
        let mut loads = self.components.loads();
        let over = |all: &Loads| all.get("/box").is_some_and(|it| *it != Load::Loading);
        let all = timeout(LONG, loads.wait_for(over)).await.expect("in time");
        all.expect("followed")["/box"].clone()
    }
}

#[tokio::test]
async fn what_the_revision_loads_is_loaded_when_its_container_appears() {
    let world = World::new(&["talk::Talker"], Started::default(), LONG);
    assert!(world.components.loads().borrow().is_empty());
    let container = MemoryContainer::start(&world.system, "/box").await;
    assert_eq!(world.load().await, Load::Loaded(vec!["/talker".to_owned()]));
    assert_eq!(container.names(), ["/talker"]);
    // The daemon is another one, and the servant has gone on.
    let again = World::beside(
        world.system.clone(),
        &["talk::Talker"],
        Started::default(),
        LONG,
    );
    assert_eq!(again.load().await, Load::Loaded(vec!["/talker".to_owned()]));
    assert_eq!(container.loaded.lock().asked.len(), 1, "it was there");
}

#[tokio::test]
async fn what_is_not_loaded_is_an_event_with_the_containers_words() {
    let world = World::new(&["talk::Talker", "talk::Walker"], Started::default(), LONG);
    let _container = MemoryContainer::start(&world.system, "/box").await;
    let words = "the component container /box does not load talk::Walker of package talk: Failed to find class with the \
                 requested plugin name.";
    assert_eq!(world.load().await, Load::Refused(words.to_owned()));
    let events = world.events.0.lock().clone();
    assert_eq!(events, [("component-refused".to_owned(), words.to_owned())]);
}

#[tokio::test]
async fn a_container_that_serves_nothing_is_told_with_how_long_was_waited() {
    let patience = Duration::from_millis(100);
    let world = World::new(&["talk::Talker"], Started::default(), patience);
    let _node = world.system.join("/box");
    let Load::Refused(words) = world.load().await else {
        panic!("it loads nothing");
    };
    assert!(
        words.contains("did not serve /box/_container/load_node within 100ms"),
        "{words}"
    );
}

#[tokio::test]
async fn a_container_that_a_stub_has_started_is_left_to_the_robot() {
    let world = World::new(&["talk::Talker"], Started::node("/box"), LONG);
    let container = MemoryContainer::start(&world.system, "/box").await;
    // Whoever follows has seen the container when it has seen what came later, and its task has run by then: one thread.
    for _ in 0..100 {
        tokio::task::yield_now().await;
    }
    assert!(world.components.loads().borrow().is_empty());
    assert!(container.loaded.lock().asked.is_empty());
}
