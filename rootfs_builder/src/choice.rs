//! Choice of the base for a push: the requested one, if the packages support it, or else the first of the default bases
//! that they support.

use std::path::Path;

use package::fits::{self, Distribution, RosSupport};
use ros::bus::RosVersion;

use crate::base::{self, Base, DEFAULT_BASE};
use crate::error::Error;
use crate::request::PushSource;

/// Default bases in order of preference; then any other one, by name. Packages that support both ROS versions use the
/// first.
const DEFAULTS: [&str; 2] = [DEFAULT_BASE, "bookworm-jazzy-wheels"];

/// The chosen base.
#[derive(Debug)]
pub(crate) struct ChosenBase {
    pub(crate) base: Base,
    /// Note about the choice.
    pub(crate) note: Option<String>,
}

/// Chooses among the definitions in a directory. Blocking; reads what was pushed.
pub(crate) fn choose_base(directory: &Path, asked: Option<&str>, source: &PushSource) -> Result<ChosenBase, Error> {
    let PushSource::Tree(tree) = source else {
        // The name of a packaged ROS package does not reveal its ROS version.
        let base = base::load(directory, asked.unwrap_or(DEFAULT_BASE))?;
        return Ok(ChosenBase { base, note: None });
    };
    // An unknown base is reported before anything else.
    let asked = asked.map(|name| base::load(directory, name)).transpose()?;
    let bases = load_usable_bases(directory, asked.as_ref())?;
    let fits = fits::detect(tree, &distributions(&bases))?;
    match asked {
        Some(base) => check_requested_base(base, &bases, fits),
        None => first_fitting_base(bases, fits),
    }
}

/// Returns all usable definitions; an unusable definition of an operator must not prevent the use of others.
fn load_usable_bases(directory: &Path, asked: Option<&Base>) -> Result<Vec<Base>, Error> {
    let mut bases = Vec::new();
    for name in base::names(directory)? {
        match base::load(directory, &name) {
            Ok(base) => bases.push(base),
            Err(error) => tracing::warn!("{error}"),
        }
    }
    if bases.is_empty() {
        bases.extend(asked.cloned());
    }
    Ok(bases)
}

fn distributions(bases: &[Base]) -> Vec<Distribution> {
    let of = |base: &Base| Distribution { version: base.ros.ros_version(), name: base.ros_distribution.clone() };
    bases.iter().map(of).collect()
}

fn check_requested_base(base: Base, bases: &[Base], fits: RosSupport) -> Result<ChosenBase, Error> {
    let given = base.ros.ros_version();
    match fits {
        RosSupport::Only { version, package, because } if version != given => Err(Error::WrongRos {
            package,
            because,
            version: version.number(),
            base: base.name.clone(),
            base_version: given.number(),
            fitting: list_bases(bases, version),
        }),
        _ => Ok(ChosenBase { base, note: None }),
    }
}

fn first_fitting_base(mut bases: Vec<Base>, fits: RosSupport) -> Result<ChosenBase, Error> {
    let rank = |base: &Base| {
        let own = DEFAULTS.iter().position(|name| *name == base.name);
        (own.unwrap_or(DEFAULTS.len()), base.name.clone())
    };
    bases.sort_by_key(rank);
    let other = match &fits {
        RosSupport::Either => {
            bases.iter().find(|base| base.ros.ros_version() == RosVersion::Two).map(|base| base.name.clone())
        }
        RosSupport::Only { .. } => None,
    };
    let found = bases.into_iter().find(|base| fits.supports(base.ros.ros_version()));
    match (found, fits) {
        (Some(base), _) => {
            let note = other.filter(|name| *name != base.name).map(|other| {
                format!(
                    "it can be built for either ROS, and is built for ROS {} on {}; for the other push with \
                     `--base {other}`",
                    base.ros.ros_version().number(),
                    base.name
                )
            });
            Ok(ChosenBase { base, note })
        }
        (None, RosSupport::Only { version, package, because }) => {
            Err(Error::NoBase { package, because, version: version.number() })
        }
        (None, RosSupport::Either) => no_base_error(),
    }
}

fn no_base_error() -> Result<ChosenBase, Error> {
    Err(Error::NoBase {
        package: "it".to_owned(),
        because: "can be built for either ROS".to_owned(),
        version: RosVersion::One.number(),
    })
}

/// Formats the names of the bases of a version.
fn list_bases(bases: &[Base], version: RosVersion) -> String {
    let of_version = bases.iter().filter(|base| base.ros.ros_version() == version);
    let names: Vec<String> = of_version.map(|base| format!("--base {}", base.name)).collect();
    if names.is_empty() {
        format!("a base of ROS {}, of which this server has none", version.number())
    } else {
        names.join(" or ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Creates definitions with these names and ROS versions.
    fn bases(definitions: &[(&str, &str)]) -> tempfile::TempDir {
        let directory = tempfile::tempdir().expect("a directory");
        for (name, ros) in definitions {
            let distribution = if *ros == "ros1" { "noetic" } else { "jazzy" };
            let text = format!(
                "summary = \"x\"\ndistribution = \"debian\"\nsuite = \"bookworm\"\nros = \"{ros}\"\n\
                 ros_distribution = \"{distribution}\"\n[runtime]\npackages = [\"libc6\"]\n[build]\npackages = []\n\
                 prefix = \"/opt/x\"\n"
            );
            std::fs::write(directory.path().join(format!("{name}.toml")), text).expect("written");
        }
        directory
    }

    fn pushed_packages(exports: &[&str]) -> (tempfile::TempDir, PushSource) {
        let root = tempfile::tempdir().expect("a directory");
        for (number, export) in exports.iter().enumerate() {
            let directory = root.path().join(format!("src/p{number}"));
            std::fs::create_dir_all(&directory).expect("made");
            let text = format!("<package format=\"3\"><name>p{number}</name><export>{export}</export></package>");
            std::fs::write(directory.join("package.xml"), text).expect("written");
        }
        let source = PushSource::Tree(root.path().to_owned());
        (root, source)
    }

    const CATKIN: &str = "<build_type>catkin</build_type>";
    const AMENT: &str = "<build_type>ament_python</build_type>";
    const CMAKE: &str = "<build_type>cmake</build_type>";
    const BOTH: &str = "<build_type condition=\"$ROS_VERSION == 1\">catkin</build_type>\
                        <build_type condition=\"$ROS_VERSION == 2\">ament_cmake</build_type>";
    const ALL: [(&str, &str); 4] =
        [("another", "ros2"), ("bookworm-jazzy-wheels", "ros2"), ("bookworm-ros1", "ros1"), ("zesty", "ros1")];

    fn chosen_name(definitions: &[(&str, &str)], asked: Option<&str>, exports: &[&str]) -> Result<ChosenBase, Error> {
        let (bases, (_root, source)) = (bases(definitions), pushed_packages(exports));
        choose_base(bases.path(), asked, &source)
    }

    #[test]
    fn without_a_word_the_base_follows_from_the_packages() {
        for (exports, base, is_noted) in [
            (&[CATKIN][..], "bookworm-ros1", false),
            (&[AMENT], "bookworm-jazzy-wheels", false),
            (&[CMAKE, AMENT], "bookworm-jazzy-wheels", false),
            (&[BOTH, AMENT], "bookworm-jazzy-wheels", false),
            (&[BOTH, CATKIN], "bookworm-ros1", false),
            (&[CMAKE], "bookworm-ros1", true),
            (&[BOTH], "bookworm-ros1", true),
        ] {
            let chosen = chosen_name(&ALL, None, exports).expect("there is one");
            assert_eq!(chosen.base.name, base, "{exports:?}");
            assert_eq!(chosen.note.is_some(), is_noted, "{exports:?}");
        }
        let others = [("another", "ros2"), ("zesty", "ros1")];
        let chosen = chosen_name(&others, None, &[AMENT]).expect("there is one");
        assert_eq!(chosen.base.name, "another");
    }

    #[test]
    fn a_package_of_the_other_ros_is_told_which_base_fits() {
        let text = chosen_name(&ALL, Some("bookworm-ros1"), &[CMAKE, AMENT]).expect_err("ROS 2").to_string();
        for words in [
            "p1 has build type ament_python",
            "bookworm-ros1 is of ROS 1",
            "--base another or --base bookworm-jazzy-wheels",
        ] {
            assert!(text.contains(words), "{text}");
        }
        let text = chosen_name(&ALL, Some("another"), &[CATKIN]).expect_err("ROS 1").to_string();
        assert!(text.contains("--base bookworm-ros1 or --base zesty"), "{text}");
        for exports in [&[BOTH][..], &[CMAKE]] {
            for base in ["another", "zesty"] {
                assert_eq!(chosen_name(&ALL, Some(base), exports).expect("fits").base.name, base);
            }
        }
    }

    #[test]
    fn two_flavours_are_refused_whatever_is_asked() {
        for asked in [None, Some("another"), Some("zesty")] {
            let text = chosen_name(&ALL, asked, &[CATKIN, AMENT]).expect_err("two flavours").to_string();
            assert!(
                text.contains("p0 has build type catkin (ROS 1)")
                    && text.contains("p1 has build type ament_python (ROS 2)"),
                "{text}"
            );
        }
    }

    #[test]
    fn where_no_base_fits_it_is_said() {
        let text = chosen_name(&[("zesty", "ros1")], None, &[AMENT]).expect_err("none");
        assert!(text.to_string().contains("no base supports build type ament_python"), "{text}");
        // An unreadable definition does not prevent the use of others.
        let (bases, (_root, source)) = (bases(&ALL), pushed_packages(&[AMENT]));
        std::fs::write(bases.path().join("broken.toml"), "ros = 7").expect("written");
        let chosen = choose_base(bases.path(), None, &source).expect("there is one");
        assert_eq!(chosen.base.name, "bookworm-jazzy-wheels");
        assert!(choose_base(bases.path(), Some("broken"), &source).is_err());
    }
}
