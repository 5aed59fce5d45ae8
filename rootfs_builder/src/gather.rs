//! All that a packaged ROS package needs to run, found by what it says of itself.
//!
//! Debian's own dependencies are not the whole story: a ROS package is cut into several Debian packages that do not
//! depend on each other, plugin lists and launch files are in development packages, and libraries that are loaded
//! by name at run time are nobody's dependency. So, starting from some ROS packages, three rules until nothing new
//! comes:
//!
//! 1. Every Debian package that holds a part of a ROS package is wanted: to be installed, or, if it is a development
//!    package, to give its files without its dependencies.
//! 2. Every ROS package that a `package.xml` so found names as an exec dependency is wanted, too, the less of it the
//!    further away it is (see [`Depth`]).
//! 3. Every library that a plugin list so found names is wanted, too.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use crate::archive::{Archive, Depth};
use crate::base::Base;
use crate::contents::Part;
use crate::deb::{self, Content, Member};
use crate::error::Error;
use crate::event::Progress;
use crate::manifest;

/// What is wanted.
#[derive(Debug, Default, Clone, PartialEq)]
pub(crate) struct Wanted {
    /// Debian packages, to be installed with their dependencies.
    pub(crate) install: BTreeSet<String>,
    /// Files of development packages.
    pub(crate) extras: Vec<Member>,
    /// Things to know.
    pub(crate) warnings: Vec<String>,
}

/// Walks from `roots` (ROS packages). `python`: whether the roots' Python modules are wanted.
pub(crate) async fn gather(
    archive: &Archive,
    base: &Base,
    roots: &BTreeSet<String>,
    python: bool,
    progress: &Progress,
) -> Result<Wanted, Error> {
    let mut wanted = Wanted::default();
    let (mut seen, mut looked_into) = (BTreeSet::new(), BTreeSet::new());
    let mut next = roots.clone();
    let mut depth = Depth::Itself { python };
    while !next.is_empty() {
        // All of one depth in one go: one call of apt, not one for each.
        let mut round = BTreeSet::new();
        for name in std::mem::take(&mut next) {
            let ignored = base.ros_packages.ignore.contains(&name) && !roots.contains(&name);
            if ignored || !seen.insert(name.clone()) {
                continue;
            }
            let carried = archive.to_run(&name, depth);
            wanted.install.extend(carried.install);
            if depth != Depth::Beyond {
                let tells = archive.contents.ros_package(&name).into_iter();
                let tells = tells.filter(|(_, parts)| {
                    parts.contains(&Part::Manifest) || parts.contains(&Part::Share)
                });
                round.extend(tells.map(|(deb, _)| deb));
                round.extend(carried.unpack);
            }
        }
        round.retain(|deb| looked_into.insert(deb.clone()));
        let debs = archive.apt.candidates(&round).await?;
        let files = archive.apt.download(&debs, progress).await?;
        for (deb, file) in debs.iter().zip(files) {
            let members =
                crate::blocking::spawn(move || deb::members(&file, deb::wanted_of_development))
                    .await??;
            let told = tell(&members, base);
            next.extend(told.ros_packages);
            wanted.warnings.extend(told.warnings);
            for library in told.plugins {
                want_plugin(archive, &library, &members, &mut wanted);
            }
            if deb.name.ends_with("-dev") {
                wanted.extras.extend(members);
            }
        }
        depth = match depth {
            Depth::Itself { .. } => Depth::Needed,
            Depth::Needed | Depth::Beyond => Depth::Beyond,
        };
    }
    wanted.extras.sort_by(|a, b| a.path.cmp(&b.path));
    wanted
        .extras
        .dedup_by(|later, first| later.path == first.path);
    // Names of libraries that do not become present would be links to nothing.
    let plugin_targets = wanted.install.clone();
    wanted.extras.retain(|member| match &member.content {
        Content::File(_) => true,
        Content::Link(target) => target
            .file_name()
            .and_then(|name| archive.contents.library(&name.to_string_lossy()))
            .is_some_and(|deb| plugin_targets.contains(deb)),
    });
    Ok(wanted)
}

/// What the package.xml files and plugin lists among these members say.
#[derive(Debug, Default, PartialEq)]
struct Told {
    ros_packages: BTreeSet<String>,
    /// `libx.so` of the plugin lists.
    plugins: BTreeSet<String>,
    warnings: Vec<String>,
}

fn tell(members: &[Member], base: &Base) -> Told {
    let mut told = Told::default();
    let texts: BTreeMap<&Path, &[u8]> = members
        .iter()
        .filter_map(|member| match &member.content {
            Content::File(bytes) => Some((member.path.as_path(), bytes.as_slice())),
            Content::Link(_) => None,
        })
        .collect();
    for (path, bytes) in &texts {
        let Ok(text) = std::str::from_utf8(bytes) else {
            continue;
        };
        if path.file_name().is_some_and(|name| name == "package.xml")
            && path.components().count() == 4
        {
            match manifest::run_dependencies(text, path, base) {
                Ok(names) => told.ros_packages.extend(names),
                Err(problem) => told.warnings.push(format!("in the archive: {problem}")),
            }
        } else if path.extension().is_some_and(|extension| extension == "xml") {
            // A plugin list may be exported by a package.xml of another Debian package; they all look alike.
            told.plugins.extend(manifest::plugin_libraries(text));
        }
    }
    told
}

/// A plugin list names `libx`; the file with that name is a link in a development package to `libx.so.1`, which is
/// in another one.
fn want_plugin(archive: &Archive, library: &str, members: &[Member], wanted: &mut Wanted) {
    let link = members
        .iter()
        .find(|member| member.path.file_name().is_some_and(|name| name == library));
    let target: Option<PathBuf> = link.and_then(|member| match &member.content {
        Content::Link(target) => Some(target.clone()),
        Content::File(_) => None,
    });
    let name = target
        .as_deref()
        .and_then(Path::file_name)
        .map_or(library.into(), |name| name.to_string_lossy());
    match archive.contents.library(&name) {
        Some(deb) if !deb.ends_with("-dev") => {
            wanted.install.insert(deb.to_owned());
        }
        _ => wanted
            .warnings
            .push(format!("no package holds the plugin library {name}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(path: &str, text: &str) -> Member {
        Member {
            path: path.into(),
            mode: 0o644,
            mtime: 0,
            content: Content::File(text.into()),
        }
    }

    #[test]
    fn manifests_and_plugin_lists_are_heard() {
        let images = Path::new(env!("CARGO_MANIFEST_DIR")).join("../images");
        let base = crate::base::load(&images, crate::DEFAULT_BASE).expect("valid");
        let members = [
            file(
                "usr/share/x/package.xml",
                "<package><name>x</name><version>1.0.0</version><description>d</description>\
                 <maintainer email=\"a@b.invalid\">m</maintainer><license>l</license>\
                 <run_depend>nodelet</run_depend><build_depend>rostest</build_depend></package>",
            ),
            file(
                "usr/share/x/nodelet_plugins.xml",
                "<library path=\"lib/libx_nodelets\"><class/></library>",
            ),
            file("usr/share/x/launch/other.xml", "<launch/>"),
        ];
        let told = tell(&members, &base);
        assert!(
            told.ros_packages.contains("nodelet") && !told.ros_packages.contains("rostest"),
            "{told:?}"
        );
        assert_eq!(told.plugins, ["libx_nodelets.so".to_owned()].into());
    }
}
