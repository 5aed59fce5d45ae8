//! What is wrong with what was pushed.

use std::io;
use std::path::PathBuf;

/// Every failure names the file, and the line where there is one.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file operation failed.
    #[error("cannot {action} {}: {source}", .path.display())]
    File {
        /// What was attempted, such as "read".
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A file that is larger than such a file can sensibly be.
    #[error("{} is larger than the {limit} bytes that are read; leave it out", .path.display())]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Bytes that are accepted.
        limit: u64,
    },
    /// More of something than can sensibly be.
    #[error("{} holds more than {limit} {what}; push a smaller directory", .path.display())]
    TooMany {
        /// The directory.
        path: PathBuf,
        /// Such as "packages".
        what: &'static str,
        /// How many are accepted.
        limit: usize,
    },
    /// A link that leads out of what was pushed.
    #[error("{} leads out of {}; replace the link with a copy", .path.display(), .root.display())]
    Outside {
        /// The link.
        path: PathBuf,
        /// What it must stay in.
        root: PathBuf,
    },
    /// A `package.xml` that does not parse or says something impossible.
    #[error("{}, line {line}, column {column}: {problem}", .path.display())]
    Manifest {
        /// The file.
        path: PathBuf,
        /// Counted from 1.
        line: u32,
        /// Counted from 1.
        column: u32,
        /// What is wrong.
        problem: String,
    },
    /// Nothing that can be pushed.
    #[error("{} is no ROS package: {looked_for}; give the directory of a package, of a workspace, or of an install space", .path.display())]
    NoPackage {
        /// The directory.
        path: PathBuf,
        /// Where a package was looked for.
        looked_for: String,
    },
    /// A devel space, which only works beside its sources and its build.
    #[error("{} is a devel space, which only works where it was built; push the workspace, or its install space after 'catkin_make install'", .path.display())]
    DevelSpace {
        /// The directory.
        path: PathBuf,
    },
    /// Two packages of one name.
    #[error("two packages are named {name:?}: {} and {}; remove one, or put a file COLCON_IGNORE (or CATKIN_IGNORE) beside it", .first.display(), .second.display())]
    SameName {
        /// The name.
        name: String,
        /// Where it is, below what was pushed.
        first: PathBuf,
        /// The second directory of that name.
        second: PathBuf,
    },
    /// A space that leads back to where it was built.
    #[error("{} was built with --symlink-install: {} leads to the workspace, which is not there; build it without, or push the workspace", .path.display(), .hook.display())]
    SymlinkInstall {
        /// The install space.
        path: PathBuf,
        /// What leads there.
        hook: PathBuf,
    },
    /// Packages of both versions of ROS.
    #[error(
        "packages of both versions of ROS cannot be in one service: {first} (ROS {first_version}), and {second} (ROS {second_version}); push them apart, or put a COLCON_IGNORE file beside the package.xml of one"
    )]
    TwoFlavours {
        /// A package, and what makes it one of its version: `talker has build type catkin`.
        first: String,
        /// 1 or 2.
        first_version: u8,
        /// The other.
        second: String,
        /// 1 or 2.
        second_version: u8,
    },
    /// A build type that nothing here builds.
    #[error(
        "{}: build type {build_type} is built by no base; those that can be built are catkin (ROS 1), ament_cmake and ament_python (ROS 2), and cmake", .path.display()
    )]
    BuildType {
        /// The package.xml.
        path: PathBuf,
        /// What it says.
        build_type: String,
    },
    /// A package of ROS 2 that counts as one of catkin.
    #[error(
        "{}: it is built with {tool}, but says no build type, which means catkin; add <export><build_type>{build_type}</build_type></export>", .path.display()
    )]
    NoBuildType {
        /// The package.xml.
        path: PathBuf,
        /// Such as `ament_cmake` or `rosidl`.
        tool: String,
        /// What it should say.
        build_type: &'static str,
    },
    /// An interface file that cannot be used.
    #[error("{}: {problem}", .path.display())]
    Definition {
        /// The `.msg`, `.srv`, `.action` or `.idl`.
        path: PathBuf,
        /// What is wrong with it, its line where there is one, and what to do.
        problem: String,
    },
    /// Packages that need each other to be built.
    #[error("packages need each other to be built: {}; break the circle in their package.xml", .circle.join(" needs "))]
    Circle {
        /// The first name is also the last.
        circle: Vec<String>,
    },
    /// An interface file that does not parse or says something impossible.
    #[error("{}, line {line}, column {column}: {problem}", .path.display())]
    Interface {
        /// The file.
        path: PathBuf,
        /// Counted from 1.
        line: usize,
        /// Counted from 1.
        column: usize,
        /// What is wrong.
        problem: String,
    },
    /// A supplement that contradicts what was found in the running package.
    #[error(
        "the interface file says that {what} is {stated}, but it was found to be {found}; correct or remove it there"
    )]
    Contradiction {
        /// Such as "input topic /image".
        what: String,
        /// What the file says.
        stated: String,
        /// What was found.
        found: String,
    },
    /// A request is said to be of a topic that there is not.
    #[error("{topic} is no {direction} of this service; {}", listed(.direction, .topics))]
    NoSuchTopic {
        /// The topic.
        topic: String,
        /// `input` or `output`.
        direction: &'static str,
        /// Those that there are.
        topics: Vec<String>,
    },
    /// A request is said to be answered by stamp, and a message has none.
    #[error("{topic} is a {type_name}, which has no header.stamp; write \"by arrival\"")]
    NoStamp {
        /// The topic.
        topic: String,
        /// Its type.
        type_name: String,
    },
    /// A request is said to be the goal of an action.
    #[error(
        "{input} is said to be answered by goal; goals of actions are recognised without being named, so leave it out"
    )]
    GoalIsNoTopic {
        /// The topic.
        input: String,
    },
    /// Two requests are said to have the same topic.
    #[error(
        "{topic} is named twice; name all outputs that answer an input in one request, and each output in one"
    )]
    NamedTwice {
        /// The topic.
        topic: String,
    },
    /// A stub cannot be put together.
    #[error(
        "the image holds no package.xml of {package}, so robots could not install a stub of it; push it with its share directory"
    )]
    NoManifest {
        /// The ROS package.
        package: String,
    },
}

fn listed(direction: &str, topics: &[String]) -> String {
    match topics {
        [] => format!("it has no {direction}s"),
        topics => format!("its {direction}s are {}", topics.join(", ")),
    }
}

impl From<foreign::Error> for Error {
    fn from(error: foreign::Error) -> Self {
        match error {
            foreign::Error::File {
                action,
                path,
                source,
            } => Self::File {
                action,
                path,
                source,
            },
            foreign::Error::TooLarge { path, limit } => Self::TooLarge { path, limit },
            foreign::Error::Outside { path, root } => Self::Outside { path, root },
            foreign::Error::TooDeep { path, limit } => Self::TooMany {
                path,
                what: "directories in each other",
                limit,
            },
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
            foreign::Error::Cancelled(cancelled) => Self::File {
                action: "read",
                path: PathBuf::new(),
                source: cancelled.into(),
            },
        }
    }
}
