//! Errors in what was pushed.

use std::io;
use std::path::PathBuf;

/// Every error names the file, and the line if there is one.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file operation failed.
    #[error("cannot {action} {}: {source}", .path.display())]
    File {
        /// Operation, such as "read".
        action: &'static str,
        /// File.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// A file exceeds the size limit of its kind.
    #[error("{} is larger than the limit of {limit} bytes; remove it", .path.display())]
    TooLarge {
        /// File.
        path: PathBuf,
        /// Maximum size in bytes.
        limit: u64,
    },
    /// There are more objects than supported.
    #[error("{} contains more than {limit} {what}; push a smaller directory", .path.display())]
    TooMany {
        /// Directory.
        path: PathBuf,
        /// Kind of object, such as "packages".
        what: &'static str,
        /// Maximum number.
        limit: usize,
    },
    /// A link points outside what was pushed.
    #[error("{} leads out of {}; replace the link with a copy", .path.display(), .root.display())]
    Outside {
        /// Link.
        path: PathBuf,
        /// Directory that it must not leave.
        root: PathBuf,
    },
    /// A `package.xml` cannot be parsed or is invalid.
    #[error("{}, line {line}, column {column}: {problem}", .path.display())]
    Manifest {
        /// File.
        path: PathBuf,
        /// Line, starting at 1.
        line: u32,
        /// Column, starting at 1.
        column: u32,
        /// Description of the problem.
        problem: String,
    },
    /// The directory contains nothing that can be pushed.
    #[error("{} is not a ROS package: {looked_for}; give the directory of a package, of a workspace, or of an install \
        space", .path.display())]
    NoPackage {
        /// Directory.
        path: PathBuf,
        /// Description of where packages were searched.
        looked_for: String,
    },
    /// A devel space, which is usable only beside its sources and its build.
    #[error("{} is a devel space, which only works where it was built; push the workspace, or its install space \
             after 'catkin_make install'", .path.display())]
    DevelSpace {
        /// Directory.
        path: PathBuf,
    },
    /// An option names a package that is not in the workspace.
    #[error("{option}: no package {name:?} was pushed; the packages are {known}")]
    UnknownPackage {
        /// The option, such as `--packages-skip`.
        option: &'static str,
        /// Name of the package.
        name: String,
        /// Names of the packages of the workspace.
        known: String,
    },
    /// No package is left to build.
    #[error("nothing is left to build without {skipped}; leave a package out of --packages-skip")]
    NothingSelected {
        /// Packages that are not built.
        skipped: String,
    },
    /// Two packages have the same name.
    #[error("two packages are named {name:?}: {} and {}; remove one, or put a file COLCON_IGNORE (or \
             CATKIN_IGNORE) beside it", .first.display(), .second.display())]
    SameName {
        /// Name of the packages.
        name: String,
        /// First directory, below what was pushed.
        first: PathBuf,
        /// Second directory, below what was pushed.
        second: PathBuf,
    },
    /// The install space contains links to where it was built.
    #[error("{} was built with --symlink-install: {} leads to the workspace, which is not there; build it without, or \
             push the workspace", .path.display(), .hook.display())]
    SymlinkInstall {
        /// Install space.
        path: PathBuf,
        /// File that points there.
        hook: PathBuf,
    },
    /// Packages of both ROS versions.
    #[error(
        "packages of both versions of ROS cannot be in one service: {first} (ROS {first_version}), and {second} (ROS \
            {second_version}); push them separately, or put a COLCON_IGNORE file beside the package.xml of one"
    )]
    TwoFlavours {
        /// A package and what determines its version: `talker has build type catkin`.
        first: String,
        /// ROS version, 1 or 2.
        first_version: u8,
        /// Package of the other version.
        second: String,
        /// ROS version, 1 or 2.
        second_version: u8,
    },
    /// Unsupported build type.
    #[error(
        "{}: no base supports build type {build_type}; supported are catkin (ROS 1), ament_cmake and ament_python (ROS \
            2), and cmake", .path.display()
    )]
    BuildType {
        /// Path of the package.xml.
        path: PathBuf,
        /// Build type stated there.
        build_type: String,
    },
    /// A ROS 2 package without a build type, which counts as catkin.
    #[error(
        "{}: it is built with {tool}, but has no build type, which means catkin; add \
            <export><build_type>{build_type}</build_type></export>", .path.display()
    )]
    NoBuildType {
        /// Path of the package.xml.
        path: PathBuf,
        /// Build tool, such as `ament_cmake` or `rosidl`.
        tool: String,
        /// Build type that it should state.
        build_type: &'static str,
    },
    /// Invalid interface file.
    #[error("{}: {problem}", .path.display())]
    Definition {
        /// Path of the `.msg`, `.srv`, `.action` or `.idl`.
        path: PathBuf,
        /// Description of the problem, with its line if there is one, and the next step.
        problem: String,
    },
    /// Packages depend on each other in a cycle.
    #[error("packages depend on each other to be built: {}; break the cycle in their \
        package.xml", .circle.join(" needs "))]
    Circle {
        /// Names along the cycle; the first is also the last.
        circle: Vec<String>,
    },
    /// An interface description cannot be parsed or is invalid.
    #[error("{}, line {line}, column {column}: {problem}", .path.display())]
    Interface {
        /// File.
        path: PathBuf,
        /// Line, starting at 1.
        line: usize,
        /// Column, starting at 1.
        column: usize,
        /// Description of the problem.
        problem: String,
    },
    /// A supplement contradicts what was found in the running package.
    #[error("in the interface file {what} is {stated}, but {found} was found; correct or remove it there")]
    Contradiction {
        /// Object, such as "input topic /image".
        what: String,
        /// Value stated in the supplement.
        stated: String,
        /// Value that was found.
        found: String,
    },
    /// A request pair names a topic that does not exist.
    #[error("{topic} is not an {direction} of this service; {}", describe_topics(.direction, .topics))]
    NoSuchTopic {
        /// Topic.
        topic: String,
        /// `input` or `output`.
        direction: &'static str,
        /// Existing topics of this direction.
        topics: Vec<String>,
    },
    /// A request pair is to be matched by stamp, but a message has none.
    #[error("{topic} is a {type_name}, which has no header.stamp; write \"by arrival\"")]
    NoStamp {
        /// Topic.
        topic: String,
        /// Type of the topic.
        type_name: String,
    },
    /// A request pair is to be matched by the goal of an action.
    #[error("{input} is given with \"by goal\"; action goals are recognised automatically, so remove it")]
    GoalIsNoTopic {
        /// Topic.
        input: String,
    },
    /// Two request pairs name the same topic.
    #[error("{topic} is named twice; name all outputs that answer an input in one request, and each output in one")]
    NamedTwice {
        /// Topic.
        topic: String,
    },
    /// The stub cannot be composed.
    #[error(
        "the image has no package.xml of {package}, so robots could not install its stub; push it with its share \
            directory"
    )]
    NoManifest {
        /// ROS package.
        package: String,
    },
    /// Types of the interface have no equivalent in the other ROS.
    #[error("robots of ROS {robot} cannot use {service}: {}", .problems.join("; "))]
    NoTwins {
        /// ROS version of the robots.
        robot: u8,
        /// Name of the service.
        service: String,
        /// Use of each type, and its fields that have no equivalent.
        problems: Vec<String>,
    },
    /// The types of the interface in the other ROS are not valid together.
    #[error("the messages of {service} in the other ROS: {error}")]
    BadTwins {
        /// Name of the service.
        service: String,
        /// The problem.
        #[source]
        error: ros::schema::SchemaError,
    },
}

fn describe_topics(direction: &str, topics: &[String]) -> String {
    match topics {
        [] => format!("it has no {direction}s"),
        topics => format!("its {direction}s are {}", topics.join(", ")),
    }
}

impl From<foreign::Error> for Error {
    fn from(error: foreign::Error) -> Self {
        match error {
            foreign::Error::File { action, path, source } => Self::File { action, path, source },
            foreign::Error::TooLarge { path, limit } => Self::TooLarge { path, limit },
            foreign::Error::Outside { path, root } => Self::Outside { path, root },
            foreign::Error::TooDeep { path, limit } => Self::TooMany { path, what: "directories in each other", limit },
            foreign::Error::NotAFile { path } => Self::File {
                action: "read",
                path,
                source: io::Error::new(io::ErrorKind::InvalidInput, "it is not a file"),
            },
            foreign::Error::Mounted { path } => Self::File {
                action: "remove",
                path,
                source: io::Error::new(
                    io::ErrorKind::ResourceBusy,
                    "a file system is mounted there; detach it with umount --lazy",
                ),
            },
            foreign::Error::Cancelled(cancelled) => {
                Self::File { action: "read", path: PathBuf::new(), source: cancelled.into() }
            }
        }
    }
}
