//! The image store, judged by tools that are not ours.

use std::process::Command;

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::deployer::run;
use support::world::{ADDER, world};

use crate::access::token;

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

pub fn an_exported_service_is_published_on_another_server() -> Verdict {
    let one = world().own("exporting").start()?;
    let pushed = [
        "--name",
        "sevens",
        "--node",
        "adder.py",
        "--param",
        "offset=7",
        "--cpus",
        "0.5",
        "--memory",
        "256M",
        "--rrt",
        "90ms",
        "--stateful",
    ];
    one.deployer().pushes("adder_py", &pushed)?.succeeded()?;
    let row = ["sla", "set", "sevens", "--rrt", "50ms", "--cpus", "0.5"];
    one.deployer().types(&row)?.succeeded()?;
    let place = tempfile::tempdir()?;
    let at = |name: &str| place.path().join(name).display().to_string();
    let file = at("sevens.oci.tar");
    one.deployer()
        .types(&["export", "sevens", "-o", &file])?
        .succeeded()?;
    let before = one.get_json("/api/v1/services/sevens")?;
    let rows = one.get_json("/api/v1/services/sevens/sla")?;
    one.ends()?;

    let other = world().own("importing").start()?;
    let types = |words: &[&str]| other.deployer().types(words);
    let said = types(&["import", &file])?.succeeded()?;
    ensure!(
        said.said().contains("measured on another machine"),
        "{}",
        said.said()
    );
    let after = other.get_json("/api/v1/services/sevens")?;
    for key in [
        "image",
        "package",
        "limits",
        "interface",
        "nodes",
        "topics",
        "services",
    ] {
        ensure!(after[key] == before[key], "{key}: {after}, not {before}");
    }
    let source = after["revisions"][0]["source"].as_str().unwrap_or_default();
    ensure!(source.contains("sevens.oci.tar, exported from"), "{source}");
    let came = other.get_json("/api/v1/services/sevens/sla")?;
    for key in ["measure", "value", "limits"] {
        ensure!(came[0][key] == rows[0][key], "{came}, not {rows}");
    }
    let adds = |service: &str| -> Verdict {
        let mut robot = other.robot(service)?;
        let answer = robot.calls("/add_two", json!({"a": 1, "b": 2}))?;
        ensure!(answer["values"]["sum"] == 10, "{service}: {answer}");
        Ok(())
    };
    adds("sevens")?;
    // Again, as another revision, and under another name; its own rows stay.
    let again = types(&["import", &file])?.succeeded()?;
    ensure!(
        again.said().contains("has a dictionary already"),
        "{}",
        again.said()
    );
    types(&["import", &file, "--name", "sevens_too"])?.succeeded()?;
    adds("sevens_too")?;

    // What it says itself cannot be said again, and what is not such a file is told so; nothing of it is published.
    let bytes = std::fs::read(&file)?;
    std::fs::write(at("torn.tar"), &bytes[..bytes.len() / 2])?;
    let record = bytes.windows(9).position(|part| part == b"\"format\":");
    let mut changed = bytes.clone();
    changed[record.context("a record")? + 9] = b'9';
    std::fs::write(at("changed.tar"), changed)?;
    let image = format!("oci:{}:sevens", other.home.join("images").display());
    let plain = format!("oci-archive:{}:plain", at("plain.tar"));
    run(Command::new("skopeo").args(["--insecure-policy", "copy", &image, &plain]))?.succeeded()?;
    let rows: [(&[&str], &[&str]); 4] = [
        (
            &["push", &file, "--cpus", "2"],
            &["says itself how it is started"],
        ),
        (
            &["import", &at("torn.tar"), "--name", "torn"],
            &["cut off", "copy the whole file"],
        ),
        (
            &["import", &at("changed.tar"), "--name", "changed"],
            &["has the content of", "export the service again"],
        ),
        (
            &["import", &at("plain.tar"), "--name", "plain"],
            &["was not exported from a service", "next:"],
        ),
    ];
    for (words, expected) in rows {
        types(words)?.failed_saying(expected)?;
    }
    let names = other.get_json("/api/v1/services")?;
    let names = names.as_array().map_or(0, Vec::len);
    ensure!(names == 2, "{names} services");
    // Who may only see it exports the image, and is told that this cannot be imported.
    let admin = token(&other, &["chief", "--role", "admin"])?;
    let eve = token(&other, &["eve", "--role", "viewer", "--service", "sevens*"])?;
    let server = format!("http://{}", other.address);
    let hers = at("hers.tar");
    let typed = [
        "--server", &server, "--token", &eve, "export", "sevens", "-o", &hers,
    ];
    let said = types(&typed)?.succeeded()?;
    ensure!(
        said.said().contains("only the image is exported"),
        "{}",
        said.said()
    );
    let typed = ["--server", &server, "--token", &admin, "import", &hers];
    types(&typed)?.failed_saying(&["was not exported from a service"])?;
    is_pulled_with_a_token(&other.address, &eve, &at("pulled"))?;
    other.ends()?;
    Ok(())
}

/// What clients of registries do: they ask, are challenged, and ask again with a password, which is a token.
fn is_pulled_with_a_token(address: &str, token: &str, to: &str) -> Verdict {
    let image = format!("docker://{address}/sevens:latest");
    let pulls = |words: &[&str]| {
        let mut skopeo = Command::new("skopeo");
        skopeo.args(["--insecure-policy", "copy", "--src-tls-verify=false"]);
        run(skopeo.args(words).args([&image, &format!("dir:{to}")]))
    };
    pulls(&["--src-creds", &format!("cluster:{token}")])?.succeeded()?;
    for words in [&["--src-no-creds"][..], &["--src-creds", "cluster:guessed"]] {
        let refused = pulls(words)?;
        let said = refused.said().to_lowercase();
        ensure!(
            refused.status != 0 && said.contains("auth"),
            "{words:?}: {said}"
        );
    }
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
