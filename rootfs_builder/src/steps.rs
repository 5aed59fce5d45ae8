//! Installation steps. dpkg unpacks all given packages before it configures any, but refuses to unpack a package whose
//! Pre-Depends are not configured yet (Debian Policy, section 7.2). apt therefore calls it several times, and so does
//! the script for which these steps are written.

use std::collections::{BTreeMap, BTreeSet};

use crate::debian_package::{Deb, Relations};

/// Packages that are unpacked together.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct InstallStep {
    /// Number of packages.
    pub(crate) unpack: usize,
    /// Names of packages to configure, with their dependencies, before the next step.
    pub(crate) configure: BTreeSet<String>,
}

/// Divides `debs`, given in the order of unpacking, into steps. The last one has nothing to configure, since all
/// packages are configured then.
pub(crate) fn plan_steps(debs: &[Deb], relations: &BTreeMap<String, Relations>) -> Vec<InstallStep> {
    let mut steps = vec![InstallStep::default()];
    // Packages that are unpacked and perhaps not configured, by each of their names.
    let mut waiting: BTreeMap<&str, &str> = BTreeMap::new();
    for deb in debs {
        let about = relations.get(&deb.name);
        let before = about.into_iter().flat_map(|about| &about.before);
        let needed: BTreeSet<String> =
            before.filter_map(|name| waiting.get(name.as_str())).map(|&name| name.to_owned()).collect();
        if !needed.is_empty() {
            waiting.retain(|_, name| !needed.contains(*name));
            if let Some(last) = steps.last_mut() {
                last.configure = needed;
            }
            steps.push(InstallStep::default());
        }
        if let Some(last) = steps.last_mut() {
            last.unpack += 1;
        }
        waiting.insert(&deb.name, &deb.name);
        let provided = about.into_iter().flat_map(|about| &about.provides);
        waiting.extend(provided.map(|name| (name.as_str(), deb.name.as_str())));
    }
    steps
}

/// Returns the step files read by the script `inside/install.sh`: a file of each kind for each step, with sortable
/// names. `files` are the paths of the packages, in the order of unpacking.
pub(crate) fn script_files(steps: &[InstallStep], files: &[String]) -> BTreeMap<String, String> {
    let mut written = BTreeMap::new();
    let mut rest = files;
    for (number, step) in steps.iter().enumerate() {
        let (now, later) = rest.split_at(step.unpack.min(rest.len()));
        rest = later;
        let lines =
            |lines: &mut dyn Iterator<Item = &String>| -> String { lines.map(|line| format!("{line}\n")).collect() };
        written.insert(format!("{number:04}.unpack"), lines(&mut now.iter()));
        let configure = lines(&mut step.configure.iter());
        written.insert(format!("{number:04}.configure"), configure);
    }
    written
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::Path;
    use std::process::Command;

    use super::*;

    fn deb(name: &str) -> Deb {
        Deb { name: name.to_owned(), version: "1".into(), architecture: "all".into() }
    }

    fn relations(all: &[(&str, &[&str], &[&str])]) -> BTreeMap<String, Relations> {
        let names = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect();
        let about = |&(name, before, provides): &(&str, &[&str], &[&str])| {
            let about = Relations { before: names(before), provides: names(provides), ..Relations::default() };
            (name.to_owned(), about)
        };
        all.iter().map(about).collect()
    }

    #[test]
    fn what_must_be_configured_first_ends_a_step() {
        let debs = ["a", "b", "c", "d"].map(deb);
        let step = |unpack, configure: &[&str]| InstallStep {
            unpack,
            configure: configure.iter().map(|&name| name.to_owned()).collect(),
        };
        assert_eq!(plan_steps(&debs, &relations(&[])), [step(4, &[])]);
        // Installed packages need no step, and packages are configured only once.
        let all = relations(&[("b", &[], &["virtual"]), ("c", &["virtual", "libc6"], &[]), ("d", &["b"], &[])]);
        assert_eq!(plan_steps(&debs, &all), [step(2, &["b"]), step(2, &[])]);
    }

    /// Creates a package whose `preinst` checks for files that its Pre-Depends create when they are configured.
    fn package(directory: &Path, name: &str, fields: &str) -> String {
        let tree = directory.join(name);
        let control = format!(
            "Package: {name}\nVersion: 1\nArchitecture: all\nMaintainer: a <a@b.invalid>\n{fields}Description: d\n"
        );
        fs::create_dir_all(tree.join("DEBIAN")).expect("made");
        fs::write(tree.join("DEBIAN/control"), control).expect("written");
        let deb = directory.join(format!("{name}.deb"));
        let mut build = Command::new("dpkg-deb");
        build.args(["--root-owner-group", "--build"]);
        let said = build.arg(&tree).arg(&deb).output().expect("run");
        assert!(said.status.success(), "{said:?}");
        deb.to_string_lossy().into_owned()
    }

    #[test]
    fn dpkg_accepts_the_steps() {
        let place = tempfile::tempdir().expect("a directory");
        let (root, given) = (place.path().join("root"), place.path().join("given"));
        fs::create_dir_all(root.join("var/lib/dpkg/updates")).expect("made");
        fs::create_dir_all(root.join("var/lib/dpkg/info")).expect("made");
        fs::write(root.join("var/lib/dpkg/status"), "").expect("written");
        fs::create_dir_all(given.join("steps")).expect("made");
        // As systemd-sysv needs systemd, which needs further packages.
        let files = [
            package(place.path(), "init", "Depends: bolt\n"),
            package(place.path(), "bolt", ""),
            package(place.path(), "init-sysv", "Pre-Depends: init\n"),
            package(place.path(), "last", "Depends: init-sysv\n"),
        ];
        let debs = ["init", "bolt", "init-sysv", "last"].map(deb);
        let all = relations(&[("init-sysv", &["init"], &[])]);
        for (name, text) in script_files(&plan_steps(&debs, &all), &files) {
            fs::write(given.join("steps").join(name), text).expect("written");
        }
        let script = include_str!("inside/install.sh").replace("/cloudroid/", &format!("{}/", given.display()));
        let mut run = Command::new("/bin/sh");
        run.args(["-c", &script]).env("DPKG_ROOT", &root).env("DPKG_FORCE", "not-root");
        let said = run.output().expect("run");
        assert!(said.status.success(), "{said:?}");
        let status = fs::read_to_string(root.join("var/lib/dpkg/status")).expect("there");
        let installed = status.matches("Status: install ok installed").count();
        assert_eq!(installed, 4, "{status}");
    }
}
