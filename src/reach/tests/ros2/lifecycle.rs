use std::sync::Arc;

use ros::bus::{Bus, ParamValue};
use ros::ros2::lifecycle::{BeginOutcome, LifecycleNode, State, StateChange, StateChanges, Transition, begin_all};
use tokio::time::timeout;

use super::lab::{LONG, Lab};
use super::parameters::tuned_node;

const STAGED: &str = "/lab/staged";

async fn next(changes: &mut StateChanges) -> StateChange {
    let change = timeout(LONG, changes.next()).await;
    change.expect("a change").expect("the bus is open")
}

#[tokio::test]
async fn a_node_is_configured_and_activated() {
    let lab = Lab::new();
    let (bus, _nodes) = tuned_node(&lab).await;
    let graph = Arc::clone(&bus.graph().borrow());
    assert!(LifecycleNode::has_lifecycle(&graph, STAGED));
    assert!(!LifecycleNode::has_lifecycle(&graph, "/lab/tuned"));
    let node = LifecycleNode::new(bus.clone(), STAGED);
    assert_eq!(node.state().await.unwrap(), State::Unconfigured);
    let known = node.transitions().await.unwrap();
    let labels: Vec<&str> = known.iter().map(|(label, _)| &**label).collect();
    assert_eq!(labels, ["configure", "shutdown"]);

    node.change_state(Transition::Configure, LONG).await.unwrap();
    assert_eq!(node.state().await.unwrap(), State::Inactive);
    let again = node.change_state(Transition::Configure, LONG).await.unwrap_err();
    assert_eq!(
        again.to_string(),
        "service /lab/staged/change_state failed: /lab/staged did not configure, and is inactive now"
    );
    let parameters = bus.node_parameters().unwrap();
    let broken = |value| vec![("broken".to_owned(), Some(ParamValue::Bool(value)))];
    parameters.set(STAGED, broken(true)).await.unwrap();
    node.change_state(Transition::Activate, LONG).await.unwrap_err();
    parameters.set(STAGED, broken(false)).await.unwrap();

    let mut changes = node.watch().await.unwrap();
    node.change_state(Transition::Activate, LONG).await.unwrap();
    for (from, to) in [(State::Inactive, State::Activating), (State::Activating, State::Active)] {
        assert_eq!(next(&mut changes).await, StateChange { from, to });
    }
    assert_eq!(node.state().await.unwrap(), State::Active);
    node.change_state(Transition::Shutdown, LONG).await.unwrap();
    assert_eq!(node.state().await.unwrap(), State::Finalized);
}

#[tokio::test]
async fn a_node_begins_when_nobody_else_drives_it() {
    let lab = Lab::new();
    let (bus, _nodes) = tuned_node(&lab).await;
    let shown: Arc<dyn Bus> = bus.clone();
    let parameters = bus.node_parameters().unwrap();
    let broken = |value| vec![("broken".to_owned(), Some(ParamValue::Bool(value)))];
    parameters.set(STAGED, broken(true)).await.unwrap();
    let refused = begin_all(&shown, LONG).await.unwrap_err();
    assert_eq!((&*refused.node, refused.transition), (STAGED, Transition::Activate));
    // It was configured by then, so it is left to whoever configured it.
    let all = begin_all(&shown, LONG).await.unwrap();
    assert_eq!(all, [(STAGED.to_owned(), BeginOutcome::Left(State::Inactive))]);

    let lab = Lab::new();
    let (bus, _nodes) = tuned_node(&lab).await;
    let shown: Arc<dyn Bus> = bus.clone();
    // Somebody has a client of it and may therefore manage it.
    let manager = lab.join("/manager").await;
    let driving = LifecycleNode::new(manager.clone(), STAGED);
    assert_eq!(driving.state().await.unwrap(), State::Unconfigured);
    let known = driving.change_state(Transition::Activate, LONG).await;
    known.expect_err("it is not configured");
    let driven = |graph: &ros::bus::Graph| {
        let ends = graph.ends.get("/manager");
        ends.is_some_and(|ends| ends.clients.contains_key("/lab/staged/change_state"))
    };
    super::lab::wait_graph(&bus, driven).await;
    let all = begin_all(&shown, LONG).await.unwrap();
    let driver = BeginOutcome::DrivenBy("/manager".to_owned());
    assert_eq!(all, [(STAGED.to_owned(), driver)]);

    manager.close().await;
    super::lab::wait_graph(&bus, |graph| !driven(graph)).await;
    let all = begin_all(&shown, LONG).await.unwrap();
    assert_eq!(all, [(STAGED.to_owned(), BeginOutcome::Now)]);
    let node = LifecycleNode::new(shown, STAGED);
    assert_eq!(node.state().await.unwrap(), State::Active);
}

#[tokio::test]
async fn a_node_that_is_active_for_subscribers_only_begins_as_well() {
    let lab = Lab::new();
    let (bus, _nodes) = tuned_node(&lab).await;
    let shown: Arc<dyn Bus> = bus.clone();
    let shy = vec![("shy".to_owned(), Some(ParamValue::Bool(true)))];
    bus.node_parameters().unwrap().set(STAGED, shy).await.unwrap();
    let all = begin_all(&shown, LONG).await.unwrap();
    assert_eq!(all, [(STAGED.to_owned(), BeginOutcome::Now)]);
    // The subscriber that it needed for that is gone again.
    super::lab::wait_graph(&bus, |graph| graph.topics.get("/seen").is_some_and(|ends| ends.subscribers.is_empty()))
        .await;
}
