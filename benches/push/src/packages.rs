//! Two packages of the distribution that share nearly all of their dependencies.

use std::fs;
use std::path::Path;

use anyhow::{Context, Result};
use bench_report::{BenchDaemon, BenchReport, Target, TimedPush, create_directory};
use serde_json::Value;

use crate::{PROBE, cache, steps};

/// Limit for the cost of the second push, as a fraction of the first.
const BOUND: f64 = 0.2;
/// The first package, and one whose dependencies are the first and those of the first.
const PACKAGES: [&str; 2] = ["image_proc", "stereo_image_proc"];

pub(crate) fn measure(report: &mut BenchReport) -> Result<()> {
    let place = create_directory()?;
    // A first run with whatever this user has cached, for the base and the downloads.
    let begun = cache::copy_user_cache(place.path())?;
    let daemon = BenchDaemon::start_in(place, "", &[("XDG_CACHE_HOME", &begun)])?;
    let mut base = None;
    for package in PACKAGES {
        eprintln!("pushing {package} for what it downloads");
        base = Some(base_digest(&push_package(&daemon, package)?)?);
    }
    let second = create_directory()?;
    let fresh = second.path().join("cache");
    cache::copy_base_and_downloads(&begun, &fresh, &base.context("two packages")?)?;
    drop(daemon);
    let daemon = BenchDaemon::start_in(second, "", &[("XDG_CACHE_HOME", &fresh)])?;
    let mut costs = Vec::new();
    for package in PACKAGES {
        eprintln!("pushing {package} with the base and all downloads in the cache");
        let pushed = push_package(&daemon, package)?;
        steps::report_steps(report, package, &pushed);
        let probe = pushed.step_duration(PROBE).context("a push tells of its probe")?;
        costs.push((
            (pushed.total - probe - pushed.time_to_first_step()).as_secs_f64(),
            pushed.total.as_secs_f64(),
            pushed.built_layers()?.len(),
        ));
    }
    let [first, second] = costs[..] else {
        anyhow::bail!("two packages, and not {costs:?}");
    };
    let figure =
        report.figure("stereo_image_proc after image_proc: from the first step on, without the probe", "s", second.0);
    figure.relative_to("image_proc", first.0).require(Target::RatioAtMost(BOUND));
    figure.note(format!("layers made: {} and {}", second.2, first.2));
    let title = "stereo_image_proc after image_proc: with the probe";
    report.figure(title, "s", second.1).relative_to("image_proc", first.1);
    Ok(())
}

fn push_package(daemon: &BenchDaemon, package: &str) -> Result<TimedPush> {
    daemon.push(&["--apt", package, "--node", package])
}

/// Returns the digest of the base layer.
fn base_digest(pushed: &TimedPush) -> Result<String> {
    let layers = pushed.done_event()?["layers"].as_array().context("done names the layers")?;
    let base = layers.iter().find(|layer| layer["name"] == "base");
    let digest = base.and_then(|layer| layer["digest"].as_str());
    Ok(digest.context("an image has a base")?.to_owned())
}

/// Returns whether a record of the cache belongs to the layer with this digest.
pub(crate) fn is_record_of_layer(record: &Path, digest: &str) -> bool {
    let record: Option<Value> = fs::read(record).ok().and_then(|text| serde_json::from_slice(&text).ok());
    record.is_some_and(|record| record["layer"]["digest"] == digest)
}
