//! Two packages of the distribution that share nearly all that they need: what the second one costs beside the first.

use std::fs;
use std::path::Path;

use anyhow::{Context, Result};
use bench_report::{Report, Target};
use bench_servant::{Daemon, Pushed};
use serde_json::Value;

use crate::{PROBE, cache, steps};

/// What the second may cost, of what the first did.
const BOUND: f64 = 0.2;
/// The first, and one whose dependencies are those of the first and itself.
const PACKAGES: [&str; 2] = ["image_proc", "stereo_image_proc"];

pub(crate) fn measure(report: &mut Report) -> Result<()> {
    let place = place()?;
    // Once with whatever this user has cached, for the base and the downloads.
    let begun = cache::copy(place.path())?;
    let daemon = Daemon::start(place, "", &[("XDG_CACHE_HOME", &begun)])?;
    let mut base = None;
    for package in PACKAGES {
        eprintln!("pushing {package} for what it downloads");
        base = Some(base_of(&push(&daemon, package)?)?);
    }
    let second = self::place()?;
    let fresh = second.path().join("cache");
    cache::base_and_downloads(&begun, &fresh, &base.context("two packages")?)?;
    drop(daemon);
    let daemon = Daemon::start(second, "", &[("XDG_CACHE_HOME", &fresh)])?;
    let mut costs = Vec::new();
    for package in PACKAGES {
        eprintln!("pushing {package} with the base and all downloads in the cache");
        let pushed = push(&daemon, package)?;
        steps::tell(report, package, &pushed);
        let probe = pushed.step(PROBE).context("a push tells of its probe")?;
        costs.push((
            (pushed.total - probe - pushed.opening()).as_secs_f64(),
            pushed.total.as_secs_f64(),
            pushed.layers_made()?.len(),
        ));
    }
    let [first, second] = costs[..] else {
        anyhow::bail!("two packages, and not {costs:?}");
    };
    report
        .figure(
            "stereo_image_proc after image_proc: from the first step on, without the probe",
            "s",
            second.0,
        )
        .beside("image_proc", first.0)
        .reach(Target::RatioAtMost(BOUND))
        .note(format!("layers made: {} and {}", second.2, first.2));
    report
        .figure(
            "stereo_image_proc after image_proc: with the probe",
            "s",
            second.1,
        )
        .beside("image_proc", first.1);
    Ok(())
}

fn place() -> Result<tempfile::TempDir> {
    Ok(tempfile::Builder::new()
        .prefix("cloudroid-bench-")
        .tempdir()?)
}

fn push(daemon: &Daemon, package: &str) -> Result<Pushed> {
    daemon.push(&["--apt", package, "--node", package])
}

/// The digest of the base layer.
fn base_of(pushed: &Pushed) -> Result<String> {
    let layers = pushed.done()?["layers"]
        .as_array()
        .context("done names the layers")?;
    let base = layers.iter().find(|layer| layer["name"] == "base");
    let digest = base.and_then(|layer| layer["digest"].as_str());
    Ok(digest.context("an image has a base")?.to_owned())
}

/// Whether a record of the cache is that of a layer.
pub(crate) fn is_of(record: &Path, digest: &str) -> bool {
    let record: Option<Value> = fs::read(record)
        .ok()
        .and_then(|text| serde_json::from_slice(&text).ok());
    record.is_some_and(|record| record["layer"]["digest"] == digest)
}
