//! `make bench ONLY=push`: cost of a push that shares something with an earlier one. Needs root.

#![forbid(unsafe_code)]

mod cache;
mod packages;
mod steps;
mod workspace;

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use bench_report::{
    BenchDaemon, BenchReport, Target, TimedPush, create_directory, is_full_run, quantile_seconds, write_install_space,
};
use rand::{RngCore, SeedableRng, rngs::StdRng};

/// Title of the step in which the image is started once (`cloudroidd`'s push).
const PROBE: &str = "starting it once";
/// Time that a push without changes may take besides that step, in seconds.
const BOUND: f64 = 2.0;
/// Bytes of data in the larger space, such as a model; noise, so that it cannot be compressed.
const MODEL: usize = 64 << 20;

fn main() -> Result<()> {
    let place = create_directory()?;
    // Base and dependencies may be cached on this machine; what is pushed here must be new to it every time.
    let cache = cache::copy_user_cache(place.path())?;
    let daemon = BenchDaemon::start_in(place, "", &[("XDG_CACHE_HOME", &cache)])?;
    eprintln!(
        "pushing a launch file for topic_tools/relay: base and dependencies are made now, if they are not cached"
    );
    let first = write_install_space(daemon.directory(), "launch_only", None)?;
    push_launch_file(&daemon, &first)?;
    let relay = find_relay(&daemon)?;
    let mut report = BenchReport::new("push");
    workspace::measure(&mut report, &daemon)?;
    for (package, size, data) in [("small_space", "one node", 0), ("big_space", "one node and 64 MiB of data", MODEL)] {
        let space = write_install_space(daemon.directory(), package, Some(&relay))?;
        if data > 0 {
            let mut model = vec![0; data];
            StdRng::seed_from_u64(1).fill_bytes(&mut model);
            fs::write(space.join("share").join(package).join("model.bin"), model)?;
        }
        measure(&mut report, &daemon, &space, size)?;
    }
    drop(daemon);
    packages::measure(&mut report)?;
    report.finish()?;
    Ok(())
}

fn push_launch_file(daemon: &BenchDaemon, space: &Path) -> Result<TimedPush> {
    daemon.push(&[space.to_str().context("UTF-8")?, "--launch", "relay.launch"])
}

/// Returns the node's executable from the image.
fn find_relay(daemon: &BenchDaemon) -> Result<PathBuf> {
    let layers = fs::read_dir(daemon.home.join("layers"))?;
    let mut found = layers.filter_map(|layer| Some(layer.ok()?.path().join("usr/lib/topic_tools/relay")));
    found.find(|path| path.exists()).context("topic_tools/relay in a layer")
}

fn measure(report: &mut BenchReport, daemon: &BenchDaemon, space: &Path, size: &str) -> Result<()> {
    eprintln!("pushing {size}");
    let first = push_launch_file(daemon, space)?;
    let made = first.built_layers()?;
    ensure!(made == ["package"], "only the package is new at the first push, and not {made:?}");
    let rounds = if is_full_run() { 15 } else { 5 };
    let (mut rebuilt, mut rests, mut probes, mut totals) = (0, vec![], vec![], vec![]);
    for round in 1..=rounds {
        eprintln!("again, {round} of {rounds}");
        let again = push_launch_file(daemon, space)?;
        let probe = again.step_duration(PROBE).context("a push tells of its probe")?;
        rebuilt += again.built_layers()?.len();
        rests.push(again.total - probe);
        probes.push(probe);
        totals.push(again.total);
    }
    let median = |times: &[Duration]| quantile_seconds(times, 0.5);
    let first_probe = first.step_duration(PROBE).context("a push tells of its probe")?;
    let probe = median(&probes);
    let title = format!("{size}, again: layers made");
    report.figure(title, "layers", rebuilt as f64).require(Target::AtMost(0.0));
    let figure = report.figure(format!("{size}, again: without the probe"), "s", median(&rests));
    figure.relative_to("first push", (first.total - first_probe).as_secs_f64()).require(Target::AtMost(BOUND));
    figure.note(format!("median of {rounds}; the probe {probe:.2} s"));
    let title = format!("{size}, again: with the probe");
    report.figure(title, "s", median(&totals)).relative_to("first push", first.total.as_secs_f64());
    Ok(())
}
