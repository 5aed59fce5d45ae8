//! Checks of the robot: whether the stub comes before the original, and where the original is.

mod ament;
mod catkin;

use std::path::{Path, PathBuf};

use anyhow::Context;
use ros::bus::RosVersion;

use super::check::Check;
use crate::arguments::{NodeArgs, StubDoctorArgs};
use crate::config::Config;
use crate::network::Variable;
use crate::original;
use crate::revision::Revision;

/// The stub that is examined.
#[derive(Debug, Clone)]
pub struct ExaminedStub {
    /// Directory `share/PKG` of the package.
    pub share: PathBuf,
    /// The ROS package.
    pub package: String,
}

impl ExaminedStub {
    /// Returns the stub that the arguments name; without `--share`, determined from the path of this program,
    /// `lib/PKG/cloudroid-stub`.
    pub fn from_args(asked: &StubDoctorArgs) -> anyhow::Result<ExaminedStub> {
        let share = match &asked.share {
            Some(share) => share.clone(),
            None => {
                let program = std::env::current_exe().context("cannot find the path of this program")?;
                find_share(&program)
                    .context("this program is not in a stub's lib/PKG: name the stub with --share DIR")?
            }
        };
        let name = || Some(share.file_name()?.to_str()?.to_owned());
        let package = asked.package.clone().or_else(name).context("name the package with --package PKG")?;
        Ok(ExaminedStub { share, package })
    }

    /// Returns the command that changes the stub's settings.
    pub fn installer(&self) -> String {
        format!("sh {}-stub/install.sh", self.package)
    }

    /// Returns the install space of the stub.
    pub fn overlay(&self) -> PathBuf {
        let overlay = original::overlay(&self.share);
        overlay.canonicalize().unwrap_or(overlay)
    }

    /// Returns the service's revision that the stub was made of.
    pub fn revision(&self) -> Revision {
        Revision::read(&self.share)
    }
}

fn find_share(program: &Path) -> Option<PathBuf> {
    let directory = program.parent()?;
    let prefix = directory.parent()?.parent()?;
    let share = prefix.join("share").join(directory.file_name()?);
    share.join(crate::config::FILE).is_file().then_some(share)
}

/// Runs all checks of the robot, with the environment of `variable`.
pub async fn checks(stub: &ExaminedStub, config: &Config, variable: Variable<'_>) -> Vec<Check> {
    let revision = Revision::read(&stub.share);
    let mut checks = match revision.ros() {
        RosVersion::One => vec![catkin::shadowing(stub, variable)],
        RosVersion::Two => ament::checks(stub, variable).await,
    };
    for node in revision.outsourced {
        checks.push(original_check(stub, config, node, variable));
    }
    checks
}

/// Returns whether an entry of a search path is this directory, after resolving links.
fn is_same_directory(entry: &Path, directory: &Path) -> bool {
    // The comparison of paths ignores the trailing slash.
    entry.canonicalize().is_ok_and(|entry| entry == directory.join(""))
}

/// Returns the check's result if a package is found elsewhere than in the stub.
fn shadowed_check(name: &str, first: Option<&PathBuf>, stub: &ExaminedStub) -> Check {
    let found = match first {
        Some(other) => format!("{name} has {} before this stub", other.display()),
        None => format!("{name} does not include this stub"),
    };
    let setup = stub.overlay().join("setup.sh");
    let fix = format!(". {}, after every other setup file", setup.display());
    Check::bad("shadowing", found, fix)
}

fn found_check(stub: &ExaminedStub) -> Check {
    let overlay = stub.overlay();
    Check::good("shadowing", format!("{} is found in {}", stub.package, overlay.display()))
}

fn original_check(
    stub: &ExaminedStub,
    config: &Config,
    node: String,
    variable: &dyn Fn(&str) -> Option<String>,
) -> Check {
    let wanted = NodeArgs { package: stub.package.clone(), node, share: stub.share.clone() };
    let name = &wanted.node;
    match original::find(&wanted, variable) {
        Some(path) => Check::good("original", format!("{name} is {}", path.display())),
        None if config.local == crate::config::LocalMode::None => {
            Check::good("original", format!("{name} runs in the cloud only, as configured"))
        }
        None => Check::warning(
            "original",
            format!("{name} is not installed on this robot, so it runs in the cloud only"),
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
    use super::*;

    #[test]
    fn the_stub_is_found_beside_its_program() {
        let root = tempfile::tempdir().expect("a directory");
        let share = root.path().join("share/p");
        std::fs::create_dir_all(&share).expect("made");
        let program = root.path().join("lib/p/cloudroid-stub");
        assert_eq!(find_share(&program), None, "no settings");
        std::fs::write(share.join("stub.toml"), "").expect("written");
        assert_eq!(find_share(&program), Some(share));
    }
}
