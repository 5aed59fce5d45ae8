//! Identity of a program's node in the terms of its ROS version.

use std::collections::BTreeMap;

/// Prefix of a process's enclave, before the name of the robot's node.
const LINK_ENCLAVE: &str = "/cloudroid_link";
/// Maximum length of the name of a node that is marked by its enclave.
const MAX_NAME_LENGTH: usize = 200;

/// Arguments and environment that set a program's node name or namespace.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct NodeIdentity {
    /// Arguments to add to the command line: at its end, or where `ros::flavour::Flavour::insert_arguments` puts them.
    pub arguments: Vec<String>,
    /// Variables to add to the environment.
    pub environment: BTreeMap<String, String>,
}

/// The parts of a node's name that are set on its command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Naming {
    /// The name, without namespace.
    pub name: bool,
    /// The namespace.
    pub namespace: bool,
}

/// Sets both parts.
impl Default for Naming {
    fn default() -> Self {
        Self { name: true, namespace: true }
    }
}

/// The name of a program's node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NodeRename {
    /// Name used by the program, including a namespace set by the program; `None` if it differs at each start.
    pub own: Option<String>,
    /// Absolute name to give it.
    pub node: String,
}

/// Returns the enclave of a process that runs as the robot's node of this name (ROS 2); it identifies all nodes of the
/// process, whatever their names. `None` if it would be longer than rcl allows.
pub fn enclave_for(node: &str) -> Option<String> {
    (node.len() <= MAX_NAME_LENGTH).then(|| format!("{LINK_ENCLAVE}{node}"))
}

/// Returns the name of the robot's node that a process with this enclave runs as; `None` for other enclaves.
pub fn linked_node(enclave: &str) -> Option<&str> {
    enclave.strip_prefix(LINK_ENCLAVE).filter(|node| node.starts_with('/'))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_node_of_an_enclave_is_found_again() {
        let enclave = enclave_for("/front/see").expect("a short name");
        assert_eq!(linked_node(&enclave), Some("/front/see"));
        for other in ["/", "/cloudroid_link", "/cloudroid_linked/see", "/secure/see"] {
            assert_eq!(linked_node(other), None, "{other}");
        }
    }
}
