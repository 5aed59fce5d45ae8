//! Detection of two robots with the same id, which would share a servant and receive each other's data.
//!
//! Machines are distinguished by what their stubs report. Several machines with the same ROS Master are one robot.

use std::sync::Arc;

use super::state::{Hub, NodeLink, RobotMachine};
use link::control::{FromCloud, Hello};

/// Remedy, for messages.
pub(super) const NEXT: &str = "give one of them another id (`robot` in stub.toml, or CLOUDROID_ROBOT)";

impl RobotMachine {
    pub(super) fn from_hello(hello: &Hello) -> Self {
        Self { id: hello.machine.clone(), host: hello.host.clone(), roscore: hello.roscore.clone() }
    }

    /// Returns whether it is neither the same machine nor one with the same Master.
    pub(super) fn is_other_robot(&self, other: &Self) -> bool {
        let one_master = !self.roscore.is_empty() && self.roscore == other.roscore;
        self.id != other.id && !one_master
    }

    /// Returns its host name, if known, in parentheses, to follow a noun.
    pub(super) fn host_suffix(&self) -> String {
        match self.host.as_str() {
            "" => String::new(),
            host => format!(" ({host})"),
        }
    }

    /// Returns its host name, or its id if the name is unknown.
    pub(super) fn name(&self) -> &str {
        match self.host.as_str() {
            "" => &self.id,
            host => host,
        }
    }
}

impl Hub {
    /// Returns one link for each other machine that is connected as the same robot.
    pub(super) fn find_duplicates(&self, link: &NodeLink) -> Vec<Arc<NodeLink>> {
        let links = self.links.lock();
        let others = links.values().filter(|other| other.is_connected() && link.machine.is_other_robot(&other.machine));
        others.cloned().collect()
    }

    /// Warns both robots and the operator if a newly connected link shows that there are two.
    pub(super) fn report_duplicates(&self, link: &NodeLink) {
        for other in self.find_duplicates(link) {
            let mut pair = [link.machine.id.clone(), other.machine.id.clone()];
            pair.sort();
            let [one, two] = pair;
            if !self.duplicates.lock().insert((one, two)) {
                continue;
            }
            let text = format!(
                "two machines are connected as this robot: {} runs {}, {} runs {}; they share one servant, and \
                    messages for one may reach the other; {NEXT}",
                other.machine.name(),
                other.node,
                link.machine.name(),
                link.node
            );
            self.nodes.warn("duplicate-robot", &text);
            for side in [link, &other] {
                side.session.send_control(&FromCloud::Notice { warning: true, text: text.clone() });
            }
        }
    }
}
