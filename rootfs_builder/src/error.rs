//! Errors of building an image.

use std::io;
use std::path::PathBuf;

use crate::base_file_error::{BaseFileError, RequirementsError};

/// Errors of a build. The message names the object and the next step.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The base does not exist.
    #[error("no base {name:?} in {directory}; available: {known}", directory = directory.display())]
    UnknownBase {
        /// Name that was requested.
        name: String,
        /// Directory of the definitions.
        directory: PathBuf,
        /// Names of existing bases.
        known: String,
    },
    /// Invalid base definition.
    #[error("base definition {path}: {problem}", path = path.display())]
    BadBase {
        /// File.
        path: PathBuf,
        /// Description of the problem, with its line if known.
        problem: BaseFileError,
    },
    /// Invalid requirements of a base's wheels.
    #[error("base definition {path}: {problem}", path = path.display())]
    BadRequirements {
        /// File.
        path: PathBuf,
        /// Description of the problem, with its line.
        problem: RequirementsError,
    },
    /// A program is not installed on the host.
    #[error("{program} is not installed: run `apt-get install {package}`")]
    MissingProgram {
        /// Command.
        program: &'static str,
        /// Debian package that contains it.
        package: &'static str,
    },
    /// A program of the host failed.
    #[error("{program} failed ({status}): {last_lines}")]
    Program {
        /// Command.
        program: String,
        /// Exit status.
        status: String,
        /// Last lines of its output.
        last_lines: String,
    },
    /// `--apt` names a Debian package without ROS packages.
    #[error("the Debian package {name} contains no ROS package; `--with {name}` adds it to one")]
    NotRos {
        /// Name that was requested.
        name: String,
    },
    /// apt cannot install these packages together.
    #[error("apt cannot install {wanted}: {words}")]
    Unsolvable {
        /// Packages to install.
        wanted: String,
        /// Message of apt.
        words: String,
    },
    /// Package lists could not be fetched or verified.
    #[error("package lists could not be fetched: {words}; {next}")]
    Lists {
        /// Message of apt.
        words: String,
        /// Next step.
        next: &'static str,
    },
    /// Packages could not be downloaded.
    #[error("packages could not be downloaded: {words}; push again: the package lists are then fetched again first")]
    Download {
        /// Message of apt.
        words: String,
    },
    /// Python packages of a base could not be downloaded.
    #[error(
        "Python packages could not be downloaded: {words}; check the configuration of this host's pip, which fetches \
            them"
    )]
    Wheels {
        /// Message of pip.
        words: String,
    },
    /// The archive lacks packages of the base.
    #[error(
        "the package archive lacks packages of base {base}: {missing}; its sources.list can be configured ([archives])"
    )]
    BaseLacks {
        /// Name of the base.
        base: String,
        /// Missing Debian packages.
        missing: String,
    },
    /// The base has not been set up, so there is nothing to export.
    #[error("base {base} was not set up on this server yet; the first push that uses it does that, then export again")]
    BaseNotSetUp {
        /// Name of the base.
        base: String,
    },
    /// The base was not imported.
    #[error("base {base} was not imported; there is nothing to remove")]
    BaseNotImported {
        /// Name of the base.
        base: String,
    },
    /// The name of a new base cannot be used.
    #[error(
        "{name:?} is no name of a base: use letters, digits, '-', '_' and '.', at most 64, the first a letter or digit"
    )]
    BaseName {
        /// Name that was given.
        name: String,
    },
    /// The name of a new base is taken.
    #[error("there is a base {name} already; {next}")]
    BaseExists {
        /// Name that was given.
        name: String,
        /// Next step.
        next: &'static str,
    },
    /// The definition of a new base cannot be written.
    #[error("the definition of base {base} cannot be written as TOML: {error}")]
    BaseText {
        /// Name of the base.
        base: String,
        /// Error of the serializer.
        error: toml::ser::Error,
    },
    /// No base can be made from an image.
    #[error(transparent)]
    System(#[from] package::system::SystemError),
    /// Layers of a base that was made from an image are missing.
    #[error("layer {layer} of base {base} is missing in the image store; import its image again, with --replace")]
    ImageGone {
        /// Name of the base.
        base: String,
        /// Diff-id of the layer.
        layer: String,
    },
    /// No packages can be added to a base.
    #[error("it has no dpkg")]
    NoDpkg,
    /// A base that was made from an image cannot compile, and what it lacks cannot be installed.
    #[error(
        "base {base} cannot compile sources: its image lacks {missing}, which cannot be installed ({words}); push an \
            install space, name an archive ([archives] {base} = …), or import an image that has them"
    )]
    NoTools {
        /// Name of the base.
        base: String,
        /// Name of the missing part.
        missing: String,
        /// Reason why it cannot be installed.
        words: String,
    },
    /// A file to import is not an exported base.
    #[error("the file is not an exported base: {problem}; create one with `cloudroidctl base export`")]
    NotABase {
        /// Description of the problem.
        problem: String,
    },
    /// A base was exported from another definition.
    #[error(
        "the file was made from another definition of base {base} than this server has; export it from a server of the \
            same version, with the same `definitions`"
    )]
    OtherDefinition {
        /// Name of the base.
        base: String,
    },
    /// Dependencies that nothing provides.
    #[error("{}", unresolved_text(.0))]
    Unresolved(Vec<Unresolved>),
    /// `--apt` names an unknown package.
    #[error(
        "{name} is neither a ROS package nor a Debian package of {suite}; look for it with \
         `apt-cache search {name}`{hint}"
    )]
    UnknownPackage {
        /// Name that was requested.
        name: String,
        /// Release of the distribution.
        suite: String,
        /// Hint with similar names; may be empty.
        hint: String,
    },
    /// The archive has no Contents index.
    #[error(
        "the package archive has no Contents index, which is needed to find ROS packages; use a mirror that has one. \
            Tried: {}",
        sources.trim().replace('\n', "; ")
    )]
    NoContents {
        /// Lines of the sources.list.
        sources: String,
    },
    /// The build of a package failed.
    #[error("the build of {package} failed; the complete log is {log}\n{last_lines}{advice}", log = log.display(),
        advice = advice.iter().map(|line| format!("\n{line}")).collect::<String>())]
    BuildFailed {
        /// ROS package that failed.
        package: String,
        /// Path of the complete log.
        log: PathBuf,
        /// Last lines of the log, including the compiler's errors.
        last_lines: String,
        /// Missing dependencies, with the options that add them.
        advice: Vec<String>,
    },
    /// dpkg failed in the sandbox.
    #[error("installing packages failed: {first_error}")]
    InstallFailed {
        /// First error of dpkg with its context, or its last lines if there is none.
        first_error: String,
    },
    /// A helper script failed in a container.
    #[error("{what} failed: {last_lines}")]
    Inside {
        /// Step that failed.
        what: &'static str,
        /// Last lines of its output.
        last_lines: String,
    },
    /// The launch plan was not written by the launch script; the package's code may have replaced it.
    #[error("the container's launch plan is invalid: {problem}")]
    BadPlan {
        /// Description of the problem.
        problem: String,
    },
    /// The image's own launch program rejected the launch file.
    #[error("{program} cannot load {file}: {words}")]
    Launch {
        /// Program: `roslaunch` or `ros2 launch`.
        program: &'static str,
        /// Launch file.
        file: String,
        /// Message of the program.
        words: String,
    },
    /// The launch file or executable does not exist in the image.
    #[error("no {what} {name:?} in the package; available: {known}{elsewhere}")]
    NotInPackage {
        /// `launch file` or `executable`.
        what: &'static str,
        /// Name that was requested.
        name: String,
        /// Existing names.
        known: String,
        /// Place where it exists instead, with the option that adds it.
        elsewhere: String,
    },
    /// The push does not state what to run.
    #[error(
        "choose what to run with --node or --launch; executables: {executables}; launch files: {launch_files}{more}"
    )]
    NothingToRun {
        /// Executables of the package.
        executables: String,
        /// Launch files of the package.
        launch_files: String,
        /// Note about these lists.
        more: &'static str,
    },
    /// Because of mistakes in build files, no program would be there to run.
    #[error("there is nothing to run: {problems}")]
    NoPrograms {
        /// Descriptions of the mistakes, with their remedies.
        problems: String,
    },
    /// Options about compiling were given for what is not compiled.
    #[error(
        "--packages-up-to, --packages-skip, --cmake-args, --on and --as-underlay are for sources, and nothing is \
            compiled here; leave them out"
    )]
    NothingToCompile,
    /// An underlay is on another base than the push.
    #[error("underlay {underlay} is built on base {base}, and this push on {wanted}; push it with --base {base}")]
    UnderlayBase {
        /// Name of the underlay.
        underlay: String,
        /// Base of the underlay.
        base: String,
        /// Base of the push.
        wanted: String,
    },
    /// The image that the base was made from has been replaced since the underlay was compiled.
    #[error("underlay {underlay} was compiled on another image of base {base}; push the underlay again")]
    UnderlayImage {
        /// Name of the underlay.
        underlay: String,
        /// Base of the underlay.
        base: String,
    },
    /// A package is in two underlays.
    #[error(
        "package {package} is in underlay {first} and, differently, in {second}; stand on one of them, or push \
            {second} again --on {first} and without {package}"
    )]
    UnderlayConflict {
        /// Name of the package.
        package: String,
        /// Underlay that has it.
        first: String,
        /// Other underlay that has it.
        second: String,
    },
    /// A package of the push is in an underlay.
    #[error(
        "package {package} is also in underlay {underlay}; leave it out with --packages-skip {package}, or push the \
            underlay with this version of it"
    )]
    InUnderlay {
        /// Name of the package.
        package: String,
        /// Underlay that has it.
        underlay: String,
    },
    /// The package does not support the base's ROS version.
    #[error(
        "{package} {because}, which is ROS {version}, but base {base} is of ROS {base_version}; push it with {fitting}"
    )]
    WrongRos {
        /// Name of the package.
        package: String,
        /// Reason for its ROS version: `has build type catkin`.
        because: String,
        /// ROS version of the package: 1 or 2.
        version: u8,
        /// Base that was requested.
        base: String,
        /// ROS version of the base.
        base_version: u8,
        /// Options with suitable bases.
        fitting: String,
    },
    /// There is no base of the package's ROS version.
    #[error(
        "{package} {because}, and this server has no base of ROS {version}; add a definition of one to the directory \
         of base definitions"
    )]
    NoBase {
        /// Name of the package.
        package: String,
        /// Reason for its ROS version.
        because: String,
        /// ROS version: 1 or 2.
        version: u8,
    },
    /// `--apt` on a base without an archive of ROS packages.
    #[error(
        "base {base} has no archive with a package {name} of ROS 2 {distribution}; push its source, or choose a base \
            with that archive (--base)"
    )]
    NotInRosArchive {
        /// Name that was requested.
        name: String,
        /// Name of the base.
        base: String,
        /// ROS distribution.
        distribution: String,
    },
    /// The image cannot read ROS 2 launch files.
    #[error(
        "the image has no Python package {module}, without which launch files of ROS 2 cannot be read: name the nodes \
         with --node, or {}",
        with.as_ref().map_or_else(|| format!("push a workspace that also contains {module}"), |deb| format!("push with \
            --with {deb}"))
    )]
    NoLaunch {
        /// Missing module: `launch`, `launch_ros`, or a dependency of these.
        module: String,
        /// Debian package that contains it.
        with: Option<String>,
    },
    /// A component class was requested, but the image has no container to load it.
    #[error(
        "{plugin} is loaded into a component container, and the image has none: push with --with rclcpp_components"
    )]
    NoContainer {
        /// Class.
        plugin: String,
    },
    /// A component was given something that components do not support.
    #[error("{words}")]
    BadComponent {
        /// Description, with what is supported.
        words: String,
    },
    /// Components must be loaded, but the image lacks the definitions of the services for it.
    #[error(
        "nodes are loaded into {container} with {what}, which the image does not define: push with --with \
            composition_interfaces, or start separate programs with --node"
    )]
    NoComposition {
        /// Name of the container.
        container: String,
        /// Type of the missing service.
        what: String,
    },
    /// The install space was built for another Python version.
    #[error(
        "the install space was built for {made_for}, but the base has {there}: push the workspace, or build it on the \
            base's distribution"
    )]
    OtherPython {
        /// Python of the install space, such as `python3.12`.
        made_for: String,
        /// Python of the base, such as `python3.11`.
        there: String,
    },
    /// The base cannot build a package of this build type.
    #[error("package {package} has build type {build_type}, which base {base} cannot build: it builds {builds}")]
    BuildType {
        /// Name of the package.
        package: String,
        /// Build type in its package.xml.
        build_type: String,
        /// Name of the base.
        base: String,
        /// Build types supported by the base.
        builds: &'static str,
    },
    /// Robots would not reach the nodes, because of their middleware.
    #[error(transparent)]
    Middleware(#[from] crate::middleware::MiddlewareError),
    /// The interface of the running package could not be probed.
    #[error("{0}")]
    Probe(#[from] crate::probe::ProbeError),
    /// The pushed tree is invalid.
    #[error(transparent)]
    Package(#[from] package::Error),
    /// The install space cannot be placed at its prefix.
    #[error(
        "the install space was built for {prefix}, where a servant has scratch space: build it with another prefix, \
         such as -DCMAKE_INSTALL_PREFIX=/opt/{package}", prefix = prefix.display()
    )]
    Prefix {
        /// Prefix for which it was built.
        prefix: PathBuf,
        /// Name of one of its packages.
        package: String,
    },
    /// Error of the image store.
    #[error(transparent)]
    Image(#[from] image::Error),
    /// Error of the container engine.
    #[error(transparent)]
    Servant(#[from] servant::Error),
    /// The disk is full.
    #[error("no space left on the disk of {path} while {what}; free some space (`cloudroidctl rm` removes services) \
        and push again", path = path.display())]
    DiskFull {
        /// Path on the full disk.
        path: PathBuf,
        /// Operation that failed.
        what: String,
    },
    /// Other I/O error.
    #[error("{what} {path}: {source}", path = path.display())]
    Io {
        /// Operation that failed.
        what: String,
        /// File.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// Files of a sandbox or a push could not be read as expected.
    #[error(transparent)]
    Foreign(foreign::Error),
    /// The thread that packs a layer has ended without a result.
    #[error("a layer was not packed; push again")]
    NotPacked,
    /// A task of this process panicked.
    #[error("an internal task ended early: {0}")]
    Task(#[from] tokio::task::JoinError),
}

/// A dependency that nothing provides.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Unresolved {
    /// rosdep key or ROS package.
    pub key: String,
    /// Packages whose package.xml depends on it.
    pub wanted_by: Vec<String>,
    /// Keys and packages with similar names.
    pub similar: Vec<String>,
}

fn unresolved_text(all: &[Unresolved]) -> String {
    let mut text = String::from("nothing provides:");
    for one in all {
        text.push_str(&format!("\n  {} (wanted by {})", one.key, one.wanted_by.join(", ")));
        if !one.similar.is_empty() {
            text.push_str(&format!("; did you mean {}?", one.similar.join(", ")));
        }
    }
    text.push_str(
        "\nname the Debian package of each with `--map KEY=DEB`, or push a workspace that also contains its source; \
            with `--map KEY=` a key needs no package",
    );
    text
}

impl Error {
    /// Creates an I/O error, or the error of a full disk.
    pub fn io(what: impl Into<String>, path: impl Into<PathBuf>, source: io::Error) -> Self {
        let (what, path) = (what.into(), path.into());
        if source.kind() == io::ErrorKind::StorageFull || source.raw_os_error() == Some(nix::libc::ENOSPC) {
            Self::DiskFull { path, what }
        } else {
            Self::Io { what, path, source }
        }
    }
}

impl From<foreign::Error> for Error {
    fn from(error: foreign::Error) -> Self {
        match error {
            foreign::Error::File { action, path, source } => Self::io(format!("cannot {action}"), path, source),
            other => Self::Foreign(other),
        }
    }
}

/// Context for I/O results: `.io_context("reading", path)`.
pub(crate) trait IoContext<T> {
    /// Adds the operation and the file to the error.
    fn io_context(self, what: &str, path: impl Into<PathBuf>) -> Result<T, Error>;
}

impl<T> IoContext<T> for io::Result<T> {
    fn io_context(self, what: &str, path: impl Into<PathBuf>) -> Result<T, Error> {
        self.map_err(|source| Error::io(what, path, source))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn new_unresolved(key: &str) -> Unresolved {
        Unresolved { key: key.to_owned(), wanted_by: vec!["a".into()], similar: Vec::new() }
    }

    #[test]
    fn all_that_is_missing_is_named_with_the_next_step() {
        let error = Error::Unresolved(vec![
            Unresolved { wanted_by: vec!["a".into(), "b".into()], ..new_unresolved("warp") },
            Unresolved { similar: vec!["libeigen3-dev".into()], ..new_unresolved("eigne") },
        ]);
        let text = error.to_string();
        assert!(text.contains("warp (wanted by a, b)\n"), "{text}");
        assert!(text.contains("eigne (wanted by a); did you mean libeigen3-dev?"), "{text}");
        assert!(text.contains("--map KEY=DEB"), "{text}");
    }

    #[test]
    fn a_full_disk_is_told_apart() {
        let error = std::fs::write("/dev/full", "x").io_context("writing", "/dev/full").expect_err("full");
        assert!(matches!(error, Error::DiskFull { .. }), "{error}");
        assert!(error.to_string().contains("the disk of /dev/full"), "{error}");
        let error = std::fs::write("/nonexistent/x", "x").io_context("writing", "/nonexistent/x").expect_err("absent");
        assert!(matches!(error, Error::Io { .. }), "{error}");
    }
}
