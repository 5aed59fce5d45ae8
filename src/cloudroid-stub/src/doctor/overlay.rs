//! The robot's side: does the stub come before the original, and where is that.

mod ament;
mod catkin;

use std::path::{Path, PathBuf};

use anyhow::Context;
use ros::bus::RosVersion;

use super::Check;
use crate::arguments::{Doctor, Node};
use crate::config::Config;
use crate::network::Variable;
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

    /// The install space that it is in.
    pub fn overlay(&self) -> PathBuf {
        let overlay = original::overlay(&self.share);
        overlay.canonicalize().unwrap_or(overlay)
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
pub async fn checks(stub: &ExaminedStub, config: &Config, variable: Variable<'_>) -> Vec<Check> {
    let revision = Revision::read(&stub.share);
    let mut checks = match revision.ros() {
        RosVersion::One => vec![catkin::shadowing(stub, variable)],
        RosVersion::Two => ament::checks(stub, variable).await,
    };
    for node in revision.outsourced {
        checks.push(local(stub, config, node, variable));
    }
    checks
}

/// Whether a directory on a search path is this one, whatever leads there.
fn is(entry: &Path, directory: &Path) -> bool {
    // A slash at its end is left out.
    entry
        .canonicalize()
        .is_ok_and(|entry| entry == directory.join(""))
}

/// What finds a package anywhere else than in the stub.
fn shadowed(name: &str, first: Option<&PathBuf>, stub: &ExaminedStub) -> Check {
    let found = match first {
        Some(other) => format!("{name} names {} before this stub", other.display()),
        None => format!("{name} does not name this stub"),
    };
    let setup = stub.overlay().join("setup.sh");
    let fix = format!(". {}, after every other setup file", setup.display());
    Check::bad("shadowing", found, fix)
}

fn found(stub: &ExaminedStub) -> Check {
    let overlay = stub.overlay();
    Check::good(
        "shadowing",
        format!("{} is found in {}", stub.package, overlay.display()),
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
    use super::*;

    #[test]
    fn the_stub_is_found_beside_its_program() {
        let root = tempfile::tempdir().expect("a directory");
        let share = root.path().join("share/p");
        std::fs::create_dir_all(&share).expect("made");
        let program = root.path().join("lib/p/cloudroid-stub");
        assert_eq!(beside(&program), None, "no settings");
        std::fs::write(share.join("stub.toml"), "").expect("written");
        assert_eq!(beside(&program), Some(share));
    }
}
