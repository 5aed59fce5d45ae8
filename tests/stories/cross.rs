//! Robots of other architectures. `make test-cross` builds their programs and tells these stories; qemu-user runs them.

use anyhow::{Context, ensure};
use support::Verdict;
use support::site::{Site, registered, string};
use support::world::{TELLER, world};

/// A robot with this architecture's stub: its node is there, hears and speaks.
fn works_on(architecture: &str, emulator: &str) -> Verdict {
    let daemon = world().with(TELLER)?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let settings = format!("robot = \"cross-{architecture}\"\nlocal = \"none\"\n");
    let overlay = site.installs_for(&daemon, "teller_py", architecture, &settings)?;
    let stub = site.emulates(emulator, &overlay, "teller_py", "teller.py", &[])?;
    let mut said = site.hears(&app, "/teller/said")?;
    let say = site.says(&app, "/teller/say", false)?;
    site.connected(&*say, 1).with_context(|| stub.said())?;
    site.fed(&said, 1).with_context(|| stub.said())?;
    say.publish(string(architecture));
    let heard = site.next(&mut said).with_context(|| stub.said())?;
    ensure!(heard.bytes == string(architecture), "{heard:?}");
    let graph = site.until(&app, "the loggers", |graph| {
        graph.services.contains_key("/teller/get_loggers")
    })?;
    ensure!(registered(&graph, "/teller").len() >= 5, "{graph:#?}");
    Ok(())
}

pub fn an_aarch64_robot_works() -> Verdict {
    works_on("aarch64", "qemu-aarch64")
}

pub fn an_armv7_robot_works() -> Verdict {
    works_on("armv7", "qemu-arm")
}
