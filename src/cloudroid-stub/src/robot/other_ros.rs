//! Command lines for a node in the cloud that is of the other ROS than the robot
//! (<http://wiki.ros.org/Remapping%20Arguments>, <https://design.ros2.org/articles/ros_command_line_arguments.html>).
//!
//! Names and remap rules are spelt by [`ros::spelling`], which leaves the node's own name and the types of values to
//! this side: only the robot knows which name the program gives itself, and reads values as its ROS does.
//!
//! | ROS 1 | ROS 2 |
//! |---|---|
//! | `__name:=n`, `ROS_NAMESPACE` | `-r __node:=n`, `-r __ns:=/above` |
//! | `_p:=base link` | `-p p:="base link"` |

use ros::bus::parameter_names::spell_in_ros1;
use ros::bus::{ParamValue, RosVersion};
use ros::ros2::arguments::{BEGIN, END};
use ros::ros2::parameters::yaml::{parse_any, parse_text};
use ros::ros2::process;
use ros::spelling::RespelledArguments;

use super::{LaunchedNode, ros2};

/// Returns the arguments of a robot's node for a program of the other ROS. What it cannot express is left out with a
/// warning.
pub fn translate_arguments(robot: &LaunchedNode) -> Vec<String> {
    let service = robot.ros.other();
    match service {
        RosVersion::One => {
            let argv = respell(robot, &robot.argv, service).into_iter();
            argv.filter(|word| !is_setting(word)).map(|word| map_parameter(&word, to_one_text)).collect()
        }
        RosVersion::Two => {
            let typed: Vec<String> = robot.argv.iter().map(|word| map_parameter(word, to_yaml)).collect();
            let mut argv = respell(robot, &typed, service);
            let names = naming_rules(robot);
            if !names.is_empty() {
                argv.push(BEGIN.to_owned());
                argv.extend(names);
                argv.push(END.to_owned());
            }
            argv
        }
    }
}

/// Returns `argv` as ROS `service` spells it.
fn respell(robot: &LaunchedNode, argv: &[String], service: RosVersion) -> Vec<String> {
    let RespelledArguments { argv, ignored } = RespelledArguments::new(argv, &robot.node, service);
    for argument in ignored {
        let number = service.number();
        tracing::warn!("{argument} does not reach the node in the cloud: it means nothing to a node of ROS {number}");
    }
    argv
}

/// Returns an argument of ROS 1 with another value, if it is a parameter.
fn map_parameter(argument: &str, convert: fn(&str) -> String) -> String {
    match argument.split_once(":=") {
        Some((name, value)) if name.starts_with('_') => format!("{name}:={}", convert(value)),
        _ => argument.to_owned(),
    }
}

/// Returns whether an argument of ROS 1 is a parameter that configures the stub.
fn is_setting(argument: &str) -> bool {
    argument.strip_prefix('_').is_some_and(|parameter| parameter.starts_with(&spell_in_ros1(ros2::SETTINGS)))
}

/// Returns the rules for the parts of the node's name that its program does not set in this way.
fn naming_rules(robot: &LaunchedNode) -> Vec<String> {
    let split = |node: &str| {
        let (above, name) = node.rsplit_once('/').unwrap_or(("", node));
        let above = if above.is_empty() { "/" } else { above };
        (above.to_owned(), name.to_owned())
    };
    let (above, name) = split(&robot.node);
    let by_program = robot.name_by_program.as_deref().map(split);
    let mut rules = Vec::new();
    if by_program.as_ref().is_none_or(|(_, by_program)| *by_program != name) {
        rules.extend(["-r".to_owned(), format!("__node:={name}")]);
    }
    if by_program.is_none_or(|(by_program, _)| by_program != above) {
        rules.extend(["-r".to_owned(), format!("__ns:={above}")]);
    }
    rules
}

/// Returns a value of ROS 1, where any text is one, in YAML as ROS 2 reads it.
fn to_yaml(text: &str) -> String {
    process::yaml(&parse_any(text))
}

/// Returns a value in YAML as ROS 1 reads it. A text has no quotes, which roscpp would take for a part of it, unless it
/// looks like another value; then only rospy, which reads YAML, takes it for a text.
fn to_one_text(yaml: &str) -> String {
    match parse_text(yaml) {
        Ok(ParamValue::String(text)) if parse_text(&text).ok() == Some(ParamValue::String(text.clone())) => text,
        _ => yaml.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::super::DefaultName;
    use super::*;

    fn words(line: &str) -> Vec<String> {
        line.split_whitespace().map(str::to_owned).collect()
    }

    /// Returns the command line in ROS 2 for one of ROS 1.
    fn translate_to_two(usual: DefaultName<'_>, argv: &[&str], namespace: &str) -> Vec<String> {
        let argv: Vec<String> = argv.iter().map(|&word| word.to_owned()).collect();
        let variable = |name: &str| (name == "ROS_NAMESPACE").then(|| namespace.to_owned());
        let robot = super::super::ros1::read(&argv, usual, &variable).expect("a robot");
        translate_arguments(&robot)
    }

    async fn translate_to_one(argv: &[String]) -> Vec<String> {
        let usual = DefaultName { name: "see", by_program: true };
        let robot = ros2::read(argv, usual, &|_| None).await.expect("a robot");
        translate_arguments(&robot)
    }

    const GUESSED: DefaultName<'_> = DefaultName { name: "usual", by_program: false };

    #[test]
    fn arguments_of_ros_1_become_those_of_ros_2() {
        let argv = [
            "3",
            "image:=/camera/image",
            "~told:=/told",
            "_rate:=2",
            "_frame:=base link",
            "_text:=a: b",
            "_none:=",
            "_list:=[1, 2]",
            "_gains/p:=0.5",
            "__name:=people",
            "__log:=/x.log",
            "--fast",
        ];
        let expected = [
            &["3", "--fast", "--ros-args"][..],
            &["-r", "image:=/camera/image", "-r", "~/told:=/told"],
            &["-p", "rate:=2", "-p", "frame:=\"base link\"", "-p", "text:=\"a: b\"", "-p", "none:=\"\""],
            &["-p", "list:=[1, 2]", "-p", "gains.p:=0.5"],
            &["--", "--ros-args", "-r", "__node:=people", "-r", "__ns:=/front", "--"],
        ];
        assert_eq!(translate_to_two(GUESSED, &argv, "/front"), expected.concat());
    }

    #[test]
    fn a_name_that_the_program_gives_is_not_told() {
        let usual = DefaultName { name: "/arm/gripper", by_program: true };
        for (argv, namespace, expected) in [
            ("", "", ""),
            ("__name:=gripper", "/arm", ""),
            ("__name:=hand", "", "--ros-args -r __node:=hand --"),
            ("", "/left", "--ros-args -r __ns:=/left --"),
            ("__ns:=/ __name:=hand", "", "--ros-args -r __node:=hand -r __ns:=/ --"),
        ] {
            let argv: Vec<&str> = argv.split_whitespace().collect();
            assert_eq!(translate_to_two(usual, &argv, namespace).join(" "), expected, "{argv:?} {namespace}");
        }
    }

    #[test]
    fn what_ros_2_would_refuse_is_left_out() {
        let argv = ["url:=http://x/?y", "_frame-id:=a", "a b:=c"];
        let translated = translate_to_two(DefaultName { name: "see", by_program: true }, &argv, "");
        assert!(translated.is_empty(), "{translated:?}");
    }

    #[tokio::test]
    async fn arguments_of_ros_2_become_those_of_ros_1() {
        let line = "--fast --ros-args -r __node:=people -r __ns:=/front -r image:=/camera/image -r ~/told:=/told -r \
                    rostopic://a:=b -r people:c:=d -r other:e:=f --log-level debug -p rate:=2 -p gains.p:=0.5 -p \
                    people_frame:=map -p use_sim_time:=true -p cloudroid.max:=0.3 -p other:rate:=9 -p ok:=yes -p \
                    number:=\"1\" -p list:=[1,2] -- own";
        let expected = "--fast own image:=/camera/image ~told:=/told a:=b c:=d _gains/p:=0.5 _list:=[1, 2] \
                        _number:=\"1\" _ok:=true _people_frame:=map _rate:=2";
        assert_eq!(translate_to_one(&words(line)).await.join(" "), expected);
        let text = ["--ros-args", "-p", "title:=two words"].map(str::to_owned);
        assert_eq!(translate_to_one(&text).await, ["_title:=two words"]);
        let pattern = words("--ros-args -r *:=/x");
        assert!(translate_to_one(&pattern).await.is_empty());
    }

    #[tokio::test]
    async fn there_and_back_arguments_are_the_same() {
        let line = "own image:=/camera/image ~told:=/told _flag:=true _gains/p:=0.5 _rate:=2";
        let usual = DefaultName { name: "see", by_program: true };
        let there = translate_to_two(usual, &words(line).iter().map(String::as_str).collect::<Vec<_>>(), "");
        assert_eq!(translate_to_one(&there).await.join(" "), line);
    }
}
