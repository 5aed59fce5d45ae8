//! Robots of other architectures. `make test-cross` builds their programs and runs these stories; qemu-user executes
//! them.

use anyhow::{Context, ensure};
use support::Verdict;
use support::site::{Site, registrations, string};
use support::world::{TELLER, world};

/// Checks a robot with the stub of this architecture: its node exists, receives and publishes.
fn run_architecture(architecture: &str, emulator: &str) -> Verdict {
    let daemon = world().daemon_with(TELLER)?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let settings = format!("robot = \"cross-{architecture}\"\nlocal = \"none\"\n");
    let overlay = site.install_stub_for(&daemon, "teller_py", architecture, &settings)?;
    let stub = site.start_emulated(emulator, &overlay, "teller_py", "teller.py", &[])?;
    let mut said = site.subscribe(&app, "/teller/said")?;
    let say = site.advertise_strings(&app, "/teller/say", false)?;
    site.wait_for_subscribers(&*say, 1).with_context(|| stub.output())?;
    site.wait_for_publishers(&said, 1).with_context(|| stub.output())?;
    say.publish(string(architecture));
    let heard = site.next_message(&mut said).with_context(|| stub.output())?;
    ensure!(heard.bytes == string(architecture), "{heard:?}");
    let graph = site.wait_for_graph(&app, "the loggers", |graph| graph.services.contains_key("/teller/get_loggers"))?;
    ensure!(registrations(&graph, "/teller").len() >= 5, "{graph:#?}");
    Ok(())
}

pub fn an_aarch64_robot_works() -> Verdict {
    run_architecture("aarch64", "qemu-aarch64")
}

pub fn an_armv7_robot_works() -> Verdict {
    run_architecture("armv7", "qemu-arm")
}
