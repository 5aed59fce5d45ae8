//! Which versions of ROS what was pushed is written for, as its package.xml files say.
//!
//! Many packages are written for both: what their package.xml says depends on ROS_VERSION. So each is read once for
//! each distribution that there is a base of, and fits those for which it names a build type that they build:
//!
//! | build type | ROS 1 | ROS 2 |
//! |---|---|---|
//! | `catkin` | yes | no |
//! | `ament_cmake`, `ament_python` | no | yes |
//! | `cmake` | unless built with ament's tools | unless built with catkin |
//!
//! An install space is of the version whose tools made it.

use std::path::Path;

use ros::bus::RosVersion;

use crate::condition::Variables;
use crate::locate::{Located, What, locate};
use crate::manifest::{INTERFACES, Kind, MAX_BYTES, Manifest};
use crate::{Error, read};

/// A distribution of ROS, such as `noetic` of ROS 1.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Distribution {
    /// The version of ROS.
    pub version: RosVersion,
    /// What `$ROS_DISTRO` stands for.
    pub name: String,
}

/// What something that was pushed fits.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Fits {
    /// Both.
    Either,
    /// This version alone.
    Only {
        /// The version.
        version: RosVersion,
        /// A package that says so.
        package: String,
        /// In words that follow "it": `has build type catkin`.
        because: String,
    },
}

impl Fits {
    /// Whether it can be put on a base of this version.
    pub fn has(&self, version: RosVersion) -> bool {
        match self {
            Fits::Either => true,
            Fits::Only { version: only, .. } => *only == version,
        }
    }
}

/// Looks at a directory that [`crate::workspace::inspect`] takes.
///
/// # Errors
/// As there; [`Error::TwoFlavours`] where two packages have no version in common, [`Error::BuildType`] for a package
/// that none of the distributions builds, [`Error::NoBuildType`] for one that forgot to say it.
pub fn of(root: &Path, distributions: &[Distribution]) -> Result<Fits, Error> {
    let located = locate(root)?;
    if let What::Space(space) = &located.what {
        let first = space.packages.first().and_then(|path| path.file_name());
        return Ok(Fits::Only {
            version: space.layout.version(),
            package: first.unwrap_or_default().to_string_lossy().into_owned(),
            because: match space.layout.version() {
                RosVersion::One => "was installed by catkin".to_owned(),
                RosVersion::Two => "is in ament's index".to_owned(),
            },
        });
    }
    let mut all = Fits::Either;
    for path in located.packages() {
        let one = of_package(&located, path, distributions)?;
        all = both(all, one)?;
    }
    Ok(all)
}

/// What fits both of these.
fn both(earlier: Fits, later: Fits) -> Result<Fits, Error> {
    match (earlier, later) {
        (Fits::Either, later) => Ok(later),
        (earlier, Fits::Either) => Ok(earlier),
        (
            Fits::Only {
                version: first,
                package: first_package,
                because: first_because,
            },
            Fits::Only {
                version: second,
                package: second_package,
                because: second_because,
            },
        ) => match first == second {
            true => Ok(Fits::Only {
                version: first,
                package: first_package,
                because: first_because,
            }),
            false => Err(Error::TwoFlavours {
                first: format!("{first_package} {first_because}"),
                first_version: first.number(),
                second: format!("{second_package} {second_because}"),
                second_version: second.number(),
            }),
        },
    }
}

fn of_package(
    located: &Located,
    path: &Path,
    distributions: &[Distribution],
) -> Result<Fits, Error> {
    let file = located.base().join(path).join("package.xml");
    let text = read::text_inside(&located.root, &file, MAX_BYTES)?;
    let mut fitting: Vec<(RosVersion, Manifest)> = Vec::new();
    let mut last = None;
    for distribution in distributions {
        let version = distribution.version;
        let variables = Variables::ros(version.number(), &distribution.name);
        let manifest = Manifest::parse(&text, &file, &variables)?;
        if manifest.fits(version) && fitting.iter().all(|(of, _)| *of != version) {
            fitting.push((version, manifest.clone()));
        }
        last = Some(manifest);
    }
    match &fitting[..] {
        [] => Err(none(&file, last)),
        [(version, manifest)] => Ok(Fits::Only {
            version: *version,
            because: because(manifest),
            package: manifest.name.clone(),
        }),
        _ => Ok(Fits::Either),
    }
}

fn because(manifest: &Manifest) -> String {
    match (&*manifest.build_type, manifest.of_ament()) {
        ("cmake", Some(tool)) => format!("is built with {tool}"),
        ("cmake", None) if manifest.of_catkin() => "is built with catkin".to_owned(),
        (build_type, _) => format!("has build type {build_type}"),
    }
}

/// Of a package that no distribution builds.
fn none(file: &Path, manifest: Option<Manifest>) -> Error {
    let Some(manifest) = manifest else {
        return Error::BuildType {
            path: file.to_owned(),
            build_type: "unknown".to_owned(),
        };
    };
    match manifest.of_ament() {
        Some(tool) if manifest.build_type == "catkin" => Error::NoBuildType {
            path: file.to_owned(),
            build_type: match manifest.needs(&[Kind::Buildtool]).contains("ament_python") {
                true => "ament_python",
                false => "ament_cmake",
            },
            tool,
        },
        _ => Error::BuildType {
            path: file.to_owned(),
            build_type: manifest.build_type,
        },
    }
}

impl Manifest {
    /// Whether a version of ROS builds the package, of a manifest that was read for it.
    pub fn fits(&self, version: RosVersion) -> bool {
        match (&*self.build_type, version) {
            // Without a word about it catkin is meant (REP 149), which is forgotten often.
            ("catkin", RosVersion::One) => self.of_catkin() || self.of_ament().is_none(),
            ("ament_cmake" | "ament_python", RosVersion::Two) => true,
            ("cmake", RosVersion::One) => self.of_ament().is_none(),
            ("cmake", RosVersion::Two) => !self.of_catkin(),
            _ => false,
        }
    }

    fn of_catkin(&self) -> bool {
        self.needs(&[Kind::Buildtool]).contains("catkin")
    }

    /// A tool of ROS 2 that it is built with.
    fn of_ament(&self) -> Option<String> {
        if self.groups.contains(INTERFACES) {
            return Some("rosidl".to_owned());
        }
        let tools = self.needs(&[Kind::Buildtool]);
        let tool = tools
            .into_iter()
            .find(|tool| tool.starts_with("ament_") || tool.starts_with("rosidl_"));
        tool.map(str::to_owned)
    }
}

#[cfg(test)]
mod tests;
