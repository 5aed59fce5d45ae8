//! What each node of a view has, with types, as nodes of ROS 2 tell it of themselves.

use std::collections::BTreeMap;

use package::interface::{Interface, Service};
use ros::bus::{NodeEnds, RosVersion, ServiceType};
use ros::ros2::actions::Parts;
use ros::schema::Registry;

use super::action_ends::End;
use super::view::View;

/// The type of a service of the interface, as its server tells it.
pub(super) fn service_type(version: RosVersion, of: &Service, registry: &Registry) -> ServiceType {
    let known = registry.service(&of.type_name);
    let known = known.ok().filter(|_| version == RosVersion::Two);
    match known {
        Some(known) => ServiceType::of(&known),
        None => ServiceType::new(&*of.type_name, &of.md5).written_by(version),
    }
}

/// Node → its ends. An action without definition has none.
pub(super) fn all(
    view: &View,
    interface: &Interface,
    registry: &Registry,
) -> BTreeMap<String, NodeEnds> {
    let mut nodes: BTreeMap<String, NodeEnds> = BTreeMap::new();
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
        let parts = of.and_then(|of| Parts::of(&action.shown.of, &of).ok());
        let Some(parts) = parts else {
            continue;
        };
        let node = nodes.entry(action.shown.node.clone()).or_default();
        for (end, name) in &action.ends {
            let name = name.clone();
            match end {
                End::SendGoal => drop(node.services.insert(name, parts.send_goal.1.clone())),
                End::CancelGoal => drop(node.services.insert(name, parts.cancel_goal.1.clone())),
                End::GetResult => drop(node.services.insert(name, parts.get_result.1.clone())),
                End::Feedback => {
                    let of = (parts.feedback.1.clone(), Parts::feedback_qos());
                    node.publishers.insert(name, of);
                }
                End::Status => {
                    let of = (parts.status.1.clone(), Parts::status_qos());
                    node.publishers.insert(name, of);
                }
                // Topics of ROS 1.
                End::Goal | End::Cancel | End::Result => {}
            }
        }
    }
    nodes
}
