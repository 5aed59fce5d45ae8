//! How a process becomes a node of ROS 2: its environment and its command line
//! (<https://design.ros2.org/articles/ros_command_line_arguments.html>).

use std::collections::{BTreeMap, BTreeSet};

use crate::bus::ParamValue;
use crate::identity::{Called, Identity, Naming};

/// The domain of every servant's nodes, and of the bus that speaks with them. A servant's network is its own, so that all can
/// have the same.
pub const DOMAIN: u16 = 0;

/// The variable that says where nodes run, and where they keep what they write.
pub(crate) const HOME: &str = "ROS_HOME";

/// What follows on a command line is for ROS, up to its end or to [`END`].
const ROS_ARGUMENTS: &str = "--ros-args";
const END: &str = "--";

/// Before the name of a robot's node, in the enclave of its process.
const LINKED: &str = "/cloudroid_link";
/// The longest name of a node that is marked by its enclave.
const MAX_MARKED: usize = 200;

pub(crate) fn environment(home: &str) -> BTreeMap<String, String> {
    [
        ("HOME", home.to_owned()),
        (HOME, home.to_owned()),
        ("ROS_LOG_DIR", format!("{home}/log")),
        ("ROS_DOMAIN_ID", DOMAIN.to_string()),
        // Nodes find each other by multicast, which a network of nothing but lo carries, too. By LOCALHOST Fast DDS would find
        // the first 32 of them alone, and Cyclone DDS none.
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET".to_owned()),
        // A node's output is a pipe: without these its lines come when a buffer is full, and the last ones of a node that crashes never.
        // 1 is by the line, wherever rcutils writes.
        ("RCUTILS_LOGGING_BUFFERED_STREAM", "1".to_owned()),
        ("PYTHONUNBUFFERED", "1".to_owned()),
    ]
    .map(|(name, value)| (name.to_owned(), value))
    .into()
}

pub(crate) fn identity(node: &str) -> Identity {
    let (above, last) = halves(node);
    remapped(&[("__node", last), ("__ns", or_root(above))])
}

/// What a program is told that runs as a robot's node of this name: as much of the name as its command line does not say itself, and the
/// mark by which its nodes are known.
pub(crate) fn of_a_robot(node: &str, says: Naming) -> Identity {
    let (above, last) = halves(node);
    let name = says
        .name
        .then(|| ["-r".to_owned(), format!("__node:={last}")]);
    let namespace = says
        .namespace
        .then(|| ["-r".to_owned(), format!("__ns:={}", or_root(above))]);
    let mark = enclave_of(node).map(|mark| ["--enclave".to_owned(), mark]);
    let told = [name, namespace, mark].into_iter().flatten();
    Identity {
        arguments: ros_arguments(told),
        environment: BTreeMap::new(),
    }
}

/// The enclave of a process that runs as a robot's node of this name, by which all of its nodes are known, whatever their names. None for a name that
/// would make it longer than rcl allows.
pub(crate) fn enclave_of(node: &str) -> Option<String> {
    (node.len() <= MAX_MARKED).then(|| format!("{LINKED}{node}"))
}

/// Rules for each node of a process that is called otherwise than by its program. A program that says another name each time is told by rules for all
/// of its nodes, since no other would fit: then there is one.
pub(crate) fn renamed(nodes: &[Called]) -> Identity {
    let mut rules = BTreeSet::new();
    for Called { own, node } in nodes {
        let Some(own) = own else {
            return identity(node);
        };
        let ((_, own), (_, last)) = (halves(own), halves(node));
        if own != last {
            rules.insert((format!("{own}:__node"), last));
        }
    }
    let rules: Vec<_> = rules.iter().map(|(from, to)| (&**from, *to)).collect();
    remapped(&rules)
}

/// Namespace and name.
fn halves(node: &str) -> (&str, &str) {
    node.rsplit_once('/').unwrap_or(("", node))
}

/// Where a rule stands before all others of a command line: rcl takes the first that fits.
pub(crate) fn first_rule(argv: &[String]) -> usize {
    let first = argv.iter().position(|word| word == ROS_ARGUMENTS);
    first.unwrap_or(argv.len())
}

/// Without security an enclave is a word that others are told. Of several the last one counts.
pub(crate) fn in_enclave(enclave: &str) -> Identity {
    let argument = ["--enclave".to_owned(), enclave.to_owned()];
    Identity {
        arguments: ros_arguments(std::iter::once(argument)),
        environment: BTreeMap::new(),
    }
}

/// Arguments that give the node of this absolute name its parameters: those below its name, and those without a namespace,
/// which every node is given. A level of names is a dot here. Whatever follows them on the command line is the program's again.
pub(crate) fn parameters(node: &str, all: &BTreeMap<String, ParamValue>) -> Vec<String> {
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
            flatten(&name.replace('/', "."), value, &mut given);
        }
    }
    let rules = given.iter();
    let mut arguments =
        ros_arguments(rules.map(|(name, value)| ["-p".to_owned(), format!("{name}:={value}")]));
    if !arguments.is_empty() {
        arguments.push(END.to_owned());
    }
    arguments
}

/// A dictionary is several parameters.
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

/// As the parser of `-p` reads it (YAML). What ROS 2 has no such parameter for (lists of several types, or of lists) is
/// written all the same: the node then ends, and says why.
pub fn yaml(value: &ParamValue) -> String {
    match value {
        ParamValue::Bool(value) => value.to_string(),
        ParamValue::Int(value) => value.to_string(),
        ParamValue::Double(value) => double(*value),
        ParamValue::String(text) => quoted(text),
        ParamValue::Nil => "null".to_owned(),
        ParamValue::Binary(bytes) => listed(bytes.iter().map(|byte| byte.to_string())),
        ParamValue::List(items) => {
            // A list has one type; what is written as `[1, 2.5]` means doubles.
            let doubles = items
                .iter()
                .any(|item| matches!(item, ParamValue::Double(_)));
            listed(items.iter().map(|item| match item {
                ParamValue::Int(value) if doubles => double(*value as f64),
                item => yaml(item),
            }))
        }
        ParamValue::Map(entries) => {
            let entries = entries
                .iter()
                .map(|(name, value)| format!("{}: {}", quoted(name), yaml(value)));
            format!("{{{}}}", entries.collect::<Vec<_>>().join(", "))
        }
    }
}

fn listed(items: impl Iterator<Item = String>) -> String {
    format!("[{}]", items.collect::<Vec<_>>().join(", "))
}

/// Told from a whole number by its point or its exponent.
fn double(value: f64) -> String {
    if value.is_nan() {
        ".nan".to_owned()
    } else if value.is_infinite() {
        (if value > 0.0 { ".inf" } else { "-.inf" }).to_owned()
    } else {
        format!("{value:?}")
    }
}

/// JSON's strings are YAML's in double quotes.
fn quoted(text: &str) -> String {
    serde_json::Value::from(text).to_string()
}

fn or_root(namespace: &str) -> &str {
    if namespace.is_empty() { "/" } else { namespace }
}

fn remapped(rules: &[(&str, &str)]) -> Identity {
    let rules = rules.iter();
    Identity {
        arguments: ros_arguments(
            rules.map(|(from, to)| ["-r".to_owned(), format!("{from}:={to}")]),
        ),
        environment: BTreeMap::new(),
    }
}

/// Nothing where there is nothing to say.
fn ros_arguments(rules: impl Iterator<Item = [String; 2]>) -> Vec<String> {
    let rules: Vec<String> = rules.flatten().collect();
    if rules.is_empty() {
        return rules;
    }
    std::iter::once(ROS_ARGUMENTS.to_owned())
        .chain(rules)
        .collect()
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
            let nodes = nodes.iter().map(|(own, node)| Called {
                own: (!own.is_empty()).then(|| (*own).to_owned()),
                node: (*node).to_owned(),
            });
            renamed(&nodes.collect::<Vec<_>>()).arguments
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
        // Another name each time.
        let all = ["--ros-args", "-r", "__node:=see", "-r", "__ns:=/front"];
        assert_eq!(told(&[("", "/front/see")]), all);
        let argv = |words: &str| words.split(' ').map(str::to_owned).collect::<Vec<_>>();
        assert_eq!(first_rule(&argv("/x -v --ros-args -r __ns:=/front")), 2);
        assert_eq!(first_rule(&argv("/x -v")), 2);
    }

    #[test]
    fn a_robots_program_is_told_what_its_command_line_does_not_say_and_is_marked() {
        let told = |name, namespace| {
            let says = Naming { name, namespace };
            of_a_robot("/camera/see", says).arguments.join(" ")
        };
        let mark = "--enclave /cloudroid_link/camera/see";
        assert_eq!(told(false, false), format!("--ros-args {mark}"));
        assert_eq!(
            told(false, true),
            format!("--ros-args -r __ns:=/camera {mark}")
        );
        let all = format!("--ros-args -r __node:=see -r __ns:=/camera {mark}");
        assert_eq!(told(true, true), all);
        let long = format!("/{}", "x".repeat(240));
        let all = Naming::default();
        assert_eq!(of_a_robot(&long, all).arguments, identity(&long).arguments);
    }

    #[test]
    fn a_node_is_told_its_name_and_its_namespace() {
        for (node, name, namespace) in [
            ("/camera/see", "see", "/camera"),
            ("/see", "see", "/"),
            ("see", "see", "/"),
            ("/a/b/c", "c", "/a/b"),
        ] {
            let identity = identity(node);
            let rules = [format!("__node:={name}"), format!("__ns:={namespace}")];
            let [name, namespace] = &rules;
            assert_eq!(
                identity.arguments,
                ["--ros-args", "-r", name, "-r", namespace],
                "{node}"
            );
            assert!(identity.environment.is_empty());
        }
        assert_eq!(
            in_enclave("/x").arguments,
            ["--ros-args", "--enclave", "/x"]
        );
    }

    #[test]
    fn all_that_a_node_writes_is_below_its_home() {
        let environment = environment("/root");
        assert_eq!(environment["ROS_LOG_DIR"], "/root/log");
        assert_eq!(environment["ROS_DOMAIN_ID"], "0");
        assert_eq!(
            (&*environment["HOME"], &*environment[HOME]),
            ("/root", "/root")
        );
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
        assert_eq!(parameters("/camera/see", &all), expected);
        assert_eq!(parameters("/see", &BTreeMap::new()), [""; 0]);
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
