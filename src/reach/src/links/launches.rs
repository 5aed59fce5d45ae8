//! The node that a robot of the other ROS wants to run, in the terms of the servant's ROS.

use std::collections::BTreeMap;

use link::control::{Hello, NodeLaunch};
use package::interface::Interface;
use ros::bus::{BusError, ParamValue, ParameterKind, RosVersion};
use ros::ros2::arguments::BEGIN;
use ros::spelling::RespelledArguments;

use super::node_time::SIM_TIME;
use super::parameters::translate_value;
use super::state::{Hub, ServantView};

/// Changes a hello's node into one of ROS `servant`; returns arguments that are ignored there.
pub(super) fn adapt_node(hello: &mut Hello, servant: RosVersion) -> Vec<String> {
    let robot = hello.ros.max(1);
    let node = &mut hello.node;
    if robot == servant.number() || spelling(node) == servant {
        return Vec::new();
    }
    let RespelledArguments { argv, ignored } = RespelledArguments::new(&node.argv, &node.name, servant);
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

/// Returns the types of the parameters of a service's nodes, as its push has recorded them. A name that has several is
/// left out: which of the nodes is meant is not known.
fn parameter_kinds(interface: &Interface) -> BTreeMap<String, ParameterKind> {
    let mut kinds: BTreeMap<String, Option<ParameterKind>> = BTreeMap::new();
    for parameter in &interface.parameters {
        let Some((name, descriptor)) = parameter.own_name().zip(parameter.descriptor.as_ref()) else { continue };
        let kind = descriptor.parameter_kind();
        let known = kinds.entry(name.to_owned()).or_insert(Some(kind));
        *known = known.filter(|known| *known == kind);
    }
    kinds.into_iter().filter_map(|(name, kind)| Some((name, kind?))).collect()
}

impl Hub {
    /// Sets whether the time of a servant of ROS 1 is simulated, as a robot of ROS 2 says it for its node.
    pub(super) async fn copy_simulated_time(&self, hello: &Hello) -> Result<(), BusError> {
        let Ok(parameters) = self.bus.parameters() else {
            return Ok(());
        };
        let key = format!("/{SIM_TIME}");
        let wanted = is_simulated(hello.parameters.get(SIM_TIME));
        let there = is_simulated(parameters.get(&key).await.ok().as_ref());
        if wanted != there {
            parameters.set(&key, ParamValue::Bool(wanted)).await?;
        }
        Ok(())
    }

    /// Returns the node of a robot as it is to be started, and what it is not given, in words. For a robot of the other
    /// ROS its parameters are passed on as the servant's ROS has them.
    pub(super) async fn prepare_launch(&self, view: &ServantView, node: &NodeLaunch) -> (NodeLaunch, Option<String>) {
        let mut launch = node.clone();
        let Some(bus) = view.translated_bus() else {
            return (launch, None);
        };
        let kinds = self.nodes.interface().map(parameter_kinds).unwrap_or_default();
        let mut translated = bus.prepare_launch(&node.name, &node.argv, &kinds);
        launch.argv = translated.argv;
        if let Ok(parameters) = self.bus.parameters() {
            for (key, value) in translated.parameters {
                let value = translate_value(self, node, &value);
                if let Err(error) = parameters.set(&key, value).await {
                    translated.left_out.add(&key, &error);
                }
            }
        }
        (launch, translated.left_out.describe(&node.name))
    }
}

#[cfg(test)]
mod tests {
    use package::interface::{Descriptor, Parameter};

    use super::*;

    #[test]
    fn types_of_parameters_are_those_that_the_push_has_recorded() {
        let parameter = |node: &str, name: &str, kind: &str| Parameter {
            name: format!("{node}/{name}"),
            node: node.to_owned(),
            descriptor: Some(Descriptor { kind: kind.to_owned(), ..Descriptor::default() }),
            ..Parameter::default()
        };
        let interface = Interface {
            parameters: vec![
                parameter("/see", "gain", "double"),
                parameter("/see", "mode", "integer"),
                parameter("/look", "gain", "double"),
                parameter("/look", "mode", "string"),
                Parameter { name: "/shared".into(), ..Parameter::default() },
            ],
            ..Interface::default()
        };
        assert_eq!(parameter_kinds(&interface), [("gain".to_owned(), ParameterKind::Double)].into());
    }

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
}
