//! The main task: an unmodified package and an independent client find people in real images.

use std::process::Command;

use anyhow::{Context, ensure};
use support::deployer::run;
use support::world::{PEOPLE, world};
use support::{Verdict, binaries};

pub fn a_robot_finds_people_in_real_pictures() -> Verdict {
    let daemon = world().daemon_with(PEOPLE)?;
    let picture = daemon.home.join("people.png");
    let outcome = run(Command::new(binaries::python())
        .arg(binaries::checkout().join("demo/robot.py"))
        .arg(daemon.url("opencv_apps?robot=looker"))
        .args(["--frames", "4", "--picture"])
        .arg(&picture))?
    .expect_success()?;
    ensure!(outcome.stdout.contains("4 of 4 frames answered"), "{}", outcome.output());
    let size = std::fs::metadata(&picture).context("the annotated picture")?.len();
    ensure!(size > 10_000, "the annotated picture has only {size} bytes");
    Ok(())
}

pub fn the_interface_is_found_lazy_inputs_included() -> Verdict {
    let daemon = world().daemon_with(PEOPLE)?;
    let service = daemon.get_json("/api/v1/services/opencv_apps")?;
    let topics = service["interface"]["topics"].as_array().context("topics")?;
    let topic = |name: &str| {
        topics.iter().find(|topic| topic["name"] == name).with_context(|| format!("{name} among {topics:#?}"))
    };
    // people_detect subscribes to `image` only while `found` has subscribers.
    let image = topic("/image")?;
    ensure!(image["direction"] == "input" && image["lazy"] == true, "{image}");
    ensure!(image["type"] == "sensor_msgs/Image", "{image}");
    ensure!(image["md5"] == "060021388200f6f0f447d0fcd9c64743", "{image}");
    let found = topic("/people_detect/found")?;
    ensure!(found["direction"] == "output" && found["type"] == "opencv_apps/RectArrayStamped", "{found}");
    ensure!(topic("/people_detect/parameter_updates")?["latched"] == true);
    let services = service["interface"]["services"].as_array().context("services")?;
    for (name, kind) in [
        ("/people_detect/list", "nodelet/NodeletList"),
        ("/people_detect/set_parameters", "dynamic_reconfigure/Reconfigure"),
    ] {
        ensure!(
            services.iter().any(|service| service["name"] == name && service["type"] == kind),
            "{name} of type {kind} among {services:#?}"
        );
    }
    let parameters = service["interface"]["parameters"].as_array().context("parameters")?;
    ensure!(
        parameters.iter().any(|parameter| parameter["name"] == "/people_detect/hit_threshold"),
        "the parameters that the node writes are recorded: {parameters:#?}"
    );
    Ok(())
}
