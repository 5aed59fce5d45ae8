//! ROS 2 command lines: the node's name and parameters, including those in files, which exist on the robot only.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::bail;
use ros::bus::{ParamValue, RosVersion};
use ros::ros2::arguments::{self, BEGIN, CommandLinePart, END, Kind, RemapRule, RemapTarget};
use ros::ros2::parameters::yaml::parse_text;
use ros::ros2::{names, process};

use super::{DefaultName, LaunchedNode, RosLocation};
use crate::network::{self, Variable};
use crate::params_file::Sections;

/// Prefix of parameters that are settings of the stub.
pub const SETTINGS: &str = "cloudroid.";
/// Pattern for all nodes of a process.
const ALL: &str = "/**";
/// Option that names a file of this robot, which configures rcl's logging.
const LOG_CONFIG_FILE: &str = "--log-config-file";

/// Implements [`LaunchedNode::read`] for ROS 2. The default name has a namespace (`/camera/detector`) if the program
/// sets one. For a program with several nodes it is the name of the first.
pub async fn read(argv: &[String], usual: DefaultName<'_>, variable: Variable<'_>) -> anyhow::Result<LaunchedNode> {
    let parts = arguments::parse(argv)?;
    let (above, name) = usual.split();
    let node = node_name(&parts, above, name)?;
    let sections = read_sections(&parts)?;
    let parameters = sections.for_node(&node);
    let (id, network) = network::read_network(variable).await?;
    Ok(LaunchedNode {
        ros: RosVersion::Two,
        place: RosLocation::Domain { id, network },
        argv: cloud_arguments(&parts, &node, !usual.by_program, &parameters),
        original_argv: original_arguments(parts),
        name_by_program: usual.name_by_program(),
        sim_time: parameters.get("use_sim_time") == Some(&ParamValue::Bool(true)),
        node,
        parameters,
    })
}

/// Returns the node's name with its namespace. The first matching rule applies; without one, the program's own name.
fn node_name(parts: &[CommandLinePart], above: &str, usual: &str) -> anyhow::Result<String> {
    let of = |renamed: RemapTarget, node: &str| {
        let rules = parts.iter().filter_map(as_rule);
        let mut rules = rules.filter(|rule| rule.of == renamed && rule.applies_to(node));
        rules.next().map(|rule| rule.to.clone())
    };
    let name = of(RemapTarget::Node, usual).unwrap_or_else(|| usual.to_owned());
    // rcl looks up the namespace by the name that it has found.
    let namespace = of(RemapTarget::Namespace, &name).unwrap_or_else(|| above.to_owned());
    let node = format!("{}/{name}", namespace.trim_end_matches('/'));
    if !names::is_global(&node) {
        bail!(
            "{node:?} is not a valid ROS 2 node name; set nodes = {{ \"EXECUTABLE\" = \"NAME\" }} \
                (or \"/NAMESPACE/NAME\") in stub.toml, or pass --ros-args -r __node:=NAME"
        );
    }
    Ok(node)
}

fn as_rule(part: &CommandLinePart) -> Option<&RemapRule> {
    match &part.kind {
        Kind::Rule(rule) => Some(rule),
        _ => None,
    }
}

/// Returns all parameters that the command line sets for any node, in rcl's order.
fn read_sections(parts: &[CommandLinePart]) -> anyhow::Result<Sections> {
    let mut sections = Sections::default();
    for part in parts {
        match &part.kind {
            Kind::Parameter(given) => {
                let nodes = match &given.node {
                    Some(node) => format!("/{node}"),
                    None => ALL.to_owned(),
                };
                let value = parse_text(&given.value);
                let value = value.map_err(|problem| arguments::invalid_value(&part.words, &problem.reason))?;
                sections.set(&nodes, given.name.clone(), value);
            }
            Kind::File(path) => sections.read(Path::new(path))?,
            _ => {}
        }
    }
    Ok(sections)
}

/// Returns the program's own arguments, followed by one group of ROS arguments. If `told` is set, all of its nodes
/// without a renaming rule are named `node`, because the names that the program sets are unknown.
fn cloud_arguments(
    parts: &[CommandLinePart],
    node: &str,
    told: bool,
    parameters: &BTreeMap<String, ParamValue>,
) -> Vec<String> {
    let mut own = Vec::new();
    let mut given = Vec::new();
    let mut others = Vec::new();
    let mut is_for_ros = false;
    for part in parts {
        match &part.kind {
            Kind::Own => own.extend(part.words.clone()),
            Kind::Mark => is_for_ros = part.words == [BEGIN],
            Kind::Rule(_) if is_for_ros => given.extend(part.words.clone()),
            Kind::Rule(_) => own.extend(part.words.clone()),
            Kind::Setting if part.words[0] == LOG_CONFIG_FILE => tracing::warn!(
                "{LOG_CONFIG_FILE} {} is a file on this robot, so the node in the cloud ignores it",
                part.words[1]
            ),
            Kind::Setting => given.extend(part.words.clone()),
            // A program may create several nodes.
            Kind::Parameter(of) if of.is_for_other_node(node) => others.extend(part.words.clone()),
            // Added below, together with those of files.
            Kind::Parameter(_) | Kind::File(_) => {}
        }
    }
    if let Some((above, name)) = node.rsplit_once('/').filter(|_| told) {
        let above = if above.is_empty() { "/" } else { above };
        for rule in [format!("__node:={name}"), format!("__ns:={above}")] {
            given.extend(["-r".to_owned(), rule]);
        }
    }
    for (name, value) in parameters {
        if name.starts_with(SETTINGS) {
            continue;
        }
        if !arguments::is_parameter_name(name) {
            tracing::warn!(
                "parameter {name} cannot be passed on a command line, so the node in the cloud uses its default; \
                    rename it with letters, digits, _ and dots"
            );
            continue;
        }
        given.push("-p".to_owned());
        given.push(format!("{name}:={}", process::yaml(value)));
    }
    // If several match one node, the later ones apply.
    given.extend(others);
    if !given.is_empty() {
        own.push(BEGIN.to_owned());
        own.extend(given);
        own.push(END.to_owned());
    }
    own
}

/// Returns the arguments without the stub's settings. The original ignores those in files.
fn original_arguments(parts: Vec<CommandLinePart>) -> Vec<String> {
    let is_setting = |part: &CommandLinePart| {
        matches!(&part.kind,
        Kind::Parameter(given) if given.name.starts_with(SETTINGS))
    };
    let given = parts.into_iter().filter(|part| !is_setting(part));
    given.flat_map(|part| part.words).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    async fn read(line: &str) -> anyhow::Result<LaunchedNode> {
        read_with_name("usual", line).await
    }

    /// Reads the command line of a program whose default node name is `usual`.
    async fn read_with_name(usual: &str, line: &str) -> anyhow::Result<LaunchedNode> {
        let argv: Vec<String> = line.split_whitespace().map(str::to_owned).collect();
        let variable = |name: &str| match name {
            "ROS_DOMAIN_ID" => Some("7".to_owned()),
            "ROS_AUTOMATIC_DISCOVERY_RANGE" => Some("LOCALHOST".to_owned()),
            // A ROS 1 variable.
            "ROS_NAMESPACE" => Some("/ignored".to_owned()),
            _ => None,
        };
        let usual = DefaultName { name: usual, by_program: true };
        super::read(&argv, usual, &variable).await
    }

    #[tokio::test]
    async fn names_are_found_as_rcl_finds_them() {
        for (line, node) in [
            ("", "/usual"),
            ("--ros-args -r __node:=a -r __node:=b", "/a"),
            ("--ros-args -r __ns:=/x/y", "/x/y/usual"),
            ("--ros-args -r __ns:=/", "/usual"),
            ("--ros-args -r other:__node:=a", "/usual"),
            ("--ros-args -r usual:__node:=a -r a:__ns:=/q -r usual:__ns:=/w", "/q/a"),
            ("__node:=old __ns:=/way", "/way/old"),
        ] {
            assert_eq!(read(line).await.expect(line).node, node, "{line}");
        }
        let robot = read("").await.expect("a robot");
        assert!(matches!(robot.place, RosLocation::Domain { id: 7, .. }), "{robot:?}");
        assert!(robot.argv.is_empty() && robot.original_argv.is_empty());
    }

    #[tokio::test]
    async fn a_namespace_that_the_program_gives_is_replaced_by_rules() {
        for (line, node) in [
            ("", "/camera/usual"),
            ("--ros-args -r __node:=a", "/camera/a"),
            ("--ros-args -r __ns:=/front", "/front/usual"),
            ("--ros-args -r __ns:=/", "/usual"),
            ("--ros-args -r usual:__ns:=/front", "/front/usual"),
            ("--ros-args -r other:__ns:=/front", "/camera/usual"),
        ] {
            let robot = read_with_name("/camera/usual", line).await.expect(line);
            assert_eq!(robot.node, node, "{line}");
            // The program may create several nodes, each of which applies the rules that match it.
            let expected = match line {
                "" => Vec::new(),
                line => line.split(' ').chain(["--"]).collect(),
            };
            assert_eq!(robot.argv, expected, "{line}");
        }
        assert!(read_with_name("camera/usual", "").await.is_err());
    }

    #[tokio::test]
    async fn a_program_is_told_a_name_that_it_is_not_known_to_say() {
        for (line, argv) in [
            ("", "--ros-args -r __node:=guess -r __ns:=/ --"),
            ("--ros-args -r __ns:=/front", "--ros-args -r __ns:=/front -r __node:=guess -r __ns:=/front --"),
            ("__node:=a", "__node:=a --ros-args -r __node:=a -r __ns:=/ --"),
        ] {
            let words: Vec<String> = line.split_whitespace().map(str::to_owned).collect();
            let usual = DefaultName { name: "guess", by_program: false };
            let robot = super::read(&words, usual, &|_| None).await.expect(line);
            assert_eq!(robot.argv.join(" "), argv, "{line}");
        }
    }

    #[tokio::test]
    async fn further_nodes_of_the_program_have_their_own_parameters() {
        let line = "--ros-args -p tenor:high:=true -p rate:=1 -p alto:rate:=2 --param tenor:cloudroid.max:=0.5";
        let robot = read_with_name("alto", line).await.expect("a robot");
        // A setting of the first node, which applies to all, does not override a node's own.
        let expected = "--ros-args -p rate:=2 -p tenor:high:=true --param tenor:cloudroid.max:=0.5 --";
        assert_eq!(robot.argv.join(" "), expected);
        assert!(robot.settings().is_empty());
    }

    #[tokio::test]
    async fn the_cloud_is_given_parameters_and_not_files() {
        let place = tempfile::tempdir().expect("a directory");
        let file = place.path().join("p.yaml");
        let text = "\
/**:
  ros__parameters:
    rate: 1
    model: /overlay/share/p/model.onnx
    frame-id: not for a command line
    cloudroid: {max: 0.5, local: warm}
people:
  ros__parameters:
    labels: [\"1\", two]
    rate: 2
/front/people:
  ros__parameters: {rate: 3}
";
        std::fs::write(&file, text).expect("written");
        let file = file.display();
        let line = format!(
            "--fast --ros-args -r __node:=people -r __ns:=/front -r image:=/camera/image --params-file {file} \
             -p use_sim_time:=true -p cloudroid.max:=0.3 -p other:rate:=9 --log-level debug -- own"
        );
        let robot = read(&line).await.expect("a robot");
        let expected = [
            "--fast",
            "own",
            "--ros-args",
            "-r",
            "__node:=people",
            "-r",
            "__ns:=/front",
            "-r",
            "image:=/camera/image",
            "--log-level",
            "debug",
            "-p",
            "model:=\"/overlay/share/p/model.onnx\"",
            "-p",
            "rate:=3",
            "-p",
            "use_sim_time:=true",
            "-p",
            "other:rate:=9",
            "--",
        ];
        assert_eq!(robot.argv, expected);
        assert!(robot.sim_time);
        let settings = robot.settings();
        assert_eq!(settings["max"], ParamValue::Double(0.3));
        assert_eq!(settings["local"], ParamValue::String("warm".into()));
        let original = line.replace("-p cloudroid.max:=0.3 ", "");
        let original: Vec<&str> = original.split_whitespace().collect();
        assert_eq!(robot.original_argv, original);
        // Without the namespace another section of the same file matches.
        let line = format!("--ros-args -r __node:=people --params-file {file}");
        let robot = read(&line).await.expect("a robot");
        assert_eq!(robot.parameters["rate"], ParamValue::Int(2));
        assert!(robot.argv.contains(&r#"labels:=["1", "two"]"#.to_owned()), "{:?}", robot.argv);
    }

    #[tokio::test]
    async fn what_cannot_be_is_said() {
        for (line, said) in [
            ("--ros-args -r __node:=a/b", "-r __node:=a/b"),
            ("--ros-args --params-file /nowhere/p.yaml", "/nowhere/p.yaml"),
            ("--ros-args -p a", "-p a"),
            ("--ros-args -p a:=", "-p a:=: the value is missing"),
            ("--ros-args -p a:={b:1}", "-p a:={b:1}"),
            ("--ros-args -p a:=[1,x]", "-p a:=[1,x]: the values of a list must have one type"),
        ] {
            let error = format!("{:#}", read(line).await.expect_err(line));
            assert!(error.contains(said), "{line}: {error}");
        }
        let argv = ["--ros-args".to_owned()];
        let usual = DefaultName { name: "9", by_program: false };
        let error = super::read(&argv, usual, &|_| None).await.expect_err("no name");
        assert!(error.to_string().contains("\"/9\" is not a valid"), "{error}");
    }
}
