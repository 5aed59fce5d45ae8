//! Arguments of a node in the spelling of the other ROS
//! (<http://wiki.ros.org/Remapping%20Arguments>, <https://design.ros2.org/articles/ros_command_line_arguments.html>):
//!
//! | ROS 1 | ROS 2 |
//! |---|---|
//! | `_p:=v`, `_a/b:=v` | `-p p:=v`, `-p a.b:=v` |
//! | `from:=to`, `~from:=to` | `-r from:=to`, `-r ~/from:=to` |
//!
//! Names of the node itself are not arguments here: whoever starts the program sets them.

use crate::bus::RosVersion;
use crate::bus::parameter_names::{spell_in_ros1, spell_in_ros2};
use crate::ros2::arguments::{self, BEGIN, END, Kind, RemapRule};

/// Parameter of ROS 2 by which a node simulates its time. In ROS 1 it belongs to all nodes.
const SIM_TIME: &str = "use_sim_time";

/// Arguments in the spelling of the other ROS.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RespelledArguments {
    /// The command line, without the program.
    pub argv: Vec<String>,
    /// Arguments that the other ROS cannot express.
    pub ignored: Vec<String>,
}

impl RespelledArguments {
    /// Spells arguments of the node of this absolute name for ROS `to`; they are those of the other ROS. Arguments that
    /// are not for ROS stay as they are.
    pub fn new(argv: &[String], node: &str, to: RosVersion) -> Self {
        match to {
            RosVersion::One => Self::for_ros1(argv, node),
            RosVersion::Two => Self::for_ros2(argv),
        }
    }

    fn for_ros2(argv: &[String]) -> Self {
        let mut out = Self::default();
        let mut rules = Vec::new();
        for argument in argv {
            let Some((name, value)) = argument.split_once(":=") else {
                out.argv.push(argument.clone());
                continue;
            };
            let words = match name.strip_prefix('_') {
                // The node's name, namespace, log and address.
                Some(special) if special.starts_with('_') => continue,
                Some(parameter) => ["-p".to_owned(), format!("{}:={value}", spell_in_ros2(parameter))],
                None => ["-r".to_owned(), format!("{}:={}", name_in_ros2(name), name_in_ros2(value))],
            };
            // rcl ends the program because of a single argument that it does not accept.
            match arguments::parse(&[&[BEGIN.to_owned()], &words[..]].concat()) {
                Ok(_) => rules.extend(words),
                Err(_) => out.ignored.push(argument.clone()),
            }
        }
        if !rules.is_empty() {
            out.argv.push(BEGIN.to_owned());
            out.argv.extend(rules);
            out.argv.push(END.to_owned());
        }
        out
    }

    fn for_ros1(argv: &[String], node: &str) -> Self {
        let own = node.rsplit('/').next().unwrap_or(node);
        let mut out = Self::default();
        let Ok(parts) = arguments::parse(argv) else {
            return Self { argv: Vec::new(), ignored: argv.to_vec() };
        };
        for part in parts {
            let words = part.words.join(" ");
            match part.kind {
                Kind::Own => out.argv.extend(part.words),
                Kind::Rule(rule) if !rule.of.is_name() || !rule.applies_to(own) => {}
                Kind::Rule(rule) => match rule_in_ros1(&rule) {
                    Some(remapping) => out.argv.push(remapping),
                    None => out.ignored.push(words),
                },
                Kind::Parameter(given) if given.is_for_other_node(node) || given.name == SIM_TIME => {}
                Kind::Parameter(given) => out.argv.push(format!("_{}:={}", spell_in_ros1(&given.name), given.value)),
                Kind::File(_) | Kind::Setting => out.ignored.push(words),
                Kind::Mark => {}
            }
        }
        out
    }
}

/// Returns a name as ROS 2 spells it: private ones have a slash.
fn name_in_ros2(name: &str) -> String {
    match name.strip_prefix('~') {
        Some(private) => format!("~/{}", private.trim_start_matches('/')),
        None => name.to_owned(),
    }
}

/// Returns a remapping as ROS 1 spells it; `None` for a pattern, which ROS 1 does not have.
fn rule_in_ros1(rule: &RemapRule) -> Option<String> {
    let names = [&rule.from, &rule.to].map(|name| match name.strip_prefix("~/") {
        Some(private) => format!("~{private}"),
        None => name.clone(),
    });
    let is_pattern = names.iter().any(|name| name.contains(['*', '\\']));
    (!is_pattern).then(|| names.join(":="))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn respell(line: &str, to: RosVersion) -> (String, Vec<String>) {
        let argv: Vec<String> = line.split(' ').map(str::to_owned).collect();
        let RespelledArguments { argv, ignored } = RespelledArguments::new(&argv, "/front/finder", to);
        (argv.join(" "), ignored)
    }

    #[test]
    fn arguments_mean_the_same_in_the_other_ros() {
        let (two, ignored) = respell("3 -v image:=/left ~out:=boxes _rate:=2 _a/b:=x __name:=y", RosVersion::Two);
        assert_eq!(two, "3 -v --ros-args -r image:=/left -r ~/out:=boxes -p rate:=2 -p a.b:=x --");
        assert!(ignored.is_empty());
        let line = "3 --ros-args -r image:=/left -r ~/out:=boxes -p rate:=2 -p a.b:=x -p use_sim_time:=true -r \
                    __node:=finder -r other:mask:=/m -p other:gain:=3 -- -v";
        let (one, ignored) = respell(line, RosVersion::One);
        assert_eq!(one, "3 image:=/left ~out:=boxes _rate:=2 _a/b:=x -v");
        assert!(ignored.is_empty());
        // No argument, no word for it.
        assert_eq!(respell("3", RosVersion::Two).0, "3");
    }

    #[test]
    fn what_the_other_ros_cannot_express_is_named() {
        let (two, ignored) = respell("_2nd:=x a:=b", RosVersion::Two);
        assert_eq!((&*two, &ignored[..]), ("--ros-args -r a:=b --", &["_2nd:=x".to_owned()][..]));
        let line = "--ros-args --log-level debug -r /a/*:=/b/\\1 --params-file /etc/x.yaml -r a:=b";
        let (one, ignored) = respell(line, RosVersion::One);
        assert_eq!(one, "a:=b");
        assert_eq!(ignored, ["--log-level debug", "-r /a/*:=/b/\\1", "--params-file /etc/x.yaml"]);
        // rcl would not accept it either.
        assert_eq!(respell("--ros-args --nonsense", RosVersion::One).1, ["--ros-args", "--nonsense"]);
    }
}
