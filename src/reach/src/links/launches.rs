//! The node that a robot of the other ROS wants to run, in the terms of the servant's ROS.

use link::control::{Hello, NodeLaunch};
use ros::bus::{BusError, ParamValue, RosVersion};
use ros::ros2::arguments::BEGIN;
use ros::spelling::RespelledArguments;

use super::node_time::SIMULATED;
use super::state::Hub;

/// Changes a hello's node into one of ROS `servant`; returns arguments that are ignored there.
pub(super) fn adapt_node(hello: &mut Hello, servant: RosVersion) -> Vec<String> {
    let robot = hello.ros.max(1);
    let node = &mut hello.node;
    if robot == servant.number() || spelling(node) == servant {
        return Vec::new();
    }
    let RespelledArguments { mut argv, ignored } = RespelledArguments::new(&node.argv, &node.name, servant);
    // In ROS 1 it is a parameter of all nodes.
    if servant == RosVersion::Two && is_simulated(hello.parameters.get(SIMULATED)) {
        argv.extend([BEGIN, "-p", "use_sim_time:=true"].map(str::to_owned));
    }
    node.argv = argv;
    // The robot's name is given to all nodes of the program, which is one node on the robot.
    node.named_by_argv = false;
    ignored
}

/// Returns the ROS in whose terms the stub gives the arguments: one that is made for a service of the other ROS spells
/// them for the service.
fn spelling(node: &NodeLaunch) -> RosVersion {
    let is_two = node.named_by_argv || node.argv.iter().any(|argument| argument == BEGIN);
    if is_two { RosVersion::Two } else { RosVersion::One }
}

fn is_simulated(value: Option<&ParamValue>) -> bool {
    value == Some(&ParamValue::Bool(true))
}

impl Hub {
    /// Sets whether the time of a servant of ROS 1 is simulated, as a robot of ROS 2 says it for its node.
    pub(super) async fn copy_simulated_time(&self, hello: &Hello) -> Result<(), BusError> {
        let Ok(parameters) = self.bus.parameters() else {
            return Ok(());
        };
        let key = format!("/{SIMULATED}");
        let wanted = is_simulated(hello.parameters.get(SIMULATED));
        let there = is_simulated(parameters.get(&key).await.ok().as_ref());
        if wanted != there {
            parameters.set(&key, ParamValue::Bool(wanted)).await?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hello(ros: u8, named_by_argv: bool, line: &str) -> Hello {
        let argv = line.split(' ').map(str::to_owned).collect();
        let node = NodeLaunch { name: "/see".into(), argv, named_by_argv, ..NodeLaunch::default() };
        Hello { ros, node, ..Hello::default() }
    }

    #[test]
    fn arguments_are_spelt_for_the_servant_once() {
        for (ros, named, line, servant, spelt) in [
            (1, false, "image:=/left _rate:=2", RosVersion::Two, "--ros-args -r image:=/left -p rate:=2 --"),
            (0, false, "image:=/left", RosVersion::Two, "--ros-args -r image:=/left --"),
            (2, true, "--ros-args -p rate:=2", RosVersion::One, "_rate:=2"),
            (2, false, "--ros-args -p rate:=2", RosVersion::One, "_rate:=2"),
            // A stub that is made for a service of the other ROS has spelt them.
            (1, true, "--ros-args -r __node:=see", RosVersion::Two, "--ros-args -r __node:=see"),
            (2, false, "_rate:=2", RosVersion::One, "_rate:=2"),
            // The same ROS.
            (1, false, "image:=/left", RosVersion::One, "image:=/left"),
            (2, true, "--ros-args --nonsense", RosVersion::Two, "--ros-args --nonsense"),
        ] {
            let mut hello = hello(ros, named, line);
            assert!(adapt_node(&mut hello, servant).is_empty(), "{line}");
            assert_eq!(hello.node.argv.join(" "), spelt, "ROS {ros} at {servant:?}: {line}");
        }
        let mut unknown = hello(2, true, "--ros-args --log-level debug");
        assert_eq!(adapt_node(&mut unknown, RosVersion::One), ["--log-level debug"]);
    }

    #[test]
    fn time_that_is_simulated_for_all_of_a_robot_is_so_for_a_node_of_ros_2() {
        let mut hello = hello(1, false, "image:=/left");
        hello.parameters.insert(SIMULATED.into(), ParamValue::Bool(true));
        adapt_node(&mut hello, RosVersion::Two);
        assert_eq!(hello.node.argv.join(" "), "--ros-args -r image:=/left -- --ros-args -p use_sim_time:=true");
    }
}
