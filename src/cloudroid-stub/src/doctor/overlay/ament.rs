//! ROS 2: checks the overlay on AMENT_PREFIX_PATH, and whether the stub and the robot's nodes can communicate.

use std::path::{Path, PathBuf};

use ros::InterfaceSelection;

use super::super::check::Check;
use super::{ExaminedStub, found_check, is_same_directory, shadowed_check};
use crate::network::{self, Variable};

const INDEX: &str = "share/ament_index/resource_index";

/// Runs all checks for ROS 2.
pub async fn checks(stub: &ExaminedStub, variable: Variable<'_>) -> Vec<Check> {
    let prefixes = prefixes(variable);
    let mut checks = vec![shadowing(stub, &prefixes), domain(variable).await];
    checks.extend(security(variable));
    checks.extend(messages(stub, &prefixes));
    checks
}

fn prefixes(variable: Variable<'_>) -> Vec<PathBuf> {
    let value = variable("AMENT_PREFIX_PATH").unwrap_or_default();
    std::env::split_paths(&value).collect()
}

/// Checks that the stub is the first install space whose index has the package, which is the one that tools use.
fn shadowing(stub: &ExaminedStub, prefixes: &[PathBuf]) -> Check {
    let entry = Path::new(INDEX).join("packages").join(&stub.package);
    let first = prefixes.iter().find(|prefix| prefix.join(&entry).is_file());
    match first {
        Some(first) if is_same_directory(first, &stub.overlay()) => found_check(stub),
        first => shadowed_check("AMENT_PREFIX_PATH", first, stub),
    }
}

async fn domain(variable: Variable<'_>) -> Check {
    match network::read_network(variable).await {
        Ok((id, network)) => {
            let place = match network.interfaces {
                _ if network.alone => "without discovery",
                InterfaceSelection::All => "on all networks of this robot",
                _ => "on this machine only",
            };
            let servers = network.servers.iter().map(|server| server.at.to_string());
            let servers: Vec<String> = servers.collect();
            let by = if servers.is_empty() {
                String::new()
            } else {
                format!(", through discovery servers at {}", servers.join(" and "))
            };
            Check::good("domain", format!("{id}, {place}{by}"))
        }
        Err(error) => Check::bad(
            "domain",
            format!("{error:#}"),
            "set the variable to the value of the robot's other nodes, or unset it",
        ),
    }
}

/// Checks that the robot's nodes do not encrypt: nodes that do receive nothing from nodes that do not.
fn security(variable: Variable<'_>) -> Option<Check> {
    const NAME: &str = "ROS_SECURITY_ENABLE";
    let enabled = variable(NAME).is_some_and(|value| value == "true");
    enabled.then(|| {
        Check::bad(
            "security",
            format!(
                "{NAME} is true: this robot's nodes use encryption (SROS 2), which stubs do not support, so they \
                cannot communicate"
            ),
            format!("unset {NAME} for the nodes that use this service"),
        )
    })
}

/// Checks that the libraries of the package's messages are found: generic subscriptions (rosbag2, bridges) look for
/// them in the install space of the package.
fn messages(stub: &ExaminedStub, prefixes: &[PathBuf]) -> Option<Check> {
    let overlay = stub.overlay();
    let entry = overlay.join(INDEX).join("rosidl_interfaces");
    let library = format!("lib/lib{}__rosidl_typesupport_cpp.so", stub.package);
    if !entry.join(&stub.package).is_file() || overlay.join(&library).exists() {
        return None;
    }
    let original = prefixes.iter().find(|prefix| prefix.join(&library).exists())?;
    Some(Check::warning(
        "messages",
        format!(
            "rosbag2 and bridges cannot find the message libraries of {}, which are in {}",
            stub.package,
            original.display()
        ),
        format!("{} again, from a shell with ROS 2 sourced", stub.installer()),
    ))
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
                robot.file(prefix, &format!("{INDEX}/packages/p"));
                robot.file(prefix, "share/p/package.xml");
            }
            robot
        }

        fn path(&self, name: &str) -> PathBuf {
            self.0.path().canonicalize().expect("there").join(name)
        }

        fn file(&self, prefix: &str, path: &str) {
            let path = self.path(prefix).join(path);
            std::fs::create_dir_all(path.parent().expect("below")).expect("made");
            std::fs::write(path, "").expect("written");
        }

        /// Runs the checks with these entries of AMENT_PREFIX_PATH, and other variables.
        async fn run_checks(&self, prefixes: &str, others: &[(&str, &str)]) -> Vec<Check> {
            let stub = ExaminedStub { share: self.path("stub/share/p"), package: "p".into() };
            let prefixes = prefixes.split(':').map(|prefix| self.path(prefix));
            let prefixes = std::env::join_paths(prefixes).expect("no colons");
            let prefixes = prefixes.into_string().expect("UTF-8");
            checks(&stub, &|name: &str| {
                let other = others.iter().find(|(variable, _)| *variable == name);
                match other {
                    Some((_, value)) => Some((*value).to_owned()),
                    None => (name == "AMENT_PREFIX_PATH").then(|| prefixes.clone()),
                }
            })
            .await
        }
    }

    fn find_check<'a>(checks: &'a [Check], name: &str) -> Option<&'a Check> {
        checks.iter().find(|check| check.name == name)
    }

    #[tokio::test]
    async fn the_index_of_the_stub_must_come_first() {
        let robot = Robot::new();
        for prefixes in ["stub:ros", "other:stub:ros"] {
            let checks = robot.run_checks(prefixes, &[]).await;
            assert!(checks.iter().all(|check| check.verdict == CheckVerdict::Good), "{checks:?}");
        }
        for (prefixes, said) in
            [("ros:stub", "ros before this stub"), ("other", "AMENT_PREFIX_PATH does not include this stub")]
        {
            let checks = robot.run_checks(prefixes, &[]).await;
            let check = find_check(&checks, "shadowing").expect("a check");
            assert_eq!(check.verdict, CheckVerdict::Bad);
            assert!(check.found.contains(said), "{check:?}");
            assert!(check.fix.as_ref().is_some_and(|fix| fix.contains("stub/setup.sh")));
        }
    }

    #[tokio::test]
    async fn what_keeps_nodes_from_hearing_each_other_is_said() {
        let robot = Robot::new();
        for (name, value, check, verdict, said) in [
            ("ROS_DOMAIN_ID", "7", "domain", CheckVerdict::Good, "7, on all networks"),
            ("ROS_LOCALHOST_ONLY", "1", "domain", CheckVerdict::Good, "0, on this machine only"),
            (
                "ROS_DISCOVERY_SERVER",
                "10.0.0.7;10.0.0.8:14520",
                "domain",
                CheckVerdict::Good,
                "0, on all networks of this robot, through discovery servers at 10.0.0.7:11811 and 10.0.0.8:14520",
            ),
            ("ROS_DISCOVERY_SERVER", "TCPv4:[10.0.0.7]:42100", "domain", CheckVerdict::Bad, "which uses TCP"),
            ("ROS_DOMAIN_ID", "300", "domain", CheckVerdict::Bad, "ROS_DOMAIN_ID is \"300\""),
            ("ROS_SECURITY_ENABLE", "true", "security", CheckVerdict::Bad, "SROS 2"),
        ] {
            let checks = robot.run_checks("stub:ros", &[(name, value)]).await;
            let found = find_check(&checks, check).expect("a check");
            assert_eq!(found.verdict, verdict, "{found:?}");
            assert!(found.found.contains(said), "{found:?}");
        }
    }

    #[tokio::test]
    async fn code_of_messages_is_missed_where_the_original_has_it() {
        let robot = Robot::new();
        robot.file("stub", &format!("{INDEX}/rosidl_interfaces/p"));
        let examined = || robot.run_checks("stub:ros", &[]);
        assert!(find_check(&examined().await, "messages").is_none(), "nobody has it");
        robot.file("ros", "lib/libp__rosidl_typesupport_cpp.so");
        let checks = examined().await;
        let check = find_check(&checks, "messages").expect("a check");
        assert_eq!(check.verdict, CheckVerdict::Warning);
        assert!(check.found.ends_with("ros"), "{check:?}");
        robot.file("stub", "lib/libp__rosidl_typesupport_cpp.so");
        assert!(find_check(&examined().await, "messages").is_none());
    }
}
