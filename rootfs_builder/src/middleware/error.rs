//! Errors of pushes whose nodes would use a middleware that the bus does not speak.

use ros::ros2::middleware::{UnsupportedMiddleware, VARIABLE};

/// Reason why nodes of a push would not be reached.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum MiddlewareError {
    /// An option names the middleware.
    #[error("{option}: {reason}; leave it out")]
    Option {
        /// The option with its value.
        option: String,
        /// Reason.
        reason: UnsupportedMiddleware,
    },
    /// A package needs the middleware at run time.
    #[error(
        "package {package} depends on {name} at run time: {reason}; if its nodes run with rmw_fastrtps_cpp or \
         rmw_cyclonedds_cpp as well, push with `--map {name}=`"
    )]
    Dependency {
        /// Name of the package.
        package: String,
        /// Name of the dependency.
        name: String,
        /// Reason.
        reason: UnsupportedMiddleware,
    },
    /// The middleware is selected by the environment.
    #[error("{by} sets {VARIABLE}: {reason}; set it to rmw_fastrtps_cpp or rmw_cyclonedds_cpp there, or remove it")]
    Variable {
        /// File or node that sets the variable.
        by: String,
        /// Reason.
        reason: UnsupportedMiddleware,
    },
}
