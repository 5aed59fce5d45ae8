//! `make bench ONLY=push`: what a push costs beside one that it shares something with: a package that needs nearly the
//! same, a workspace of which one package changed, an install space that has not changed. Needs root.

#![forbid(unsafe_code)]

mod cache;
mod packages;
mod steps;
mod workspace;

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use bench_report::{Report, Target};
use bench_servant::{Daemon, Pushed, full, space};
use rand::{RngCore, SeedableRng, rngs::StdRng};

/// Title of the step in which the image is started once (`cloudroidd`'s push).
const PROBE: &str = "starting it once";
/// What a push without changes may take besides, in seconds.
const BOUND: f64 = 2.0;
/// Bytes of data in the bigger space: a model, say. Noise, so that no compressor makes it small.
const MODEL: usize = 64 << 20;

fn main() -> Result<()> {
    let place = tempfile::Builder::new()
        .prefix("cloudroid-bench-")
        .tempdir()?;
    // Base and dependencies are as cached on this machine; what is pushed here must be new to it, every time.
    let cache = cache::copy(place.path())?;
    let daemon = Daemon::start(place, "", &[("XDG_CACHE_HOME", &cache)])?;
    eprintln!(
        "pushing a launch file for topic_tools/relay: base and dependencies are made now, if they are not cached"
    );
    let first = space(daemon.place(), "launch_only", None)?;
    push(&daemon, &first)?;
    let relay = relay_of(&daemon)?;
    let mut report = Report::new("push");
    workspace::measure(&mut report, &daemon)?;
    for (package, size, data) in [
        ("small_space", "one node", 0),
        ("big_space", "one node and 64 MiB of data", MODEL),
    ] {
        let space = space(daemon.place(), package, Some(&relay))?;
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

fn push(daemon: &Daemon, space: &Path) -> Result<Pushed> {
    daemon.push(&[space.to_str().context("UTF-8")?, "--launch", "relay.launch"])
}

/// The node's program, out of the image.
fn relay_of(daemon: &Daemon) -> Result<PathBuf> {
    let layers = fs::read_dir(daemon.home().join("layers"))?;
    let mut found =
        layers.filter_map(|layer| Some(layer.ok()?.path().join("usr/lib/topic_tools/relay")));
    found
        .find(|path| path.exists())
        .context("topic_tools/relay in a layer")
}

fn measure(report: &mut Report, daemon: &Daemon, space: &Path, size: &str) -> Result<()> {
    eprintln!("pushing {size}");
    let first = push(daemon, space)?;
    let made = first.layers_made()?;
    ensure!(
        made == ["package"],
        "only the package is new at the first push, and not {made:?}"
    );
    let rounds = if full() { 15 } else { 5 };
    let (mut rebuilt, mut rests, mut probes, mut totals) = (0, vec![], vec![], vec![]);
    for round in 1..=rounds {
        eprintln!("again, {round} of {rounds}");
        let again = push(daemon, space)?;
        let probe = again.step(PROBE).context("a push tells of its probe")?;
        rebuilt += again.layers_made()?.len();
        rests.push(again.total - probe);
        probes.push(probe);
        totals.push(again.total);
    }
    let median = |times: &[Duration]| {
        bench_report::quantile(times, 0.5).map_or(f64::NAN, |time| time.as_secs_f64())
    };
    let first_probe = first.step(PROBE).context("a push tells of its probe")?;
    let probe = median(&probes);
    report
        .figure(
            format!("{size}, again: layers made"),
            "layers",
            rebuilt as f64,
        )
        .reach(Target::AtMost(0.0));
    report
        .figure(
            format!("{size}, again: without the probe"),
            "s",
            median(&rests),
        )
        .beside("first push", (first.total - first_probe).as_secs_f64())
        .reach(Target::AtMost(BOUND))
        .note(format!("median of {rounds}; the probe {probe:.2} s"));
    report
        .figure(
            format!("{size}, again: with the probe"),
            "s",
            median(&totals),
        )
        .beside("first push", first.total.as_secs_f64());
    Ok(())
}
