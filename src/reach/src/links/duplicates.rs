//! Two robots with one id: they would share a servant, and each would hear what the other one does.
//!
//! Machines are told apart by what their stubs say of them. Several machines may be one robot: those have one Master.

use std::sync::Arc;

use super::Hub;
use super::node_link::NodeLink;
use link::control::{FromCloud, Hello};

/// What to do about it.
pub(super) const NEXT: &str =
    "give one of them another id (`robot` in stub.toml, or CLOUDROID_ROBOT)";

/// Where a stub runs.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Machine {
    id: String,
    host: String,
    roscore: String,
}

impl Machine {
    pub(super) fn of(hello: &Hello) -> Self {
        Self {
            id: hello.machine.clone(),
            host: hello.host.clone(),
            roscore: hello.roscore.clone(),
        }
    }

    /// Neither the same machine nor one with the same Master.
    pub(super) fn is_of_another_robot(&self, other: &Self) -> bool {
        let one_master = !self.roscore.is_empty() && self.roscore == other.roscore;
        self.id != other.id && !one_master
    }

    /// Its name, where it is known, to be put behind a noun.
    pub(super) fn named(&self) -> String {
        match self.host.as_str() {
            "" => String::new(),
            host => format!(" ({host})"),
        }
    }

    /// Its name, or what stands for one.
    pub(super) fn name(&self) -> &str {
        match self.host.as_str() {
            "" => &self.id,
            host => host,
        }
    }
}

impl Hub {
    /// Other machines that are connected as the same robot, by a node of each.
    pub(super) fn duplicates_of(&self, link: &NodeLink) -> Vec<Arc<NodeLink>> {
        let links = self.links.lock();
        let others = links.values().filter(|other| {
            other.is_connected() && link.machine.is_of_another_robot(&other.machine)
        });
        others.cloned().collect()
    }

    /// A link is connected: says on both sides, and here, that there are two robots, if there are.
    pub(super) fn report_duplicates(&self, link: &NodeLink) {
        for other in self.duplicates_of(link) {
            let mut pair = [link.machine.id.clone(), other.machine.id.clone()];
            pair.sort();
            let [one, two] = pair;
            if !self.duplicates.lock().insert((one, two)) {
                continue;
            }
            let text = format!(
                "two machines are connected as this robot: {} runs {}, {} runs {}; they share one servant, and what is meant for one may reach the other; {NEXT}",
                other.machine.name(),
                other.node,
                link.machine.name(),
                link.node
            );
            self.nodes.warn("duplicate-robot", &text);
            for side in [link, &other] {
                side.session.report(&FromCloud::Notice {
                    warning: true,
                    text: text.clone(),
                });
            }
        }
    }
}
