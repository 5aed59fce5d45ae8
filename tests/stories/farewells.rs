//! A stub that is told to end, while what it stands for cannot be told.

use std::time::Duration;

use anyhow::{Context, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use ros::bus::RosVersion;
use support::Verdict;
use support::patience::Deadline;
use support::site::Site;
use support::world::{ADDER, HERALD, world};

/// After which launch sends another signal, and this stub would end by that; where nothing else runs.
const LAUNCH: Duration = Duration::from_secs(5);

/// With a T_max so long that the link itself would notice nothing for as long.
const PATIENT: &str = "local = \"none\"\ndesire = 30.0\nmax = 60.0\n";

pub fn a_stub_ends_beside_a_daemon_that_is_frozen_or_killed(ros: RosVersion) -> Verdict {
    let (service, executable, topic) = match ros {
        RosVersion::One => (ADDER, "adder.py", "/sums"),
        RosVersion::Two => (HERALD, "herald", "/greeting"),
    };
    let setup = world().own(&format!("farewells-{}", ros.number()));
    let daemon = setup.start()?;
    let package = service.package.context("one of ours")?;
    let push = daemon.deployer().pushes(package, service.arguments)?;
    push.succeeded()?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    let pid = Pid::from_raw(daemon.pid());
    let begins = |robot: &str| {
        let toml = format!(
            "server = \"ws://{}\"\nservice = \"{}\"\nrobot = \"{robot}\"\n{PATIENT}",
            daemon.address, service.name
        );
        let package = match ros {
            RosVersion::One => service.name,
            RosVersion::Two => "herald",
        };
        let stub = site.stub_with(&toml, package, executable, &[])?;
        site.until(&app, topic, |graph| graph.topics.contains_key(topic))
            .with_context(|| stub.said())?;
        anyhow::Ok(stub)
    };
    let mut stub = begins("frozen")?;
    kill(pid, Signal::SIGSTOP)?;
    let deadline = Deadline::begin_for(LAUNCH);
    stub.signal(Signal::SIGTERM)?;
    let ended = stub.ends();
    let is_late = deadline.is_over();
    kill(pid, Signal::SIGCONT)?;
    ended?;
    ensure!(!is_late, "{}", stub.said());
    site.until(&app, "nothing of it", |graph| {
        !graph.topics.contains_key(topic)
    })?;
    let mut stub = begins("killed")?;
    daemon.is_killed()?;
    let deadline = Deadline::begin_for(LAUNCH);
    stub.signal(Signal::SIGTERM)?;
    stub.ends()?;
    let is_late = deadline.is_over();
    ensure!(!is_late, "{}", stub.said());
    let daemon = setup.start()?;
    daemon.deployer().types(&["stop", "--all"])?;
    daemon.ends()?;
    Ok(())
}
