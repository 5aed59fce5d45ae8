//! What a service is given beyond its container: only what its push asked for, and the operator allowed.

use std::net::TcpListener;

use anyhow::{Context, ensure};
use support::Verdict;
use support::deployer::path_str;
use support::grants::{INSIDE, KIND, Specification, are_there_and_no_more, lay_out};
use support::world::{BURGLAR, world};

pub fn a_service_is_given_what_its_operator_allows() -> Verdict {
    // Of a kind of this run's own: of two specifications of one device the later counts, and the state directory of the
    // virtual machine, which may be made at the same time, has such a device, too.
    let kind = format!("{KIND}-{}", std::process::id());
    let _specification = Specification::write(&kind)?;
    let place = tempfile::tempdir()?;
    let models = place.path().join("models");
    lay_out(&models)?;
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let out = listener.local_addr()?.to_string();
    let config = format!(
        "[allow]\ndevices = [\"{kind}=*\"]\nvolumes = [{models:?}]\negress = [\"{out}\"]\n"
    );
    let daemon = world().own("granted").config(&config).start()?;
    let device = format!("{kind}=zero");
    let pushed = daemon
        .deployer()
        .pushes(
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
        .succeeded()?;
    let hook = format!("device {device}: its hook createRuntime (/bin/false story) is not run");
    let said = format!("{}{}", pushed.stdout, pushed.stderr);
    ensure!(said.contains(&hook), "{said}");
    let mut robot = daemon.robot("burglar_cpp?robot=r1")?;
    are_there_and_no_more(&mut robot, &listener)?;
    let events = daemon.deployer().asks(&["events"])?;
    let told = events.as_array().context("events")?.iter().any(|event| {
        event["kind"] == "device-incomplete" && event["message"].to_string().contains(&hook)
    });
    ensure!(told, "{events:#}");
    drop(robot);
    daemon.ends()?;
    Ok(())
}

pub fn nothing_is_given_unasked_or_unallowed() -> Verdict {
    let daemon = world().with(BURGLAR)?;
    for (flag, value, kind) in [
        ("--volume", "/etc:/models", "volume /etc"),
        ("--device", "nvidia.com/gpu=0", "device nvidia.com/gpu=0"),
        ("--egress", "example.org:443", "egress example.org:443"),
    ] {
        daemon
            .deployer()
            .pushes(
                "burglar_cpp",
                &["--name", "greedy", "--node", "burglar", flag, value],
            )?
            .failed_saying(&[kind, "not allowed", "[allow]"])?;
    }
    Ok(())
}
