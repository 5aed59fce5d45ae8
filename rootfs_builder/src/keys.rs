//! From the names in a package.xml (rosdep keys and ROS packages) to Debian packages.
//!
//! In this order: what the deployer said (`--map`), what is in the same workspace, the base's table, ROS packages of
//! the archive, a Debian package of that very name.

use std::collections::{BTreeMap, BTreeSet};

use crate::archive::Archive;
use crate::base::Base;
use crate::error::{Error, Unresolved};

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
}

enum Found {
    Debs(Vec<String>),
    Ros,
    Nothing,
}

/// Resolves all keys, or names all that nothing provides. `own`: packages of the workspace itself.
pub(crate) fn resolve(
    archive: &Archive,
    base: &Base,
    map: &BTreeMap<String, String>,
    own: &BTreeSet<String>,
    asked: &Needed,
) -> Result<Resolved, Error> {
    let find = |key: &str| -> Found {
        if let Some(deb) = map.get(key) {
            return Found::Debs(
                deb.split([',', ' '])
                    .filter(|deb| !deb.is_empty())
                    .map(str::to_owned)
                    .collect(),
            );
        }
        if let Some(debs) = base.keys.get(key) {
            return Found::Debs(debs.clone());
        }
        if !archive.contents.ros_package(key).is_empty() {
            return Found::Ros;
        }
        if archive.candidates.contains(key) {
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
        match find(key) {
            Found::Debs(debs) => resolved.build.extend(debs),
            Found::Ros => resolved.build.extend(archive.to_build(key)),
            Found::Nothing if base.ros_packages.ignore.contains(key) => {}
            Found::Nothing => miss(key, by),
        }
    }
    for (key, by) in asked.run.iter().filter(|(key, _)| !own.contains(*key)) {
        match find(key) {
            // What is linked from a development package is found by what the result needs.
            Found::Debs(debs) => resolved
                .run
                .extend(debs.into_iter().filter(|deb| !deb.ends_with("-dev"))),
            Found::Ros if base.ros_packages.ignore.contains(key) => {}
            Found::Ros => {
                resolved.run_ros.insert(key.clone());
            }
            Found::Nothing if base.ros_packages.ignore.contains(key) => {}
            Found::Nothing => miss(key, by),
        }
    }
    // What the deployer wrote may be wrong as well.
    for (key, debs) in map {
        for deb in debs
            .split([',', ' '])
            .filter(|deb| !deb.is_empty() && !archive.candidates.contains(deb))
        {
            missing
                .entry(deb.to_owned())
                .or_default()
                .insert(format!("--map {key}={debs}"));
        }
    }
    if missing.is_empty() {
        return Ok(resolved);
    }
    Err(Error::Unresolved(
        missing
            .into_iter()
            .map(|(key, by)| Unresolved {
                similar: archive.similar(&key),
                wanted_by: by.into_iter().collect(),
                key,
            })
            .collect(),
    ))
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
        let resolved =
            resolve(&lab.archive, &lab.base, &map, &set(&["app_msgs"]), &asked).expect("all known");
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
    fn all_that_nothing_provides_is_named_at_once() {
        let lab = lab();
        let map = BTreeMap::from([("frob".to_owned(), "libfrob9".to_owned())]);
        let asked = asked(&["warp", "frob"], &["flux", "tf"]);
        let error = resolve(&lab.archive, &lab.base, &map, &BTreeSet::new(), &asked)
            .expect_err("two are missing");
        let Error::Unresolved(missing) = error else {
            panic!("{error}")
        };
        let keys: Vec<_> = missing.iter().map(|one| one.key.as_str()).collect();
        assert_eq!(keys, ["flux", "libfrob9", "warp"]);
        assert_eq!(missing[1].wanted_by, ["--map frob=libfrob9"]);
        assert_eq!(missing[0].wanted_by, ["app"]);
    }
}
