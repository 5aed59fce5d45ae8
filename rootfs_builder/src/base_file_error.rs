//! Reasons why a base definition or a requirements file beside it is invalid.

use std::path::PathBuf;

use ros::ros2::middleware::UnsupportedMiddleware;

/// Reason why the text of a definition is invalid, with its line if it is known.
#[derive(Debug, thiserror::Error)]
#[error("{}{problem}", .line.map(|line| format!("line {line}: ")).unwrap_or_default())]
pub struct BaseFileError {
    /// Line, starting at 1.
    pub line: Option<usize>,
    /// Reason.
    pub problem: BaseFileProblem,
}

/// Reason why the text of a definition is invalid.
#[derive(Debug, thiserror::Error)]
pub enum BaseFileProblem {
    /// The text is not the TOML of a definition.
    #[error("{}", .0.message())]
    Toml(Box<toml::de::Error>),
    /// Invalid name of a Debian package.
    #[error("{0:?} is not a Debian package name")]
    PackageName(String),
    /// The definition names no packages for nodes.
    #[error("runtime.packages is empty: list the packages that nodes need")]
    NoPackages,
    /// Invalid rule about unpacked files.
    #[error("{0:?} is neither path-exclude=/… nor path-include=/…")]
    StripRule(String),
    /// Invalid properties of wheels.
    #[error(transparent)]
    Wheels(#[from] WheelsError),
    /// Robots would not reach the nodes.
    #[error("environment: {0}; set RMW_IMPLEMENTATION to rmw_fastrtps_cpp or rmw_cyclonedds_cpp")]
    Middleware(#[from] UnsupportedMiddleware),
    /// Invalid path.
    #[error("{0:?} is not an absolute path below /")]
    Path(String),
}

/// Reason why properties of wheels are invalid.
#[derive(Debug, thiserror::Error)]
pub enum WheelsError {
    /// Invalid version of Python.
    #[error("{0:?} is not a version of Python 3")]
    Python(String),
    /// Invalid version of the C library.
    #[error("{0:?} is not a version of glibc")]
    Glibc(String),
    /// Invalid path of an additional file.
    #[error("{0:?} is not a path below the prefix")]
    File(PathBuf),
    /// Invalid name of a requirements file.
    #[error("{0:?} is not the name of a file beside this one")]
    Requirements(String),
}

/// Reason why a requirements file is invalid, with its line.
#[derive(Debug, thiserror::Error)]
#[error("line {line}: {problem}")]
pub struct RequirementsError {
    /// Line, starting at 1.
    pub line: usize,
    /// Reason.
    pub problem: RequirementProblem,
}

/// Reason why a requirement is invalid.
#[derive(Debug, thiserror::Error)]
pub enum RequirementProblem {
    /// The line does not begin with a name and a version.
    #[error("{0:?} is not NAME==VERSION")]
    NotPinned(String),
    /// This word of the line is not a hash.
    #[error("{0:?} is not --hash=sha256:HEX")]
    NotAHash(String),
    /// The package has no hash.
    #[error("{0} has no --hash=sha256:HEX")]
    NoHash(String),
    /// The package is on an earlier line, too.
    #[error("{0} appears twice")]
    Repeated(String),
}
