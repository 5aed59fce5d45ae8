//! `--apt NAME`: a ROS package that the distribution has compiled already.

use std::collections::{BTreeMap, BTreeSet};

use ros::flavour::Version;
use serde::{Deserialize, Serialize};

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
    debs.extend(
        build
            .request
            .map
            .values()
            .flat_map(|debs| debs.split([',', ' ']))
            .map(str::to_owned),
    );
    debs.remove("");
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
    let (archive, base) = (&build.archive, &build.base);
    let own = format!("ros-{}-", base.ros_distribution);
    let plain = name.strip_prefix(&own).unwrap_or(name).replace('-', "_");
    let Some(deb) = keys::deb_of(archive, base, &plain) else {
        return Err(Error::NotInRosArchive {
            name: name.to_owned(),
            base: base.name.clone(),
            distribution: base.ros_distribution.clone(),
        });
    };
    let (_, mut debs) = build.extra_packages().await?;
    let version = archive.candidates.get(&deb);
    debs.insert(deb);
    let mapped = build.request.map.values();
    let mapped = mapped.flat_map(|debs| debs.split([',', ' ']));
    debs.extend(mapped.filter(|deb| !deb.is_empty()).map(str::to_owned));
    let dependencies = build
        .add("dependencies", &build.on_base(), &debs, Vec::new())
        .await?;
    Ok(Parts {
        versions: BTreeMap::from([(
            plain.clone(),
            version.map_or_else(String::new, |deb| deb.version),
        )]),
        packages: vec![plain],
        dependencies,
        package: Made::default(),
        prefix: None,
    })
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
