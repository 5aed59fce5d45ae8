//! The image store, judged by tools that are not ours.

use std::process::Command;

use anyhow::ensure;
use serde_json::Value;
use support::Verdict;
use support::deployer::run;
use support::world::{ADDER, world};

pub fn skopeo_and_umoci_read_the_store() -> Verdict {
    let daemon = world().with(ADDER)?;
    let store = daemon.home.join("images");
    let inspected = run(Command::new("skopeo")
        .arg("inspect")
        .arg(format!("oci:{}:adder_py", store.display())))?;
    let inspected: Value = serde_json::from_str(&inspected.succeeded()?.stdout)?;
    ensure!(
        inspected["Layers"]
            .as_array()
            .is_some_and(|layers| layers.len() >= 2),
        "{inspected}"
    );
    ensure!(
        inspected["Architecture"] == "amd64" && inspected["Os"] == "linux",
        "{inspected}"
    );
    let place = tempfile::tempdir()?;
    let bundle = place.path().join("bundle");
    run(Command::new("umoci")
        .args([
            "unpack",
            "--image",
            &format!("{}:adder_py", store.display()),
        ])
        .arg(&bundle))?
    .succeeded()?;
    ensure!(
        bundle
            .join("rootfs/usr/bin/python3")
            .symlink_metadata()
            .is_ok(),
        "the base is there"
    );
    // What the registry interface serves is the same image.
    let (status, manifest) = daemon.get("/v2/adder_py/manifests/latest")?;
    ensure!(status == 200, "{status} {manifest}");
    let manifest: Value = serde_json::from_str(&manifest)?;
    let served: Vec<_> = manifest["layers"]
        .as_array()
        .into_iter()
        .flatten()
        .map(|layer| &layer["digest"])
        .collect();
    let stored: Vec<_> = inspected["Layers"]
        .as_array()
        .into_iter()
        .flatten()
        .collect();
    ensure!(served == stored, "{served:?} against {stored:?}");
    // So is what the command line writes into a file.
    let file = place.path().join("adder.tar").display().to_string();
    let deployer = daemon.deployer();
    deployer
        .types(&["export", "adder_py", "-o", &file])?
        .succeeded()?;
    let archive = format!("oci-archive:{file}");
    let exported = run(Command::new("skopeo").args(["inspect", &archive]))?;
    let exported: Value = serde_json::from_str(&exported.succeeded()?.stdout)?;
    for key in ["Digest", "Layers"] {
        ensure!(
            exported[key] == inspected[key],
            "{exported}, not {inspected}"
        );
    }
    let copied = format!("dir:{}", place.path().join("copied").display());
    // Reads every blob, and compares its digest.
    run(Command::new("skopeo").args(["--insecure-policy", "copy", &archive, &copied]))?
        .succeeded()?;
    // What is not there is told by the status, and writes nothing.
    let nowhere = place.path().join("nowhere.tar").display().to_string();
    for missing in [&["adder_py", "--revision", "9"][..], &["nobody"]] {
        let words = [&["export", "-o", nowhere.as_str()][..], missing].concat();
        let refused = deployer.types(&words)?;
        ensure!(refused.status == 5, "{missing:?}: {}", refused.status);
    }
    let left = std::fs::read_dir(place.path())?.count();
    ensure!(left == 3, "{left} files: bundle, adder.tar, copied");
    Ok(())
}

pub fn what_nobody_refers_to_is_collected() -> Verdict {
    let daemon = world().with(ADDER)?;
    let deployer = daemon.deployer();
    deployer
        .pushes(
            "adder_py",
            &[
                "--name", "fleeting", "--node", "adder.py", "--param", "offset=7",
            ],
        )?
        .succeeded()?;
    let image = daemon.get_json("/api/v1/services/fleeting")?["image"]
        .as_str()
        .unwrap_or_default()
        .to_owned();
    let blob = daemon
        .home
        .join("images/blobs/sha256")
        .join(image.trim_start_matches("sha256:"));
    ensure!(blob.exists(), "{}", blob.display());
    let shared = run(Command::new("skopeo").args([
        "inspect",
        &format!("oci:{}:adder_py", daemon.home.join("images").display()),
    ]))?;
    shared.succeeded()?;
    deployer.types(&["rm", "fleeting"])?.succeeded()?;
    ensure!(
        !blob.exists() || daemon.get_json("/api/v1/services/adder_py")?["image"] == image.as_str(),
        "the image of a removed service is collected"
    );
    run(Command::new("skopeo").args([
        "inspect",
        &format!("oci:{}:adder_py", daemon.home.join("images").display()),
    ]))?
    .succeeded()?;
    Ok(())
}
