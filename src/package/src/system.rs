//! Inspection of a root file system: its distribution, its ROS, and what packages can be built with in it. All is found
//! by looking, since an image of a lab says nothing about itself.
//!
//! ```text
//!   layers ─┬─ os-release (os-release(5))         ─▶ distribution and release
//!           ├─ .catkin, ament index, package.xml  ─▶ install spaces, ROS version and distribution
//!           ├─ var/lib/dpkg/status                ─▶ packages of the distribution
//!           └─ programs and Python modules        ─▶ what is there to compile and to launch with
//! ```

mod dpkg;
mod environment;
mod spaces;
mod view;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use ros::bus::RosVersion;
use ros::ros2::middleware;

use crate::Error;

pub use dpkg::{InstalledPackage, parse_status};
pub use environment::{choose_middleware, make_environment};
pub use spaces::{RosSpace, SpaceLayout};
use view::View;

/// Directories that are replaced by scratch space in a servant, so that files of the image there are not visible.
pub const HIDDEN_DIRECTORIES: [&str; 7] = ["/dev", "/proc", "/root", "/run", "/sys", "/tmp", "/var"];

/// Maximum size of a list of installed packages in bytes.
const LARGEST_STATUS: u64 = 64 << 20;
/// Maximum size of an interpreter in bytes, of which only the header is used.
const LARGEST_PROGRAM: u64 = 256 << 20;
/// Maximum size of a file of settings in bytes.
const LARGEST_TEXT: u64 = 1 << 20;
/// Programs that are looked for.
const PROGRAMS: [&str; 10] =
    ["c++", "clang++", "cmake", "colcon", "g++", "make", "ninja", "ros2", "roslaunch", "catkin_find"];
/// Python modules that are looked for.
const MODULES: [&str; 7] = ["catkin_pkg", "em", "launch_ros", "numpy", "rospkg", "setuptools", "yaml"];

/// Reason why the layers are not a system that packages of ROS can be built upon.
#[derive(Debug, thiserror::Error)]
pub enum SystemError {
    /// The image has no ROS.
    #[error(
        "no ROS was found: looked for install spaces (.catkin, share/ament_index) that the image's environment names, \
            or that are at most {depth} directories deep, such as /opt/ros/jazzy, and for Debian's rospy{also}; \
            import an image with ROS, such as ros:jazzy",
        depth = spaces::DEPTH
    )]
    NoRos {
        /// Spaces that cannot be used, with the reason, or nothing.
        also: String,
    },
    /// The image has several, and nothing says which one counts.
    #[error("it has several ROS distributions ({}); name one with --ros-distro", .0.join(", "))]
    SeveralRos(Vec<String>),
    /// Nothing says which distribution it is.
    #[error("{0} does not say which ROS distribution it is; name it with --ros-distro, such as --ros-distro jazzy")]
    UnknownDistribution(String),
    /// The requested distribution has no name that ROS distributions have.
    #[error("{0:?} is no name of a ROS distribution: they consist of lower-case letters, digits and _, such as jazzy")]
    DistributionName(String),
    /// The requested distribution is not there.
    #[error("it has no ROS {wanted}; found: {}", .found.join(", "))]
    NoSuchRos {
        /// Requested distribution.
        wanted: String,
        /// Names that exist.
        found: Vec<String>,
    },
    /// There is no Python 3.
    #[error(
        "/usr/bin/python3 is missing, with which packages are built and launch files are read; add it to the image"
    )]
    NoPython,
    /// ROS is for Python 2.
    #[error("ROS {0} in it is for Python 2, which is not supported; import an image of ROS noetic or of ROS 2")]
    PythonTwo(String),
    /// Nodes of ROS 2 could use a middleware only that the bus does not speak.
    #[error(
        "of middlewares it has {0} alone, which speaks Zenoh, and Cloudroid speaks DDS only; add \
            rmw_fastrtps_cpp or rmw_cyclonedds_cpp to the image"
    )]
    Middleware(String),
    /// It is for other machines.
    #[error("it is for {its}, but this machine is {ours}; import a system for {ours}")]
    Architecture {
        /// Architecture of its programs, such as `aarch64`.
        its: &'static str,
        /// Architecture of this machine.
        ours: &'static str,
    },
    /// dpkg's list is longer than that of any system.
    #[error("dpkg lists more than {0} packages in it")]
    TooManyPackages(usize),
    /// The layers cannot be read.
    #[error(transparent)]
    Layers(#[from] Error),
}

/// A root file system with ROS.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundSystem {
    /// Distribution, as `ID` in os-release: `ubuntu`.
    pub distribution: String,
    /// Release, as `VERSION_CODENAME` or `VERSION_ID`: `noble`.
    pub suite: String,
    /// Human-readable name of both: `Ubuntu 24.04.1 LTS`.
    pub title: String,
    /// ROS version.
    pub ros: RosVersion,
    /// ROS distribution, such as `jazzy`.
    pub ros_distribution: String,
    /// Install spaces, in the order in which they are searched; empty if ROS is the distribution's own, below `/usr`.
    pub spaces: Vec<RosSpace>,
    /// Spaces that cannot be used, with the reason.
    pub unusable: Vec<(String, &'static str)>,
    /// Version of Python: `3.12`.
    pub python: String,
    /// Packages that dpkg has installed, with their versions; `None` if it has no list.
    pub debian: Option<BTreeMap<String, String>>,
    /// Names of the programs, Python modules and headers that were looked for and are there.
    pub tools: BTreeSet<&'static str>,
}

impl FoundSystem {
    /// Returns the ROS packages of all spaces with their versions; the first space that has a package counts.
    pub fn packages(&self) -> BTreeMap<String, String> {
        let mut all = BTreeMap::new();
        for (name, version) in self.spaces.iter().flat_map(|space| &space.packages) {
            all.entry(name.clone()).or_insert_with(|| version.clone());
        }
        all
    }

    /// Returns the first of these packages that one of its spaces has.
    pub fn first_package<'a>(&self, names: &[&'a str]) -> Option<&'a str> {
        let has = |name: &&&str| self.spaces.iter().any(|space| space.packages.contains_key(**name));
        names.iter().find(has).copied()
    }

    /// Returns whether any of these programs or Python modules is there.
    pub fn has_any(&self, names: &[&str]) -> bool {
        names.iter().any(|name| self.tools.contains(name))
    }
}

/// Finds what a stack of extracted layers is, given lowest first. `environment`: of the image's processes;
/// `distribution`: the ROS distribution that counts, if there are several. Blocking.
///
/// # Errors
/// A [`SystemError`] that says what was looked for, or what cannot be used.
pub fn find_system<L: AsRef<Path>>(
    layers: &[L],
    environment: &BTreeMap<String, String>,
    distribution: Option<&str>,
) -> Result<FoundSystem, SystemError> {
    if let Some(name) = distribution.filter(|name| !spaces::is_distribution(name)) {
        return Err(SystemError::DistributionName(name.chars().take(64).collect()));
    }
    let view = View::open(layers)?;
    let release = read_release(&view)?;
    let field = |name: &str| release.get(name).cloned().filter(|value| !value.is_empty());
    // Words that are compared, and given to programs.
    let word = |name: &str| {
        let kept = |c: &char| c.is_ascii_alphanumeric() || matches!(c, '.' | '_' | '-');
        let text: String = field(name)?.chars().filter(kept).collect();
        Some(text.trim_start_matches('-').to_owned()).filter(|text| !text.is_empty())
    };
    let python = find_python(&view)?.ok_or(SystemError::NoPython)?;
    let found = spaces::find_spaces(&view, environment)?;
    let chosen = spaces::choose_distribution(&view, found, environment, distribution)?;
    if chosen.spaces.iter().any(|space| space.is_for_python_two) {
        return Err(SystemError::PythonTwo(chosen.distribution));
    }
    let status = view.read_text("/var/lib/dpkg/status", LARGEST_STATUS)?;
    let prefixes: Vec<String> = chosen.spaces.iter().flat_map(RosSpace::prefixes).collect();
    let system = FoundSystem {
        distribution: word("ID").unwrap_or_else(|| "linux".to_owned()),
        suite: word("VERSION_CODENAME").or_else(|| word("VERSION_ID")).unwrap_or_else(|| "unknown".to_owned()),
        title: field("PRETTY_NAME").unwrap_or_else(|| "a system without os-release".to_owned()),
        tools: find_tools(&view, &prefixes, &python)?,
        ros: chosen.ros,
        ros_distribution: chosen.distribution,
        spaces: chosen.spaces,
        unusable: chosen.unusable,
        python,
        debian: status.as_deref().map(dpkg::list_installed).transpose()?,
    };
    check_middleware(&system)?;
    Ok(system)
}

/// Refuses a system of ROS 2 that has a middleware over Zenoh, and none that the bus speaks. One without any may get it
/// from the archive.
fn check_middleware(system: &FoundSystem) -> Result<(), SystemError> {
    if system.ros == RosVersion::One || system.first_package(&middleware::SUPPORTED).is_some() {
        return Ok(());
    }
    let mut names = system.spaces.iter().flat_map(|space| space.packages.keys());
    match names.find(|name| middleware::is_zenoh(name)) {
        Some(name) => Err(SystemError::Middleware(name.clone())),
        None => Ok(()),
    }
}

/// Reads os-release, whose values may be quoted as in a shell. Control characters are dropped.
fn read_release(view: &View) -> Result<BTreeMap<String, String>, Error> {
    // The second is a link to the first, or replaces it.
    let text = match view.read_text("/usr/lib/os-release", LARGEST_TEXT)? {
        Some(text) => text,
        None => view.read_text("/etc/os-release", LARGEST_TEXT)?.unwrap_or_default(),
    };
    let pairs = text.lines().filter_map(|line| line.trim().split_once('='));
    let plain = |value: &str| -> String {
        let value = value.trim().trim_matches(['"', '\'']);
        value.chars().filter(|c| !c.is_control() && *c != '\\').take(120).collect()
    };
    Ok(pairs.map(|(name, value)| (name.to_owned(), plain(value))).collect())
}

/// Returns the version of `/usr/bin/python3`; `None` if there is none.
///
/// # Errors
/// [`SystemError::Architecture`] if the interpreter is for other machines.
fn find_python(view: &View) -> Result<Option<String>, SystemError> {
    let mut name = "python3".to_owned();
    // python3 → python3.12, which is a program.
    for _ in 0..4 {
        let path = format!("/usr/bin/{name}");
        if let Some(target) = view.read_link(&path)? {
            let Some(file) = target.file_name().and_then(|file| file.to_str()) else {
                return Ok(None);
            };
            name = file.to_owned();
            continue;
        }
        let Some(program) = view.read(&path, LARGEST_PROGRAM)? else {
            return Ok(None);
        };
        check_machine(&program)?;
        break;
    }
    if is_python_version(&name) {
        return Ok(name.strip_prefix("python").map(str::to_owned));
    }
    // A program of its own, or a link that leads elsewhere: its modules tell the version.
    let libraries = view.names("/usr/lib")?;
    let minors = libraries.iter().filter_map(|name| name.strip_prefix("python3.")?.parse::<u32>().ok());
    Ok(minors.max().map(|minor| format!("3.{minor}")))
}

/// Returns whether a name is that of a minor version of Python 3: `python3.12`.
fn is_python_version(name: &str) -> bool {
    let minor = name.strip_prefix("python3.");
    minor.is_some_and(|minor| !minor.is_empty() && minor.bytes().all(|byte| byte.is_ascii_digit()))
}

/// Checks the machine in the header of an ELF file (System V ABI, `e_machine`).
fn check_machine(program: &[u8]) -> Result<(), SystemError> {
    let ours = std::env::consts::ARCH;
    let its = match (program.get(..4), program.get(18..20)) {
        (Some(b"\x7fELF"), Some([62, 0])) => "x86_64",
        (Some(b"\x7fELF"), Some([183, 0])) => "aarch64",
        (Some(b"\x7fELF"), Some([40, 0])) => "arm",
        (Some(b"\x7fELF"), Some([243, 0])) => "riscv64",
        (Some(b"\x7fELF"), Some(_)) => "another architecture",
        // A script; what it runs shows at the first push.
        _ => return Ok(()),
    };
    if its == ours { Ok(()) } else { Err(SystemError::Architecture { its, ours }) }
}

fn find_tools(view: &View, prefixes: &[String], python: &str) -> Result<BTreeSet<&'static str>, Error> {
    let bins = ["/usr/bin", "/usr/local/bin", "/bin"].map(str::to_owned);
    let bins = prefixes.iter().map(|prefix| format!("{prefix}/bin")).chain(bins);
    let mut names = BTreeSet::new();
    for bin in bins {
        names.extend(view.names(&bin)?);
    }
    let mut found: BTreeSet<&'static str> = PROGRAMS.into_iter().filter(|name| names.contains(*name)).collect();
    let system = [
        "/usr/lib/python3/dist-packages".to_owned(),
        format!("/usr/lib/python{python}/site-packages"),
        format!("/usr/lib64/python{python}/site-packages"),
        format!("/usr/local/lib/python{python}/dist-packages"),
        format!("/usr/local/lib/python{python}/site-packages"),
    ];
    if view.read("/usr/include/ros/ros.h", LARGEST_TEXT)?.is_some() {
        found.insert("ros.h");
    }
    let own = prefixes.iter().flat_map(|prefix| environment::python_directories(view, prefix));
    let mut modules = BTreeSet::new();
    for directory in own.chain(system) {
        modules.extend(view.names(&directory)?);
    }
    let is_there = |name: &&str| modules.contains(*name) || modules.contains(&format!("{name}.py"));
    found.extend(MODULES.into_iter().filter(is_there));
    Ok(found)
}

#[cfg(test)]
mod tests;
