//! Middleware of the robot's nodes of ROS 2: the RMW implementation that they load. It is the one that a variable
//! names, else the default, which is Fast DDS in all distributions, else any that ament's index lists.

use std::path::Path;

use ros::ros2::middleware::{SUPPORTED, VARIABLE, is_zenoh};

use crate::network::Variable;

/// Part of ament's index that lists RMW implementations, and the package that chooses among them.
const INDEX: &str = "share/ament_index/resource_index/rmw_typesupport";
const CHOOSER: &str = "rmw_implementation";

/// Reason why the robot's nodes and a stub cannot communicate.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{by}: this robot's nodes speak Zenoh, and stubs speak DDS only, so they cannot communicate")]
pub struct ZenohError {
    /// Sign of it, such as `RMW_IMPLEMENTATION is rmw_zenoh_cpp`.
    pub by: String,
}

/// Middleware of the robot's nodes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RobotMiddleware {
    /// The default of the distribution.
    Default,
    /// One that was tested with stubs.
    Tested(String),
    /// One that was not tested with stubs.
    Untested(String),
}

impl RobotMiddleware {
    /// Reads what this environment says.
    ///
    /// # Errors
    /// Nodes in it use Zenoh.
    pub fn read(variable: Variable<'_>) -> Result<RobotMiddleware, ZenohError> {
        match variable(VARIABLE).filter(|value| !value.is_empty()) {
            Some(name) if SUPPORTED.contains(&name.as_str()) => Ok(RobotMiddleware::Tested(name)),
            Some(name) if is_zenoh(&name) => Err(ZenohError { by: format!("{VARIABLE} is {name}") }),
            Some(name) => Ok(RobotMiddleware::Untested(name)),
            None => match list_installed(variable).as_slice() {
                [name, others @ ..] if is_zenoh(name) && others.iter().all(|name| is_zenoh(name)) => {
                    Err(ZenohError { by: format!("{VARIABLE} is not set, and {name} is the only one installed") })
                }
                _ => Ok(RobotMiddleware::Default),
            },
        }
    }
}

/// Returns what to do where the robot's nodes use Zenoh.
pub fn advice() -> String {
    format!("export {VARIABLE}=rmw_fastrtps_cpp (or rmw_cyclonedds_cpp), for all nodes of this robot")
}

/// Returns the RMW implementations in the install spaces.
fn list_installed(variable: Variable<'_>) -> Vec<String> {
    let value = variable("AMENT_PREFIX_PATH").unwrap_or_default();
    let list = |prefix: &Path| std::fs::read_dir(prefix.join(INDEX)).into_iter().flatten().flatten();
    let entries = std::env::split_paths(&value).flat_map(|prefix| list(&prefix));
    let names = entries.filter_map(|entry| entry.file_name().into_string().ok());
    names.filter(|name| name != CHOOSER).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_variable_selects_the_middleware() {
        let read = |value: &str| RobotMiddleware::read(&|name: &str| (name == VARIABLE).then(|| value.to_owned()));
        assert_eq!(read(""), Ok(RobotMiddleware::Default));
        assert_eq!(read("rmw_cyclonedds_cpp"), Ok(RobotMiddleware::Tested("rmw_cyclonedds_cpp".to_owned())));
        assert_eq!(read("rmw_connextdds"), Ok(RobotMiddleware::Untested("rmw_connextdds".to_owned())));
        let error = read("rmw_zenoh_cpp").expect_err("it is not DDS").to_string();
        assert!(error.starts_with("RMW_IMPLEMENTATION is rmw_zenoh_cpp: this robot's nodes speak Zenoh"), "{error}");
    }

    #[test]
    fn without_the_variable_the_only_one_that_is_installed_counts() {
        let place = tempfile::tempdir().expect("a directory");
        let install = |prefix: &str, name: &str| {
            let index = place.path().join(prefix).join(INDEX);
            std::fs::create_dir_all(&index).expect("made");
            std::fs::write(index.join(name), "").expect("written");
        };
        let prefixes = ["overlay", "none", "ros"].map(|prefix| place.path().join(prefix));
        let prefixes = std::env::join_paths(prefixes).expect("no colons").into_string().expect("UTF-8");
        let read = || RobotMiddleware::read(&|name: &str| (name == "AMENT_PREFIX_PATH").then(|| prefixes.clone()));
        assert_eq!(read(), Ok(RobotMiddleware::Default), "nothing is listed");
        install("ros", CHOOSER);
        install("ros", "rmw_zenoh_cpp");
        let error = read().expect_err("there is no other").to_string();
        assert!(error.contains("is not set, and rmw_zenoh_cpp is the only one installed"), "{error}");
        install("overlay", "rmw_fastrtps_cpp");
        assert_eq!(read(), Ok(RobotMiddleware::Default));
    }
}
