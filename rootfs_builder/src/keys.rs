//! From the names in a package.xml (rosdep keys and ROS packages) to Debian packages.
//!
//! In this order: what the deployer said (`--map`), what is in the same workspace, the base's table, ROS packages that are
//! there already (of ROS 2), ROS packages of the archive, a Debian package of that very name.

use std::collections::{BTreeMap, BTreeSet};

use ros::flavour::Version;

use crate::archive::Archive;
use crate::base::Base;
use crate::error::{Error, Unresolved};
use crate::indexed::Indexed;

/// Who asks for what.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Needed {
    /// Key → packages that ask for it while compiling.
    pub(crate) build: BTreeMap<String, BTreeSet<String>>,
    /// Key → packages that ask for it at run time.
    pub(crate) run: BTreeMap<String, BTreeSet<String>>,
}

/// What it comes to.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Resolved {
    /// Debian packages to compile with.
    pub(crate) build: BTreeSet<String>,
    /// Debian packages to run with.
    pub(crate) run: BTreeSet<String>,
    /// ROS packages to run with, to be gathered.
    pub(crate) run_ros: BTreeSet<String>,
    /// Things to know.
    pub(crate) warnings: Vec<String>,
}

enum Found {
    Debs(Vec<String>),
    Ros,
    There,
    Nothing,
}

/// The package of an archive of ROS 2 that holds a ROS package (REP 2003: `ros-jazzy-std-msgs`).
pub(crate) fn deb_of(archive: &Archive, base: &Base, name: &str) -> Option<String> {
    let name = name.replace('_', "-");
    let deb = format!("ros-{}-{name}", base.ros_distribution);
    archive.candidates.contains(&deb).then_some(deb)
}

/// Resolves all keys, or names all that nothing provides. `own`: packages of the workspace itself. `there`: those in the
/// layers.
pub(crate) fn resolve(
    archive: &Archive,
    base: &Base,
    map: &BTreeMap<String, String>,
    own: &BTreeSet<String>,
    asked: &Needed,
    there: &Indexed,
) -> Result<Resolved, Error> {
    let find = |key: &str, there: &BTreeSet<String>| -> Found {
        if let Some(deb) = map.get(key) {
            return Found::Debs(names_in(deb).map(str::to_owned).collect());
        }
        if let Some(debs) = base.keys.get(key) {
            return Found::Debs(debs.clone());
        }
        if there.contains(key) {
            return Found::There;
        }
        match base.ros {
            Version::Ros1 if !archive.contents.ros_package(key).is_empty() => return Found::Ros,
            Version::Ros2 => {
                if let Some(deb) = deb_of(archive, base, key) {
                    return Found::Debs(vec![deb]);
                }
            }
            Version::Ros1 => {}
        }
        if archive.candidates.contains(key) && !is_of_other_ros(archive, base, key) {
            return Found::Debs(vec![key.to_owned()]);
        }
        Found::Nothing
    };
    let mut resolved = Resolved::default();
    let mut missing: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    let mut miss = |key: &str, by: &BTreeSet<String>| {
        missing
            .entry(key.to_owned())
            .or_default()
            .extend(by.clone())
    };
    for (key, by) in asked.build.iter().filter(|(key, _)| !own.contains(*key)) {
        match find(key, &there.build) {
            Found::Debs(debs) => resolved.build.extend(debs),
            Found::There => {}
            Found::Ros => resolved.build.extend(archive.to_build(key)),
            Found::Nothing if base.ros_packages.ignore.contains(key) => {}
            Found::Nothing => miss(key, by),
        }
    }
    for (key, by) in asked.run.iter().filter(|(key, _)| !own.contains(*key)) {
        match find(key, &there.run) {
            // What is linked from a development package is found by what the result needs.
            Found::Debs(debs) => resolved
                .run
                .extend(debs.into_iter().filter(|deb| !deb.ends_with("-dev"))),
            Found::Ros | Found::Nothing if base.ros_packages.ignore.contains(key) => {}
            Found::Ros => {
                resolved.run_ros.insert(key.clone());
            }
            Found::There => {}
            // Often a tool that is named as <depend>: nothing of it runs.
            Found::Nothing if there.build.contains(key) => resolved.warnings.push(format!(
                "{} asks for {key} at run time, which base {} has for compiling alone; a node that uses it will fail",
                by.iter().cloned().collect::<Vec<_>>().join(", "),
                base.name
            )),
            Found::Nothing => miss(key, by),
        }
    }
    // What the deployer wrote may be wrong as well.
    add_unknown(archive, map, &mut missing);
    refuse_missing(archive, base, missing)?;
    Ok(resolved)
}

/// The Debian packages that a deployer names with `--map`, of which each must be the archive's: apt would take other words for files of
/// this machine, patterns, or packages to be removed.
pub(crate) fn mapped(
    archive: &Archive,
    base: &Base,
    map: &BTreeMap<String, String>,
) -> Result<BTreeSet<String>, Error> {
    let mut unknown = BTreeMap::new();
    add_unknown(archive, map, &mut unknown);
    refuse_missing(archive, base, unknown)?;
    let names = map.values().flat_map(|debs| names_in(debs));
    Ok(names.map(str::to_owned).collect())
}

/// Names in one value of `--map`.
fn names_in(debs: &str) -> impl Iterator<Item = &str> {
    debs.split([',', ' ']).filter(|deb| !deb.is_empty())
}

/// Adds what `--map` names and the archive has not, with the option that names it.
fn add_unknown(
    archive: &Archive,
    map: &BTreeMap<String, String>,
    missing: &mut BTreeMap<String, BTreeSet<String>>,
) {
    for (key, debs) in map {
        for deb in names_in(debs).filter(|deb| !archive.candidates.contains(deb)) {
            let by = missing.entry(deb.to_owned()).or_default();
            by.insert(format!("--map {key}={debs}"));
        }
    }
}

/// An error that names all that is missing, if anything is.
fn refuse_missing(
    archive: &Archive,
    base: &Base,
    missing: BTreeMap<String, BTreeSet<String>>,
) -> Result<(), Error> {
    if missing.is_empty() {
        return Ok(());
    }
    Err(Error::Unresolved(
        missing
            .into_iter()
            .map(|(key, by)| Unresolved {
                similar: similar(archive, base, &key),
                wanted_by: by.into_iter().collect(),
                key,
            })
            .collect(),
    ))
}

/// Whether a Debian package, on a base of ROS 2, is of the ROS 1 that the distribution has itself.
pub(crate) fn is_of_other_ros(archive: &Archive, base: &Base, deb: &str) -> bool {
    let own = format!("ros-{}-", base.ros_distribution);
    base.ros != Version::Ros1
        && !deb.starts_with(&own)
        && !archive.contents.ros_packages_in(deb).is_empty()
}

/// The Debian package that a name means which a deployer gives for a base of ROS 2: that of a ROS package, or its own.
pub(crate) fn named(archive: &Archive, base: &Base, name: &str) -> Option<String> {
    let own = archive.candidates.contains(name) && !is_of_other_ros(archive, base, name);
    deb_of(archive, base, name).or_else(|| own.then(|| name.to_owned()))
}

/// A name that nothing provides.
pub(crate) fn unresolved(archive: &Archive, base: &Base, name: &str, by: &str) -> Unresolved {
    Unresolved {
        key: name.to_owned(),
        wanted_by: vec![by.to_owned()],
        similar: similar(archive, base, name),
    }
}

/// Names that look like a key. What has the name of a package of the distribution's own ROS 1 looks like that one alone.
fn similar(archive: &Archive, base: &Base, key: &str) -> Vec<String> {
    let mut similar = archive.similar(key);
    if base.ros != Version::Ros1 {
        let of_one = !archive.contents.ros_package(key).is_empty();
        let own = format!("ros-{}-", base.ros_distribution);
        similar
            .retain(|deb| deb.starts_with(&own) || !of_one && !is_of_other_ros(archive, base, deb));
    }
    similar
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::contents::{Contents, tests::list};
    use std::path::Path;
    use std::sync::Arc;

    struct Lab {
        _directory: tempfile::TempDir,
        archive: Archive,
        base: Base,
    }

    fn lab() -> Lab {
        let directory = tempfile::tempdir().expect("a directory");
        let text = "usr/share/tf/package.xml libdevel/libtf-dev\n\
                    usr/share/tf/msg/tfMessage.msg devel/ros-tf-msgs\n\
                    usr/share/message_generation/package.xml devel/ros-message-generation\n";
        let lists = [list(directory.path(), "c.gz", text)];
        let names = [
            "libtf-dev",
            "ros-tf-msgs",
            "libfrob3-dev",
            "libfrob3",
            "libeigen3-dev",
            "python3-six",
        ];
        let archive = Archive {
            apt: crate::apt::Apt::open(directory.path(), "").expect("prepared"),
            contents: Arc::new(Contents::open(directory.path(), &lists).expect("read")),
            candidates: crate::candidates::tests::named(&names),
            stamp: String::new(),
            sources: String::new(),
        };
        let images = Path::new(env!("CARGO_MANIFEST_DIR")).join("../images");
        let base = crate::base::load(&images, crate::DEFAULT_BASE).expect("valid");
        Lab {
            _directory: directory,
            archive,
            base,
        }
    }

    fn set(keys: &[&str]) -> BTreeSet<String> {
        keys.iter().map(|&key| key.to_owned()).collect()
    }

    fn asked(build: &[&str], run: &[&str]) -> Needed {
        let by = |keys: &[&str]| {
            keys.iter()
                .map(|&key| (key.to_owned(), set(&["app"])))
                .collect()
        };
        Needed {
            build: by(build),
            run: by(run),
        }
    }

    #[test]
    fn each_name_is_found_where_it_is_known() {
        let lab = lab();
        let map = BTreeMap::from([("frob".to_owned(), "libfrob3-dev libfrob3".to_owned())]);
        let keys = [
            "frob",
            "eigen",
            "tf",
            "python3-six",
            "app_msgs",
            "message_generation",
        ];
        let asked = asked(&keys, &keys);
        let resolved = resolve(
            &lab.archive,
            &lab.base,
            &map,
            &set(&["app_msgs"]),
            &asked,
            &Indexed::default(),
        )
        .expect("all known");
        assert_eq!(
            resolved.build,
            set(&[
                "libfrob3-dev",
                "libfrob3",
                "libeigen3-dev",
                "libtf-dev",
                "ros-tf-msgs",
                "python3-six",
                "ros-message-generation"
            ])
        );
        // No development packages at run time, and nothing that only builds.
        assert_eq!(resolved.run, set(&["libfrob3", "python3-six"]));
        assert_eq!(resolved.run_ros, set(&["tf"]));
    }

    #[test]
    fn nothing_is_mapped_but_to_packages_of_the_archive() {
        let lab = lab();
        let map = |debs: &str| BTreeMap::from([("frob".to_owned(), debs.to_owned())]);
        let mapped = |debs: &str| mapped(&lab.archive, &lab.base, &map(debs));
        let found = mapped("libfrob3, libtf-dev").expect("both are there");
        assert_eq!(found, set(&["libfrob3", "libtf-dev"]));
        // Files of this machine, what apt would remove, other releases and versions, patterns, tasks.
        for wrong in [
            "./own.deb",
            "/tmp/own.deb",
            "libfrob3,../own.deb",
            "libfrob3-",
            "libfrob3/sid",
            "libfrob3=1",
            "libfrob3:armhf",
            "?essential",
            "~nlib",
            "lib.*",
            "frob^",
            "-o",
        ] {
            let error = mapped(wrong).expect_err(wrong).to_string();
            let name = wrong.split(',').next_back().unwrap_or(wrong);
            assert!(
                error.contains(&format!("{name} (wanted by --map frob={wrong})")),
                "{error}"
            );
        }
    }

    #[test]
    fn all_that_nothing_provides_is_named_at_once() {
        let lab = lab();
        let map = BTreeMap::from([("frob".to_owned(), "libfrob9".to_owned())]);
        let asked = asked(&["warp", "frob"], &["flux", "tf"]);
        let (none, there) = (BTreeSet::new(), Indexed::default());
        let error = resolve(&lab.archive, &lab.base, &map, &none, &asked, &there)
            .expect_err("two are missing");
        let Error::Unresolved(missing) = error else {
            panic!("{error}")
        };
        let keys: Vec<_> = missing.iter().map(|one| one.key.as_str()).collect();
        assert_eq!(keys, ["flux", "libfrob9", "warp"]);
        assert_eq!(missing[1].wanted_by, ["--map frob=libfrob9"]);
        assert_eq!(missing[0].wanted_by, ["app"]);
    }

    /// The same archive, and a base of ROS 2 that is as far as its keys go the same.
    fn lab_of_two() -> Lab {
        let mut lab = lab();
        lab.base.definition.ros = Version::Ros2;
        lab.base.definition.ros_distribution = "jazzy".to_owned();
        let more = [
            "ros-jazzy-nav-msgs",
            "libtf-dev",
            "ros-tf-msgs",
            "python3-six",
        ];
        lab.archive.candidates = crate::candidates::tests::named(&more);
        lab
    }

    #[test]
    fn of_ros_2_is_what_the_index_and_its_own_archive_have() {
        let lab = lab_of_two();
        let (own, map) = (set(&["app_msgs"]), BTreeMap::new());
        let there = Indexed {
            build: set(&["rclpy", "ament_cmake", "rosidl_default_generators"]),
            run: set(&["rclpy"]),
        };
        let run = [
            "rclpy",
            "app_msgs",
            "nav_msgs",
            "python3-six",
            "ament_cmake",
        ];
        let asked = asked(
            &["ament_cmake", "rosidl_default_generators", "nav_msgs"],
            &run,
        );
        let resolved =
            resolve(&lab.archive, &lab.base, &map, &own, &asked, &there).expect("all known");
        assert_eq!(resolved.build, set(&["ros-jazzy-nav-msgs"]));
        assert_eq!(resolved.run, set(&["ros-jazzy-nav-msgs", "python3-six"]));
        assert!(resolved.run_ros.is_empty());
        // A tool that is there to compile with, and was named for running, too.
        assert!(
            resolved.warnings.len() == 1 && resolved.warnings[0].contains("asks for ament_cmake"),
            "{:?}",
            resolved.warnings
        );
    }

    #[test]
    fn ros_1_of_the_distribution_satisfies_nothing_of_ros_2() {
        let lab = lab_of_two();
        let (own, map) = (BTreeSet::new(), BTreeMap::new());
        let asked = asked(&["tf", "rclcpp"], &["libtf-dev", "rclcpp"]);
        let error = resolve(
            &lab.archive,
            &lab.base,
            &map,
            &own,
            &asked,
            &Indexed::default(),
        )
        .expect_err("nothing of it is there");
        let Error::Unresolved(missing) = &error else {
            panic!("{error}")
        };
        let keys: Vec<_> = missing.iter().map(|one| one.key.as_str()).collect();
        assert_eq!(keys, ["libtf-dev", "rclcpp", "tf"]);
        assert!(
            missing.iter().all(|one| one.similar.is_empty()),
            "{missing:?}"
        );
        assert!(error.to_string().contains("or push a workspace"), "{error}");
    }
}
