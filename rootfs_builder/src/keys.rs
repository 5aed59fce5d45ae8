//! Resolution of the names in a package.xml (rosdep keys and ROS packages) to Debian packages.
//!
//! In this order: the deployer's mapping (`--map`), packages of the same workspace, the base's table, existing ROS
//! packages in install spaces (on a base made from an image before the table, which was not written for it), ROS
//! packages of the archive, a Debian package of the same name, an existing Python module of that name, if no more is
//! needed.

use std::collections::{BTreeMap, BTreeSet};

use crate::archive::Archive;
use crate::base::Base;
use crate::error::{Error, Unresolved};
use crate::indexed::IndexedPackages;
use crate::spelling;

/// Required keys and the packages that need them.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct RequiredKeys {
    /// Key → packages that need it while compiling.
    pub(crate) build: BTreeMap<String, BTreeSet<String>>,
    /// Key → packages that need it at run time.
    pub(crate) run: BTreeMap<String, BTreeSet<String>>,
    /// Keys of which at most the Python module is needed.
    pub(crate) modules: BTreeSet<String>,
}

/// Result of the resolution.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct ResolvedKeys {
    /// Debian packages for compiling.
    pub(crate) build: BTreeSet<String>,
    /// Debian packages for running.
    pub(crate) run: BTreeSet<String>,
    /// ROS packages for running, still to be gathered.
    pub(crate) run_ros: BTreeSet<String>,
    /// Warnings for the deployer.
    pub(crate) warnings: Vec<String>,
}

enum KeyProvider {
    Debs(Vec<String>),
    Ros,
    There,
    Nothing,
}

/// Returns the package of a ROS 2 archive that contains a ROS package (REP 2003: `ros-jazzy-std-msgs`).
pub(crate) fn find_ros_deb(archive: &Archive, base: &Base, name: &str) -> Option<String> {
    let name = name.replace('_', "-");
    let deb = format!("ros-{}-{name}", base.ros_distribution);
    archive.candidates.contains(&deb).then_some(deb)
}

/// Resolves all keys; the error names all that nothing provides. `own` are the packages of the workspace itself,
/// `there` those in the layers.
pub(crate) fn resolve_keys(
    archive: &Archive,
    base: &Base,
    map: &BTreeMap<String, String>,
    own: &BTreeSet<String>,
    asked: &RequiredKeys,
    there: &IndexedPackages,
) -> Result<ResolvedKeys, Error> {
    // A mapping may also name a package of the push or of the base.
    let is_there = |name: &str| own.contains(name) || there.build.contains(name) || there.run.contains(name);
    let modules = &there.modules;
    let find = |key: &str, there: &BTreeSet<String>| -> KeyProvider {
        if let Some(names) = map.get(key) {
            let debs = split_names(names).filter(|name| !is_there(name));
            return KeyProvider::Debs(debs.map(str::to_owned).collect());
        }
        if base.image.is_some() && there.contains(key) {
            return KeyProvider::There;
        }
        if let Some(debs) = base.keys.get(key) {
            return KeyProvider::Debs(debs.clone());
        }
        if there.contains(key) {
            return KeyProvider::There;
        }
        if base.has_distributions_ros() {
            if !archive.contents.ros_package(key).is_empty() {
                return KeyProvider::Ros;
            }
        } else if let Some(deb) = find_ros_deb(archive, base, key) {
            return KeyProvider::Debs(vec![deb]);
        }
        if archive.candidates.contains(key) && !is_of_other_ros(archive, base, key) {
            return KeyProvider::Debs(vec![key.to_owned()]);
        }
        if asked.modules.contains(key) && modules.contains(key) {
            return KeyProvider::There;
        }
        KeyProvider::Nothing
    };
    let mut resolved = ResolvedKeys::default();
    let mut missing: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    let mut miss = |key: &str, by: &BTreeSet<String>| missing.entry(key.to_owned()).or_default().extend(by.clone());
    for (key, by) in asked.build.iter().filter(|(key, _)| !own.contains(*key)) {
        match find(key, &there.build) {
            KeyProvider::Debs(debs) => resolved.build.extend(debs),
            KeyProvider::There => {}
            KeyProvider::Ros => resolved.build.extend(archive.build_packages(key)),
            KeyProvider::Nothing if base.ros_packages.ignore.contains(key) => {}
            KeyProvider::Nothing => miss(key, by),
        }
    }
    for (key, by) in asked.run.iter().filter(|(key, _)| !own.contains(*key)) {
        match find(key, &there.run) {
            // Libraries of a development package are found by what the compiled result needs.
            KeyProvider::Debs(debs) => resolved.run.extend(debs.into_iter().filter(|deb| !deb.ends_with("-dev"))),
            KeyProvider::Ros | KeyProvider::Nothing if base.ros_packages.ignore.contains(key) => {}
            KeyProvider::Ros => {
                resolved.run_ros.insert(key.clone());
            }
            KeyProvider::There => {}
            // Often a build tool declared as <depend>, which is not needed at run time.
            KeyProvider::Nothing if there.build.contains(key) => resolved.warnings.push(format!(
                "{} needs {key} at run time, which base {} has only for compiling; a node that uses it will fail",
                by.iter().cloned().collect::<Vec<_>>().join(", "),
                base.name
            )),
            KeyProvider::Nothing => miss(key, by),
        }
    }
    // The deployer's mapping may be wrong as well.
    add_unknown(archive, map, is_there, &mut missing);
    refuse_missing(archive, base, missing, &there.build)?;
    Ok(resolved)
}

/// Returns the Debian packages named with `--map`. Each must be in the archive: apt would also accept local files,
/// patterns, or packages to be removed.
pub(crate) fn mapped_packages(
    archive: &Archive,
    base: &Base,
    map: &BTreeMap<String, String>,
) -> Result<BTreeSet<String>, Error> {
    let mut unknown = BTreeMap::new();
    add_unknown(archive, map, |_| false, &mut unknown);
    refuse_missing(archive, base, unknown, &BTreeSet::new())?;
    let names = map.values().flat_map(|debs| split_names(debs));
    Ok(names.map(str::to_owned).collect())
}

/// Splits a value of `--map` into names.
fn split_names(debs: &str) -> impl Iterator<Item = &str> {
    debs.split([',', ' ']).filter(|deb| !deb.is_empty())
}

/// Adds the names in `--map` that are neither in the archive nor there anyway, with the option that contains them.
fn add_unknown(
    archive: &Archive,
    map: &BTreeMap<String, String>,
    is_there: impl Fn(&str) -> bool,
    missing: &mut BTreeMap<String, BTreeSet<String>>,
) {
    for (key, debs) in map {
        for deb in split_names(debs).filter(|deb| !is_there(deb) && !archive.candidates.contains(deb)) {
            let by = missing.entry(deb.to_owned()).or_default();
            by.insert(format!("--map {key}={debs}"));
        }
    }
}

/// Maximum number of missing names for which similar ones are searched: each search goes through the whole archive, and
/// a push may name any number.
const MOST_SUGGESTIONS: usize = 50;

/// Fails with all missing names, if there are any; `there` are the ROS packages of the base.
fn refuse_missing(
    archive: &Archive,
    base: &Base,
    missing: BTreeMap<String, BTreeSet<String>>,
    there: &BTreeSet<String>,
) -> Result<(), Error> {
    if missing.is_empty() {
        return Ok(());
    }
    let unresolved = missing.into_iter().enumerate().map(|(number, (key, by))| Unresolved {
        similar: if number < MOST_SUGGESTIONS { similar(archive, base, &key, there) } else { Vec::new() },
        wanted_by: by.into_iter().collect(),
        key,
    });
    Err(Error::Unresolved(unresolved.collect()))
}

/// Returns whether, on a base with install spaces, a Debian package belongs to the distribution's own ROS 1.
pub(crate) fn is_of_other_ros(archive: &Archive, base: &Base, deb: &str) -> bool {
    let own = format!("ros-{}-", base.ros_distribution);
    !base.has_distributions_ros() && !deb.starts_with(&own) && !archive.contents.ros_packages_in(deb).is_empty()
}

/// Finds the Debian package for a name given on a base with install spaces: that of a ROS package, or the package
/// itself.
pub(crate) fn find_named_deb(archive: &Archive, base: &Base, name: &str) -> Option<String> {
    let own = archive.candidates.contains(name) && !is_of_other_ros(archive, base, name);
    find_ros_deb(archive, base, name).or_else(|| own.then(|| name.to_owned()))
}

/// Creates the error entry for a name given with `--with` that nothing provides; `there` are the ROS packages of the
/// base.
pub(crate) fn unresolved_name(archive: &Archive, base: &Base, name: &str, there: &BTreeSet<String>) -> Unresolved {
    let similar = similar(archive, base, name, there);
    Unresolved { key: name.to_owned(), wanted_by: vec!["--with".to_owned()], similar }
}

/// Maximum number of similar names.
const MOST_SIMILAR: usize = 3;

/// Returns names similar to a key: keys that the base knows first. On a base with install spaces these are not of the
/// distribution's own ROS 1, and ROS packages of the base (`there`) and its archive come before others.
fn similar(archive: &Archive, base: &Base, key: &str, there: &BTreeSet<String>) -> Vec<String> {
    let mut similar = archive.similar(key);
    // Names of libraries are short and alike: of keys, one slip is enough.
    let is_near = |name: &&String| spelling::slips(key, name).is_some_and(|slips| slips < 2);
    let mut known: BTreeSet<String> = base.keys.keys().filter(is_near).cloned().collect();
    if !base.has_distributions_ros() {
        let is_ros1 = |name: &str| !archive.contents.ros_package(name).is_empty();
        let own = format!("ros-{}-", base.ros_distribution);
        let of_one = is_ros1(key);
        similar.retain(|deb| deb.starts_with(&own) || !of_one && !is_ros1(deb) && !is_of_other_ros(archive, base, deb));
        let packaged = archive.candidates.names().filter_map(|deb| deb.strip_prefix(&*own));
        known.extend(packaged.map(|name| name.replace('-', "_")));
        known.extend(there.iter().cloned());
    }
    let near = known.into_iter().filter_map(|name| Some((spelling::slips(key, &name)?, name)));
    let near: BTreeSet<(usize, String)> = near.filter(|(_, name)| name != key).collect();
    let mut found: Vec<String> = near.into_iter().map(|(_, name)| name).collect();
    similar.retain(|name| !found.contains(name));
    found.append(&mut similar);
    found.truncate(MOST_SIMILAR);
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::contents::{Contents, tests::list};
    use ros::flavour::Version;
    use std::path::Path;
    use std::sync::Arc;

    struct KeysFixture {
        _directory: tempfile::TempDir,
        archive: Archive,
        base: Base,
    }

    fn new_fixture() -> KeysFixture {
        let directory = tempfile::tempdir().expect("a directory");
        let text = "usr/share/tf/package.xml libdevel/libtf-dev\n\
                    usr/share/tf/msg/tfMessage.msg devel/ros-tf-msgs\n\
                    usr/share/message_generation/package.xml devel/ros-message-generation\n";
        let lists = [list(directory.path(), "c.gz", text)];
        let names = ["libtf-dev", "ros-tf-msgs", "libfrob3-dev", "libfrob3", "libeigen3-dev", "python3-six"];
        let archive = Archive {
            apt: crate::apt::Apt::open(directory.path(), "").expect("prepared"),
            contents: Arc::new(Contents::open(directory.path(), &lists).expect("read")),
            candidates: crate::candidates::tests::candidates_named(&names),
            stamp: String::new(),
            sources: String::new(),
        };
        let images = Path::new(env!("CARGO_MANIFEST_DIR")).join("../images");
        let base = crate::base::load(&images, crate::DEFAULT_BASE).expect("valid");
        KeysFixture { _directory: directory, archive, base }
    }

    fn set(keys: &[&str]) -> BTreeSet<String> {
        keys.iter().map(|&key| key.to_owned()).collect()
    }

    fn new_required_keys(build: &[&str], run: &[&str]) -> RequiredKeys {
        let by = |keys: &[&str]| keys.iter().map(|&key| (key.to_owned(), set(&["app"]))).collect();
        RequiredKeys { build: by(build), run: by(run), modules: BTreeSet::new() }
    }

    #[test]
    fn each_name_is_found_where_it_is_known() {
        let lab = new_fixture();
        let map = BTreeMap::from([("frob".to_owned(), "libfrob3-dev libfrob3".to_owned())]);
        let keys = ["frob", "eigen", "tf", "python3-six", "app_msgs", "message_generation"];
        let asked = new_required_keys(&keys, &keys);
        let resolved =
            resolve_keys(&lab.archive, &lab.base, &map, &set(&["app_msgs"]), &asked, &IndexedPackages::default())
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
        // No development packages at run time, and no build tools.
        assert_eq!(resolved.run, set(&["libfrob3", "python3-six"]));
        assert_eq!(resolved.run_ros, set(&["tf"]));
    }

    #[test]
    fn nothing_is_mapped_but_to_known_packages() {
        let lab = new_fixture();
        let map = |debs: &str| BTreeMap::from([("frob".to_owned(), debs.to_owned())]);
        let mapped = |debs: &str| mapped_packages(&lab.archive, &lab.base, &map(debs));
        let found = mapped("libfrob3, libtf-dev").expect("both are there");
        assert_eq!(found, set(&["libfrob3", "libtf-dev"]));
        // Local files, package removals, other releases and versions, patterns, tasks.
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
            assert!(error.contains(&format!("{name} (wanted by --map frob={wrong})")), "{error}");
        }
    }

    #[test]
    fn all_that_nothing_provides_is_named_at_once() {
        let lab = new_fixture();
        let map = BTreeMap::from([("frob".to_owned(), "libfrob9".to_owned())]);
        let asked = new_required_keys(&["warp", "frob"], &["flux", "tf"]);
        let (none, there) = (BTreeSet::new(), IndexedPackages::default());
        let error = resolve_keys(&lab.archive, &lab.base, &map, &none, &asked, &there).expect_err("two are missing");
        let Error::Unresolved(missing) = error else { panic!("{error}") };
        let keys: Vec<_> = missing.iter().map(|one| one.key.as_str()).collect();
        assert_eq!(keys, ["flux", "libfrob9", "warp"]);
        assert_eq!(missing[1].wanted_by, ["--map frob=libfrob9"]);
        assert_eq!(missing[0].wanted_by, ["app"]);
    }

    /// Creates the same archive with a base of ROS 2 that has the same keys.
    fn new_ros2_fixture() -> KeysFixture {
        let mut lab = new_fixture();
        lab.base.definition.ros = Version::Ros2;
        lab.base.definition.ros_distribution = "jazzy".to_owned();
        let more = ["ros-jazzy-nav-msgs", "libtf-dev", "ros-tf-msgs", "python3-six"];
        lab.archive.candidates = crate::candidates::tests::candidates_named(&more);
        lab
    }

    #[test]
    fn of_ros_2_is_what_the_index_and_its_own_archive_have() {
        let lab = new_ros2_fixture();
        let (own, map) = (set(&["app_msgs"]), BTreeMap::new());
        let there = IndexedPackages {
            build: set(&["rclpy", "ament_cmake", "rosidl_default_generators"]),
            run: set(&["rclpy"]),
            modules: BTreeSet::new(),
        };
        let run = ["rclpy", "app_msgs", "nav_msgs", "python3-six", "ament_cmake"];
        let asked = new_required_keys(&["ament_cmake", "rosidl_default_generators", "nav_msgs"], &run);
        let resolved = resolve_keys(&lab.archive, &lab.base, &map, &own, &asked, &there).expect("all known");
        assert_eq!(resolved.build, set(&["ros-jazzy-nav-msgs"]));
        assert_eq!(resolved.run, set(&["ros-jazzy-nav-msgs", "python3-six"]));
        assert!(resolved.run_ros.is_empty());
        // A build tool that was also declared for run time.
        assert!(
            resolved.warnings.len() == 1 && resolved.warnings[0].contains("needs ament_cmake"),
            "{:?}",
            resolved.warnings
        );
    }

    #[test]
    fn a_key_may_be_met_by_another_package_or_by_what_is_there() {
        let lab = new_ros2_fixture();
        let own = set(&["tf2_ros_py"]);
        let there =
            IndexedPackages { build: set(&["rclpy"]), run: set(&["rclpy"]), modules: set(&["tf2_py", "rclcpp"]) };
        let keys = ["tf2_ros", "warp", "six", "rclcpp_py"];
        let asked = new_required_keys(&keys, &keys);
        let map = |pairs: &[(&str, &str)]| -> BTreeMap<String, String> {
            pairs.iter().map(|(key, name)| ((*key).to_owned(), (*name).to_owned())).collect()
        };
        let met = map(&[("tf2_ros", "tf2_ros_py"), ("warp", ""), ("six", "python3-six"), ("rclcpp_py", "rclpy")]);
        let resolved = resolve_keys(&lab.archive, &lab.base, &met, &own, &asked, &there).expect("all are met");
        assert_eq!((resolved.build, resolved.run), (set(&["python3-six"]), set(&["python3-six"])));
        let wrong = map(&[("tf2_ros", "tf2_ros_pi"), ("warp", ""), ("six", ""), ("rclcpp_py", "")]);
        let refused = resolve_keys(&lab.archive, &lab.base, &wrong, &own, &asked, &there).expect_err("a slip");
        assert!(refused.to_string().contains("tf2_ros_pi (wanted by --map tf2_ros=tf2_ros_pi)"), "{refused}");
        // A module of the base is enough for those who need no more.
        let asked = RequiredKeys { modules: set(&["tf2_py"]), ..new_required_keys(&["tf2_py"], &["tf2_py"]) };
        resolve_keys(&lab.archive, &lab.base, &map(&[]), &own, &asked, &there).expect("it is there");
        let asked = new_required_keys(&["rclcpp"], &["rclcpp"]);
        resolve_keys(&lab.archive, &lab.base, &map(&[]), &own, &asked, &there).expect_err("headers are needed");
    }

    #[test]
    fn ros_1_of_the_distribution_satisfies_nothing_of_ros_2() {
        let lab = new_ros2_fixture();
        let (own, map) = (BTreeSet::new(), BTreeMap::new());
        let asked = new_required_keys(&["tf", "rclcpp"], &["libtf-dev", "rclcpp"]);
        let error = resolve_keys(&lab.archive, &lab.base, &map, &own, &asked, &IndexedPackages::default())
            .expect_err("nothing of it is there");
        let Error::Unresolved(missing) = &error else { panic!("{error}") };
        let keys: Vec<_> = missing.iter().map(|one| one.key.as_str()).collect();
        assert_eq!(keys, ["libtf-dev", "rclcpp", "tf"]);
        assert!(missing.iter().all(|one| one.similar.is_empty()), "{missing:?}");
        assert!(error.to_string().contains("or push a workspace"), "{error}");
    }

    #[test]
    fn of_many_missing_names_the_first_have_suggestions() {
        let lab = new_ros2_fixture();
        let there = set(&["cv_bridge"]);
        let missing = ('a'..='z').flat_map(|a| ('x'..='z').map(move |b| (format!("cv_bridge{a}{b}"), BTreeSet::new())));
        let error = refuse_missing(&lab.archive, &lab.base, missing.collect(), &there).expect_err("all are missing");
        let Error::Unresolved(missing) = error else { panic!("{error}") };
        assert_eq!(missing.len(), 78);
        let suggested = missing.iter().take_while(|one| one.similar.contains(&"cv_bridge".to_owned()));
        assert_eq!(suggested.count(), MOST_SUGGESTIONS);
        assert!(missing[MOST_SUGGESTIONS..].iter().all(|one| one.similar.is_empty()), "{missing:?}");
    }

    #[test]
    fn a_misspelt_package_of_ros_2_is_suggested() {
        let lab = new_ros2_fixture();
        let there = set(&["cv_bridge", "rclpy"]);
        for (key, expected) in
            [("cv_brigde", &["cv_bridge"][..]), ("nav_mgs", &["nav_msgs"]), ("message_genration", &[])]
        {
            assert_eq!(similar(&lab.archive, &lab.base, key, &there), expected, "{key}");
        }
    }
}
