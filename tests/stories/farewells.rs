//! A stub that is asked to end while the server cannot be reached.

use std::time::Duration;

use anyhow::{Context, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use ros::bus::RosVersion;
use support::Verdict;
use support::patience::Deadline;
use support::site::Site;
use support::world::{ADDER, HERALD, world};

/// Time after which launch sends another signal, which would kill this stub; on an idle machine.
const LAUNCH: Duration = Duration::from_secs(5);

/// With a T_max so long that the link does not notice anything before.
const PATIENT: &str = "local = \"none\"\ndesire = 30.0\nmax = 60.0\n";

pub fn a_stub_ends_beside_a_daemon_that_is_frozen_or_killed(ros: RosVersion) -> Verdict {
    let (service, executable, topic) = match ros {
        RosVersion::One => (ADDER, "adder.py", "/sums"),
        RosVersion::Two => (HERALD, "herald", "/greeting"),
    };
    let setup = world().setup(&format!("farewells-{}", ros.number()));
    let daemon = setup.start()?;
    let package = service.package.context("one of ours")?;
    let push = daemon.deployer().push(package, service.arguments)?;
    push.expect_success()?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
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
        let stub = site.start_stub_with_config(&toml, package, executable, &[])?;
        site.wait_for_graph(&app, topic, |graph| graph.topics.contains_key(topic)).with_context(|| stub.output())?;
        anyhow::Ok(stub)
    };
    let mut stub = begins("frozen")?;
    kill(pid, Signal::SIGSTOP)?;
    let deadline = Deadline::begin_for(LAUNCH);
    stub.signal(Signal::SIGTERM)?;
    let ended = stub.wait_for_exit();
    let is_late = deadline.is_over();
    kill(pid, Signal::SIGCONT)?;
    ended?;
    ensure!(!is_late, "{}", stub.output());
    site.wait_for_graph(&app, "nothing of it", |graph| !graph.topics.contains_key(topic))?;
    let mut stub = begins("killed")?;
    daemon.kill()?;
    let deadline = Deadline::begin_for(LAUNCH);
    stub.signal(Signal::SIGTERM)?;
    stub.wait_for_exit()?;
    let is_late = deadline.is_over();
    ensure!(!is_late, "{}", stub.output());
    let daemon = setup.start()?;
    daemon.deployer().run(&["stop", "--all"])?;
    daemon.stop()?;
    Ok(())
}
