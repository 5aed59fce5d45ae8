//! Names of a shared node on a robot. The group's nodes run with the deployer's command line, while a stub stands for
//! one of them with its robot's. A name is traced back to what the program wrote and resolved again as ROS would on the
//! robot (ROS 1: <http://wiki.ros.org/Names>, <http://wiki.ros.org/Remapping%20Arguments>; ROS 2:
//! <https://design.ros2.org/articles/static_remapping.html>):
//!
//! ```text
//!  /plan ─ undo the remap work:=/plan ─▶ /work ─ relative to /worker ─▶ work ─ in node /r1/w ─▶ /r1/work
//!                                                                            ─ the robot's remaps ─▶
//! ```
//! Names at the top of a node's namespace are taken as relative: for a node in `/`, both look the same.
//!
//! A ROS 1 action is remapped by its name or topic by topic. A ROS 2 action is not (at least up to rcl of Jazzy): only
//! its topics and services are, each by its full name.

use ros::bus::RosVersion;
use ros::ros1;
use ros::ros2::{self, arguments};

use arguments::{Kind, RemapTarget};

/// Name resolution of one node's command line.
#[derive(Debug, Clone)]
pub(super) struct NameResolver {
    version: RosVersion,
    node: String,
    /// Remappings; the first match counts.
    remaps: Vec<NameRemap>,
}

/// A remapping with both names resolved.
#[derive(Debug, Clone)]
struct NameRemap {
    from: String,
    to: String,
    /// Only topics or only services (ROS 2).
    of: Option<NameKind>,
}

/// Kind of a name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum NameKind {
    Topic,
    Service,
}

impl NameResolver {
    /// Creates the resolver of a node with this absolute name and command line.
    pub(super) fn new(version: RosVersion, node: &str, argv: &[String]) -> NameResolver {
        let remaps = match version {
            RosVersion::One => ros1_remaps(node, argv),
            RosVersion::Two => ros2_remaps(node, argv),
        };
        NameResolver { version, node: node.to_owned(), remaps }
    }

    /// Returns the name that the program wrote for the registered `name`.
    fn source_name(&self, name: &str) -> String {
        let below = |above: &str| name.strip_prefix(above)?.strip_prefix('/');
        if let Some(own) = below(&self.node) {
            return match self.version {
                RosVersion::One => format!("~{own}"),
                RosVersion::Two => format!("~/{own}"),
            };
        }
        let namespace = self.node.rsplit_once('/').map_or("", |(above, _)| above);
        below(namespace).unwrap_or(name).to_owned()
    }

    fn name_before_remap(&self, name: &str, what: NameKind) -> Option<&str> {
        let mut remaps = self.remaps.iter().filter(|remap| remap.applies_to(what));
        remaps.find(|remap| remap.to == name).map(|remap| remap.from.as_str())
    }

    /// Resolves a name written by the program, without remappings.
    fn resolve(&self, name: &str) -> String {
        match self.version {
            RosVersion::One => ros1::names::resolve(name, &self.node),
            RosVersion::Two => ros2::names::resolve(name, &self.node),
        }
    }

    fn apply_remaps(&self, name: String, what: NameKind) -> String {
        let mut remaps = self.remaps.iter().filter(|remap| remap.applies_to(what));
        let remap = remaps.find(|remap| remap.from == name);
        remap.map_or(name, |remap| remap.to.clone())
    }

    /// Translates the name of a service from this command line to the robot's.
    pub(super) fn service_name_on(&self, robot: &NameResolver, name: &str) -> String {
        let what = NameKind::Service;
        let before = self.name_before_remap(name, what).unwrap_or(name);
        robot.apply_remaps(robot.resolve(&self.source_name(before)), what)
    }

    /// Translates the name of an action.
    pub(super) fn action_name_on(&self, robot: &NameResolver, action: &str) -> String {
        match self.version {
            RosVersion::One => self.service_name_on(robot, action),
            RosVersion::Two => robot.resolve(&self.source_name(action)),
        }
    }

    /// Translates the name of a topic or service of an action, given its suffix. In ROS 1 it is remapped on its own or
    /// with its action: `/count` and `/goal`.
    pub(super) fn endpoint_name_on(&self, robot: &NameResolver, action: &str, end: &str, what: NameKind) -> String {
        let before = match self.version {
            // If all five topics were remapped, they determine the action's name.
            RosVersion::One => {
                self.name_before_remap(&format!("{action}{end}"), what).and_then(|topic| topic.strip_suffix(end))
            }
            RosVersion::Two => None,
        };
        let action = self.action_name_on(robot, before.unwrap_or(action));
        robot.apply_remaps(format!("{action}{end}"), what)
    }
}

impl NameRemap {
    fn applies_to(&self, what: NameKind) -> bool {
        self.of.is_none_or(|of| of == what)
    }
}

fn ros1_remaps(node: &str, argv: &[String]) -> Vec<NameRemap> {
    let remaps = argv.iter().filter_map(|argument| argument.split_once(":="));
    // `__name:=` and `_parameter:=` are not remappings.
    let remaps = remaps.filter(|(from, to)| !from.is_empty() && !from.starts_with('_') && !to.is_empty());
    let resolved = |name| ros1::names::resolve(name, node);
    let remaps = remaps.map(|(from, to)| NameRemap { from: resolved(from), to: resolved(to), of: None });
    // In ROS 1 the last match counts.
    remaps.rev().collect()
}

/// Returns none if rcl would not accept the command line either.
fn ros2_remaps(node: &str, argv: &[String]) -> Vec<NameRemap> {
    let last = node.rsplit('/').next().unwrap_or_default();
    let resolved = |name: &str| ros2::names::resolve(name, node);
    let parts = arguments::parse(argv).unwrap_or_default();
    let remaps = parts.into_iter().filter_map(|part| {
        let Kind::Rule(rule) = part.kind else {
            return None;
        };
        let of = match rule.of {
            RemapTarget::Topic => Some(NameKind::Topic),
            RemapTarget::Service => Some(NameKind::Service),
            RemapTarget::Name => None,
            RemapTarget::Node | RemapTarget::Namespace => return None,
        };
        rule.applies_to(last).then(|| NameRemap { from: resolved(&rule.from), to: resolved(&rule.to), of })
    });
    remaps.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(node: &str, argv: &[&str]) -> NameResolver {
        let argv: Vec<String> = argv.iter().map(|&argument| argument.to_owned()).collect();
        NameResolver::new(RosVersion::One, node, &argv)
    }

    fn names_two(node: &str, argv: &str) -> NameResolver {
        let argv: Vec<String> = argv.split_whitespace().map(str::to_owned).collect();
        NameResolver::new(RosVersion::Two, node, &argv)
    }

    #[test]
    fn robots_have_names_as_if_the_node_ran_there() {
        for (deployed, robot, name, expected) in [
            // The same command line.
            (("/w", &[][..]), ("/w", &[][..]), "/work", "/work"),
            (("/w", &[]), ("/w", &[]), "/w/set", "/w/set"),
            // Other names and namespaces.
            (("/w", &[]), ("/r1/x", &[]), "/work", "/r1/work"),
            (("/w", &[]), ("/r1/x", &[]), "/w/set", "/r1/x/set"),
            (("/w", &[]), ("/r1/x", &[]), "/a/work", "/r1/a/work"),
            (("/lab/w", &[]), ("/r1/x", &[]), "/lab/work", "/r1/work"),
            (("/lab/w", &[]), ("/r1/x", &[]), "/work", "/work"),
            (("/lab/w", &[]), ("/x", &[]), "/lab/w/set", "/x/set"),
            // Not below the node's name, although it begins with it.
            (("/w", &[]), ("/x", &[]), "/wide/set", "/wide/set"),
            // The robot's remappings.
            (("/w", &[]), ("/x", &["work:=plan"]), "/work", "/plan"),
            (("/w", &[]), ("/r1/x", &["work:=plan"]), "/work", "/r1/plan"),
            (("/w", &[]), ("/r1/x", &["work:=/plan"]), "/work", "/plan"),
            (("/w", &[]), ("/x", &["~set:=/put"]), "/w/set", "/put"),
            (("/w", &[]), ("/r1/x", &["/work:=/plan"]), "/work", "/r1/work"),
            // The deployer's remappings, which do not apply on the robot.
            (("/w", &["work:=/plan"]), ("/x", &[]), "/plan", "/work"),
            (("/w", &["work:=/plan"]), ("/r1/x", &["work:=mine"]), "/plan", "/r1/mine"),
            // Not remappings.
            (("/w", &[]), ("/x", &["_work:=1", "3", "__name:=y"]), "/work", "/work"),
        ] {
            let (from, to) = (names(deployed.0, deployed.1), names(robot.0, robot.1));
            assert_eq!(from.service_name_on(&to, name), expected, "{deployed:?} {robot:?} {name}");
        }
    }

    #[test]
    fn actions_are_remapped_whole_or_topic_by_topic() {
        for (deployed, robot, action, expected) in [
            (&[][..], &[][..], "/count", "/r1/count/goal"),
            (&[], &["count:=tally"], "/count", "/r1/tally/goal"),
            (&[], &["count/goal:=/tally/goal"], "/count", "/tally/goal"),
            (&[], &["count/result:=/tally/result"], "/count", "/r1/count/goal"),
            (&["count:=/tally"], &[], "/tally", "/r1/count/goal"),
            (&["count/goal:=/tally/goal"], &[], "/tally", "/r1/count/goal"),
        ] {
            let (from, to) = (names("/w", deployed), names("/r1/x", robot));
            let topic = from.endpoint_name_on(&to, action, "/goal", NameKind::Topic);
            assert_eq!(topic, expected, "{deployed:?} {robot:?} {action}");
        }
    }

    #[test]
    fn names_round_trip_between_command_lines() {
        let lines: [(&str, &[&str]); 4] =
            [("/w", &[]), ("/lab/w", &["work:=/plan"]), ("/w", &["~set:=put", "work:=there"]), ("/a/b/c", &["x:=y"])];
        for one in lines {
            for other in lines {
                let (one, other) = (names(one.0, one.1), names(other.0, other.1));
                for written in ["work", "~set", "sub/work", "x"] {
                    let name = one.apply_remaps(one.resolve(written), NameKind::Service);
                    let there = one.service_name_on(&other, &name);
                    assert_eq!(other.service_name_on(&one, &there), name, "{one:?} {other:?}");
                }
            }
        }
    }

    /// Expected values as of a node of rclpy 7.1.
    #[test]
    fn robots_of_ros_2_have_names_as_if_the_node_ran_there() {
        for (deployed, robot, name, expected) in [
            // The same command line.
            (("/w", ""), ("/w", ""), "/work", "/work"),
            // Other names and namespaces.
            (("/w", ""), ("/r1/x", ""), "/work", "/r1/work"),
            (("/w", ""), ("/r1/x", ""), "/w/own", "/r1/x/own"),
            (("/lab/w", ""), ("/r1/x", ""), "/lab/work", "/r1/work"),
            (("/lab/w", ""), ("/r1/x", ""), "/abs", "/abs"),
            // The robot's rules, of which the first counts.
            (("/w", ""), ("/r1/x", "-r work:=/plan"), "/work", "/plan"),
            (("/w", ""), ("/r1/x", "-r work:=plan"), "/work", "/r1/plan"),
            (("/w", ""), ("/r1/x", "-r ~/own:=put"), "/w/own", "/r1/put"),
            (("/w", ""), ("/w", "-r work:=one -r /work:=two"), "/work", "/one"),
            (("/w", ""), ("/w", "-r work:=~/mine"), "/work", "/w/mine"),
            // Rules for services, for topics, and for one node of the process.
            (("/w", ""), ("/w", "-r rosservice://work:=x"), "/work", "/x"),
            (("/w", ""), ("/w", "-r rostopic://work:=x"), "/work", "/work"),
            (("/w", ""), ("/w", "-r w:work:=x"), "/work", "/x"),
            (("/w", ""), ("/w", "-r other:work:=x"), "/work", "/work"),
            // The deployer's rules, which do not apply on the robot.
            (("/w", "-r work:=/plan"), ("/x", ""), "/plan", "/work"),
            (("/w", "-r work:=/plan"), ("/r1/x", "-r work:=mine"), "/plan", "/r1/mine"),
            (("/w", "-p work:=1"), ("/x", "-r __ns:=/y"), "/work", "/work"),
        ] {
            let [from, to] =
                [deployed, robot].map(|(node, rules)| names_two(node, &format!("/opt/w --ros-args {rules}")));
            let found = from.service_name_on(&to, name);
            assert_eq!(found, expected, "{deployed:?} {robot:?} {name}");
        }
    }

    /// Expected values as of a node of rclpy 7.1.
    #[test]
    fn actions_of_ros_2_are_remapped_part_by_part() {
        let (from, end) = (names_two("/w", ""), "/_action/send_goal");
        for (rules, action, expected) in [
            ("", "/r1/count", "/r1/count/_action/send_goal"),
            ("-r count:=tally", "/r1/count", "/r1/count/_action/send_goal"),
            ("-r count/_action/send_goal:=zz", "/r1/count", "/r1/zz"),
        ] {
            let to = names_two("/r1/x", &format!("--ros-args {rules}"));
            assert_eq!(from.action_name_on(&to, "/count"), action);
            let part = from.endpoint_name_on(&to, "/count", end, NameKind::Service);
            assert_eq!(part, expected, "{rules}");
            let topic = from.endpoint_name_on(&to, "/count", "/_action/status", NameKind::Topic);
            assert_eq!(topic, "/r1/count/_action/status");
        }
    }
}
