//! Command lines of ROS 2: what names the node, and what its parameters are, with the files that are on the robot only.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::bail;
use ros::bus::{ParamValue, RosVersion};
use ros::ros2::arguments::{self, BEGIN, END, Kind, Part, Renamed, Rule};
use ros::ros2::{names, process};

use super::{Place, Robot, Usual};
use crate::network::{self, Variable};
use crate::params_file::{Sections, value};

/// Parameters that begin so are settings of the stub.
pub const SETTINGS: &str = "cloudroid.";
/// All nodes of a process.
const ALL: &str = "/**";
/// A file of this robot, by which rcl's logging is set.
const LOG_CONFIG_FILE: &str = "--log-config-file";

/// As [`Robot::read`]. The usual name has a namespace (`/camera/detector`) where the program gives its node one. Of a program of several nodes
/// it is that of the first.
pub async fn read(
    argv: &[String],
    usual: Usual<'_>,
    variable: Variable<'_>,
) -> anyhow::Result<Robot> {
    let parts = arguments::parse(argv)?;
    let (above, name) = usual.name.rsplit_once('/').unwrap_or(("", usual.name));
    let node = named(&parts, above, name)?;
    let sections = sections(&parts)?;
    let parameters = sections.of(&node);
    let (id, network) = network::network(variable).await?;
    Ok(Robot {
        ros: RosVersion::Two,
        place: Place::Domain { id, network },
        argv: for_the_cloud(&parts, &node, !usual.by_program, &parameters),
        original_argv: for_the_original(parts),
        sim_time: parameters.get("use_sim_time") == Some(&ParamValue::Bool(true)),
        node,
        parameters,
    })
}

/// The node's name with its namespace. Of several rules the first one counts; what the program says, where there is none.
fn named(parts: &[Part], above: &str, usual: &str) -> anyhow::Result<String> {
    let of = |renamed: Renamed, node: &str| {
        let rules = parts.iter().filter_map(rule);
        let mut rules = rules.filter(|rule| rule.of == renamed && rule.concerns(node));
        rules.next().map(|rule| rule.to.clone())
    };
    let name = of(Renamed::Node, usual).unwrap_or_else(|| usual.to_owned());
    // rcl looks for the namespace of the name that it has found.
    let namespace = of(Renamed::Namespace, &name).unwrap_or_else(|| above.to_owned());
    let node = format!("{}/{name}", namespace.trim_end_matches('/'));
    if !names::is_global(&node) {
        bail!(
            "{node:?} is not a name that ROS 2 allows for a node; set nodes = {{ \"EXECUTABLE\" = \"NAME\" }} (or \"/NAMESPACE/NAME\") in stub.toml, or give --ros-args -r __node:=NAME"
        );
    }
    Ok(node)
}

fn rule(part: &Part) -> Option<&Rule> {
    match &part.kind {
        Kind::Rule(rule) => Some(rule),
        _ => None,
    }
}

/// All parameters that the command line gives to any node, in rcl's order.
fn sections(parts: &[Part]) -> anyhow::Result<Sections> {
    let mut sections = Sections::default();
    for part in parts {
        match &part.kind {
            Kind::Parameter(given) => {
                let nodes = match &given.node {
                    Some(node) => format!("/{node}"),
                    None => ALL.to_owned(),
                };
                let value = value::of_text(&given.value);
                let value = value.map_err(|reason| arguments::no_value(&part.words, &reason))?;
                sections.set(&nodes, given.name.clone(), value);
            }
            Kind::File(path) => sections.read(Path::new(path))?,
            _ => {}
        }
    }
    Ok(sections)
}

/// The program's own arguments, and then one group of ROS's. `told`: all of its nodes are called as `node` that no rule names, since it is not known what
/// the program calls them.
fn for_the_cloud(
    parts: &[Part],
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
                "{LOG_CONFIG_FILE} {} is a file of this robot: the node in the cloud logs as it does without it",
                part.words[1]
            ),
            Kind::Setting => given.extend(part.words.clone()),
            // A program may be several nodes.
            Kind::Parameter(of) if of.is_of_another(node) => others.extend(part.words.clone()),
            // Below, with those of files.
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
        if !arguments::is_parameter(name) {
            tracing::warn!(
                "parameter {name} cannot be given on a command line: the node in the cloud has its default; rename it with letters, digits, _ and dots"
            );
            continue;
        }
        given.push("-p".to_owned());
        given.push(format!("{name}:={}", process::yaml(value)));
    }
    // Of several for one node the later ones count.
    given.extend(others);
    if !given.is_empty() {
        own.push(BEGIN.to_owned());
        own.extend(given);
        own.push(END.to_owned());
    }
    own
}

/// As given, but for the stub's settings. Those in files the original does not ask for.
fn for_the_original(parts: Vec<Part>) -> Vec<String> {
    let is_setting = |part: &Part| matches!(&part.kind, Kind::Parameter(given) if given.name.starts_with(SETTINGS));
    let given = parts.into_iter().filter(|part| !is_setting(part));
    given.flat_map(|part| part.words).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    async fn read(line: &str) -> anyhow::Result<Robot> {
        read_of("usual", line).await
    }

    /// Of a program that calls its node so.
    async fn read_of(usual: &str, line: &str) -> anyhow::Result<Robot> {
        let argv: Vec<String> = line.split_whitespace().map(str::to_owned).collect();
        let variable = |name: &str| match name {
            "ROS_DOMAIN_ID" => Some("7".to_owned()),
            "ROS_AUTOMATIC_DISCOVERY_RANGE" => Some("LOCALHOST".to_owned()),
            // ROS 1's.
            "ROS_NAMESPACE" => Some("/ignored".to_owned()),
            _ => None,
        };
        let usual = Usual {
            name: usual,
            by_program: true,
        };
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
            (
                "--ros-args -r usual:__node:=a -r a:__ns:=/q -r usual:__ns:=/w",
                "/q/a",
            ),
            ("__node:=old __ns:=/way", "/way/old"),
        ] {
            assert_eq!(read(line).await.expect(line).node, node, "{line}");
        }
        let robot = read("").await.expect("a robot");
        assert!(
            matches!(robot.place, Place::Domain { id: 7, .. }),
            "{robot:?}"
        );
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
            let robot = read_of("/camera/usual", line).await.expect(line);
            assert_eq!(robot.node, node, "{line}");
            // The program may be several nodes, of which each takes the rules that concern it.
            let expected = match line {
                "" => Vec::new(),
                line => line.split(' ').chain(["--"]).collect(),
            };
            assert_eq!(robot.argv, expected, "{line}");
        }
        assert!(read_of("camera/usual", "").await.is_err());
    }

    #[tokio::test]
    async fn a_program_is_told_a_name_that_it_is_not_known_to_say() {
        for (line, argv) in [
            ("", "--ros-args -r __node:=guess -r __ns:=/ --"),
            (
                "--ros-args -r __ns:=/front",
                "--ros-args -r __ns:=/front -r __node:=guess -r __ns:=/front --",
            ),
            (
                "__node:=a",
                "__node:=a --ros-args -r __node:=a -r __ns:=/ --",
            ),
        ] {
            let words: Vec<String> = line.split_whitespace().map(str::to_owned).collect();
            let usual = Usual {
                name: "guess",
                by_program: false,
            };
            let robot = super::read(&words, usual, &|_| None).await.expect(line);
            assert_eq!(robot.argv.join(" "), argv, "{line}");
        }
    }

    #[tokio::test]
    async fn further_nodes_of_the_program_have_their_own_parameters() {
        let line = "--ros-args -p tenor:high:=true -p rate:=1 -p alto:rate:=2 --param tenor:cloudroid.max:=0.5";
        let robot = read_of("alto", line).await.expect("a robot");
        // That of the first one, which has to be all's, does not count for one that has its own.
        let expected =
            "--ros-args -p rate:=2 -p tenor:high:=true --param tenor:cloudroid.max:=0.5 --";
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
        // Without its namespace the same file says other things.
        let line = format!("--ros-args -r __node:=people --params-file {file}");
        let robot = read(&line).await.expect("a robot");
        assert_eq!(robot.parameters["rate"], ParamValue::Int(2));
        assert!(
            robot.argv.contains(&r#"labels:=["1", "two"]"#.to_owned()),
            "{:?}",
            robot.argv
        );
    }

    #[tokio::test]
    async fn what_cannot_be_is_said() {
        for (line, said) in [
            ("--ros-args -r __node:=a/b", "-r __node:=a/b"),
            (
                "--ros-args --params-file /nowhere/p.yaml",
                "/nowhere/p.yaml",
            ),
            ("--ros-args -p a", "-p a"),
            ("--ros-args -p a:=", "-p a:=: there is no value"),
            ("--ros-args -p a:={b:1}", "-p a:={b:1}"),
            (
                "--ros-args -p a:=[1,x]",
                "-p a:=[1,x]: a list holds values of one type",
            ),
        ] {
            let error = format!("{:#}", read(line).await.expect_err(line));
            assert!(error.contains(said), "{line}: {error}");
        }
        let argv = ["--ros-args".to_owned()];
        let usual = Usual {
            name: "9",
            by_program: false,
        };
        let error = super::read(&argv, usual, &|_| None)
            .await
            .expect_err("no name");
        assert!(
            error.to_string().contains("\"/9\" is not a name"),
            "{error}"
        );
    }
}
