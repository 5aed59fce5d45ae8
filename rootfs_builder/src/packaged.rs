//! `--apt NAME`: a ROS package that the distribution has compiled already.

use std::collections::{BTreeMap, BTreeSet};

use ros::flavour::Version;
use serde::{Deserialize, Serialize};

use crate::archive::Archive;
use crate::base::Base;
use crate::build::{Build, Parts};
use crate::deb::Member;
use crate::error::Error;
use crate::gather::{self, Wanted};
use crate::imports::Programs;
use crate::install::Made;
use crate::key::Key;
use crate::keys;
use crate::request::{PushRequest, Source};

/// `name`: a ROS package, or a Debian package that holds some.
pub(crate) async fn build(build: &Build<'_>, name: &str) -> Result<Parts, Error> {
    if build.base.ros != Version::Ros1 {
        return of_two(build, name).await;
    }
    let archive = &build.archive;
    let mapped = keys::mapped(archive, &build.base, &build.request.map)?;
    let (mut roots, mut debs) = build.extra_packages().await?;
    let packages: Vec<String> = if !archive.contents.ros_package(name).is_empty() {
        vec![name.to_owned()]
    } else if archive.candidates.contains(name) {
        debs.insert(name.to_owned());
        archive
            .contents
            .ros_packages_in(name)
            .into_iter()
            .map(str::to_owned)
            .collect()
    } else {
        Vec::new()
    };
    if packages.is_empty() && archive.candidates.contains(name) {
        return Err(Error::NotRos {
            name: name.to_owned(),
        });
    }
    if packages.is_empty() {
        let similar = archive.similar(name);
        let hint = if similar.is_empty() {
            String::new()
        } else {
            format!(" (there is {})", similar.join(", "))
        };
        return Err(Error::UnknownPackage {
            name: name.to_owned(),
            suite: build.base.suite.clone(),
            hint,
        });
    }
    roots.extend(packages.iter().cloned());
    build
        .progress
        .step(&format!("looking up what {name} needs"))
        .await;
    let wanted = wanted(build, &roots, true).await?;
    debs.extend(wanted.install);
    debs.extend(mapped);
    let versions = packages.iter();
    let versions = versions.map(|package| (package.clone(), version(build, package)));
    let versions = versions.collect();
    let dependencies = build
        .add("dependencies", &build.on_base(), &debs, wanted.extras)
        .await?;
    Ok(Parts {
        packages,
        versions,
        dependencies,
        package: Made::default(),
        prefix: None,
    })
}

/// Of ROS 2, whose archive has one Debian package for each ROS package, with all that it needs.
async fn of_two(build: &Build<'_>, name: &str) -> Result<Parts, Error> {
    let InArchive { package, deb } = in_archive(&build.archive, &build.base, name)?;
    let (_, mut debs) = build.extra_packages().await?;
    let version = build.archive.candidates.get(&deb);
    debs.insert(deb);
    debs.extend(keys::mapped(
        &build.archive,
        &build.base,
        &build.request.map,
    )?);
    let dependencies = build
        .add("dependencies", &build.on_base(), &debs, Vec::new())
        .await?;
    Ok(Parts {
        versions: BTreeMap::from([(
            package.clone(),
            version.map_or_else(String::new, |deb| deb.version),
        )]),
        packages: vec![package],
        dependencies,
        package: Made::default(),
        prefix: None,
    })
}

/// A ROS package and the Debian package that holds it.
#[derive(Debug, PartialEq)]
struct InArchive {
    package: String,
    deb: String,
}

/// `name` is that of the ROS package, or of the Debian package, with or without what it begins with.
fn in_archive(archive: &Archive, base: &Base, name: &str) -> Result<InArchive, Error> {
    let own = format!("ros-{}-", base.ros_distribution);
    let package = name.strip_prefix(&own).unwrap_or(name).replace('-', "_");
    match keys::deb_of(archive, base, &package) {
        Some(deb) => Ok(InArchive { package, deb }),
        None => Err(Error::NotInRosArchive {
            name: name.to_owned(),
            base: base.name.clone(),
            distribution: base.ros_distribution.clone(),
        }),
    }
}

/// Remembered: it downloads and looks into many packages.
#[derive(Serialize, Deserialize)]
struct Note {
    install: BTreeSet<String>,
    extras: Vec<Member>,
    warnings: Vec<String>,
    unknown: BTreeSet<String>,
}

/// Gathers from these ROS packages.
pub(crate) async fn wanted(
    build: &Build<'_>,
    roots: &BTreeSet<String>,
    python: bool,
) -> Result<Wanted, Error> {
    if roots.is_empty() {
        return Ok(Wanted::default());
    }
    let keys = serde_json::to_string(&build.base.keys).unwrap_or_default();
    let programs = programs(build.request);
    let key = Key::new("gathered with imports")
        .with("archive", &build.archive.stamp)
        .with("keys", keys)
        .with_all("ignore", &build.base.ros_packages.ignore)
        .with("python", [u8::from(python)])
        .with("programs", format!("{programs:?}"))
        .with_all("root", roots)
        .finish();
    let note: Note = match build.shop.layers.note(&key) {
        Some(note) => note,
        None => {
            let found = gather::gather(
                &build.archive,
                &build.base,
                roots,
                python,
                &programs,
                build.progress,
            )
            .await?;
            let note = Note {
                install: found.install,
                extras: found.extras,
                warnings: found.warnings,
                unknown: found.unknown,
            };
            build.shop.layers.keep_note(&key, &note)?;
            note
        }
    };
    for warning in &note.warnings {
        build.progress.warn(warning.as_str()).await;
    }
    for name in &note.unknown {
        if !build.request.map.contains_key(name) {
            let text = format!(
                "package.xml asks for {name}, which nothing provides; name its Debian package with `--map {name}=DEB`"
            );
            build.progress.warn(text).await;
        }
    }
    Ok(Wanted {
        install: note.install,
        extras: note.extras,
        warnings: note.warnings,
        unknown: note.unknown,
    })
}

/// Programs of packages of the archive that a push runs, as far as it is known before.
fn programs(request: &PushRequest) -> Programs {
    if let (Source::Packaged(_), Some(_)) = (&request.source, &request.launch) {
        return Programs::All;
    }
    // `PACKAGE/PROGRAM ARGUMENTS`
    let names = request.nodes.iter().filter_map(|node| {
        let path = node.split_whitespace().next()?;
        Some(path.rsplit('/').next().unwrap_or(path).to_owned())
    });
    Programs::Named(names.collect())
}

/// The archive's version of the Debian package that holds a ROS package's programs, or its package.xml.
fn version(build: &Build<'_>, package: &str) -> String {
    let carriers = build.archive.contents.ros_package(package);
    let deb = carriers
        .keys()
        .find(|deb| !deb.ends_with("-dev"))
        .or(carriers.keys().next());
    deb.and_then(|deb| build.archive.candidates.get(deb))
        .map_or_else(String::new, |deb| deb.version)
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
            candidates: crate::candidates::tests::named(&[
                "ros-jazzy-demo-nodes-py",
                "ros-humble-turtlesim",
                "python3-six",
            ]),
            stamp: String::new(),
            sources: String::new(),
        };
        let images = Path::new(env!("CARGO_MANIFEST_DIR")).join("../images");
        let base = crate::base::load(&images, "noble-jazzy").expect("valid");
        for name in ["demo_nodes_py", "demo-nodes-py", "ros-jazzy-demo-nodes-py"] {
            let found = in_archive(&archive, &base, name);
            let expected = InArchive {
                package: "demo_nodes_py".to_owned(),
                deb: "ros-jazzy-demo-nodes-py".to_owned(),
            };
            assert_eq!(found.expect("it is there"), expected, "{name}");
        }
        // Of another distribution, of no ROS, and of nobody.
        for name in ["turtlesim", "ros-humble-turtlesim", "python3-six", "frob"] {
            let refused = in_archive(&archive, &base, name).expect_err("it is not there");
            let refused = refused.to_string();
            assert!(
                refused.contains(name) && refused.contains("noble-jazzy"),
                "{refused}"
            );
        }
    }
}
