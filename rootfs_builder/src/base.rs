//! Base definitions: properties of a distribution and its ROS (`images/NAME.toml`).

mod imported_image;
mod wheels;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use image::Digest;
use ros::flavour::{Flavour, Version};
use ros::ros2::middleware;
use serde::{Deserialize, Serialize};

pub use crate::base_file_error::{BaseFileError, BaseFileProblem, WheelsError};
use crate::error::{Error, IoContext};

pub use imported_image::{Finding, ImportedImage};
pub(crate) use wheels::RequiredWheels;
pub use wheels::Wheels;

/// Default base for packages that support ROS 1.
pub const DEFAULT_BASE: &str = "bookworm-ros1";

/// A base image.
#[derive(Debug, Clone, PartialEq)]
pub struct Base {
    /// File name without `.toml`.
    pub name: String,
    /// Content of the definition.
    pub definition: Definition,
    /// Requirements of its wheels.
    pub(crate) required: RequiredWheels,
}

impl Base {
    /// Returns the ROS flavour recorded with revisions.
    pub fn flavour(&self) -> Flavour {
        Flavour { base: self.name.clone(), ros: self.ros, distribution: self.ros_distribution.clone() }
    }

    /// Returns whether its ROS is the distribution's own, of ROS 1 below `/usr`. Otherwise ROS is in install spaces,
    /// and its Debian packages, if there are any, are named by its distribution (REP 2003: `ros-jazzy-std-msgs`).
    pub(crate) fn has_distributions_ros(&self) -> bool {
        self.ros == Version::Ros1 && self.install_prefixes().is_empty()
    }

    /// Returns the install spaces as absolute paths: those in the environment of all processes and of compilers.
    /// Empty for the distribution's own ROS 1, which is below `/usr`.
    pub(crate) fn install_prefixes(&self) -> Vec<String> {
        let mut named: Vec<String> = Vec::new();
        for environment in [&self.environment, &self.build.environment] {
            for variable in ["AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH"] {
                let value = environment.get(variable).map_or("", String::as_str);
                named.extend(value.split(':').map(str::to_owned));
            }
        }
        if self.ros == Version::Ros2 {
            named.push(format!("/opt/ros/{}", self.ros_distribution));
        }
        let mut seen = BTreeSet::new();
        named.retain(|prefix| {
            prefix.len() > 1 && prefix.starts_with('/') && prefix != "/usr" && seen.insert(prefix.clone())
        });
        named
    }

    /// Returns the properties that affect installed trees, as a part of their cache keys. A new rosdep key does not
    /// affect them.
    pub(crate) fn system_key(&self) -> String {
        let parts = (&self.distribution, &self.suite, &self.runtime, &self.strip);
        serde_json::to_string(&parts).unwrap_or_default()
    }

    /// Returns the diff-ids of the layers that the base was made from; none if it was built.
    pub(crate) fn layers_of_image(&self) -> &[Digest] {
        self.image.as_ref().map_or(&[], |image| &image.layers)
    }

    /// Returns the properties that affect compiled packages.
    pub(crate) fn build_key(&self) -> String {
        serde_json::to_string(&(&self.build, &self.environment)).unwrap_or_default()
    }

    /// Returns the base with these arguments of CMake after its own; the later one of two that contradict each other is
    /// used.
    pub(crate) fn with_cmake_arguments(mut self, arguments: &[String]) -> Base {
        self.definition.build.cmake.extend_from_slice(arguments);
        self
    }
}

impl std::ops::Deref for Base {
    type Target = Definition;

    fn deref(&self) -> &Definition {
        &self.definition
    }
}

/// Content of a base definition.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Definition {
    /// One-line summary.
    pub summary: String,
    /// Distribution, as in os-release: `debian`.
    pub distribution: String,
    /// Release name in the archive: `bookworm`.
    pub suite: String,
    /// ROS version of its packages.
    pub ros: Version,
    /// ROS distribution, as in `$ROS_DISTRO` in the conditions of a package.xml: `noetic`.
    pub ros_distribution: String,
    /// Another base whose `keys` are inherited; those of this base take precedence.
    pub keys_of: Option<String>,
    /// Content of every image.
    pub runtime: Runtime,
    /// Environment of every process.
    #[serde(default)]
    pub environment: BTreeMap<String, String>,
    /// Files left out of all layers.
    #[serde(default)]
    pub strip: Strip,
    /// Python packages that provide ROS, if the distribution has no such packages.
    pub wheels: Option<Wheels>,
    /// Toolchain.
    pub build: Build,
    /// Settings for individual ROS packages.
    #[serde(default)]
    pub ros_packages: RosPackages,
    /// rosdep key → Debian packages.
    #[serde(default)]
    pub keys: BTreeMap<String, Vec<String>>,
    /// Image that it was made from; written by [`crate::Builder::import_image`].
    pub image: Option<ImportedImage>,
}

/// Content of every image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Runtime {
    /// Debian packages.
    pub packages: Vec<String>,
}

/// Files left out of all layers.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Strip {
    /// `path-exclude=` and `path-include=` options of dpkg.
    pub unpacked: Vec<String>,
    /// Globs of absolute paths, or bare names at any depth, that are left out of the finished tree.
    pub paths: Vec<String>,
}

/// Toolchain.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Build {
    /// Debian packages, present only while a package is compiled.
    pub packages: Vec<String>,
    /// Installation prefix of compiled packages.
    pub prefix: PathBuf,
    /// Arguments of every cmake call.
    #[serde(default)]
    pub cmake: Vec<String>,
    /// Additional environment while compiling.
    #[serde(default)]
    pub environment: BTreeMap<String, String>,
    /// Additional files while compiling: absolute path → content.
    #[serde(default)]
    pub files: BTreeMap<PathBuf, String>,
}

/// Settings for individual ROS packages.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RosPackages {
    /// Packages not needed at run time: neither installed nor reported as missing.
    pub ignore: BTreeSet<String>,
}

/// Loads the definition `name` from a directory, and the files that it refers to.
pub fn load(directory: &Path, name: &str) -> Result<Base, Error> {
    let mut definition = read(directory, name)?;
    if let Some(other) = &definition.keys_of {
        for (key, packages) in read(directory, other)?.keys {
            definition.keys.entry(key).or_insert(packages);
        }
    }
    let required = match &definition.wheels {
        Some(wheels) => RequiredWheels::read(directory, wheels)?,
        None => RequiredWheels::default(),
    };
    Ok(Base { name: name.to_owned(), definition, required })
}

/// Reads a single definition file.
fn read(directory: &Path, name: &str) -> Result<Definition, Error> {
    let plain = !name.is_empty() && name.bytes().all(|b| b.is_ascii_alphanumeric() || b"-_.".contains(&b));
    let path = directory.join(format!("{name}.toml"));
    if !plain || !path.is_file() {
        let known = names(directory)?;
        return Err(Error::UnknownBase {
            name: name.to_owned(),
            directory: directory.to_owned(),
            known: if known.is_empty() { "none".into() } else { known.join(", ") },
        });
    }
    let text = fs::read_to_string(&path).io_context("reading", &path)?;
    parse(&text).map_err(|problem| Error::BadBase { path, problem })
}

/// Returns the names of all definitions in a directory, sorted.
pub fn names(directory: &Path) -> Result<Vec<String>, Error> {
    let mut names = Vec::new();
    for entry in fs::read_dir(directory).io_context("reading", directory)? {
        let path = entry.io_context("reading", directory)?.path();
        if path.extension().is_some_and(|e| e == "toml")
            && let Some(stem) = path.file_stem().and_then(|s| s.to_str())
        {
            names.push(stem.to_owned());
        }
    }
    names.sort();
    Ok(names)
}

/// Returns the layers of all bases in a directory that were made from images. Definitions that cannot be read are left
/// out.
pub(crate) fn image_layers(directory: &Path) -> Vec<Digest> {
    let all = names(directory).unwrap_or_default();
    let images = all.iter().filter_map(|name| load(directory, name).ok()?.definition.image);
    images.flat_map(|image| image.layers).collect()
}

/// Parses and validates a definition; the error does not contain the file name yet.
fn parse(text: &str) -> Result<Definition, BaseFileError> {
    let definition: Definition = toml::from_str(text).map_err(|error: toml::de::Error| BaseFileError {
        line: error.span().map(|span| text[..span.start.min(text.len())].matches('\n').count() + 1),
        problem: BaseFileProblem::Toml(Box::new(error)),
    })?;
    let wrong = |needle: &str, problem: BaseFileProblem| {
        let index = text.lines().position(|line| line.contains(needle));
        BaseFileError { line: index.map(|index| index + 1), problem }
    };
    let packages = [&definition.runtime.packages, &definition.build.packages];
    for package in packages.into_iter().flatten().chain(definition.keys.values().flatten()) {
        if !is_debian_name(package) {
            let problem = BaseFileProblem::PackageName(package.clone());
            return Err(wrong(&format!("{package:?}"), problem));
        }
    }
    if definition.runtime.packages.is_empty() && definition.image.is_none() {
        return Err(wrong("[runtime]", BaseFileProblem::NoPackages));
    }
    for rule in &definition.strip.unpacked {
        if !rule.starts_with("path-exclude=/") && !rule.starts_with("path-include=/") {
            let problem = BaseFileProblem::StripRule(rule.clone());
            return Err(wrong(&format!("{rule:?}"), problem));
        }
    }
    if definition.ros == Version::Ros2 {
        let checked = middleware::check_environment(&definition.environment);
        checked.map_err(|error| wrong(middleware::VARIABLE, error.into()))?;
    }
    if let Some(wheels) = &definition.wheels {
        wheels.check().map_err(|error| wrong("[wheels]", error.into()))?;
    }
    let absolute = definition
        .build
        .files
        .keys()
        .chain([&definition.build.prefix])
        .chain(definition.wheels.as_ref().map(|wheels| &wheels.prefix));
    for path in absolute {
        let climbs = path.components().any(|part| part == std::path::Component::ParentDir);
        if !path.is_absolute() || climbs || path == Path::new("/") {
            let shown = path.display().to_string();
            return Err(wrong(&shown, BaseFileProblem::Path(shown.clone())));
        }
    }
    Ok(definition)
}

/// Returns whether a text is the name of a Debian package (policy 5.6.1): lower-case letters, digits, `+-.`, at least
/// two characters, beginning alphanumerically.
pub(crate) fn is_debian_name(name: &str) -> bool {
    name.len() >= 2
        && name.as_bytes()[0].is_ascii_alphanumeric()
        && name.bytes().all(|b| b.is_ascii_lowercase() || b.is_ascii_digit() || b"+-.".contains(&b))
}

#[cfg(test)]
mod tests;
