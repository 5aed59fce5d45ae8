//! Endpoints of each node of a view with their types, as ROS 2 nodes announce them.

use std::collections::BTreeMap;

use package::interface::{Interface, Service};
use ros::bus::{ActionEndpoint, NodeEntities, RosVersion, ServiceType};
use ros::ros2::actions::ActionInterfaces;
use ros::schema::Registry;

use super::view::GroupView;

/// Returns the type of a service of the interface, as its server announces it.
pub(super) fn service_type(version: RosVersion, of: &Service, registry: &Registry) -> ServiceType {
    let known = registry.service(&of.type_name);
    let known = known.ok().filter(|_| version == RosVersion::Two);
    match known {
        Some(known) => ServiceType::from_service(&known),
        None => ServiceType::new(&*of.type_name, &of.md5).with_version(version),
    }
}

/// Returns the endpoints by node. Actions without definition are omitted.
pub(super) fn collect_node_ends(
    view: &GroupView,
    interface: &Interface,
    registry: &Registry,
) -> BTreeMap<String, NodeEntities> {
    let mut nodes: BTreeMap<String, NodeEntities> = BTreeMap::new();
    for (name, shown) in &view.services {
        let mut services = interface.services.iter();
        if let Some(of) = services.find(|service| service.name == shown.of) {
            let of = service_type(RosVersion::Two, of, registry);
            let node = nodes.entry(shown.node.clone()).or_default();
            node.services.insert(name.clone(), of);
        }
    }
    for action in view.actions.values() {
        let of = registry.action(&action.type_name).ok();
        let parts = of.and_then(|of| ActionInterfaces::for_action(&action.shown.of, &of).ok());
        let Some(parts) = parts else {
            continue;
        };
        let node = nodes.entry(action.shown.node.clone()).or_default();
        for (end, name) in &action.ends {
            let name = name.clone();
            match end {
                ActionEndpoint::SendGoal => drop(node.services.insert(name, parts.send_goal.1.clone())),
                ActionEndpoint::CancelGoal => drop(node.services.insert(name, parts.cancel_goal.1.clone())),
                ActionEndpoint::GetResult => drop(node.services.insert(name, parts.get_result.1.clone())),
                ActionEndpoint::Feedback => {
                    let of = (parts.feedback.1.clone(), ActionInterfaces::feedback_qos());
                    node.publishers.insert(name, of);
                }
                ActionEndpoint::Status => {
                    let of = (parts.status.1.clone(), ActionInterfaces::status_qos());
                    node.publishers.insert(name, of);
                }
                // Topics of ROS 1.
                ActionEndpoint::Goal | ActionEndpoint::Cancel | ActionEndpoint::Result => {}
            }
        }
    }
    nodes
}
