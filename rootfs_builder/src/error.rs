//! What can go wrong while a push becomes an image.

use std::io;
use std::path::PathBuf;

/// Every way a build can fail. The text names the thing and what to do about it.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// No definition of that name.
    #[error("there is no base {name:?} in {directory}; there are: {known}", directory = directory.display())]
    UnknownBase {
        /// What was asked for.
        name: String,
        /// Where definitions are.
        directory: PathBuf,
        /// Names that exist.
        known: String,
    },
    /// A base definition that cannot be used.
    #[error("base definition {path}: {problem}", path = path.display())]
    BadBase {
        /// The file.
        path: PathBuf,
        /// What is wrong in it, with its line where that is known.
        problem: String,
    },
    /// A program of the host is missing.
    #[error("{program} is not installed: run `apt-get install {package}`")]
    MissingProgram {
        /// The command.
        program: &'static str,
        /// The Debian package that has it.
        package: &'static str,
    },
    /// A program of the host failed.
    #[error("{program} failed ({status}): {last_lines}")]
    Program {
        /// The command.
        program: String,
        /// How it ended.
        status: String,
        /// The last lines it printed.
        last_lines: String,
    },
    /// `--apt` names something that is no ROS package.
    #[error("the Debian package {name} holds no ROS package; `--with {name}` adds it to one")]
    NotRos {
        /// What was asked for.
        name: String,
    },
    /// apt knows no way to install these packages together.
    #[error("apt cannot install {wanted}: {words}")]
    Unsolvable {
        /// What was to be installed.
        wanted: String,
        /// apt's own words.
        words: String,
    },
    /// Lists of packages that could not be had, or are not believed.
    #[error("package lists could not be fetched: {words}; {next}")]
    Lists {
        /// apt's own words.
        words: String,
        /// What to do.
        next: &'static str,
    },
    /// Packages that the mirror would not give.
    #[error(
        "packages could not be downloaded: {words}; push again: the package lists will be fetched anew first"
    )]
    Download {
        /// apt's own words.
        words: String,
    },
    /// Python packages of a base that could not be had.
    #[error(
        "Python packages could not be downloaded: {words}; they are fetched by this host's pip, from where that is configured to"
    )]
    Wheels {
        /// pip's own words.
        words: String,
    },
    /// The archive is not the one that a base is made of.
    #[error(
        "the package archive has not what base {base} is made of: {missing}; its sources.list can be configured ([archives])"
    )]
    BaseLacks {
        /// The base.
        base: String,
        /// Debian packages that are not there.
        missing: String,
    },
    /// Names that nothing provides.
    #[error("{}", unresolved_text(.0))]
    Unresolved(Vec<Unresolved>),
    /// `--apt` names something that is not there.
    #[error(
        "{name} is neither a ROS package nor a Debian package of {suite}{hint}; look for it with `apt-cache search {name}`"
    )]
    UnknownPackage {
        /// What was asked for.
        name: String,
        /// Of which distribution.
        suite: String,
        /// Names that look alike, or nothing.
        hint: String,
    },
    /// The archive has no index of files.
    #[error(
        "the package archive has no Contents index, by which ROS packages are found; use a mirror that has one. Asked: {}",
        sources.trim().replace('\n', "; ")
    )]
    NoContents {
        /// Lines of the sources.list.
        sources: String,
    },
    /// The package's build failed.
    #[error("the build of {package} failed; the complete log is {log}\n{last_lines}{advice}", log = log.display(),
        advice = advice.iter().map(|line| format!("\n{line}")).collect::<String>())]
    BuildFailed {
        /// The ROS package that failed.
        package: String,
        /// The complete log.
        log: PathBuf,
        /// Its last lines, the compiler's own words among them.
        last_lines: String,
        /// What is missing, and the options that add it.
        advice: Vec<String>,
    },
    /// dpkg failed inside the sandbox.
    #[error("installing packages failed: {first_error}")]
    InstallFailed {
        /// dpkg's first error and what led to it; its last lines where it named none.
        first_error: String,
    },
    /// Something of ours that runs inside a container failed.
    #[error("{what} failed: {last_lines}")]
    Inside {
        /// The step that failed.
        what: &'static str,
        /// The last lines it printed.
        last_lines: String,
    },
    /// The launch plan is not one that the launch script writes; the package's code may have replaced it.
    #[error("the launch plan that the container wrote is not valid: {problem}")]
    BadPlan {
        /// What is wrong with it.
        problem: String,
    },
    /// The image's own launch program refused the launch file.
    #[error("{program} cannot load {file}: {words}")]
    Launch {
        /// `roslaunch` or `ros2 launch`.
        program: &'static str,
        /// The launch file.
        file: String,
        /// Its own words.
        words: String,
    },
    /// No such launch file or executable in the image.
    #[error("there is no {what} {name:?} in the package; there are: {known}{elsewhere}")]
    NotInPackage {
        /// `launch file` or `executable`.
        what: &'static str,
        /// What was asked for.
        name: String,
        /// Names that exist.
        known: String,
        /// Where it is instead, with the option that adds it.
        elsewhere: String,
    },
    /// Nothing says what to run.
    #[error(
        "say what to run, with --node or --launch; executables: {executables}; launch files: {launch_files}{more}"
    )]
    NothingToRun {
        /// Executables of the package.
        executables: String,
        /// Launch files of the package.
        launch_files: String,
        /// What is to be said of these lists.
        more: &'static str,
    },
    /// A package of the other ROS than the base's.
    #[error(
        "{package} {because}, which is ROS {version}, but base {base} is of ROS {base_version}; push it with {fitting}"
    )]
    WrongRos {
        /// The package.
        package: String,
        /// Why it is of its ROS: `has build type catkin`.
        because: String,
        /// Its ROS: 1 or 2.
        version: u8,
        /// The base that was asked for.
        base: String,
        /// The base's ROS.
        base_version: u8,
        /// Options that name bases which fit.
        fitting: String,
    },
    /// No base of a package's ROS.
    #[error(
        "{package} {because}, and this server has no base of ROS {version}; add a definition of one to the directory of base definitions"
    )]
    NoBase {
        /// The package.
        package: String,
        /// Why it is of its ROS.
        because: String,
        /// 1 or 2.
        version: u8,
    },
    /// `--apt` on a base that knows no archive of ROS packages.
    #[error(
        "base {base} has no archive with a package {name} of ROS 2 {distribution}; push its source, or take a base with that archive (--base)"
    )]
    NotInRosArchive {
        /// What was asked for.
        name: String,
        /// The base.
        base: String,
        /// Of which ROS.
        distribution: String,
    },
    /// A launch file of ROS 2 in an image that cannot read any.
    #[error(
        "the image has no Python package {module}, without which launch files of ROS 2 cannot be read: name the nodes with --node, or {}",
        with.as_ref().map_or_else(|| format!("push a workspace that also holds {module}"), |deb| format!("push with --with {deb}"))
    )]
    NoLaunch {
        /// `launch` or `launch_ros`, or what they need themselves.
        module: String,
        /// The Debian package that has it.
        with: Option<String>,
    },
    /// A class of a node is named, and nothing in the image could load it.
    #[error(
        "{plugin} is loaded into a component container, and the image has none: push with --with rclcpp_components"
    )]
    NoContainer {
        /// The class.
        plugin: String,
    },
    /// What a component is given cannot be given to it.
    #[error("{words}")]
    BadComponent {
        /// What, and what can.
        words: String,
    },
    /// Nodes are to be loaded, and nobody knows how to ask for that.
    #[error(
        "nodes are loaded into {container} by {what}, which the image does not define: push with --with composition_interfaces, or start programs of their own with --node"
    )]
    NoComposition {
        /// The container's name.
        container: String,
        /// The type of a service.
        what: String,
    },
    /// An install space that was made for another Python.
    #[error(
        "the install space was made for {made_for}, and the base has {there}: push the workspace, or build it on the base's own distribution"
    )]
    OtherPython {
        /// Such as `python3.12`.
        made_for: String,
        /// Such as `python3.11`.
        there: String,
    },
    /// A package this base cannot compile.
    #[error(
        "package {package} has build type {build_type}, which base {base} cannot build: it builds {builds}"
    )]
    BuildType {
        /// The package.
        package: String,
        /// What its package.xml says.
        build_type: String,
        /// The base.
        base: String,
        /// The build types that it builds.
        builds: &'static str,
    },
    /// The running package does not show what it should.
    #[error("{0}")]
    Probe(#[from] crate::probe::ProbeError),
    /// The pushed tree is not what it should be.
    #[error(transparent)]
    Package(#[from] package::Error),
    /// An install space that cannot be where it was built for.
    #[error(
        "the install space was built for {prefix}, where a servant has scratch space: build it with another prefix, \
         such as -DCMAKE_INSTALL_PREFIX=/opt/{package}", prefix = prefix.display()
    )]
    Prefix {
        /// Where it wants to be.
        prefix: PathBuf,
        /// One of its packages.
        package: String,
    },
    /// The image store.
    #[error(transparent)]
    Image(#[from] image::Error),
    /// The container engine.
    #[error(transparent)]
    Servant(#[from] servant::Error),
    /// No space left.
    #[error("no space left on the disk that holds {path} while {what}; free some (`cloudroidctl rm` removes services) and push again", path = path.display())]
    DiskFull {
        /// A path on the full disk.
        path: PathBuf,
        /// What was being done.
        what: String,
    },
    /// Some other input or output.
    #[error("{what} {path}: {source}", path = path.display())]
    Io {
        /// What was being done.
        what: String,
        /// With which file.
        path: PathBuf,
        /// Why it failed.
        source: io::Error,
    },
    /// What a sandbox left, or what was pushed, is not what is read.
    #[error(transparent)]
    Foreign(foreign::Error),
    /// A thread of this process panicked.
    #[error("an internal task ended early: {0}")]
    Task(#[from] tokio::task::JoinError),
}

/// A name that nothing provides.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Unresolved {
    /// The rosdep key or ROS package.
    pub key: String,
    /// Packages whose package.xml ask for it.
    pub wanted_by: Vec<String>,
    /// Debian packages whose names look alike.
    pub similar: Vec<String>,
}

fn unresolved_text(all: &[Unresolved]) -> String {
    let mut text = String::from("nothing provides:");
    for one in all {
        text.push_str(&format!(
            "\n  {} (wanted by {})",
            one.key,
            one.wanted_by.join(", ")
        ));
        if !one.similar.is_empty() {
            text.push_str(&format!("; perhaps {}", one.similar.join(", ")));
        }
    }
    text.push_str("\nname the Debian package of each with `--map KEY=DEB`, or push a workspace that also holds its source");
    text
}

impl Error {
    /// An input/output error, told apart from a full disk.
    pub fn io(what: impl Into<String>, path: impl Into<PathBuf>, source: io::Error) -> Self {
        let (what, path) = (what.into(), path.into());
        if source.kind() == io::ErrorKind::StorageFull
            || source.raw_os_error() == Some(nix::libc::ENOSPC)
        {
            Self::DiskFull { path, what }
        } else {
            Self::Io { what, path, source }
        }
    }
}

impl From<foreign::Error> for Error {
    fn from(error: foreign::Error) -> Self {
        match error {
            foreign::Error::File {
                action,
                path,
                source,
            } => Self::io(format!("cannot {action}"), path, source),
            other => Self::Foreign(other),
        }
    }
}

/// `map_err` for input and output: `.at("reading", path)`.
pub(crate) trait IoAt<T> {
    /// Names what was being done with which file.
    fn at(self, what: &str, path: impl Into<PathBuf>) -> Result<T, Error>;
}

impl<T> IoAt<T> for io::Result<T> {
    fn at(self, what: &str, path: impl Into<PathBuf>) -> Result<T, Error> {
        self.map_err(|source| Error::io(what, path, source))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_that_is_missing_is_named_with_the_next_step() {
        let error = Error::Unresolved(vec![
            Unresolved {
                key: "warp".into(),
                wanted_by: vec!["a".into(), "b".into()],
                similar: vec![],
            },
            Unresolved {
                key: "eigne".into(),
                wanted_by: vec!["a".into()],
                similar: vec!["libeigen3-dev".into()],
            },
        ]);
        let text = error.to_string();
        assert!(text.contains("warp (wanted by a, b)\n"), "{text}");
        assert!(
            text.contains("eigne (wanted by a); perhaps libeigen3-dev"),
            "{text}"
        );
        assert!(text.contains("--map KEY=DEB"), "{text}");
    }

    #[test]
    fn a_full_disk_is_told_apart() {
        let error = std::fs::write("/dev/full", "x")
            .at("writing", "/dev/full")
            .expect_err("full");
        assert!(matches!(error, Error::DiskFull { .. }), "{error}");
        assert!(
            error.to_string().contains("the disk that holds /dev/full"),
            "{error}"
        );
        let error = std::fs::write("/nonexistent/x", "x")
            .at("writing", "/nonexistent/x")
            .expect_err("absent");
        assert!(matches!(error, Error::Io { .. }), "{error}");
    }
}
