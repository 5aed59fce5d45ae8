//! Installation and removal of the package.

use std::path::Path;

use anyhow::{Context, ensure};
use serde_json::json;
use support::robot::Robot;
use support::{Verdict, leftovers, procfs};

use crate::confinement;
use crate::machine::{HOME, SERVANTS, daemon, main_pid, property, run_program};

/// Installs the package on a clean machine, which results in a running service with everything it needs.
pub fn installs() -> Verdict {
    let package = std::fs::read_dir("/stage")?
        .flatten()
        .map(|entry| entry.path())
        .find(|path| path.extension().is_some_and(|end| end == "deb"))
        .context("a package to install")?;
    run_program("dpkg", &["-i", &package.to_string_lossy()])?;
    ensure!(property("cloudroid.service", "ActiveState")? == "active");
    // Containers of the warm pool would disturb stories that count servants.
    let configuration = "/etc/cloudroid/cloudroid.toml";
    let text = std::fs::read_to_string(configuration)?;
    ensure!(text.contains("#: warm_pool = 8"), "{text}");
    let text = text.replace("#: warm_pool = 8", "warm_pool = 0");
    let text = text.replace("[allow]\n", &format!("[allow]\n{}\n", confinement::allow_config()));
    std::fs::write(configuration, text)?;
    run_program("systemctl", &["restart", "cloudroid"])?;
    ensure!(property("cloudroid.service", "Type")? == "notify");
    ensure!(property("cloudroid.service", "WatchdogUSec")? != "0");
    ensure!(property("cloudroid-servants.service", "ActiveState")? == "active");
    let daemon = daemon()?;
    let status = daemon.deployer().run_json(&["status"])?;
    ensure!(status["pid"] == main_pid()?, "{status:#}");
    ensure!(status["isolation"]["cgroup_version"] == 2 && status["isolation"]["missing"] == json!([]), "{status:#}");
    let doctor = daemon.deployer().run_json(&["doctor"])?;
    for check in doctor["checks"].as_array().context("checks")? {
        ensure!(check["status"] != "missing", "{check:#}");
    }
    Ok(())
}

/// Removes the package: every servant is ended, and only the state is left.
pub fn removes() -> Verdict {
    let daemon = daemon()?;
    let _robot = daemon.robot("greeter_cpp?robot=last")?.call("/greeter/count", json!({}))?;
    let id = daemon.servant_of("greeter_cpp", "last")?["id"].clone();
    // As a build would leave them, for the next story.
    run_program(
        "sh",
        &["-c", &format!("mkdir {BUILT_PROGRAMS} && cp -r /usr/bin/cloudroid* /usr/lib/cloudroid/* {BUILT_PROGRAMS}")],
    )?;
    let log = run_program("dpkg", &["--purge", "cloudroid"])?;
    nothing_but_the_state_is_left(id.as_str().context("an id")?).context(log)
}

/// Directory of programs, as a build leaves them.
const BUILT_PROGRAMS: &str = "/var/built";

/// Runs the scripts that `make install`, after building, and `make uninstall` run.
pub fn installs_and_removes_without_a_package() -> Verdict {
    let script = |name: &str| format!("/stage/source/scripts/{name}");
    let said = run_program(&script("install"), &[BUILT_PROGRAMS, "", "/usr/local"])?;
    ensure!(said.contains("installed and running"), "{said}");
    ensure!(property("cloudroid.service", "ActiveState")? == "active");
    ensure!(property("cloudroid.service", "FragmentPath")?.starts_with("/usr/local/"), "another unit runs");
    // The programs and the command that stories call are now in another directory.
    let asks = |arguments: &[&str]| -> anyhow::Result<serde_json::Value> {
        let told = run_program("/usr/local/bin/cloudroidctl", &[&["--format", "json"], arguments].concat())?;
        Ok(serde_json::from_str(&told)?)
    };
    let status = asks(&["status", "--wait"])?;
    ensure!(status["pid"] == main_pid()?, "{status:#}");
    let address = status["listen"].as_str().context("an address")?;
    let mut robot = Robot::connect(&format!("ws://{address}/greeter_cpp?robot=made"))?;
    ensure!(robot.call("/greeter/count", json!({}))?["result"] == true);
    let servants = asks(&["servants"])?;
    let id = servants[0]["id"].as_str().context("an id")?.to_owned();
    let said = run_program(&script("uninstall"), &["/usr/local"])?;
    run_program("rm", &["-r", BUILT_PROGRAMS, "/etc/cloudroid"])?;
    nothing_but_the_state_is_left(&id).context(said)
}

fn nothing_but_the_state_is_left(id: &str) -> Verdict {
    ensure!(!Path::new(SERVANTS).exists(), "its cgroup is there");
    for pid in procfs::pids() {
        let command = procfs::command_line(pid).unwrap_or_default();
        ensure!(!command.contains("cloudroid"), "{pid}: {command}");
    }
    ensure!(leftovers::cgroups(&[id.to_owned()]).is_empty(), "cgroups of servants are left");
    let found = run_program("find", &["/etc", "/usr", "/var", "/run", "/lib/", "-xdev", "-name", "*cloudroid*"])?;
    let left: Vec<&str> = found
        .lines()
        .filter(|path| {
            *path != HOME
                && !path.starts_with("/var/lib/dpkg/")
                && !path.starts_with("/var/log/")
                && !path.starts_with(BUILT_PROGRAMS)
        })
        .collect();
    ensure!(left.is_empty(), "{left:#?}");
    ensure!(Path::new(HOME).join("cloudroid.db").exists(), "the state is gone");
    Ok(())
}
