//! The servant's processes as known to the shim. Pure bookkeeping: events go in; messages and consequences come out.

use std::collections::BTreeMap;

use crate::engine::{NodeEvent, NodeExit};
use crate::protocol::NodeStatus;
use crate::spec::{NodeSpec, RUN};

/// One node.
#[derive(Debug)]
struct NodeRecord {
    spec: NodeSpec,
    status: NodeStatus,
    /// Pid in the container, while it runs.
    inside: Option<i32>,
}

/// All nodes of the servant, by name.
#[derive(Debug, Default)]
pub(super) struct NodeTable {
    known: BTreeMap<String, NodeRecord>,
    /// Starts that init has not answered yet, by their number.
    starting: BTreeMap<u32, String>,
    next: u32,
}

/// Reason why a node cannot be added or signalled.
#[derive(Debug, thiserror::Error)]
pub(super) enum NodeTableError {
    /// The spec has no name or no program.
    #[error("node {0:?} needs a name and the absolute path of its program")]
    Incomplete(String),
    #[error("node {0} runs already: stop it first or choose another name")]
    RunsAlready(String),
    #[error("there is no node {0}")]
    Unknown(String),
    #[error("node {0} does not run")]
    NotRunning(String),
}

/// Consequence of the end of a node.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Consequence {
    /// Nothing follows.
    None,
    /// The node is restarted after this number of seconds.
    Respawn(f64),
    /// The servant ends.
    EndServant,
}

impl NodeTable {
    /// Adds a node, or replaces one of the same name that has ended.
    pub(super) fn add(&mut self, spec: NodeSpec) -> Result<(), NodeTableError> {
        if spec.name.is_empty() || spec.argv.first().is_none_or(|program| !program.starts_with('/')) {
            return Err(NodeTableError::Incomplete(spec.name));
        }
        let starting = self.is_starting(&spec.name);
        let running = self.known.get(&spec.name).is_some_and(|node| node.inside.is_some());
        if starting || running {
            return Err(NodeTableError::RunsAlready(spec.name));
        }
        let starts = self.known.get(&spec.name).map_or(0, |node| node.status.starts);
        let status = NodeStatus { starts, run: spec.environment.get(RUN).cloned(), ..NodeStatus::default() };
        self.known.insert(spec.name.clone(), NodeRecord { spec, status, inside: None });
        Ok(())
    }

    /// Retires a node: nothing follows from its end.
    pub(super) fn retire(&mut self, name: &str) {
        if let Some(node) = self.known.get_mut(name) {
            node.spec.respawn = false;
            node.spec.required = false;
        }
    }

    /// Returns whether the node is to be restarted when it has ended.
    pub(super) fn should_respawn(&self, name: &str) -> bool {
        self.known.get(name).is_some_and(|node| node.spec.respawn)
    }

    /// Allocates a number for the start of a node, and returns the spec to start.
    pub(super) fn start(&mut self, name: &str) -> Option<(u32, NodeSpec)> {
        let spec = self.known.get(name).filter(|node| node.inside.is_none())?.spec.clone();
        let number = self.allocate_number();
        self.starting.insert(number, name.to_owned());
        Some((number, spec))
    }

    /// Allocates a number for the start of a program, which may be that of no node.
    pub(super) fn allocate_number(&mut self) -> u32 {
        let number = self.next;
        self.next = self.next.wrapping_add(1);
        number
    }

    /// Called when init has executed the program.
    pub(super) fn on_started(&mut self, number: u32, inside: i32, host: i32) -> Option<NodeEvent> {
        let name = self.starting.remove(&number)?;
        let node = self.known.get_mut(&name)?;
        node.inside = Some(inside);
        node.status.pid = Some(host);
        node.status.starts += 1;
        Some(NodeEvent::Started { node: name })
    }

    /// Called when the program could not be executed.
    pub(super) fn on_exec_failed(&mut self, number: u32, reason: String) -> Option<(NodeEvent, Consequence)> {
        let name = self.starting.remove(&number)?;
        let node = self.known.get_mut(&name)?;
        node.status.exit =
            Some(NodeExit { code: None, signal: None, out_of_memory: false, exec_error: Some(reason.clone()) });
        // A restart would fail again.
        let consequence = if node.spec.required { Consequence::EndServant } else { Consequence::None };
        Some((NodeEvent::ExecFailed { node: name, reason }, consequence))
    }

    /// Called when the process with this pid in the container has ended; returns `None` if it is not a node.
    pub(super) fn on_exited(&mut self, inside: i32, exit: NodeExit) -> Option<(NodeEvent, Consequence)> {
        let (name, node) = self.known.iter_mut().find(|(_, node)| node.inside == Some(inside))?;
        node.inside = None;
        node.status.pid = None;
        node.status.exit = Some(exit.clone());
        let consequence = match &node.spec {
            spec if spec.required => Consequence::EndServant,
            spec if spec.respawn => Consequence::Respawn(spec.respawn_delay.clamp(0.0, 3600.0)),
            _ => Consequence::None,
        };
        let NodeExit { code, signal, out_of_memory, .. } = exit;
        Some((NodeEvent::Exited { node: name.clone(), code, signal, out_of_memory }, consequence))
    }

    /// Returns the running nodes with their pids in the container, and the number of nodes being started.
    pub(super) fn running_and_starting(&self) -> (Vec<(String, i32)>, usize) {
        let running = self.known.iter().filter_map(|(name, node)| Some((name.clone(), node.inside?))).collect();
        (running, self.starting.len())
    }

    /// Returns whether init has yet to answer for its start.
    pub(super) fn is_starting(&self, name: &str) -> bool {
        self.starting.values().any(|starting| starting == name)
    }

    /// Returns the numbers of the starts that init has not answered.
    pub(super) fn starting_numbers(&self) -> Vec<u32> {
        self.starting.keys().copied().collect()
    }

    /// Returns the pid of a node in the container.
    pub(super) fn pid_inside(&self, name: &str) -> Result<i32, NodeTableError> {
        let node = self.known.get(name).ok_or_else(|| NodeTableError::Unknown(name.to_owned()))?;
        node.inside.ok_or_else(|| NodeTableError::NotRunning(name.to_owned()))
    }

    /// Returns the status of a node.
    pub(super) fn status(&self, name: &str) -> NodeStatus {
        self.known.get(name).map(|node| node.status.clone()).unwrap_or_default()
    }

    /// Returns the status of all nodes.
    pub(super) fn statuses(&self) -> BTreeMap<String, NodeStatus> {
        self.known.iter().map(|(name, node)| (name.clone(), node.status.clone())).collect()
    }
}

/// Converts a wait status from `waitpid`.
pub(super) fn parse_wait_status(status: i32, out_of_memory: bool) -> NodeExit {
    let code = libc::WIFEXITED(status).then(|| libc::WEXITSTATUS(status));
    let signal = libc::WIFSIGNALED(status).then(|| libc::WTERMSIG(status));
    NodeExit { code, signal, out_of_memory, exec_error: None }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn node(name: &str, required: bool, respawn: bool) -> NodeSpec {
        let argv = vec!["/bin/true".to_owned()];
        let respawn_delay = 0.5;
        NodeSpec {
            name: name.into(),
            argv,
            environment: BTreeMap::new(),
            directory: String::new(),
            respawn,
            respawn_delay,
            required,
        }
    }

    fn run(nodes: &mut NodeTable, spec: NodeSpec, inside: i32) {
        let name = spec.name.clone();
        nodes.add(spec).unwrap();
        let (number, _) = nodes.start(&name).unwrap();
        nodes.on_started(number, inside, inside + 1000).unwrap();
    }

    #[test]
    fn the_end_of_a_node_has_the_consequence_that_ros_users_know() {
        let mut nodes = NodeTable::default();
        run(&mut nodes, node("/plain", false, false), 2);
        run(&mut nodes, node("/again", false, true), 3);
        run(&mut nodes, node("/needed", true, true), 4);
        let mut end = |pid| nodes.on_exited(pid, parse_wait_status(0, false)).map(|(_, consequence)| consequence);
        assert_eq!(end(2), Some(Consequence::None));
        assert_eq!(end(3), Some(Consequence::Respawn(0.5)));
        assert_eq!(end(4), Some(Consequence::EndServant));
        assert_eq!(end(4), None, "it ended once");
        assert_eq!(end(99), None, "an orphan is no node");
    }

    #[test]
    fn nothing_follows_from_the_end_of_a_node_that_ends_for_good() {
        let mut nodes = NodeTable::default();
        run(&mut nodes, node("/again", false, true), 3);
        run(&mut nodes, node("/needed", true, true), 4);
        run(&mut nodes, node("/pausing", false, true), 5);
        let end = |nodes: &mut NodeTable, pid| {
            let ended = nodes.on_exited(pid, parse_wait_status(0, false));
            ended.map(|(_, consequence)| consequence)
        };
        // One has ended already and waits to be restarted.
        assert_eq!(end(&mut nodes, 5), Some(Consequence::Respawn(0.5)));
        assert!(nodes.should_respawn("/pausing"));
        for name in ["/again", "/needed", "/pausing", "/never"] {
            nodes.retire(name);
            assert!(!nodes.should_respawn(name));
        }
        assert_eq!(end(&mut nodes, 3), Some(Consequence::None));
        assert_eq!(end(&mut nodes, 4), Some(Consequence::None));
    }

    #[test]
    fn a_name_is_free_again_once_its_node_has_ended() {
        let mut nodes = NodeTable::default();
        run(&mut nodes, node("/a", false, false), 2);
        assert!(nodes.add(node("/a", false, false)).unwrap_err().to_string().contains("runs already"));
        nodes.on_exited(2, parse_wait_status(256, false)).unwrap();
        assert_eq!(nodes.status("/a").current_exit().unwrap().code, Some(1));
        run(&mut nodes, node("/a", false, false), 3);
        assert_eq!((nodes.status("/a").starts, nodes.status("/a").pid), (2, Some(1003)));
        assert!(nodes.add(NodeSpec { argv: vec!["relative".into()], ..node("/b", false, false) }).is_err());
    }

    #[test]
    fn it_is_known_for_which_run_a_node_was_started_last() {
        let mut nodes = NodeTable::default();
        for (life, inside) in [("first life", 2), ("second life", 3)] {
            let environment = BTreeMap::from([(RUN.to_owned(), life.to_owned())]);
            let spec = NodeSpec { environment, ..node("/see", false, false) };
            run(&mut nodes, spec, inside);
            assert_eq!(nodes.status("/see").run.as_deref(), Some(life));
            nodes.on_exited(inside, parse_wait_status(0, false)).unwrap();
        }
        run(&mut nodes, node("/planned", false, false), 4);
        assert_eq!(nodes.status("/planned").run, None);
    }

    #[test]
    fn statuses_are_read_as_wait_means_them() {
        assert_eq!(parse_wait_status(0x0300, false).code, Some(3));
        assert_eq!(parse_wait_status(9, true).signal, Some(9));
        assert_eq!((parse_wait_status(9, true).code, parse_wait_status(9, true).out_of_memory), (None, true));
    }
}
