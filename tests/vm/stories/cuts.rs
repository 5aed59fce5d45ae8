//! Power cuts during operations. After the boot the store is consistent, services are published, and nothing is left of
//! incomplete operations.

use std::path::Path;
use std::process::{Child, Command, Stdio};

use anyhow::{Context, ensure};
use serde_json::json;
use support::patience::Deadline;
use support::{Verdict, binaries};

use crate::machine::{HOME, SERVANTS, daemon, run_program};

/// Checks that services work and that nothing is left of earlier servants and builds.
fn all_is_well() -> Verdict {
    let daemon = daemon()?;
    for part in ["servants", "build"] {
        let left: Vec<_> = std::fs::read_dir(Path::new(HOME).join(part))?.flatten().collect();
        ensure!(left.is_empty(), "{part}: {left:?}");
    }
    ensure!(daemon.deployer().run_json(&["servants"])? == json!([]));
    if let Ok(entries) = std::fs::read_dir(SERVANTS) {
        let kinds = entries.flatten().filter(|entry| entry.path().is_dir());
        let left: Vec<_> = kinds.filter(|entry| entry.file_name() != "shims").collect();
        ensure!(left.is_empty(), "cgroups: {left:?}");
    }
    ensure!(!run_program("cat", &["/proc/self/mountinfo"])?.contains("overlay"), "an overlay is mounted");
    let services = daemon.deployer().run_json(&["services"])?;
    let names: Vec<&str> =
        services.as_array().context("services")?.iter().filter_map(|service| service["name"].as_str()).collect();
    ensure!(names == ["adder_py", "burglar_cpp", "granted", "greeter_cpp", "small"], "{names:?}");
    let mut robot = daemon.robot("greeter_cpp?robot=after")?;
    ensure!(robot.call("/greeter/count", json!({"reset": false}))?["result"] == true);
    robot.leave()?;
    daemon.deployer().run(&["stop", "--all"])?.expect_success()?;
    Ok(())
}

/// Checks that every blob is complete and matches its name.
fn the_store_verifies() -> Verdict {
    let blobs = Path::new(HOME).join("images/blobs/sha256");
    for blob in std::fs::read_dir(&blobs)?.flatten() {
        let name = blob.file_name().to_string_lossy().into_owned();
        ensure!(!name.contains('.'), "{name} is half-made");
        let sum = run_program("sha256sum", &[&blob.path().to_string_lossy()])?;
        ensure!(sum.starts_with(&name), "blob {name} holds something else");
    }
    Ok(())
}

/// Waits until the operation has reached the intended state.
fn wait_until_seen(what: &str, there: impl Fn() -> bool) -> Verdict {
    let deadline = Deadline::begin();
    while !there() {
        deadline.check(|| format!("{what} was not seen"))?;
        std::thread::yield_now();
    }
    Ok(())
}

fn spawn(program: &str, arguments: &[&str]) -> anyhow::Result<Child> {
    Command::new(binaries::path(program))
        .args(arguments)
        .env("CLOUDROID_HOME", HOME)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .context(program.to_owned())
}

/// A container is incomplete: its directory exists, its nodes do not.
pub mod in_the_middle_of_a_start {
    use super::*;

    pub fn before() -> Verdict {
        let daemon = daemon()?;
        let _ready = daemon.robot("greeter_cpp?robot=ready")?.call("/greeter/count", json!({}))?;
        let url = daemon.url("burglar_cpp?robot=starting");
        std::thread::spawn(move || support::robot::Robot::connect(&url));
        let servants = Path::new(HOME).join("servants");
        wait_until_seen("a servant's launch record", || {
            std::fs::read_dir(&servants).is_ok_and(|entries| {
                entries.flatten().any(|entry| {
                    entry.file_name().to_string_lossy().starts_with("burglar")
                        && entry.path().join("spec.json").exists()
                })
            })
        })
    }

    pub fn after() -> Verdict {
        all_is_well()
    }
}

/// A push has unpacked the upload and built nothing yet.
pub mod in_the_middle_of_a_push {
    use super::*;

    pub fn before() -> Verdict {
        daemon()?;
        let _push = spawn("cloudroidctl", &["push", "/stage/greeter_cpp", "--name", "halved", "--node", "greeter"])?;
        let build = Path::new(HOME).join("build");
        wait_until_seen("a build", || std::fs::read_dir(&build).is_ok_and(|mut entries| entries.next().is_some()))
    }

    pub fn after() -> Verdict {
        the_store_verifies()?;
        all_is_well()
    }
}

/// The database is being written repeatedly.
pub mod in_the_middle_of_a_database_write {
    use super::*;

    pub fn before() -> Verdict {
        let daemon = daemon()?;
        let mut robot = daemon.robot("greeter_cpp?robot=written")?;
        robot.call("/greeter/count", json!({}))?;
        let id = daemon.servant_of("greeter_cpp", "written")?["id"].as_str().context("an id")?.to_owned();
        let wal = Path::new(HOME).join("cloudroid.db-wal");
        // Once its pages are in the database, the file is overwritten from its beginning and does not grow.
        let written = || {
            let metadata = std::fs::metadata(&wal).ok()?;
            Some((metadata.len(), metadata.modified().ok()?))
        };
        let before = written();
        let _set = spawn("cloudroidctl", &["set", &id, "--pids", "77"])?;
        wait_until_seen("a write to the database", || written() != before)
    }

    pub fn after() -> Verdict {
        all_is_well()
    }
}
