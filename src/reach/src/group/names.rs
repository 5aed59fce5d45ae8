//! Names of a shared node on a robot. The group's nodes run under the deployer's command line, a stub stands for one of them under
//! its robot's. A name is traced back to what the program wrote, and resolved again as ROS resolves it on the robot
//! (ROS 1: <http://wiki.ros.org/Names>, <http://wiki.ros.org/Remapping%20Arguments>; ROS 2:
//! <https://design.ros2.org/articles/static_remapping.html>):
//!
//! ```text
//!  /plan ─ without the remap work:=/plan ─▶ /work ─ beside /worker ─▶ work ─ of the node /r1/w ─▶ /r1/work ─ the robot's remaps ─▶
//! ```
//! What stands at the top of a node's namespace counts as written without a slash: of a node in `/`, both look the same.
//!
//! An action of ROS 1 is remapped as its name, or topic by topic. One of ROS 2 is not (rcl up to Jazzy, at least): only its parts are,
//! each by its whole name.

use ros::bus::RosVersion;
use ros::ros1;
use ros::ros2::{self, arguments};

use arguments::{Kind, Renamed};

/// How one node's command line resolves names.
#[derive(Debug, Clone)]
pub(super) struct Names {
    version: RosVersion,
    node: String,
    /// Of several for one name the first counts.
    remaps: Vec<Remap>,
}

/// Resolved, both sides.
#[derive(Debug, Clone)]
struct Remap {
    from: String,
    to: String,
    /// Of topics, or of services, alone (ROS 2).
    of: Option<What>,
}

/// What is named.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum What {
    Topic,
    Service,
}

impl Names {
    /// Those of a node of this absolute name, which was started with these arguments.
    pub(super) fn new(version: RosVersion, node: &str, argv: &[String]) -> Names {
        let remaps = match version {
            RosVersion::One => of_one(node, argv),
            RosVersion::Two => of_two(node, argv),
        };
        Names {
            version,
            node: node.to_owned(),
            remaps,
        }
    }

    /// What the program wrote, where it has registered `name`.
    fn written(&self, name: &str) -> String {
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

    fn before_remaps(&self, name: &str, what: What) -> Option<&str> {
        let mut remaps = self.remaps.iter().filter(|remap| remap.concerns(what));
        remaps
            .find(|remap| remap.to == name)
            .map(|remap| remap.from.as_str())
    }

    /// What a program that has written `name` has, without remaps.
    fn resolved(&self, name: &str) -> String {
        match self.version {
            RosVersion::One => ros1::names::resolve(name, &self.node),
            RosVersion::Two => ros2::names::resolve(name, &self.node),
        }
    }

    fn remapped(&self, name: String, what: What) -> String {
        let mut remaps = self.remaps.iter().filter(|remap| remap.concerns(what));
        let remap = remaps.find(|remap| remap.from == name);
        remap.map_or(name, |remap| remap.to.clone())
    }

    /// The name of a service that the node has by this command line, by the robot's.
    pub(super) fn on(&self, robot: &Names, name: &str) -> String {
        let what = What::Service;
        let before = self.before_remaps(name, what).unwrap_or(name);
        robot.remapped(robot.resolved(&self.written(before)), what)
    }

    /// The same of an action.
    pub(super) fn action_on(&self, robot: &Names, action: &str) -> String {
        match self.version {
            RosVersion::One => self.on(robot, action),
            RosVersion::Two => robot.resolved(&self.written(action)),
        }
    }

    /// The same of a part of an action, whose name ends so. In ROS 1 it is remapped itself or with its action: `/count` and `/goal`.
    pub(super) fn end_on(&self, robot: &Names, action: &str, end: &str, what: What) -> String {
        let before = match self.version {
            // Where all five topics were remapped to others, that has given the action its name.
            RosVersion::One => self
                .before_remaps(&format!("{action}{end}"), what)
                .and_then(|topic| topic.strip_suffix(end)),
            RosVersion::Two => None,
        };
        let action = self.action_on(robot, before.unwrap_or(action));
        robot.remapped(format!("{action}{end}"), what)
    }
}

impl Remap {
    fn concerns(&self, what: What) -> bool {
        self.of.is_none_or(|of| of == what)
    }
}

fn of_one(node: &str, argv: &[String]) -> Vec<Remap> {
    let remaps = argv.iter().filter_map(|argument| argument.split_once(":="));
    // `__name:=` and `_parameter:=` are no names.
    let remaps =
        remaps.filter(|(from, to)| !from.is_empty() && !from.starts_with('_') && !to.is_empty());
    let resolved = |name| ros1::names::resolve(name, node);
    let remaps = remaps.map(|(from, to)| Remap {
        from: resolved(from),
        to: resolved(to),
        of: None,
    });
    // The last one counts there.
    remaps.rev().collect()
}

/// None where rcl would not take the command line either.
fn of_two(node: &str, argv: &[String]) -> Vec<Remap> {
    let last = node.rsplit('/').next().unwrap_or_default();
    let resolved = |name: &str| ros2::names::resolve(name, node);
    let parts = arguments::parse(argv).unwrap_or_default();
    let remaps = parts.into_iter().filter_map(|part| {
        let Kind::Rule(rule) = part.kind else {
            return None;
        };
        let of = match rule.of {
            Renamed::Topic => Some(What::Topic),
            Renamed::Service => Some(What::Service),
            Renamed::Name => None,
            Renamed::Node | Renamed::Namespace => return None,
        };
        rule.concerns(last).then(|| Remap {
            from: resolved(&rule.from),
            to: resolved(&rule.to),
            of,
        })
    });
    remaps.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(node: &str, argv: &[&str]) -> Names {
        let argv: Vec<String> = argv.iter().map(|&argument| argument.to_owned()).collect();
        Names::new(RosVersion::One, node, &argv)
    }

    fn names_two(node: &str, argv: &str) -> Names {
        let argv: Vec<String> = argv.split_whitespace().map(str::to_owned).collect();
        Names::new(RosVersion::Two, node, &argv)
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
            // No name of the node, though it begins with one.
            (("/w", &[]), ("/x", &[]), "/wide/set", "/wide/set"),
            // The robot's remaps.
            (("/w", &[]), ("/x", &["work:=plan"]), "/work", "/plan"),
            (("/w", &[]), ("/r1/x", &["work:=plan"]), "/work", "/r1/plan"),
            (("/w", &[]), ("/r1/x", &["work:=/plan"]), "/work", "/plan"),
            (("/w", &[]), ("/x", &["~set:=/put"]), "/w/set", "/put"),
            (
                ("/w", &[]),
                ("/r1/x", &["/work:=/plan"]),
                "/work",
                "/r1/work",
            ),
            // The deployer's, which are no robot's.
            (("/w", &["work:=/plan"]), ("/x", &[]), "/plan", "/work"),
            (
                ("/w", &["work:=/plan"]),
                ("/r1/x", &["work:=mine"]),
                "/plan",
                "/r1/mine",
            ),
            // No remaps.
            (
                ("/w", &[]),
                ("/x", &["_work:=1", "3", "__name:=y"]),
                "/work",
                "/work",
            ),
        ] {
            let (from, to) = (names(deployed.0, deployed.1), names(robot.0, robot.1));
            assert_eq!(
                from.on(&to, name),
                expected,
                "{deployed:?} {robot:?} {name}"
            );
        }
    }

    #[test]
    fn actions_are_remapped_whole_or_topic_by_topic() {
        for (deployed, robot, action, expected) in [
            (&[][..], &[][..], "/count", "/r1/count/goal"),
            (&[], &["count:=tally"], "/count", "/r1/tally/goal"),
            (&[], &["count/goal:=/tally/goal"], "/count", "/tally/goal"),
            (
                &[],
                &["count/result:=/tally/result"],
                "/count",
                "/r1/count/goal",
            ),
            (&["count:=/tally"], &[], "/tally", "/r1/count/goal"),
            (
                &["count/goal:=/tally/goal"],
                &[],
                "/tally",
                "/r1/count/goal",
            ),
        ] {
            let (from, to) = (names("/w", deployed), names("/r1/x", robot));
            let topic = from.end_on(&to, action, "/goal", What::Topic);
            assert_eq!(topic, expected, "{deployed:?} {robot:?} {action}");
        }
    }

    #[test]
    fn there_and_back_a_name_is_what_it_was() {
        let lines: [(&str, &[&str]); 4] = [
            ("/w", &[]),
            ("/lab/w", &["work:=/plan"]),
            ("/w", &["~set:=put", "work:=there"]),
            ("/a/b/c", &["x:=y"]),
        ];
        for one in lines {
            for other in lines {
                let (one, other) = (names(one.0, one.1), names(other.0, other.1));
                for written in ["work", "~set", "sub/work", "x"] {
                    let name = one.remapped(one.resolved(written), What::Service);
                    let there = one.on(&other, &name);
                    assert_eq!(other.on(&one, &there), name, "{one:?} {other:?}");
                }
            }
        }
    }

    /// Each as a node of rclpy 7.1 has it.
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
            (
                ("/w", ""),
                ("/w", "-r work:=one -r /work:=two"),
                "/work",
                "/one",
            ),
            (("/w", ""), ("/w", "-r work:=~/mine"), "/work", "/w/mine"),
            // Of services, of topics, of one node of the process.
            (("/w", ""), ("/w", "-r rosservice://work:=x"), "/work", "/x"),
            (
                ("/w", ""),
                ("/w", "-r rostopic://work:=x"),
                "/work",
                "/work",
            ),
            (("/w", ""), ("/w", "-r w:work:=x"), "/work", "/x"),
            (("/w", ""), ("/w", "-r other:work:=x"), "/work", "/work"),
            // The deployer's, which are no robot's.
            (("/w", "-r work:=/plan"), ("/x", ""), "/plan", "/work"),
            (
                ("/w", "-r work:=/plan"),
                ("/r1/x", "-r work:=mine"),
                "/plan",
                "/r1/mine",
            ),
            (
                ("/w", "-p work:=1"),
                ("/x", "-r __ns:=/y"),
                "/work",
                "/work",
            ),
        ] {
            let [from, to] = [deployed, robot]
                .map(|(node, rules)| names_two(node, &format!("/opt/w --ros-args {rules}")));
            let found = from.on(&to, name);
            assert_eq!(found, expected, "{deployed:?} {robot:?} {name}");
        }
    }

    /// Each as a node of rclpy 7.1 has it.
    #[test]
    fn actions_of_ros_2_are_remapped_part_by_part() {
        let (from, end) = (names_two("/w", ""), "/_action/send_goal");
        for (rules, action, expected) in [
            ("", "/r1/count", "/r1/count/_action/send_goal"),
            (
                "-r count:=tally",
                "/r1/count",
                "/r1/count/_action/send_goal",
            ),
            ("-r count/_action/send_goal:=zz", "/r1/count", "/r1/zz"),
        ] {
            let to = names_two("/r1/x", &format!("--ros-args {rules}"));
            assert_eq!(from.action_on(&to, "/count"), action);
            let part = from.end_on(&to, "/count", end, What::Service);
            assert_eq!(part, expected, "{rules}");
            let topic = from.end_on(&to, "/count", "/_action/status", What::Topic);
            assert_eq!(topic, "/r1/count/_action/status");
        }
    }
}
