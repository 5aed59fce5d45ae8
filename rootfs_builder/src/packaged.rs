//! `--apt NAME`: a ROS package that is already compiled in the distribution.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use crate::archive::Archive;
use crate::base::Base;
use crate::build::{Build, BuildParts};
use crate::deb::DebMember;
use crate::error::Error;
use crate::gather::{self, GatheredPackages};
use crate::imports::SelectedPrograms;
use crate::install::LayerSet;
use crate::key::Key;
use crate::keys;
use crate::request::{PushRequest, PushSource};

/// Builds from `name`: a ROS package, or a Debian package that contains some.
pub(crate) async fn build(build: &Build<'_>, name: &str) -> Result<BuildParts, Error> {
    if !build.base.has_distributions_ros() {
        return build_in_space(build, name).await;
    }
    let archive = &build.archive;
    let mapped = keys::mapped_packages(archive, &build.base, &build.request.map)?;
    let (mut roots, mut debs) = build.extra_packages().await?;
    let packages: Vec<String> = if !archive.contents.ros_package(name).is_empty() {
        vec![name.to_owned()]
    } else if archive.candidates.contains(name) {
        debs.insert(name.to_owned());
        archive.contents.ros_packages_in(name).into_iter().map(str::to_owned).collect()
    } else {
        Vec::new()
    };
    if packages.is_empty() && archive.candidates.contains(name) {
        return Err(Error::NotRos { name: name.to_owned() });
    }
    if packages.is_empty() {
        let similar = archive.similar(name);
        let hint = if similar.is_empty() { String::new() } else { format!("; did you mean {}?", similar.join(", ")) };
        return Err(Error::UnknownPackage { name: name.to_owned(), suite: build.base.suite.clone(), hint });
    }
    roots.extend(packages.iter().cloned());
    build.progress.step(&format!("looking up the dependencies of {name}")).await;
    let wanted = gather_wanted(build, &roots, true).await?;
    debs.extend(wanted.install);
    debs.extend(mapped);
    let versions = packages.iter();
    let versions = versions.map(|package| (package.clone(), archive_version(build, package)));
    let versions = versions.collect();
    let dependencies = build.add_packages("dependencies", &build.base_diff_ids(), &debs, wanted.extras).await?;
    Ok(BuildParts { packages, versions, dependencies, package: LayerSet::default(), prefix: None, contents: None })
}

/// Builds on a base with install spaces: from a package in one of them, which an image may have brought, or else from
/// ROS's archive, which has a Debian package with all dependencies for each ROS package.
async fn build_in_space(build: &Build<'_>, name: &str) -> Result<BuildParts, Error> {
    let (_, mut debs) = build.extra_packages().await?;
    debs.extend(keys::mapped_packages(&build.archive, &build.base, &build.request.map)?);
    let there = build.indexed_packages(&build.base_diff_ids()).await?;
    let (package, version) = if there.contains(name) {
        let image = build.base.image.as_ref();
        (name.to_owned(), image.and_then(|image| image.ros.get(name).cloned()).unwrap_or_default())
    } else {
        let ArchivePackage { package, deb } = find_in_archive(&build.archive, &build.base, name)?;
        let version = build.archive.candidates.get(&deb).map_or_else(String::new, |deb| deb.version);
        debs.insert(deb);
        (package, version)
    };
    let dependencies = build.add_packages("dependencies", &build.base_diff_ids(), &debs, Vec::new()).await?;
    Ok(BuildParts {
        versions: BTreeMap::from([(package.clone(), version)]),
        packages: vec![package],
        dependencies,
        package: LayerSet::default(),
        prefix: None,
        contents: None,
    })
}

/// A ROS package and the Debian package that contains it.
#[derive(Debug, PartialEq)]
struct ArchivePackage {
    package: String,
    deb: String,
}

/// Finds a package by the name of the ROS package, or of the Debian package with or without its prefix.
fn find_in_archive(archive: &Archive, base: &Base, name: &str) -> Result<ArchivePackage, Error> {
    let own = format!("ros-{}-", base.ros_distribution);
    let package = name.strip_prefix(&own).unwrap_or(name).replace('-', "_");
    match keys::find_ros_deb(archive, base, &package) {
        Some(deb) => Ok(ArchivePackage { package, deb }),
        None => Err(Error::NotInRosArchive {
            name: name.to_owned(),
            base: base.name.clone(),
            distribution: base.ros_distribution.clone(),
        }),
    }
}

/// Cached result: gathering downloads and inspects many packages.
#[derive(Serialize, Deserialize)]
struct GatherNote {
    install: BTreeSet<String>,
    extras: Vec<DebMember>,
    warnings: Vec<String>,
    unknown: BTreeSet<String>,
}

/// Gathers from ROS packages, with caching.
pub(crate) async fn gather_wanted(
    build: &Build<'_>,
    roots: &BTreeSet<String>,
    python: bool,
) -> Result<GatheredPackages, Error> {
    if roots.is_empty() {
        return Ok(GatheredPackages::default());
    }
    let keys = serde_json::to_string(&build.base.keys).unwrap_or_default();
    let programs = selected_programs(build.request);
    let key = Key::new("gathered with imports")
        .input("archive", &build.archive.stamp)
        .input("keys", keys)
        .inputs("ignore", &build.base.ros_packages.ignore)
        .input("python", [u8::from(python)])
        .input("programs", format!("{programs:?}"))
        .inputs("root", roots)
        .finish();
    let note: GatherNote = match build.shop.layers.read_note(&key) {
        Some(note) => note,
        None => {
            let found =
                gather::gather_packages(&build.archive, &build.base, roots, python, &programs, build.progress).await?;
            let note = GatherNote {
                install: found.install,
                extras: found.extras,
                warnings: found.warnings,
                unknown: found.unknown,
            };
            build.shop.layers.write_note(&key, &note)?;
            note
        }
    };
    for warning in &note.warnings {
        build.progress.warn(warning.as_str()).await;
    }
    for name in &note.unknown {
        if !build.request.map.contains_key(name) {
            let text = format!(
                "package.xml needs {name}, which no known package provides; name its Debian package with `--map \
                    {name}=DEB`"
            );
            build.progress.warn(text).await;
        }
    }
    Ok(GatheredPackages { install: note.install, extras: note.extras, warnings: note.warnings, unknown: note.unknown })
}

/// Returns the programs of the archive's packages that a push runs, as far as known in advance.
fn selected_programs(request: &PushRequest) -> SelectedPrograms {
    if let (PushSource::Packaged(_), Some(_)) = (&request.source, &request.launch) {
        return SelectedPrograms::All;
    }
    // `PACKAGE/PROGRAM ARGUMENTS`
    let names = request.nodes.iter().filter_map(|node| {
        let path = node.split_whitespace().next()?;
        Some(path.rsplit('/').next().unwrap_or(path).to_owned())
    });
    SelectedPrograms::Named(names.collect())
}

/// Returns the version of the Debian package that contains a ROS package's programs or its package.xml.
fn archive_version(build: &Build<'_>, package: &str) -> String {
    let carriers = build.archive.contents.ros_package(package);
    let deb = carriers.keys().find(|deb| !deb.ends_with("-dev")).or(carriers.keys().next());
    deb.and_then(|deb| build.archive.candidates.get(deb)).map_or_else(String::new, |deb| deb.version)
}

#[cfg(test)]
mod tests {
    use std::path::Path;
    use std::sync::Arc;

    use super::*;
    use crate::contents::{Contents, tests::list};

    #[test]
    fn packages_of_an_archive_of_ros_2_are_known_by_each_of_their_names() {
        let directory = tempfile::tempdir().expect("a directory");
        let lists = [list(directory.path(), "c.gz", "")];
        let archive = Archive {
            apt: crate::apt::Apt::open(directory.path(), "").expect("prepared"),
            contents: Arc::new(Contents::open(directory.path(), &lists).expect("read")),
            candidates: crate::candidates::tests::candidates_named(&[
                "ros-jazzy-demo-nodes-py",
                "ros-humble-turtlesim",
                "python3-six",
            ]),
            stamp: String::new(),
            sources: String::new(),
        };
        let images = Path::new(env!("CARGO_MANIFEST_DIR")).join("../images");
        let base = crate::base::load(&images, "bookworm-jazzy-wheels").expect("valid");
        for name in ["demo_nodes_py", "demo-nodes-py", "ros-jazzy-demo-nodes-py"] {
            let found = find_in_archive(&archive, &base, name);
            let expected =
                ArchivePackage { package: "demo_nodes_py".to_owned(), deb: "ros-jazzy-demo-nodes-py".to_owned() };
            assert_eq!(found.expect("it is there"), expected, "{name}");
        }
        // Of another distribution, without ROS packages, and unknown.
        for name in ["turtlesim", "ros-humble-turtlesim", "python3-six", "frob"] {
            let refused = find_in_archive(&archive, &base, name).expect_err("it is not there");
            let refused = refused.to_string();
            assert!(refused.contains(name) && refused.contains("bookworm-jazzy-wheels"), "{refused}");
        }
    }
}
