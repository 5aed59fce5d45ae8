//! Names of a shared node on a robot. The group's nodes run under the deployer's command line, a stub stands for one of them under
//! its robot's. A name is traced back to what the program wrote, and resolved again as ROS 1 resolves it on the robot
//! (<http://wiki.ros.org/Names>, <http://wiki.ros.org/Remapping%20Arguments>):
//!
//! ```text
//!  /plan ─ without the remap work:=/plan ─▶ /work ─ beside /worker ─▶ work ─ of the node /r1/w ─▶ /r1/work ─ the robot's remaps ─▶
//! ```
//! What stands at the top of a node's namespace counts as written without a slash: of a node in `/`, both look the same.

use std::collections::BTreeMap;

use ros::ros1::names::resolve;

/// How one node's command line resolves names.
#[derive(Debug, Clone)]
pub(super) struct Names {
    node: String,
    /// Resolved, both sides.
    remaps: BTreeMap<String, String>,
}

impl Names {
    /// Those of a node of this absolute name, which was started with these arguments.
    pub(super) fn new(node: &str, argv: &[String]) -> Names {
        let remaps = argv.iter().filter_map(|argument| argument.split_once(":="));
        // `__name:=` and `_parameter:=` are no names.
        let remaps = remaps
            .filter(|(from, to)| !from.is_empty() && !from.starts_with('_') && !to.is_empty());
        Names {
            node: node.to_owned(),
            remaps: remaps
                .map(|(from, to)| (resolve(from, node), resolve(to, node)))
                .collect(),
        }
    }

    /// What the program wrote, where it has registered `name`.
    fn written(&self, name: &str) -> String {
        let name = self.before_remaps(name).unwrap_or(name);
        let below = |above: &str| name.strip_prefix(above)?.strip_prefix('/');
        if let Some(own) = below(&self.node) {
            return format!("~{own}");
        }
        let namespace = self.node.rsplit_once('/').map_or("", |(above, _)| above);
        below(namespace).unwrap_or(name).to_owned()
    }

    fn before_remaps(&self, name: &str) -> Option<&str> {
        let mut remaps = self.remaps.iter();
        remaps
            .find(|(_, to)| *to == name)
            .map(|(from, _)| from.as_str())
    }

    /// What a program registers that has written `name`.
    fn resolved(&self, name: &str) -> String {
        self.remapped(resolve(name, &self.node))
    }

    fn remapped(&self, name: String) -> String {
        self.remaps.get(&name).cloned().unwrap_or(name)
    }

    /// A name that the node has by this command line, by the robot's.
    pub(super) fn on(&self, robot: &Names, name: &str) -> String {
        robot.resolved(&self.written(name))
    }

    /// The same of a topic of an action, which is remapped itself or with its action: `/count` and `/goal`.
    pub(super) fn topic_on(&self, robot: &Names, action: &str, end: &str) -> String {
        // Where all five topics were remapped to others, that has given the action its name.
        let topic = self.before_remaps(&format!("{action}{end}"));
        let before = topic.and_then(|topic| topic.strip_suffix(end));
        let action = self.on(robot, before.unwrap_or(action));
        robot.remapped(format!("{action}{end}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(node: &str, argv: &[&str]) -> Names {
        let argv: Vec<String> = argv.iter().map(|&argument| argument.to_owned()).collect();
        Names::new(node, &argv)
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
            let topic = from.topic_on(&to, action, "/goal");
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
                    let name = one.resolved(written);
                    let there = one.on(&other, &name);
                    assert_eq!(other.on(&one, &there), name, "{one:?} {other:?}");
                }
            }
        }
    }
}
