//! Checks that the stub and the robot's nodes of ROS 2 can communicate.

use ros::ros2::middleware::VARIABLE;

use super::check::Check;
use crate::middleware::{self, RobotMiddleware};
use crate::network::Variable;

const NAME: &str = "middleware";

/// Checks the environment of `variable`.
pub(super) fn check(variable: Variable<'_>) -> Check {
    match RobotMiddleware::read(variable) {
        Err(error) => Check::bad(NAME, error.to_string(), middleware::advice()),
        Ok(RobotMiddleware::Default) => {
            Check::good(NAME, format!("{VARIABLE} is not set: default of the distribution"))
        }
        Ok(RobotMiddleware::Tested(name)) => Check::good(NAME, name),
        Ok(RobotMiddleware::Untested(name)) => Check::warning(
            NAME,
            format!("{name} is untested with stubs; it works if it implements RTPS as specified by OMG"),
            format!("if nodes cannot communicate: export {VARIABLE}=rmw_fastrtps_cpp"),
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::super::check::CheckVerdict::{Bad, Good, Warning};
    use super::*;

    #[test]
    fn each_middleware_is_judged() {
        for (value, verdict, said, fix) in [
            ("", Good, "is not set: default", ""),
            ("rmw_cyclonedds_cpp", Good, "rmw_cyclonedds_cpp", ""),
            ("rmw_connextdds", Warning, "untested", "if nodes cannot communicate"),
            ("rmw_zenoh_cpp", Bad, "stubs speak DDS only", "RMW_IMPLEMENTATION=rmw_fastrtps_cpp (or rmw_cyclonedds"),
        ] {
            let found = check(&|name: &str| (name == VARIABLE).then(|| value.to_owned()));
            let advice = found.fix.clone().unwrap_or_default();
            assert!(found.verdict == verdict && found.found.contains(said) && advice.contains(fix), "{found:?}");
        }
    }
}
