//! The part of a service's recorded interface that robots of the other ROS can use. A robot that could use nothing is
//! refused.

use package::interface::Interface;
use translation::bus::TranslatedBus;

/// Maximum number of reasons given for a refusal.
const REASONS: usize = 3;

/// Returns why nothing of an interface can be carried to the other ROS; `None` if something can, or if it is empty.
pub(super) fn find_refusal(bus: &TranslatedBus, interface: &Interface) -> Option<String> {
    let topics = interface.topics.iter();
    let topics = topics.map(|topic| (format!("topic {}", topic.name), bus.message_problem(&topic.type_name)));
    let services = interface.services.iter();
    let services = services.map(|it| (format!("service {}", it.name), bus.service_problem(&it.type_name)));
    let actions = interface.actions.iter();
    let actions = actions.map(|it| (format!("action {}", it.name), bus.action_problem(&it.type_name)));
    let mut reasons = Vec::new();
    for (what, problem) in topics.chain(services).chain(actions) {
        reasons.push(format!("{what}: {}", problem?));
    }
    let count = reasons.len();
    reasons.truncate(REASONS);
    let others = if count > REASONS { format!("; and {} more", count - REASONS) } else { String::new() };
    (count > 0).then(|| format!("nothing of it can be carried to this robot's ROS: {}{others}", reasons.join("; ")))
}
