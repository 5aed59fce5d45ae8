//! Names of parameters in both ROSes: `/camera/see/gains/p` at a Master is `gains.p` of the node `/camera/see`.

use std::sync::Arc;

use ros::bus::parameter_names::spell_in_ros1;
use ros::bus::{Bus, Graph};
use ros::ros1::xmlrpc::MAX_DEPTH;

/// Key and name of the parameter by which simulated time is turned on: for all nodes in ROS 1, for each in ROS 2.
pub(super) const SIM_TIME: &str = "use_sim_time";
pub(super) const SIM_TIME_KEY: &str = "/use_sim_time";

/// The service by which a node of ROS 2 that has parameters is known.
const LISTS: &str = "/list_parameters";

/// Returns the key of a node's parameter; `None` for a name that no key stands for, such as those that client libraries
/// declare for topics (`qos_overrides./scan.publisher.depth`).
pub(super) fn to_key(node: &str, parameter: &str) -> Option<String> {
    let is_carried = parameter.split('.').all(|part| !part.is_empty() && !part.contains('/'));
    is_carried.then(|| format!("{node}/{}", spell_in_ros1(parameter)))
}

/// Returns the key of a node's parameter for an error, whether or not it is a valid one.
pub(super) fn shown_key(node: &str, parameter: &str) -> String {
    format!("{node}/{}", spell_in_ros1(parameter))
}

/// Returns the nodes of ROS 2 that have parameters.
pub(super) fn node_names(graph: &Graph) -> impl Iterator<Item = &str> {
    graph.services.keys().filter_map(|service| service.strip_suffix(LISTS))
}

/// Returns the part of `key` below `above`; `None` if it is not below it. Everything is below `/`.
pub(super) fn strip_parent<'k>(key: &'k str, above: &str) -> Option<&'k str> {
    let rest = match above {
        "/" => key.strip_prefix('/')?,
        _ => key.strip_prefix(above)?.strip_prefix('/')?,
    };
    (!rest.is_empty()).then_some(rest)
}

/// Returns the key of an entry of the dictionary at `key`.
pub(super) fn join(key: &str, entry: &str) -> String {
    match key {
        "/" => format!("/{entry}"),
        _ => format!("{key}/{entry}"),
    }
}

/// The nodes that have parameters, by the graph.
pub(super) struct ParameterNodes {
    graph: Arc<Graph>,
}

impl ParameterNodes {
    /// Returns those of a bus of ROS 2 now.
    pub(super) fn of_bus(bus: &dyn Bus) -> Self {
        Self { graph: bus.graph().borrow().clone() }
    }

    /// Returns true if the node runs and answers questions about parameters.
    pub(super) fn has(&self, node: &str) -> bool {
        self.graph.services.contains_key(&format!("{node}{LISTS}"))
    }

    /// Splits a key into the node that it belongs to, the one of the longest name, and the rest: empty if the key is
    /// the node's name.
    pub(super) fn owner<'k>(&self, key: &'k str) -> Option<(&'k str, &'k str)> {
        if self.has(key) {
            return Some((key, ""));
        }
        // No more than a key may have: each costs as much as the key is long.
        let mut ends = key.rmatch_indices('/').map(|(at, _)| at).take(MAX_DEPTH);
        ends.find_map(|at| self.has(&key[..at]).then(|| (&key[..at], &key[at + 1..])))
    }

    /// Returns the nodes whose names are `key` or below it.
    pub(super) fn at_or_below(&self, key: &str) -> Vec<String> {
        node_names(&self.graph)
            .filter(|node| *node == key || strip_parent(node, key).is_some())
            .map(str::to_owned)
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn nodes(names: &[&str]) -> ParameterNodes {
        let services = names.iter().map(|node| (format!("{node}{LISTS}"), (*node).to_owned()));
        ParameterNodes { graph: Arc::new(Graph { services: services.collect(), ..Graph::default() }) }
    }

    #[test]
    fn levels_are_separated_by_dots_at_nodes_and_by_slashes_at_the_master() {
        assert_eq!(to_key("/camera/see", "gains.p").as_deref(), Some("/camera/see/gains/p"));
        for name in ["qos_overrides./scan.publisher.depth", "", "a..b", ".a", "a."] {
            assert_eq!(to_key("/see", name), None, "{name}");
        }
    }

    #[test]
    fn a_key_belongs_to_the_node_of_the_longest_name() {
        let nodes = nodes(&["/camera", "/camera/see"]);
        for (key, owner) in [
            ("/camera/see/gains/p", Some(("/camera/see", "gains/p"))),
            ("/camera/see", Some(("/camera/see", ""))),
            ("/camera/seen", Some(("/camera", "seen"))),
            ("/cameras/x", None),
            ("/x", None),
            ("/", None),
        ] {
            assert_eq!(nodes.owner(key), owner, "{key}");
        }
        assert_eq!(nodes.at_or_below("/"), ["/camera", "/camera/see"]);
        assert_eq!(nodes.at_or_below("/camera/see"), ["/camera/see"]);
        assert!(nodes.at_or_below("/cam").is_empty());
    }

    #[test]
    fn keys_are_below_whole_parts_of_names() {
        assert_eq!(
            (strip_parent("/a/b", "/a"), strip_parent("/ab", "/a"), strip_parent("/a", "/a")),
            (Some("b"), None, None)
        );
        assert_eq!((strip_parent("/a", "/"), strip_parent("/", "/")), (Some("a"), None));
        assert_eq!((join("/", "a"), join("/a", "b")), ("/a".to_owned(), "/a/b".to_owned()));
    }
}
