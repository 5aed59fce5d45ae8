//! ROS 1: checks that two variables name the overlay before any other directory with the package: catkin's tools use
//! one, rospack and rospkg the other.

use std::path::PathBuf;

use super::super::check::Check;
use super::{ExaminedStub, found_check, is_same_directory, shadowed_check};
use crate::network::Variable;

/// Checks that the package's name resolves to the stub.
pub fn shadowing(stub: &ExaminedStub, variable: Variable<'_>) -> Check {
    for (name, below, held_by) in [("CMAKE_PREFIX_PATH", "", "share"), ("ROS_PACKAGE_PATH", "share", "")] {
        let value = variable(name).unwrap_or_default();
        let entries: Vec<PathBuf> = std::env::split_paths(&value).collect();
        let holds = |entry: &&PathBuf| {
            let package = entry.join(held_by).join(&stub.package);
            package.join("package.xml").is_file()
        };
        let first = entries.iter().find(holds);
        let ours = stub.overlay().join(below);
        if !first.is_some_and(|first| is_same_directory(first, &ours)) {
            return shadowed_check(name, first, stub);
        }
    }
    found_check(stub)
}

#[cfg(test)]
mod tests {
    use super::super::super::check::CheckVerdict;
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

        fn run_check(&self, prefixes: &str, packages: &str) -> Check {
            let stub = ExaminedStub { share: self.path("stub/share/p"), package: "p".into() };
            let filled = |template: &str| {
                let parts = template.split(':').map(|part| self.path(part));
                std::env::join_paths(parts).expect("no colons").into_string().expect("UTF-8")
            };
            let (prefixes, packages) = (filled(prefixes), filled(packages));
            shadowing(&stub, &|name: &str| match name {
                "CMAKE_PREFIX_PATH" => Some(prefixes.clone()),
                "ROS_PACKAGE_PATH" => Some(packages.clone()),
                _ => None,
            })
        }
    }

    #[test]
    fn both_paths_must_name_the_stub_first() {
        let robot = Robot::new();
        let good = robot.run_check("stub:ros", "stub/share:ros/share");
        assert_eq!(good.verdict, CheckVerdict::Good, "{good:?}");
        // A workspace without the package may come before.
        let other = robot.run_check("other:stub:ros", "other:stub/share:ros/share");
        assert_eq!(other.verdict, CheckVerdict::Good, "{other:?}");
        for (prefixes, packages, words) in [
            ("ros:stub", "stub/share:ros/share", "CMAKE_PREFIX_PATH has"),
            ("stub:ros", "ros/share:stub/share", "ROS_PACKAGE_PATH has"),
            ("stub:ros", "other", "ROS_PACKAGE_PATH does not include"),
        ] {
            let bad = robot.run_check(prefixes, packages);
            assert_eq!(bad.verdict, CheckVerdict::Bad);
            assert!(bad.found.contains(words), "{bad:?}");
            assert!(bad.fix.is_some_and(|fix| fix.contains("stub/setup.sh")));
        }
    }
}
