//! Environment and command line that make a process a node of ROS 1 (<http://wiki.ros.org/ROS/EnvironmentVariables>,
//! <http://wiki.ros.org/Remapping%20Arguments>).

use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use ros_bus::{NodeIdentity, ParamValue};

/// Address of every servant's Master, as seen from inside.
pub const MASTER: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 11311);

/// Variable with the working directory of nodes, where they also write their files.
pub const HOME: &str = "ROS_HOME";

/// Returns the environment of every process of a servant, with this working directory of its nodes.
pub fn environment(home: &str) -> BTreeMap<String, String> {
    [
        ("HOME", home.to_owned()),
        (HOME, home.to_owned()),
        ("ROS_LOG_DIR", format!("{home}/log")),
        ("ROS_MASTER_URI", format!("http://localhost:{}", MASTER.port())),
        ("ROS_HOSTNAME", "localhost".to_owned()),
        // A node's output is a pipe: without these its lines arrive only when a buffer is full, and the last lines of a
        // node that crashes are lost.
        ("ROSCONSOLE_STDOUT_LINE_BUFFERED", "1".to_owned()),
        ("PYTHONUNBUFFERED", "1".to_owned()),
    ]
    .map(|(name, value)| (name.to_owned(), value))
    .into()
}

/// Returns the arguments and environment that make a program the node of this absolute name.
pub fn identity(node: &str) -> NodeIdentity {
    let (above, last) = node.rsplit_once('/').unwrap_or(("", node));
    NodeIdentity { arguments: vec![format!("__name:={last}")], ..namespace(above) }
}

/// Returns the environment that puts a program's nodes into this namespace.
pub fn namespace(namespace: &str) -> NodeIdentity {
    let namespace = if namespace.is_empty() { "/" } else { namespace };
    NodeIdentity { arguments: Vec::new(), environment: [("ROS_NAMESPACE".to_owned(), namespace.to_owned())].into() }
}

/// Returns the parameters that roslaunch sets. The line end is roslaunch's, which fills the parameter from the output
/// of a command.
pub fn parameters(distribution: &str) -> BTreeMap<String, ParamValue> {
    let distribution = ParamValue::String(format!("{distribution}\n"));
    BTreeMap::from([("/rosdistro".to_owned(), distribution)])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_node_is_told_its_name_and_its_namespace() {
        for (node, argument, namespace) in [
            ("/camera/see", "__name:=see", "/camera"),
            ("/see", "__name:=see", "/"),
            ("see", "__name:=see", "/"),
            ("/a/b/c", "__name:=c", "/a/b"),
        ] {
            let identity = identity(node);
            assert_eq!(identity.arguments, [argument], "{node}");
            let variable = ("ROS_NAMESPACE".to_owned(), namespace.to_owned());
            assert_eq!(identity.environment, [variable].into(), "{node}");
        }
    }

    #[test]
    fn what_a_node_prints_is_there_at_once() {
        let environment = environment("/root");
        for name in ["ROSCONSOLE_STDOUT_LINE_BUFFERED", "PYTHONUNBUFFERED"] {
            assert_eq!(environment[name], "1");
        }
    }

    #[test]
    fn all_that_a_node_writes_is_below_its_home() {
        let environment = environment("/root");
        assert_eq!(environment["ROS_LOG_DIR"], "/root/log");
        assert_eq!(environment["ROS_MASTER_URI"], "http://localhost:11311");
        assert_eq!((&*environment["HOME"], &*environment[HOME]), ("/root", "/root"));
    }
}
