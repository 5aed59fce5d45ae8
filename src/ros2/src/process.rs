//! Environment and command line that make a process a node of ROS 2
//! (<https://design.ros2.org/articles/ros_command_line_arguments.html>).

use std::collections::{BTreeMap, BTreeSet};

use ros_bus::parameter_names::spell_in_ros2;
use ros_bus::{Naming, NodeIdentity, NodeRename, ParamValue, enclave_for};

/// Domain of every servant's nodes, and of the bus that connects to them. Each servant has its own network, so all can
/// use the same.
pub const DOMAIN: u16 = 0;

/// Variable with the working directory of nodes, where they also write their files.
pub const HOME: &str = "ROS_HOME";

/// Begins arguments for ROS, which extend to the end or to [`END`].
const ROS_ARGUMENTS: &str = "--ros-args";
const END: &str = "--";

/// Returns the environment of every process of a servant, with this working directory of its nodes.
pub fn environment(home: &str) -> BTreeMap<String, String> {
    [
        ("HOME", home.to_owned()),
        (HOME, home.to_owned()),
        ("ROS_LOG_DIR", format!("{home}/log")),
        ("ROS_DOMAIN_ID", DOMAIN.to_string()),
        // Nodes discover each other by multicast, which works even on a network with nothing but lo. With LOCALHOST
        // Fast DDS would find only the first 32 of them, and Cyclone DDS none.
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET".to_owned()),
        // A node's output is a pipe: without these its lines arrive only when a buffer is full, and the last lines of a
        // node that crashes are lost. 1 means line buffering, wherever rcutils writes.
        ("RCUTILS_LOGGING_BUFFERED_STREAM", "1".to_owned()),
        ("PYTHONUNBUFFERED", "1".to_owned()),
    ]
    .map(|(name, value)| (name.to_owned(), value))
    .into()
}

/// Returns the arguments that make a program the node of this absolute name.
pub fn identity(node: &str) -> NodeIdentity {
    let (above, last) = split_name(node);
    remap_identity(&[("__node", last), ("__ns", or_root(above))])
}

/// Returns the arguments for a program that runs as the robot's node of this name: the parts of the name that its
/// command line does not set itself, and the mark by which its nodes are known.
pub fn robot_identity(node: &str, says: Naming) -> NodeIdentity {
    let (above, last) = split_name(node);
    let name = says.name.then(|| ["-r".to_owned(), format!("__node:={last}")]);
    let namespace = says.namespace.then(|| ["-r".to_owned(), format!("__ns:={}", or_root(above))]);
    let mark = enclave_for(node).map(|mark| ["--enclave".to_owned(), mark]);
    let told = [name, namespace, mark].into_iter().flatten();
    NodeIdentity { arguments: ros_arguments(told), environment: BTreeMap::new() }
}

/// Returns rules for the nodes of a process whose names differ from those set by the program. For a program whose node
/// name differs at each start the rules apply to all of its nodes, because no other would match: then there is one
/// node.
pub fn rename_identity(nodes: &[NodeRename]) -> NodeIdentity {
    let mut rules = BTreeSet::new();
    for NodeRename { own, node } in nodes {
        let Some(own) = own else {
            return identity(node);
        };
        let ((_, own), (_, last)) = (split_name(own), split_name(node));
        if own != last {
            rules.insert((format!("{own}:__node"), last));
        }
    }
    let rules: Vec<_> = rules.iter().map(|(from, to)| (&**from, *to)).collect();
    remap_identity(&rules)
}

/// Splits into namespace and name.
fn split_name(node: &str) -> (&str, &str) {
    node.rsplit_once('/').unwrap_or(("", node))
}

/// Returns the position at which a rule precedes all others on a command line: rcl applies the first match.
pub fn first_rule_position(argv: &[String]) -> usize {
    let first = argv.iter().position(|word| word == ROS_ARGUMENTS);
    first.unwrap_or(argv.len())
}

/// Returns the arguments that set an enclave. Without security it is just a word that others are told. If there are
/// several, the last one applies.
pub fn enclave_identity(enclave: &str) -> NodeIdentity {
    let argument = ["--enclave".to_owned(), enclave.to_owned()];
    NodeIdentity { arguments: ros_arguments(std::iter::once(argument)), environment: BTreeMap::new() }
}

/// Returns the arguments that set the parameters of the node of this absolute name: those below its name, and those
/// without a namespace, which every node is given. Levels are separated by dots here. Arguments that follow on the
/// command line are the program's again.
pub fn parameter_arguments(node: &str, all: &BTreeMap<String, ParamValue>) -> Vec<String> {
    let mut given = BTreeMap::new();
    for (key, value) in all {
        let everybodys = key.strip_prefix('/').filter(|name| !name.contains('/'));
        if let Some(name) = everybodys {
            flatten(name, value, &mut given);
        }
    }
    let own = format!("{node}/");
    for (key, value) in all {
        if let Some(name) = key.strip_prefix(&own) {
            flatten(&spell_in_ros2(name), value, &mut given);
        }
    }
    let rules = given.iter();
    let mut arguments = ros_arguments(rules.map(|(name, value)| ["-p".to_owned(), format!("{name}:={value}")]));
    if !arguments.is_empty() {
        arguments.push(END.to_owned());
    }
    arguments
}

/// Flattens a dictionary into several parameters.
fn flatten(name: &str, value: &ParamValue, into: &mut BTreeMap<String, String>) {
    match value {
        ParamValue::Map(entries) => {
            for (below, value) in entries {
                flatten(&format!("{name}.{below}"), value, into);
            }
        }
        _ => {
            into.insert(name.to_owned(), yaml(value));
        }
    }
}

/// Formats a value as the parser of `-p` reads it (YAML). Values that ROS 2 does not support (lists of mixed types, or
/// of lists) are written all the same: the node then exits with the reason.
pub fn yaml(value: &ParamValue) -> String {
    match value {
        ParamValue::Bool(value) => value.to_string(),
        ParamValue::Int(value) => value.to_string(),
        ParamValue::Double(value) => yaml_double(*value),
        ParamValue::String(text) => quote(text),
        ParamValue::Nil => "null".to_owned(),
        ParamValue::Binary(bytes) => yaml_list(bytes.iter().map(|byte| byte.to_string())),
        ParamValue::List(items) => {
            // A list has one type; `[1, 2.5]` means doubles.
            let doubles = items.iter().any(|item| matches!(item, ParamValue::Double(_)));
            yaml_list(items.iter().map(|item| match item {
                ParamValue::Int(value) if doubles => yaml_double(*value as f64),
                item => yaml(item),
            }))
        }
        ParamValue::Map(entries) => {
            let entries = entries.iter().map(|(name, value)| format!("{}: {}", quote(name), yaml(value)));
            format!("{{{}}}", entries.collect::<Vec<_>>().join(", "))
        }
    }
}

fn yaml_list(items: impl Iterator<Item = String>) -> String {
    format!("[{}]", items.collect::<Vec<_>>().join(", "))
}

/// Formats a double so that it differs from an integer by its point or its exponent.
fn yaml_double(value: f64) -> String {
    if value.is_nan() {
        ".nan".to_owned()
    } else if value.is_infinite() {
        (if value > 0.0 { ".inf" } else { "-.inf" }).to_owned()
    } else {
        format!("{value:?}")
    }
}

/// Quotes a text. JSON strings are YAML double-quoted strings.
fn quote(text: &str) -> String {
    serde_json::Value::from(text).to_string()
}

fn or_root(namespace: &str) -> &str {
    if namespace.is_empty() { "/" } else { namespace }
}

fn remap_identity(rules: &[(&str, &str)]) -> NodeIdentity {
    let rules = rules.iter();
    NodeIdentity {
        arguments: ros_arguments(rules.map(|(from, to)| ["-r".to_owned(), format!("{from}:={to}")])),
        environment: BTreeMap::new(),
    }
}

/// Returns the arguments; empty if there are no rules.
fn ros_arguments(rules: impl Iterator<Item = [String; 2]>) -> Vec<String> {
    let rules: Vec<String> = rules.flatten().collect();
    if rules.is_empty() {
        return rules;
    }
    std::iter::once(ROS_ARGUMENTS.to_owned()).chain(rules).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_node_prints_is_there_at_once() {
        let environment = environment("/root");
        for name in ["RCUTILS_LOGGING_BUFFERED_STREAM", "PYTHONUNBUFFERED"] {
            assert_eq!(environment[name], "1");
        }
    }

    #[test]
    fn nodes_of_a_process_are_renamed_one_by_one_and_before_all_other_rules() {
        let told = |nodes: &[(&str, &str)]| {
            let nodes = nodes.iter().map(|(own, node)| NodeRename {
                own: (!own.is_empty()).then(|| (*own).to_owned()),
                node: (*node).to_owned(),
            });
            rename_identity(&nodes.collect::<Vec<_>>()).arguments
        };
        assert_eq!(told(&[("/front/talker", "/front/talker")]), [""; 0]);
        let nodes = [
            ("/front/ears", "/front/ears_2"),
            ("/front/mouth", "/front/mouth"),
            ("/nose", "/nose_2"),
            ("/rear/ears", "/rear/ears_2"),
        ];
        let rules = ["-r", "ears:__node:=ears_2", "-r", "nose:__node:=nose_2"];
        assert_eq!(told(&nodes), [&["--ros-args"], &rules[..]].concat());
        // Another name at each start.
        let all = ["--ros-args", "-r", "__node:=see", "-r", "__ns:=/front"];
        assert_eq!(told(&[("", "/front/see")]), all);
        let argv = |words: &str| words.split(' ').map(str::to_owned).collect::<Vec<_>>();
        assert_eq!(first_rule_position(&argv("/x -v --ros-args -r __ns:=/front")), 2);
        assert_eq!(first_rule_position(&argv("/x -v")), 2);
    }

    #[test]
    fn a_robots_program_is_told_what_its_command_line_does_not_say_and_is_marked() {
        let told = |name, namespace| {
            let says = Naming { name, namespace };
            robot_identity("/camera/see", says).arguments.join(" ")
        };
        let mark = "--enclave /cloudroid_link/camera/see";
        assert_eq!(told(false, false), format!("--ros-args {mark}"));
        assert_eq!(told(false, true), format!("--ros-args -r __ns:=/camera {mark}"));
        let all = format!("--ros-args -r __node:=see -r __ns:=/camera {mark}");
        assert_eq!(told(true, true), all);
        let long = format!("/{}", "x".repeat(240));
        let all = Naming::default();
        assert_eq!(robot_identity(&long, all).arguments, identity(&long).arguments);
    }

    #[test]
    fn a_node_is_told_its_name_and_its_namespace() {
        for (node, name, namespace) in
            [("/camera/see", "see", "/camera"), ("/see", "see", "/"), ("see", "see", "/"), ("/a/b/c", "c", "/a/b")]
        {
            let identity = identity(node);
            let rules = [format!("__node:={name}"), format!("__ns:={namespace}")];
            let [name, namespace] = &rules;
            assert_eq!(identity.arguments, ["--ros-args", "-r", name, "-r", namespace], "{node}");
            assert!(identity.environment.is_empty());
        }
        assert_eq!(enclave_identity("/x").arguments, ["--ros-args", "--enclave", "/x"]);
    }

    #[test]
    fn all_that_a_node_writes_is_below_its_home() {
        let environment = environment("/root");
        assert_eq!(environment["ROS_LOG_DIR"], "/root/log");
        assert_eq!(environment["ROS_DOMAIN_ID"], "0");
        assert_eq!((&*environment["HOME"], &*environment[HOME]), ("/root", "/root"));
    }

    fn value(json: &str) -> ParamValue {
        serde_json::from_str(json).expect("a value")
    }

    #[test]
    fn a_node_is_given_its_own_parameters_and_everybodys() {
        let all: BTreeMap<String, ParamValue> = [
            ("/use_sim_time", "true"),
            ("/rate", "1"),
            ("/camera/see/rate", "2.0"),
            ("/camera/see/gains/p", "3"),
            ("/camera/see/names", r#"{"left": "l", "right": "10"}"#),
            ("/camera/seen/rate", "4"),
            ("/other/rate", "5"),
        ]
        .map(|(key, json)| (key.to_owned(), value(json)))
        .into();
        let expected = [
            "--ros-args",
            "-p",
            "gains.p:=3",
            "-p",
            r#"names.left:="l""#,
            "-p",
            r#"names.right:="10""#,
            "-p",
            "rate:=2.0",
            "-p",
            "use_sim_time:=true",
            "--",
        ];
        assert_eq!(parameter_arguments("/camera/see", &all), expected);
        assert_eq!(parameter_arguments("/see", &BTreeMap::new()), [""; 0]);
    }

    #[test]
    fn values_keep_their_types() {
        for (json, written) in [
            ("true", "true"),
            ("-7", "-7"),
            ("1.0", "1.0"),
            ("1e300", "1e300"),
            (r#""1""#, r#""1""#),
            (r#""a\n\"b\"""#, r#""a\n\"b\"""#),
            ("[1, 2]", "[1, 2]"),
            ("[1, 2.5]", "[1.0, 2.5]"),
            (r#"["a", "b"]"#, r#"["a", "b"]"#),
            ("[]", "[]"),
        ] {
            assert_eq!(yaml(&value(json)), written);
        }
        assert_eq!(yaml(&ParamValue::Double(f64::NEG_INFINITY)), "-.inf");
        assert_eq!(yaml(&ParamValue::Double(f64::NAN)), ".nan");
    }
}
