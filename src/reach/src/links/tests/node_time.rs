//! Conversion of stamps if the clocks differ.

use bytes::Bytes;
use link::clock::ClockSample;
use ros::bus::{FailureReason, NodeParameters, ServiceHandler, ServiceType};

use super::*;
use crate::memory_bus::{MemoryBus, MemorySystem};

const HOUR: i64 = 3600 * 1_000_000_000;
const SIM_TIME: &str = "use_sim_time";

struct SilentService;

#[async_trait]
impl ServiceHandler for SilentService {
    async fn call(&self, _: Bytes, _: &str) -> Result<Bytes, FailureReason> {
        std::future::pending().await
    }
}

async fn set_sim_time(bus: &MemoryBus, simulated: bool) {
    let change = (SIM_TIME.to_owned(), Some(ParamValue::Bool(simulated)));
    let set = bus.set(bus.node(), vec![change]).await;
    assert_eq!(set.expect("it is there"), [Ok(())]);
}

/// Creates a node that answers queries for its parameters.
async fn node(system: &Arc<MemorySystem>, name: &str) -> (Arc<MemoryBus>, Box<dyn Send + Sync>) {
    let bus = system.join(name);
    set_sim_time(&bus, false).await;
    let of = ServiceType::new("rcl_interfaces/srv/GetParameters", "*").with_version(RosVersion::Two);
    let service = format!("{name}/get_parameters");
    let served = bus.serve(&service, of, Arc::new(SilentService)).await;
    let served = served.expect("it is served");
    (bus, served)
}

/// Waits until the stamps of these two nodes are converted or not, as wanted.
async fn wait_shifts(hub: &Hub, wanted: [bool; 2]) {
    let now = || {
        let links = hub.links.lock();
        ["/detect", "/plan"].map(|node| links[node].skew(hub).is_some())
    };
    let begun = std::time::Instant::now();
    while now() != wanted {
        assert!(begun.elapsed() < PATIENCE, "{:?}", now());
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
}

#[tokio::test]
async fn nodes_of_ros_2_simulate_their_time_each_for_itself_and_change_it() {
    let system = Arc::new(MemorySystem::default());
    let registry = Arc::new(Registry::for_version(RosVersion::Two));
    let (nodes, options) = (Arc::new(QuietNodes::default()), HubOptions::default());
    let hub = Hub::new("s1", system.join("/bridge"), registry, nodes, options);
    hub.skew.on_clock_sample(ClockSample { offset: HOUR, delay: 0 });
    let (detect, _serves) = node(&system, "/detect").await;
    let (plan, _serves_too) = node(&system, "/plan").await;
    // One of them was set before there was a link, as after a restart of the daemon.
    set_sim_time(&plan, true).await;
    let mut robots = Vec::new();
    for name in ["/detect", "/plan"] {
        let hello = Hello { ros: 2, ..hello(name, 1) };
        robots.push(send_hello(&hub, &hello).await);
    }
    wait_shifts(&hub, [true, false]).await;
    set_sim_time(&detect, true).await;
    wait_shifts(&hub, [false, false]).await;
    set_sim_time(&plan, false).await;
    wait_shifts(&hub, [false, true]).await;
    set_sim_time(&detect, false).await;
    wait_shifts(&hub, [true, true]).await;
}

#[tokio::test]
async fn the_parameter_server_simulates_the_time_of_all_but_no_kept_stamp_is_changed() {
    let (hub, _nodes) = hub().await;
    let mut robots = Vec::new();
    for (name, keep_stamps) in [("/detect", true), ("/plan", false)] {
        let hello = Hello { keep_stamps, ..hello(name, 1) };
        robots.push(send_hello(&hub, &hello).await);
    }
    wait_shifts(&hub, [false, true]).await;
    for (simulated, wanted) in [(true, [false, false]), (false, [false, true])] {
        let change = (format!("/{SIM_TIME}"), Some(ParamValue::Bool(simulated)));
        hub.own_view.parameters.apply_changes(&hub, vec![change]).await;
        wait_shifts(&hub, wanted).await;
    }
}
