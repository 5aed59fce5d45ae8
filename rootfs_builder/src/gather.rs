//! Gathers everything that a packaged ROS package needs to run, based on its own metadata.
//!
//! Debian's dependencies are not sufficient: a ROS package is split into several Debian packages that do not depend on
//! each other, plugin lists and launch files are in development packages, and libraries loaded by name at run time are
//! not declared as dependencies. So, starting from some ROS packages, these rules are applied until nothing new is
//! found:
//!
//! 1. Every Debian package that contains a part of a ROS package is needed: installed or, if it is a development
//!    package, unpacked for its files without its dependencies.
//! 2. Every ROS package that a `package.xml` found this way names as an exec dependency is needed, with fewer parts the
//!    further away it is (see [`DependencyDepth`]).
//! 3. Every library named in a plugin list found this way is needed.
//! 4. Every Python module imported by selected programs, and by modules of the requested ROS packages, is needed.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use futures_util::{StreamExt, stream};

use crate::archive::{Archive, DependencyDepth};
use crate::base::Base;
use crate::contents::RosPackagePart;
use crate::deb::{self, DebMember, MemberContent};
use crate::debian_package::Deb;
use crate::error::Error;
use crate::event::Progress;
use crate::imports::{self, SelectedPrograms};
use crate::manifest::{self, PluginLibrary};

/// Number of packages that are unpacked concurrently, each by separate processes.
const AT_ONCE: usize = 4;

/// Packages and files to add.
#[derive(Debug, Default, Clone, PartialEq)]
pub(crate) struct GatheredPackages {
    /// Debian packages to install with their dependencies.
    pub(crate) install: BTreeSet<String>,
    /// Files of development packages.
    pub(crate) extras: Vec<DebMember>,
    /// Warnings for the deployer.
    pub(crate) warnings: Vec<String>,
    /// Dependencies in a package.xml that nothing provides.
    pub(crate) unknown: BTreeSet<String>,
}

/// Gathers from `roots` (ROS packages). `python` is whether the Python modules of the roots are needed, `programs`
/// which of their programs may be run.
pub(crate) async fn gather_packages(
    archive: &Archive,
    base: &Base,
    roots: &BTreeSet<String>,
    python: bool,
    programs: &SelectedPrograms,
    progress: &Progress,
) -> Result<GatheredPackages, Error> {
    let mut wanted = GatheredPackages::default();
    let (mut seen, mut looked_into) = (BTreeSet::new(), BTreeSet::new());
    let mut next = roots.clone();
    let mut importing = BTreeSet::new();
    let mut depth = DependencyDepth::Itself { python };
    while !next.is_empty() {
        // All packages of the same depth together: one call of apt instead of one for each.
        let mut round = BTreeSet::new();
        for name in std::mem::take(&mut next) {
            let ignored = base.ros_packages.ignore.contains(&name) && !roots.contains(&name);
            if ignored || !seen.insert(name.clone()) {
                continue;
            }
            let carried = archive.runtime_packages(&name, depth);
            if let DependencyDepth::Itself { python } = depth {
                let carriers = archive.contents.ros_package(&name);
                let imports = |deb: &&String| {
                    carriers.get(*deb).is_some_and(|parts| {
                        parts.contains(&RosPackagePart::Programs) || python && parts.contains(&RosPackagePart::Python)
                    })
                };
                importing.extend(carried.install.iter().filter(imports).cloned());
            }
            wanted.install.extend(carried.install);
            if depth != DependencyDepth::Beyond {
                let tells = archive.contents.ros_package(&name).into_iter();
                let tells = tells.filter(|(_, parts)| {
                    parts.contains(&RosPackagePart::Manifest) || parts.contains(&RosPackagePart::Share)
                });
                round.extend(tells.map(|(deb, _)| deb));
                round.extend(carried.unpack);
            }
        }
        round.retain(|deb| looked_into.insert(deb.clone()));
        let debs: Vec<Deb> = round.iter().filter_map(|name| archive.candidates.get(name)).collect();
        let of_round = inspect_each(archive, &debs, progress, deb::runtime_members).await?;
        for (deb, members) in debs.iter().zip(of_round) {
            let report = report_members(&members, base);
            let itself = matches!(depth, DependencyDepth::Itself { .. });
            for name in report.needed {
                match find_provider(archive, base, &name) {
                    NameProvider::Ros => {
                        next.insert(name);
                    }
                    // Further away, Debian's dependencies are relied on.
                    NameProvider::Debs(debs) if itself => wanted.install.extend(debs),
                    NameProvider::Nothing if itself => {
                        wanted.unknown.insert(name);
                    }
                    NameProvider::Debs(_) | NameProvider::Nothing => {}
                }
            }
            wanted.warnings.extend(report.warnings);
            for library in report.plugins {
                add_plugin_library(archive, &library, &members, &mut wanted);
            }
            if deb.name.ends_with("-dev") {
                wanted.extras.extend(members);
            }
        }
        depth = match depth {
            DependencyDepth::Itself { .. } => DependencyDepth::Needed,
            DependencyDepth::Needed | DependencyDepth::Beyond => DependencyDepth::Beyond,
        };
    }
    wanted.install.extend(imported_packages(archive, &importing, programs, progress).await?);
    wanted.extras.sort_by(|a, b| a.path.cmp(&b.path));
    wanted.extras.dedup_by(|later, first| later.path == first.path);
    // Library links whose target is not installed would be dangling.
    let plugin_targets = wanted.install.clone();
    wanted.extras.retain(|member| match &member.content {
        MemberContent::File(_) => true,
        MemberContent::Link(target) => target
            .file_name()
            .and_then(|name| archive.contents.library(&name.to_string_lossy()))
            .is_some_and(|deb| plugin_targets.contains(deb)),
    });
    Ok(wanted)
}

/// Downloads packages and inspects several concurrently; `look` gets the package's file and the cache directory for its
/// results.
async fn inspect_each<T: Send + 'static>(
    archive: &Archive,
    debs: &[Deb],
    progress: &Progress,
    look: fn(&Path, &Path) -> Result<T, Error>,
) -> Result<Vec<T>, Error> {
    let files = archive.apt.download(debs, progress).await?;
    let kept = archive.apt.root().to_owned();
    let looked = stream::iter(files).map(|file| {
        let kept = kept.clone();
        crate::blocking::spawn(move || look(&file, &kept))
    });
    let mut looked = looked.buffered(AT_ONCE);
    let mut found = Vec::with_capacity(debs.len());
    while let Some(of_one) = looked.next().await {
        found.push(of_one??);
    }
    Ok(found)
}

/// Returns the Debian packages that provide what Python files of the given ones import.
async fn imported_packages(
    archive: &Archive,
    importing: &BTreeSet<String>,
    programs: &SelectedPrograms,
    progress: &Progress,
) -> Result<BTreeSet<String>, Error> {
    let debs: Vec<Deb> = importing.iter().filter_map(|name| archive.candidates.get(name)).collect();
    let found = inspect_each(archive, &debs, progress, imports::read_imports).await?;
    let modules: BTreeSet<String> = found.into_iter().flat_map(|imports| imports.for_programs(programs)).collect();
    let debs = modules.iter().filter_map(|module| imports::provider_package(archive, module));
    Ok(debs.map(str::to_owned).collect())
}

/// Provider of the name in an exec dependency.
#[derive(Debug, PartialEq)]
enum NameProvider {
    Ros,
    Debs(Vec<String>),
    Nothing,
}

/// Finds the provider of a name: a ROS package, a rosdep key, or a Debian package of that name. Development packages
/// are not used at run time.
fn find_provider(archive: &Archive, base: &Base, name: &str) -> NameProvider {
    if !archive.contents.ros_package(name).is_empty() || base.ros_packages.ignore.contains(name) {
        return NameProvider::Ros;
    }
    let debs = match base.keys.get(name) {
        Some(debs) => debs.clone(),
        None if archive.candidates.contains(name) => vec![name.to_owned()],
        None => return NameProvider::Nothing,
    };
    NameProvider::Debs(debs.into_iter().filter(|deb| !deb.ends_with("-dev")).collect())
}

/// Content of the package.xml files and plugin lists among some members.
#[derive(Debug, Default, PartialEq)]
struct MemberReport {
    /// ROS packages and rosdep keys.
    needed: BTreeSet<String>,
    plugins: BTreeSet<PluginLibrary>,
    warnings: Vec<String>,
}

fn report_members(members: &[DebMember], base: &Base) -> MemberReport {
    let mut report = MemberReport::default();
    let texts: BTreeMap<&Path, &[u8]> = members
        .iter()
        .filter_map(|member| match &member.content {
            MemberContent::File(bytes) => Some((member.path.as_path(), bytes.as_slice())),
            MemberContent::Link(_) => None,
        })
        .collect();
    for (path, bytes) in &texts {
        let Ok(text) = std::str::from_utf8(bytes) else {
            continue;
        };
        if path.file_name().is_some_and(|name| name == "package.xml") && path.components().count() == 4 {
            match manifest::run_dependencies(text, path, base) {
                Ok(names) => report.needed.extend(names),
                Err(problem) => report.warnings.push(format!("in the archive: {problem}")),
            }
        } else if path.extension().is_some_and(|extension| extension == "xml") {
            // A plugin list may be exported by a package.xml of another Debian package; all have the same format.
            report.plugins.extend(manifest::plugin_libraries(text));
        }
    }
    report
}

/// Adds the library of a plugin list. The list names `libx`; the file with that name is a link in a development package
/// to `libx.so.1`, which is in another package. If the list states `lib/libx`, pluginlib looks in `/usr/lib` and not in
/// Debian's library directory; this works on other distributions but fails here, so a link is added.
fn add_plugin_library(
    archive: &Archive,
    library: &PluginLibrary,
    members: &[DebMember],
    wanted: &mut GatheredPackages,
) {
    let link = members.iter().find(|member| member.path.file_name().is_some_and(|name| name == library.name.as_str()));
    let target: Option<PathBuf> = link.and_then(|member| match &member.content {
        MemberContent::Link(target) => Some(target.clone()),
        MemberContent::File(_) => None,
    });
    let linked = target.as_deref().and_then(Path::file_name);
    let mut name = linked.map_or(library.name.clone(), |name| name.to_string_lossy().into_owned());
    let mut deb = archive.contents.library(&name);
    if deb.is_none_or(|deb| deb.ends_with("-dev"))
        && let Some((version, of)) = archive.contents.library_versions(&library.name).first()
    {
        // The list and the link are in different packages.
        (name, deb) = (version.clone(), Some(*of));
    }
    let Some(deb) = deb.filter(|deb| !deb.ends_with("-dev")) else {
        let text = format!("no package holds the plugin library {name}");
        return wanted.warnings.push(text);
    };
    wanted.install.insert(deb.to_owned());
    let triplet = crate::contents::triplet();
    let mut link = |directory: &str, target: String| {
        wanted.extras.push(DebMember {
            path: Path::new(directory).join(&library.name),
            mode: 0o777,
            mtime: 0,
            content: MemberContent::Link(target.into()),
        });
    };
    if library.in_directory {
        link("usr/lib", format!("{triplet}/{name}"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(path: &str, text: &str) -> DebMember {
        DebMember { path: path.into(), mode: 0o644, mtime: 0, content: MemberContent::File(text.into()) }
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
            file("usr/share/x/nodelet_plugins.xml", "<library path=\"lib/libx_nodelets\"><class/></library>"),
            file("usr/share/x/launch/other.xml", "<launch/>"),
        ];
        let report = report_members(&members, &base);
        assert!(report.needed.contains("nodelet") && !report.needed.contains("rostest"), "{report:?}");
        let plugin = PluginLibrary { name: "libx_nodelets.so".to_owned(), in_directory: true };
        assert_eq!(report.plugins, [plugin].into());
    }

    fn archive(directory: &Path, contents: &str, names: &[&str]) -> Archive {
        let lists = [crate::contents::tests::list(directory, "c.gz", contents)];
        let contents = crate::contents::Contents::open(directory, &lists).expect("read");
        Archive {
            apt: crate::apt::Apt::open(directory, "").expect("prepared"),
            contents: std::sync::Arc::new(contents),
            candidates: crate::candidates::tests::candidates_named(names),
            stamp: String::new(),
            sources: String::new(),
        }
    }

    #[test]
    fn a_plugin_library_is_found_where_its_list_says_a_directory() {
        let directory = tempfile::tempdir().expect("a directory");
        let triplet = crate::contents::triplet();
        let text = format!(
            "usr/lib/{triplet}/libpcl_ros_filters.so libdevel/libpcl-ros-dev\n\
             usr/lib/{triplet}/libpcl_ros_filters.so.0d libs/libpcl-ros-filters0d\n\
             usr/lib/{triplet}/libpcl_ros_filters.so.1.7.5 libs/libpcl-ros-filters0d\n"
        );
        let archive = archive(directory.path(), &text, &[]);
        for in_directory in [false, true] {
            let library = PluginLibrary { name: "libpcl_ros_filters.so".to_owned(), in_directory };
            let mut wanted = GatheredPackages::default();
            add_plugin_library(&archive, &library, &[], &mut wanted);
            assert_eq!(wanted.install, ["libpcl-ros-filters0d".to_owned()].into());
            assert!(wanted.warnings.is_empty(), "{wanted:?}");
            let links: Vec<_> = wanted.extras.iter().map(|member| (&member.path, &member.content)).collect();
            let path = PathBuf::from("usr/lib/libpcl_ros_filters.so");
            let content = MemberContent::Link(format!("{triplet}/libpcl_ros_filters.so.0d").into());
            let expected = if in_directory { vec![(&path, &content)] } else { Vec::new() };
            assert_eq!(links, expected);
        }
    }

    /// Creates the file of a Debian package where apt would put it.
    fn package(archive: &Archive, name: &str, files: &[(&str, &str)]) {
        let place = tempfile::tempdir().expect("a directory");
        let control =
            format!("Package: {name}\nVersion: 1\nArchitecture: all\nMaintainer: a <a@b.invalid>\nDescription: d\n");
        let tree = place.path().join("tree");
        for (path, text) in files.iter().copied().chain([("DEBIAN/control", &*control)]) {
            let path = tree.join(path);
            std::fs::create_dir_all(path.parent().expect("below")).expect("made");
            std::fs::write(path, text).expect("written");
        }
        let deb = archive.apt.root().join(format!("archives/{name}_1_all.deb"));
        let mut build = std::process::Command::new("dpkg-deb");
        build.args(["--root-owner-group", "--build"]);
        let said = build.arg(&tree).arg(&deb).output().expect("run");
        assert!(said.status.success(), "{said:?}");
    }

    #[tokio::test]
    async fn what_a_packaged_python_program_imports_comes_with_it() {
        let directory = tempfile::tempdir().expect("a directory");
        let modules = "usr/lib/python3/dist-packages";
        let text = format!(
            "usr/share/monitor/package.xml python/python3-monitor\n\
             usr/lib/monitor/cpu_monitor python/python3-monitor\n\
             usr/share/updater/package.xml libdevel/libupdater-dev\n\
             usr/share/updater/cmake/updaterConfig.cmake libdevel/libupdater-dev\n\
             {modules}/updater/__init__.py python/python3-updater\n\
             {modules}/numpy/__init__.py python/python3-numpy\n\
             {modules}/unused/__init__.py python/python3-unused\n"
        );
        let names = ["python3-monitor", "python3-updater", "python3-numpy", "python3-unused", "libupdater-dev"];
        let archive = archive(directory.path(), &text, &names);
        let manifest = |name: &str, needs: &str| {
            format!(
                "<package><name>{name}</name><version>1.0.0</version><description>d</description>\
                 <maintainer email=\"a@b.invalid\">m</maintainer><license>l</license>{needs}</package>"
            )
        };
        let about = manifest("monitor", "<run_depend>updater</run_depend>");
        let program = "#!/usr/bin/python3\nimport os, numpy\nfrom updater import Updater\n";
        let files = [("usr/share/monitor/package.xml", about.as_str()), ("usr/lib/monitor/cpu_monitor", program)];
        package(&archive, "python3-monitor", &files);
        let about = manifest("updater", "");
        let files = [("usr/share/updater/package.xml", about.as_str())];
        package(&archive, "libupdater-dev", &files);
        let images = Path::new(env!("CARGO_MANIFEST_DIR")).join("../images");
        let base = crate::base::load(&images, crate::DEFAULT_BASE).expect("valid");
        let progress = Progress::new(tokio::sync::mpsc::channel(1).0);
        let roots = ["monitor".to_owned()].into();
        let all = vec!["python3-monitor", "python3-numpy", "python3-updater"];
        let named = |name: &str| SelectedPrograms::Named([name.to_owned()].into());
        for (programs, expected) in [
            (named("cpu_monitor"), all.clone()),
            // Now from the cache.
            (SelectedPrograms::All, all),
            (named("other"), vec!["python3-monitor"]),
        ] {
            let wanted = gather_packages(&archive, &base, &roots, true, &programs, &progress).await.expect("gathered");
            let install: Vec<&str> = wanted.install.iter().map(String::as_str).collect();
            assert_eq!(install, expected, "{programs:?}");
        }
    }

    #[test]
    fn what_a_package_xml_asks_for_is_found_as_ros_package_as_key_and_by_its_debian_name() {
        let directory = tempfile::tempdir().expect("a directory");
        let text = "usr/share/tf/package.xml libdevel/libtf-dev\n";
        let archive = archive(directory.path(), text, &["python3-numpy", "libeigen3-dev", "opencv-data"]);
        let images = Path::new(env!("CARGO_MANIFEST_DIR")).join("../images");
        let base = crate::base::load(&images, crate::DEFAULT_BASE).expect("valid");
        let debs = |names: &[&str]| NameProvider::Debs(names.iter().map(|&name| name.to_owned()).collect());
        for (name, expected) in [
            ("tf", NameProvider::Ros),
            ("python-numpy", debs(&["python3-numpy"])),
            ("eigen", debs(&[])),
            ("opencv-data", debs(&["opencv-data"])),
            ("rviz", NameProvider::Ros),
            ("warp", NameProvider::Nothing),
        ] {
            assert_eq!(find_provider(&archive, &base, name), expected, "{name}");
        }
    }
}
