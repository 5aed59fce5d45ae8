//! Refusal of pushes of ROS 2 whose nodes would use a middleware that the bus does not speak: robots would not reach
//! them.
//!
//! ```text
//!  before the build   options, dependencies at run time, literal statements of launch files
//!  after it           launch plan: the environment that setup scripts and launch files make for each node
//! ```

mod error;

use package::foreseen::{self, SetVariable};
use package::manifest::Kind;
use package::workspace::{Package, Workspace};
use ros::flavour::Version;
use ros::ros2::middleware::{self, UnsupportedMiddleware, VARIABLE};

use crate::launch::LaunchAnswer;
use crate::request::{PushRequest, PushSource};

pub use error::MiddlewareError;

/// Returns the RMW implementation over Zenoh that a name stands for: of a ROS package, or of a Debian package of one
/// (`ros-kilted-rmw-zenoh-cpp`).
fn find_zenoh(name: &str) -> Option<UnsupportedMiddleware> {
    let words = name.replace('-', "_");
    let at = if words.starts_with("ros_") { words.find("_rmw_").map_or(0, |at| at + 1) } else { 0 };
    words.get(at..).filter(|name| middleware::is_zenoh(name)).and_then(|name| middleware::check(name).err())
}

/// Checks the options of a push on a base of this version.
pub(crate) fn check_options(request: &PushRequest, ros: Version) -> Result<(), MiddlewareError> {
    if ros == Version::Ros1 {
        return Ok(());
    }
    let with = request.with.iter().map(|name| ("--with ".to_owned(), name));
    let args = request.args.iter().map(|(key, value)| (format!("--arg {key}:="), value));
    let apt = match &request.source {
        PushSource::Packaged(name) => Some(("--apt ".to_owned(), name)),
        PushSource::Tree(_) => None,
    };
    for (option, value) in apt.into_iter().chain(with).chain(args) {
        if let Some(reason) = find_zenoh(value) {
            return Err(MiddlewareError::Option { option: format!("{option}{value}"), reason });
        }
    }
    Ok(())
}

/// Checks what packages need at run time, but for keys that are mapped to something else.
pub(crate) fn check_packages(packages: &[Package], request: &PushRequest, ros: Version) -> Result<(), MiddlewareError> {
    if ros == Version::Ros1 {
        return Ok(());
    }
    for Package { manifest, .. } in packages {
        let needed = manifest.needs(&[Kind::Exec]).into_iter().filter(|name| !request.map.contains_key(*name));
        for name in needed {
            if let Some(reason) = find_zenoh(name) {
                let (package, name) = (manifest.name.clone(), name.to_owned());
                return Err(MiddlewareError::Dependency { package, name, reason });
            }
        }
    }
    Ok(())
}

/// Checks the launch file that is run, as far as it can be read. Blocking; reads what was pushed.
pub(crate) fn check_sources(workspace: &Workspace, request: &PushRequest, ros: Version) -> Result<(), MiddlewareError> {
    let is_launched = request.launch.is_some() || request.nodes.is_empty();
    if ros == Version::Ros1 || request.as_underlay || !is_launched {
        return Ok(());
    }
    match foreseen::find_set_variable(workspace, request.launch.as_deref(), VARIABLE) {
        Some(SetVariable { file, value }) => check_value(&value, || format!("launch file {file}")),
        None => Ok(()),
    }
}

fn check_value(value: &str, by: impl FnOnce() -> String) -> Result<(), MiddlewareError> {
    middleware::check(value).map_err(|reason| MiddlewareError::Variable { by: by(), reason })
}

/// Checks what the nodes of an image are started with.
pub(crate) fn check_plan(answer: &LaunchAnswer, ros: Version) -> Result<(), MiddlewareError> {
    if ros == Version::Ros1 {
        return Ok(());
    }
    if let Some(value) = answer.environment.get(VARIABLE) {
        check_value(value, || "a setup script of the install space".to_owned())?;
    }
    for node in &answer.nodes {
        let checked = middleware::check_process(&node.environment, &node.argv);
        checked
            .map_err(|reason| MiddlewareError::Variable { by: format!("what starts node {}", node.name), reason })?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::launch::LaunchNode;

    #[test]
    fn options_that_name_it_are_refused_on_ros_2() {
        let apt = |name: &str| PushRequest { source: PushSource::Packaged(name.to_owned()), ..PushRequest::default() };
        let with = |name: &str| PushRequest { with: vec![name.to_owned()], ..PushRequest::default() };
        let arg =
            |value: &str| PushRequest { args: [("rmw".to_owned(), value.to_owned())].into(), ..PushRequest::default() };
        for (request, words) in [
            (apt("rmw_zenoh_cpp"), "--apt rmw_zenoh_cpp: rmw_zenoh_cpp speaks Zenoh"),
            (apt("ros-kilted-rmw-zenoh-cpp"), "--apt ros-kilted-rmw-zenoh-cpp: rmw_zenoh_cpp speaks Zenoh"),
            (with("ros-jazzy-rmw-zenoh-cpp"), "--with ros-jazzy-rmw-zenoh-cpp: "),
            (arg("rmw_zenoh_cpp"), "--arg rmw:=rmw_zenoh_cpp: "),
        ] {
            let refused = check_options(&request, Version::Ros2).expect_err(words).to_string();
            assert!(refused.starts_with(words) && refused.ends_with("; leave it out"), "{refused}");
            check_options(&request, Version::Ros1).expect("ROS 1 has no middlewares");
        }
        for name in ["rmw_fastrtps_cpp", "ros-jazzy-rmw-cyclonedds-cpp", "ros-jazzy-nav2-map-server", "zenoh", "é"] {
            for request in [apt(name), with(name), arg(name)] {
                check_options(&request, Version::Ros2).expect(name);
            }
        }
    }

    #[test]
    fn what_starts_a_node_may_not_select_it() {
        let node = |environment: &[(&str, &str)], argv: &[&str]| LaunchNode {
            name: "/talker".into(),
            package: "talk".into(),
            executable: "talker".into(),
            argv: argv.iter().map(|&word| word.to_owned()).collect(),
            remaps: BTreeMap::new(),
            environment: environment.iter().map(|&(name, value)| (name.to_owned(), value.to_owned())).collect(),
            directory: None,
            respawn: false,
            respawn_delay: 0.0,
            required: false,
            named: true,
        };
        let started = |node: LaunchNode| LaunchAnswer { nodes: vec![node], ..LaunchAnswer::default() };
        let sourced = |value: &str| LaunchAnswer {
            environment: [(VARIABLE.to_owned(), value.to_owned())].into(),
            ..LaunchAnswer::default()
        };
        for (answer, words) in [
            (sourced("rmw_zenoh_cpp"), "a setup script of the install space sets RMW_IMPLEMENTATION: rmw_zenoh_cpp"),
            (
                started(node(&[(VARIABLE, "rmw_zenoh_cpp")], &["/x"])),
                "what starts node /talker sets RMW_IMPLEMENTATION: rmw_zenoh_cpp speaks Zenoh",
            ),
            (started(node(&[], &["env", "RMW_IMPLEMENTATION=rmw_zenoh_cpp", "/x"])), "what starts node /talker"),
            (started(node(&[(VARIABLE, "rmw_email_cpp")], &["/x"])), "what starts node /talker sets"),
        ] {
            let refused = check_plan(&answer, Version::Ros2).expect_err(words).to_string();
            assert!(refused.starts_with(words) && refused.contains("set it to rmw_fastrtps_cpp or"), "{refused}");
            check_plan(&answer, Version::Ros1).expect("ROS 1 has no middlewares");
        }
        let good = started(node(&[(VARIABLE, "rmw_cyclonedds_cpp")], &["/x"]));
        for answer in [good, sourced("rmw_fastrtps_cpp"), sourced("")] {
            check_plan(&answer, Version::Ros2).expect("DDS");
        }
    }
}
