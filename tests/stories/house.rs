//! The daemon and the rest of its machine.

use std::fs::Permissions;
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::ensure;
use ros::bus::RosVersion;
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::deployer::run;
use support::world::{PEOPLE, SEER, world};
use support::{Verdict, binaries, leftovers};

pub fn a_second_daemon_on_the_same_home_is_refused() -> Verdict {
    let setup = world().setup("one");
    let daemon = setup.start()?;
    let said = setup.expect_refusal()?;
    ensure!(said.contains(&daemon.pid().to_string()), "the first is named: {said}");
    ensure!(daemon.get("/healthz")?.0 == 200, "and is not disturbed");
    Ok(())
}

/// Finds everything below a home that other users may read, write or enter, except the content of layers, which has the
/// permissions of its image.
fn find_open_to_others(path: &Path, found: &mut Vec<PathBuf>) -> Verdict {
    let about = match path.symlink_metadata() {
        // Servants come and go.
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(()),
        about => about?,
    };
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    // These files belong to the story.
    if about.is_symlink() || ["daemon.log", "test-config.toml"].contains(&&*name) {
        return Ok(());
    }
    let root_of_servant = name == "skeleton";
    if about.permissions().mode() & 0o077 != 0 && !root_of_servant {
        found.push(path.to_owned());
    }
    if about.is_dir() && !root_of_servant && name != "layers" {
        for entry in std::fs::read_dir(path).into_iter().flatten() {
            find_open_to_others(&entry?.path(), found)?;
        }
    }
    Ok(())
}

fn expect_closed(home: &Path) -> Verdict {
    let mut found = Vec::new();
    find_open_to_others(home, &mut found)?;
    ensure!(found.is_empty(), "open to others: {found:#?}");
    Ok(())
}

/// Restores the permissions of earlier versions.
fn open_up(path: &Path) -> Verdict {
    let about = path.symlink_metadata()?;
    if about.is_symlink() || ["skeleton", "layers"].iter().any(|name| path.ends_with(name)) {
        return Ok(());
    }
    let rights = if about.is_dir() { 0o755 } else { 0o644 };
    std::fs::set_permissions(path, Permissions::from_mode(rights))?;
    if about.is_dir() {
        for entry in std::fs::read_dir(path)? {
            open_up(&entry?.path())?;
        }
    }
    Ok(())
}

pub fn the_state_is_closed_to_others() -> Verdict {
    let setup = world().setup("closed");
    let daemon = setup.start()?;
    daemon.deployer().push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    let adds = |daemon: &Daemon| -> Verdict {
        let mut robot = daemon.robot("adder_py?robot=r1")?;
        let answer = robot.call("/add_two", json!({"a": 1, "b": 2}))?;
        ensure!(answer["values"]["sum"] == 3, "{answer}");
        expect_closed(&daemon.home)
    };
    adds(&daemon)?;
    // Other users cannot lock the ranges of user ids.
    let held = Command::new("flock")
        .args(["--shared", "--nonblock", "/run/cloudroid/uid-ranges", "true"])
        .uid(65534)
        .gid(65534)
        .output()?;
    let said = String::from_utf8_lossy(&held.stderr);
    ensure!(!held.status.success() && said.contains("Permission denied"), "{said}");
    let home = daemon.home.clone();
    daemon.stop()?;
    open_up(&home)?;
    let daemon = setup.start()?;
    expect_closed(&home)?;
    adds(&daemon)
}

pub fn a_taken_port_is_named() -> Verdict {
    let daemon = world().setup("port-owner").start()?;
    let said = world().setup("port-wanter").listen(&daemon.address).expect_refusal()?;
    ensure!(said.contains(&daemon.address) && said.contains("--listen"), "{said}");
    Ok(())
}

pub fn the_demo_ends_by_itself_and_leaves_nothing(ros: RosVersion) -> Verdict {
    let (service, answered, picture) = match ros {
        RosVersion::One => (PEOPLE, "people found", "people.png"),
        RosVersion::Two => (SEER, "14 of 14 pictures answered as recorded", "board.png"),
    };
    // The demo's daemon finds in the cache what the shared daemon has fetched for its base.
    world().daemon_with(service)?;
    let home = world().home(&format!("demo{}", ros.number()));
    let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
    let binaries = binaries::path("cloudroidd").parent().map(ToOwned::to_owned).unwrap_or_default();
    let outcome = run(Command::new(binaries::checkout().join("demo/demo"))
        .env("BIN", binaries)
        .env("CHECK", "1")
        .env("ROS", ros.number().to_string())
        .env("CLOUDROID_HOME", &home)
        .env("CLOUDROID_LISTEN", format!("127.0.0.1:{port}")))?
    .expect_success()?;
    ensure!(outcome.stdout.contains(answered), "{}", outcome.output());
    ensure!(home.join(picture).exists());
    let left = leftovers::find_leftovers(&home);
    ensure!(left.is_empty(), "left behind: {left:#?}");
    Ok(())
}

pub fn doctor_names_each_need() -> Verdict {
    let daemon = world().ensure_shared()?;
    let outcome = daemon.deployer().run(&["doctor"])?;
    for need in
        ["root", "overlay", "idmap", "user namespace", "seccomp", "landlock", "cgroup", "mmdebstrap", "cloudroid-init"]
    {
        ensure!(outcome.output().to_lowercase().contains(need), "{need} in:\n{}", outcome.output());
    }
    let answer: Value = daemon.deployer().run_json(&["doctor"])?;
    ensure!(answer.to_string().contains("mmdebstrap"), "{answer}");
    Ok(())
}

pub fn a_robot_that_stays_away_loses_its_servant_after_the_grace_time() -> Verdict {
    let daemon = world().setup("grace").config("[servant]\ngrace = \"1s\"\n").start()?;
    daemon.deployer().push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    let mut robot = daemon.robot("adder_py?robot=guest")?;
    robot.call("/add_two", json!({"a": 1, "b": 1}))?;
    let id = daemon.servant_of("adder_py", "guest")?["id"].as_str().unwrap_or_default().to_owned();
    robot.leave()?;
    support::wait_until("the servant's end", || {
        let left = daemon.servants_of("adder_py")?;
        Ok(if left.is_empty() { Ok(()) } else { Err(format!("{left:#?}")) })
    })?;
    ensure!(leftovers::cgroups(std::slice::from_ref(&id)).is_empty(), "{id} left a cgroup");
    // A robot that returns later gets a new servant.
    let mut robot = daemon.robot("adder_py?robot=guest")?;
    robot.call("/add_two", json!({"a": 1, "b": 1}))?;
    ensure!(daemon.servant_of("adder_py", "guest")?["id"] != id.as_str());
    Ok(())
}
