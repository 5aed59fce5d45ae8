//! Resources granted to a service beyond its container: only those that its push requested and the operator allowed.

use std::net::TcpListener;

use anyhow::{Context, ensure};
use support::Verdict;
use support::deployer::path_str;
use support::grants::{CdiSpecification, INSIDE, KIND, check_grants, create_models};
use support::world::{BURGLAR, world};

pub fn a_service_is_given_what_its_operator_allows() -> Verdict {
    // A device kind of this run's own: of two specifications of the same device the later one counts, and a state
    // directory for the virtual machine, which may be created at the same time, contains such a device as well.
    let kind = format!("{KIND}-{}", std::process::id());
    let _specification = CdiSpecification::write(&kind)?;
    let place = tempfile::tempdir()?;
    let models = place.path().join("models");
    create_models(&models)?;
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let out = listener.local_addr()?.to_string();
    let config = format!("[allow]\ndevices = [\"{kind}=*\"]\nvolumes = [{models:?}]\negress = [\"{out}\"]\n");
    let daemon = world().setup("granted").config(&config).start()?;
    let device = format!("{kind}=zero");
    let pushed = daemon
        .deployer()
        .push(
            "burglar_cpp",
            &[
                "--node",
                "burglar",
                "--volume",
                &format!("{}:{INSIDE}", path_str(&models)),
                "--device",
                &device,
                "--egress",
                &out,
            ],
        )?
        .expect_success()?;
    let hook = format!("device {device}: its hook createRuntime (/bin/false story) is not run");
    let said = format!("{}{}", pushed.stdout, pushed.stderr);
    ensure!(said.contains(&hook), "{said}");
    let mut robot = daemon.robot("burglar_cpp?robot=r1")?;
    check_grants(&mut robot, &listener)?;
    let events = daemon.deployer().run_json(&["events"])?;
    let told = events
        .as_array()
        .context("events")?
        .iter()
        .any(|event| event["kind"] == "device-incomplete" && event["message"].to_string().contains(&hook));
    ensure!(told, "{events:#}");
    drop(robot);
    daemon.stop()?;
    Ok(())
}

pub fn nothing_is_given_unasked_or_unallowed() -> Verdict {
    let daemon = world().daemon_with(BURGLAR)?;
    for (flag, value, kind) in [
        ("--volume", "/etc:/models", "volume /etc"),
        ("--device", "nvidia.com/gpu=0", "device nvidia.com/gpu=0"),
        ("--egress", "example.org:443", "egress example.org:443"),
    ] {
        daemon
            .deployer()
            .push("burglar_cpp", &["--name", "greedy", "--node", "burglar", flag, value])?
            .expect_failure(&[kind, "not allowed", "[allow]"])?;
    }
    Ok(())
}
