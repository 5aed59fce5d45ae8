//! Command lines of roslaunch: arguments, remaps, private parameters, and special keys such as `__name:=`.

use std::collections::BTreeMap;

use anyhow::{Context, bail};
use ros::bus::RosVersion;
use ros::ros1::names::{self, PeerUri};

use super::{DefaultName, LaunchedNode, RosLocation};
use crate::network::Variable;

/// Default address of the Master.
const MASTER: &str = "http://localhost:11311";

/// Implements [`LaunchedNode::read`] for ROS 1. The default name has a namespace if a program of ROS 2 sets one.
pub fn read(argv: &[String], usual: DefaultName<'_>, variable: Variable<'_>) -> anyhow::Result<LaunchedNode> {
    let set = |name| variable(name).filter(|value| !value.is_empty());
    let (above, name) = usual.split();
    let mut namespace = set("ROS_NAMESPACE").unwrap_or_else(|| above.to_owned());
    let mut name = name.to_owned();
    let mut master = set("ROS_MASTER_URI").unwrap_or_else(|| MASTER.to_owned());
    let mut own = set("ROS_HOSTNAME").or_else(|| set("ROS_IP"));
    let mut passed = Vec::new();
    for argument in argv {
        match argument.split_once(":=") {
            Some(("__name", value)) => name = value.to_owned(),
            Some(("__ns", value)) => namespace = value.to_owned(),
            Some(("__master", value)) => master = value.to_owned(),
            Some(("__hostname" | "__ip", value)) => own = Some(value.to_owned()),
            Some((special, _)) if special.starts_with("__") => {}
            _ => passed.push(argument.clone()),
        }
    }
    if name.contains('/') {
        bail!("__name:={name} contains a slash; use __ns:= or ROS_NAMESPACE for the namespace");
    }
    let node = names::canonical(&format!("{namespace}/{name}"));
    if !names::is_global(&node) {
        bail!("{node:?} is not a valid ROS node name");
    }
    let place = PeerUri::parse(&master, "http")
        .with_context(|| format!("ROS_MASTER_URI is {master:?}; it should look like {MASTER}"))?;
    let mut original_argv = passed.clone();
    original_argv.push(format!("__name:={name}"));
    Ok(LaunchedNode {
        ros: RosVersion::One,
        place: RosLocation::Master { host: place.host, port: place.port, own },
        node,
        name_by_program: usual.name_by_program(),
        argv: passed,
        original_argv,
        parameters: BTreeMap::new(),
        sim_time: false,
    })
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn read(argv: &[&str], environment: &[(&str, &str)]) -> anyhow::Result<LaunchedNode> {
        let argv: Vec<String> = argv.iter().map(|&argument| argument.to_owned()).collect();
        let usual = DefaultName { name: "usual", by_program: false };
        super::read(&argv, usual, &|name| {
            let found = environment.iter().find(|(variable, _)| *variable == name);
            found.map(|(_, value)| (*value).to_owned())
        })
    }

    #[test]
    fn roslaunch_s_arguments_are_understood() {
        let robot = read(
            &["3", "image:=/camera/image", "_threshold:=2", "__name:=people", "__log:=/x/y.log"],
            &[("ROS_NAMESPACE", "/front/"), ("ROS_MASTER_URI", "http://brain:1234/")],
        )
        .unwrap();
        assert_eq!(robot.node, "/front/people");
        assert_eq!(robot.argv, ["3", "image:=/camera/image", "_threshold:=2"]);
        assert_eq!(robot.original_argv[3..], ["__name:=people"]);
        let place = RosLocation::Master { host: "brain".into(), port: 1234, own: None };
        assert_eq!(robot.place, place);
        assert_eq!(robot.to_cloud_node("p", "x", Path::new("")).namespace, "/front");
    }

    #[test]
    fn without_any_the_usual_ones_hold() {
        let robot = read(&[], &[("ROS_IP", "10.0.0.2")]).unwrap();
        let place = RosLocation::Master { host: "localhost".into(), port: 11311, own: Some("10.0.0.2".into()) };
        assert_eq!((robot.node.as_str(), robot.place.clone()), ("/usual", place));
        assert_eq!(robot.to_cloud_node("p", "x", Path::new("")).namespace, "");
    }

    #[test]
    fn what_cannot_be_is_said() {
        for (argv, environment) in [
            (vec!["__name:=a/b"], vec![]),
            (vec!["__name:=ä"], vec![]),
            (vec![], vec![("ROS_MASTER_URI", "localhost:11311")]),
        ] {
            assert!(read(&argv, &environment).is_err(), "{argv:?} {environment:?}");
        }
    }
}
