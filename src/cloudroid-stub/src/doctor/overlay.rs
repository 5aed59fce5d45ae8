//! The robot's side: does the stub come before the original, and where is that.

use std::path::{Path, PathBuf};

use anyhow::Context;

use super::Check;
use crate::arguments::{Doctor, Node};
use crate::config::Config;
use crate::original;
use crate::revision::Revision;

/// Which stub is examined.
#[derive(Debug, Clone)]
pub struct ExaminedStub {
    /// Its `share/PKG`.
    pub share: PathBuf,
    /// The ROS package.
    pub package: String,
}

impl ExaminedStub {
    /// As asked for; without `--share`, by where this program is: `lib/PKG/cloudroid-stub`.
    pub fn of(asked: &Doctor) -> anyhow::Result<ExaminedStub> {
        let share = match &asked.share {
            Some(share) => share.clone(),
            None => {
                let program = std::env::current_exe().context("cannot find this very program")?;
                beside(&program).context(
                    "this program does not stand in a stub's lib/PKG: say which stub with --share DIR",
                )?
            }
        };
        let name = || Some(share.file_name()?.to_str()?.to_owned());
        let package = asked
            .package
            .clone()
            .or_else(name)
            .context("say which package with --package PKG")?;
        Ok(ExaminedStub { share, package })
    }

    /// The command that changes its settings.
    pub fn installer(&self) -> String {
        format!("sh {}-stub/install.sh", self.package)
    }

    /// The service's revision that the stub was made of.
    pub fn revision(&self) -> Option<u64> {
        Revision::read(&self.share).revision
    }
}

fn beside(program: &Path) -> Option<PathBuf> {
    let directory = program.parent()?;
    let prefix = directory.parent()?.parent()?;
    let share = prefix.join("share").join(directory.file_name()?);
    share.join(crate::config::FILE).is_file().then_some(share)
}

/// All checks of the robot, with variables from `variable`.
pub fn checks(
    stub: &ExaminedStub,
    config: &Config,
    variable: &dyn Fn(&str) -> Option<String>,
) -> Vec<Check> {
    let mut checks = vec![shadowing(stub, variable)];
    for node in Revision::read(&stub.share).outsourced {
        checks.push(local(stub, config, node, variable));
    }
    checks
}

/// Both variables must name the overlay before anything else that holds the package: catkin's tools go by the one,
/// rospack and rospkg by the other.
fn shadowing(stub: &ExaminedStub, variable: &dyn Fn(&str) -> Option<String>) -> Check {
    let overlay = original::overlay(&stub.share);
    let overlay = overlay.canonicalize().unwrap_or(overlay);
    let package = &stub.package;
    let fix = format!(
        ". {}, after every other setup file",
        overlay.join("setup.sh").display()
    );
    for (name, below, held_by) in [
        ("CMAKE_PREFIX_PATH", "", "share"),
        ("ROS_PACKAGE_PATH", "share", ""),
    ] {
        let value = variable(name).unwrap_or_default();
        let entries: Vec<PathBuf> = std::env::split_paths(&value).collect();
        let holds = |entry: &&PathBuf| {
            entry
                .join(held_by)
                .join(package)
                .join("package.xml")
                .is_file()
        };
        let first = entries.iter().find(holds);
        let ours = overlay.join(below);
        let is_ours = |entry: &&PathBuf| {
            entry
                .canonicalize()
                .is_ok_and(|entry| entry == ours.join(""))
        };
        if first.filter(is_ours).is_none() {
            let found = match first {
                Some(other) => format!("{name} names {} before this stub", other.display()),
                None => format!("{name} does not name this stub"),
            };
            return Check::bad("shadowing", found, fix);
        }
    }
    Check::good(
        "shadowing",
        format!("{package} is found in {}", overlay.display()),
    )
}

fn local(
    stub: &ExaminedStub,
    config: &Config,
    node: String,
    variable: &dyn Fn(&str) -> Option<String>,
) -> Check {
    let wanted = Node {
        package: stub.package.clone(),
        node,
        share: stub.share.clone(),
    };
    let name = &wanted.node;
    match original::find(&wanted, variable) {
        Some(path) => Check::good("original", format!("{name} is {}", path.display())),
        None if config.local == crate::config::Local::None => {
            Check::good("original", format!("{name} runs in the cloud only, as set"))
        }
        None => Check::warning(
            "original",
            format!("{name} is not installed on this robot: it runs in the cloud only"),
            format!(
                "install the package {}, or set local = \"none\" in {}",
                stub.package,
                stub.share.join(crate::config::FILE).display()
            ),
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::super::Verdict;
    use super::*;

    struct Robot(tempfile::TempDir);

    impl Robot {
        fn new() -> Robot {
            let robot = Robot(tempfile::tempdir().expect("a directory"));
            for prefix in ["ros", "stub"] {
                let share = robot.path(prefix).join("share/p");
                std::fs::create_dir_all(&share).expect("made");
                std::fs::write(share.join("package.xml"), "<package/>").expect("written");
            }
            robot
        }

        fn path(&self, name: &str) -> PathBuf {
            self.0.path().canonicalize().expect("there").join(name)
        }

        fn examined(&self, prefixes: &str, packages: &str) -> Check {
            let stub = ExaminedStub {
                share: self.path("stub/share/p"),
                package: "p".into(),
            };
            let filled = |template: &str| {
                let parts = template.split(':').map(|part| self.path(part));
                std::env::join_paths(parts)
                    .expect("no colons")
                    .into_string()
                    .expect("UTF-8")
            };
            let (prefixes, packages) = (filled(prefixes), filled(packages));
            shadowing(&stub, &|name| match name {
                "CMAKE_PREFIX_PATH" => Some(prefixes.clone()),
                "ROS_PACKAGE_PATH" => Some(packages.clone()),
                _ => None,
            })
        }
    }

    #[test]
    fn both_paths_must_name_the_stub_first() {
        let robot = Robot::new();
        let good = robot.examined("stub:ros", "stub/share:ros/share");
        assert_eq!(good.verdict, Verdict::Good, "{good:?}");
        // A workspace without the package may come before.
        let other = robot.examined("other:stub:ros", "other:stub/share:ros/share");
        assert_eq!(other.verdict, Verdict::Good, "{other:?}");
        for (prefixes, packages, words) in [
            (
                "ros:stub",
                "stub/share:ros/share",
                "CMAKE_PREFIX_PATH names",
            ),
            ("stub:ros", "ros/share:stub/share", "ROS_PACKAGE_PATH names"),
            ("stub:ros", "other", "ROS_PACKAGE_PATH does not name"),
        ] {
            let bad = robot.examined(prefixes, packages);
            assert_eq!(bad.verdict, Verdict::Bad);
            assert!(bad.found.contains(words), "{bad:?}");
            assert!(bad.fix.is_some_and(|fix| fix.contains("stub/setup.sh")));
        }
    }

    #[test]
    fn the_stub_is_found_beside_its_program() {
        let robot = Robot::new();
        let program = robot.path("stub/lib/p/cloudroid-stub");
        assert_eq!(beside(&program), None, "no settings");
        std::fs::write(robot.path("stub/share/p/stub.toml"), "").expect("written");
        assert_eq!(beside(&program), Some(robot.path("stub/share/p")));
    }
}
