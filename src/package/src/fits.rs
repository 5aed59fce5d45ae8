//! ROS versions that the pushed packages support, according to their package.xml files.
//!
//! Many packages support both, with a package.xml that depends on ROS_VERSION. So each is parsed once for each
//! distribution with a base, and supports those for which it states a build type of that version:
//!
//! | Build type | ROS 1 | ROS 2 |
//! |---|---|---|
//! | `catkin` | yes | no |
//! | `ament_cmake`, `ament_python` | no | yes |
//! | `cmake` | unless it uses ament's build tools | unless it uses catkin |
//!
//! An install space supports the version of the tools that created it.

use std::path::Path;

use ros::bus::RosVersion;

use crate::condition::Variables;
use crate::locate::{Located, LocatedKind, locate};
use crate::manifest::{INTERFACES, Kind, MAX_BYTES, Manifest};
use crate::{Error, read};

/// A ROS distribution, such as `noetic` of ROS 1.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Distribution {
    /// ROS version.
    pub version: RosVersion,
    /// Name of the distribution, as in `$ROS_DISTRO`.
    pub name: String,
}

/// ROS versions supported by what was pushed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RosSupport {
    /// Both versions.
    Either,
    /// One version only.
    Only {
        /// Supported version.
        version: RosVersion,
        /// Package that determines it.
        package: String,
        /// Reason, as a phrase that follows "it": `has build type catkin`.
        because: String,
    },
}

impl RosSupport {
    /// Returns whether a base of this version is supported.
    pub fn supports(&self, version: RosVersion) -> bool {
        match self {
            RosSupport::Either => true,
            RosSupport::Only { version: only, .. } => *only == version,
        }
    }
}

/// Detects the ROS versions supported by a directory that [`crate::workspace::inspect`] accepts.
///
/// # Errors
/// As there; [`Error::TwoFlavours`] if two packages have no version in common, [`Error::BuildType`] for a package that
/// none of the distributions can build, [`Error::NoBuildType`] for one that lacks its build type.
pub fn detect(root: &Path, distributions: &[Distribution]) -> Result<RosSupport, Error> {
    let located = locate(root)?;
    if let LocatedKind::Space(space) = &located.what {
        let first = space.packages.first().and_then(|path| path.file_name());
        return Ok(RosSupport::Only {
            version: space.layout.version(),
            package: first.unwrap_or_default().to_string_lossy().into_owned(),
            because: match space.layout.version() {
                RosVersion::One => "was installed by catkin".to_owned(),
                RosVersion::Two => "is in ament's index".to_owned(),
            },
        });
    }
    let mut all = RosSupport::Either;
    for path in located.packages() {
        let one = detect_package(&located, path, distributions)?;
        all = intersect(all, one)?;
    }
    Ok(all)
}

/// Returns the versions supported by both.
fn intersect(earlier: RosSupport, later: RosSupport) -> Result<RosSupport, Error> {
    match (earlier, later) {
        (RosSupport::Either, later) => Ok(later),
        (earlier, RosSupport::Either) => Ok(earlier),
        (
            RosSupport::Only { version: first, package: first_package, because: first_because },
            RosSupport::Only { version: second, package: second_package, because: second_because },
        ) => {
            if first == second {
                Ok(RosSupport::Only { version: first, package: first_package, because: first_because })
            } else {
                Err(Error::TwoFlavours {
                    first: format!("{first_package} {first_because}"),
                    first_version: first.number(),
                    second: format!("{second_package} {second_because}"),
                    second_version: second.number(),
                })
            }
        }
    }
}

fn detect_package(located: &Located, path: &Path, distributions: &[Distribution]) -> Result<RosSupport, Error> {
    let file = located.base().join(path).join("package.xml");
    let text = read::read_text(&located.root, &file, MAX_BYTES)?;
    let mut fitting: Vec<(RosVersion, Manifest)> = Vec::new();
    let mut last = None;
    for distribution in distributions {
        let version = distribution.version;
        let variables = Variables::for_distribution(version.number(), &distribution.name);
        let manifest = Manifest::parse(&text, &file, &variables)?;
        if manifest.supports_ros(version) && fitting.iter().all(|(of, _)| *of != version) {
            fitting.push((version, manifest.clone()));
        }
        last = Some(manifest);
    }
    match &fitting[..] {
        [] => Err(unsupported_error(&file, last)),
        [(version, manifest)] => {
            Ok(RosSupport::Only { version: *version, because: reason(manifest), package: manifest.name.clone() })
        }
        _ => Ok(RosSupport::Either),
    }
}

fn reason(manifest: &Manifest) -> String {
    match (&*manifest.build_type, manifest.ament_tool()) {
        ("cmake", Some(tool)) => format!("is built with {tool}"),
        ("cmake", None) if manifest.uses_catkin() => "is built with catkin".to_owned(),
        (build_type, _) => format!("has build type {build_type}"),
    }
}

/// Returns the error for a package that no distribution can build.
fn unsupported_error(file: &Path, manifest: Option<Manifest>) -> Error {
    let Some(manifest) = manifest else {
        return Error::BuildType { path: file.to_owned(), build_type: "unknown".to_owned() };
    };
    match manifest.ament_tool() {
        Some(tool) if manifest.build_type == "catkin" => Error::NoBuildType {
            path: file.to_owned(),
            build_type: if manifest.needs(&[Kind::Buildtool]).contains("ament_python") {
                "ament_python"
            } else {
                "ament_cmake"
            },
            tool,
        },
        _ => Error::BuildType { path: file.to_owned(), build_type: manifest.build_type },
    }
}

impl Manifest {
    /// Returns whether a ROS version can build the package; the manifest must have been parsed for that version.
    pub fn supports_ros(&self, version: RosVersion) -> bool {
        match (&*self.build_type, version) {
            // The default build type is catkin (REP 149); packages often omit it by mistake.
            ("catkin", RosVersion::One) => self.uses_catkin() || self.ament_tool().is_none(),
            ("ament_cmake" | "ament_python", RosVersion::Two) => true,
            ("cmake", RosVersion::One) => self.ament_tool().is_none(),
            ("cmake", RosVersion::Two) => !self.uses_catkin(),
            _ => false,
        }
    }

    fn uses_catkin(&self) -> bool {
        self.needs(&[Kind::Buildtool]).contains("catkin")
    }

    /// Returns a ROS 2 build tool that the package uses.
    fn ament_tool(&self) -> Option<String> {
        if self.groups.contains(INTERFACES) {
            return Some("rosidl".to_owned());
        }
        let tools = self.needs(&[Kind::Buildtool]);
        let tool = tools.into_iter().find(|tool| tool.starts_with("ament_") || tool.starts_with("rosidl_"));
        tool.map(str::to_owned)
    }
}

#[cfg(test)]
mod tests;
