//! The image store, checked with independent tools.

use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::binaries;
use support::daemon::{Daemon, DaemonSetup};
use support::deployer::run;
use support::world::{ADDER, COURIER, HERALD, LOCALISER_TWO, world};

use crate::access::create_token;

pub fn skopeo_and_umoci_read_the_store() -> Verdict {
    let daemon = world().daemon_with(ADDER)?;
    let store = daemon.home.join("images");
    let inspected = run(Command::new("skopeo").arg("inspect").arg(format!("oci:{}:adder_py", store.display())))?;
    let inspected: Value = serde_json::from_str(&inspected.expect_success()?.stdout)?;
    ensure!(inspected["Layers"].as_array().is_some_and(|layers| layers.len() >= 2), "{inspected}");
    ensure!(inspected["Architecture"] == "amd64" && inspected["Os"] == "linux", "{inspected}");
    let place = tempfile::tempdir()?;
    let bundle = place.path().join("bundle");
    run(Command::new("umoci").args(["unpack", "--image", &format!("{}:adder_py", store.display())]).arg(&bundle))?
        .expect_success()?;
    ensure!(bundle.join("rootfs/usr/bin/python3").symlink_metadata().is_ok(), "the base is there");
    // The registry API serves the same image.
    let (status, manifest) = daemon.get("/v2/adder_py/manifests/latest")?;
    ensure!(status == 200, "{status} {manifest}");
    let manifest: Value = serde_json::from_str(&manifest)?;
    let served: Vec<_> = manifest["layers"].as_array().into_iter().flatten().map(|layer| &layer["digest"]).collect();
    let stored: Vec<_> = inspected["Layers"].as_array().into_iter().flatten().collect();
    ensure!(served == stored, "{served:?} against {stored:?}");
    // The command line exports the same image to a file.
    let file = place.path().join("adder.tar").display().to_string();
    let deployer = daemon.deployer();
    deployer.run(&["export", "adder_py", "-o", &file])?.expect_success()?;
    let archive = format!("oci-archive:{file}");
    let exported = run(Command::new("skopeo").args(["inspect", &archive]))?;
    let exported: Value = serde_json::from_str(&exported.expect_success()?.stdout)?;
    for key in ["Digest", "Layers"] {
        ensure!(exported[key] == inspected[key], "{exported}, not {inspected}");
    }
    let copied = format!("dir:{}", place.path().join("copied").display());
    // Reads every blob and compares its digest.
    run(Command::new("skopeo").args(["--insecure-policy", "copy", &archive, &copied]))?.expect_success()?;
    // A missing image is reported by the exit status, and no file is written.
    let nowhere = place.path().join("nowhere.tar").display().to_string();
    for missing in [&["adder_py", "--revision", "9"][..], &["nobody"]] {
        let words = [&["export", "-o", nowhere.as_str()][..], missing].concat();
        let refused = deployer.run(&words)?;
        ensure!(refused.status == 5, "{missing:?}: {}", refused.status);
    }
    let left = std::fs::read_dir(place.path())?.count();
    ensure!(left == 3, "{left} files: bundle, adder.tar, copied");
    Ok(())
}

pub fn an_exported_service_is_published_on_another_server() -> Verdict {
    let one = world().setup("exporting").start()?;
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
    one.deployer().push("adder_py", &pushed)?.expect_success()?;
    let row = ["sla", "set", "sevens", "--rrt", "50ms", "--cpus", "0.5"];
    one.deployer().run(&row)?.expect_success()?;
    let place = tempfile::tempdir()?;
    let at = |name: &str| place.path().join(name).display().to_string();
    let file = at("sevens.oci.tar");
    one.deployer().run(&["export", "sevens", "-o", &file])?.expect_success()?;
    let before = one.get_json("/api/v1/services/sevens")?;
    let rows = one.get_json("/api/v1/services/sevens/sla")?;
    one.stop()?;

    let other = world().setup("importing").start()?;
    let types = |words: &[&str]| other.deployer().run(words);
    let said = types(&["import", &file])?.expect_success()?;
    ensure!(said.output().contains("measured on another machine"), "{}", said.output());
    let after = other.get_json("/api/v1/services/sevens")?;
    for key in ["image", "package", "limits", "interface", "nodes", "topics", "services"] {
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
        let answer = robot.call("/add_two", json!({"a": 1, "b": 2}))?;
        ensure!(answer["values"]["sum"] == 10, "{service}: {answer}");
        Ok(())
    };
    adds("sevens")?;
    // Imported again it is unchanged, or a service with another name; rows of the existing service are kept.
    let again = types(&["import", &file])?.expect_success()?;
    ensure!(again.stdout.contains("== unchanged: revision 1 serves"), "{}", again.output());
    ensure!(again.output().contains("keeps its existing SLA table"), "{}", again.output());
    types(&["import", &file, "--name", "sevens_too"])?.expect_success()?;
    adds("sevens_too")?;

    // Properties of the image cannot be given again, and other files are rejected; nothing is published in these cases.
    let bytes = std::fs::read(&file)?;
    std::fs::write(at("torn.tar"), &bytes[..bytes.len() / 2])?;
    let record = bytes.windows(9).position(|part| part == b"\"format\":");
    let mut changed = bytes.clone();
    changed[record.context("a record")? + 9] = b'9';
    std::fs::write(at("changed.tar"), changed)?;
    let image = format!("oci:{}:sevens", other.home.join("images").display());
    let plain = format!("oci-archive:{}:plain", at("plain.tar"));
    run(Command::new("skopeo").args(["--insecure-policy", "copy", &image, &plain]))?.expect_success()?;
    let rows: [(&[&str], &[&str]); 4] = [
        (&["push", &file, "--cpus", "2"], &["includes its start commands"]),
        (&["import", &at("torn.tar"), "--name", "torn"], &["truncated", "copy the whole file"]),
        (&["import", &at("changed.tar"), "--name", "changed"], &["has the content of", "export the service again"]),
        (&["import", &at("plain.tar"), "--name", "plain"], &["is not an exported service", "next:"]),
    ];
    for (words, expected) in rows {
        types(words)?.expect_failure(expected)?;
    }
    let names = other.get_json("/api/v1/services")?;
    let names = names.as_array().map_or(0, Vec::len);
    ensure!(names == 2, "{names} services");
    // A principal who may only view can export the image, and is told that the export cannot be imported.
    let admin = create_token(&other, &["chief", "--role", "admin"])?;
    let eve = create_token(&other, &["eve", "--role", "viewer", "--service", "sevens*"])?;
    let server = format!("http://{}", other.address);
    let hers = at("hers.tar");
    let typed = ["--server", &server, "--token", &eve, "export", "sevens", "-o", &hers];
    let said = types(&typed)?.expect_success()?;
    ensure!(said.output().contains("only the image is exported"), "{}", said.output());
    let typed = ["--server", &server, "--token", &admin, "import", &hers];
    types(&typed)?.expect_failure(&["is not an exported service"])?;
    other.stop()?;
    Ok(())
}

/// File that lists the programs that would have set up a base.
const CALLED: &str = "called";

/// Returns the setup of a daemon where nothing is cached, nothing answers where packages of a base come from, and what
/// would set a base up does not.
fn offline_setup(name: &str, place: &Path, base: &str) -> anyhow::Result<DaemonSetup> {
    let programs = place.join("bin");
    std::fs::create_dir(&programs)?;
    for program in ["mmdebstrap", "pip3"] {
        let path = programs.join(program);
        std::fs::write(&path, format!("#!/bin/sh\necho $0 >> {}\nexit 1\n", place.join(CALLED).display()))?;
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755))?;
    }
    Ok(world()
        .setup(name)
        .environment("PATH", &format!("{}:{}", programs.display(), std::env::var("PATH")?))
        .environment("XDG_CACHE_HOME", &place.join("cache").display().to_string())
        .config(&format!("[archives]\n{base} = [\"deb http://127.0.0.1:9/debian bookworm main\"]\n")))
}

/// Returns what was found of a subject in the image of a base, and its consequence.
fn finding(base: &Value, subject: &str) -> anyhow::Result<[String; 2]> {
    let mut all = base["findings"].as_array().context("findings")?.iter();
    let found = all.find(|one| one["subject"] == subject).with_context(|| format!("no {subject} in {base:#}"))?;
    Ok(["found", "consequence"].map(|field| found[field].as_str().unwrap_or_default().to_owned()))
}

/// Checks that a robot hears the node of the courier.
fn hear_courier(daemon: &Daemon, service: &str) -> Verdict {
    let mut robot = daemon.robot(&format!("{service}?robot=of-{service}"))?;
    robot.send(json!({"op": "subscribe", "topic": "/home",
        "qos": {"reliability": "reliable", "durability": "transient_local", "depth": 1}}))?;
    let told = robot.next_message_on("/home")?;
    ensure!(told["data"] == "in the clouds", "{told}");
    robot.leave()
}

pub fn a_saved_image_becomes_a_base() -> Verdict {
    const BASE: &str = "bookworm-jazzy-wheels";
    let one = world().daemon_with(COURIER)?;
    let place = world().directory("saved")?;
    let at = |name: &str| place.path().join(name).display().to_string();
    // As `podman save` and `skopeo copy` write an image: with layers that are not compressed, and as a directory.
    one.deployer().run(&["base", "export", BASE, "-o", &at("base.oci.tar")])?.expect_success()?;
    let from = format!("oci-archive:{}", at("base.oci.tar"));
    for to in [format!("docker-archive:{}:lab/ros:jazzy", at("image.tar")), format!("oci:{}:jazzy", at("layout"))] {
        run(Command::new("skopeo").args(["--insecure-policy", "copy", &from, &to]))?.expect_success()?;
    }
    let setup = offline_setup("base-of-an-image", place.path(), "lab")?;
    let other = setup.start()?;
    let types = |words: &[&str]| other.deployer().run(words);
    // What is no image, what is no name, and a name that is taken, are refused.
    std::fs::write(at("text"), "hello")?;
    let bytes = std::fs::read(at("image.tar"))?;
    std::fs::write(at("torn.tar"), &bytes[..bytes.len() / 2])?;
    drop(bytes);
    let rows: [(&[&str], &[&str]); 5] = [
        (&["base", "import", "lab", "--from", &at("text")], &["next:"]),
        (&["base", "import", "lab", "--from", &at("torn.tar")], &["truncated"]),
        (&["base", "import", "../lab", "--from", &at("image.tar")], &["is no name of a base"]),
        (&["base", "import", BASE, "--from", &at("image.tar")], &["there is a base", "choose another name"]),
        (&["base", "import", "lab", "--from", "docker://ros:jazzy"], &["names no registry"]),
    ];
    for (words, expected) in rows {
        types(words)?.expect_failure(expected)?;
    }
    types(&["bases", "show", "lab"])?.expect_failure(&["no base \"lab\""])?;

    let imported = types(&["base", "import", "lab", "--from", &at("image.tar")])?.expect_success()?;
    for words in ["with the toolchain", "CONSEQUENCE", "ROS 2 jazzy in /opt/ros/jazzy", "rmw_fastrtps_cpp"] {
        ensure!(imported.stdout.contains(words), "{words}: {}", imported.output());
    }
    let base = other.deployer().run_json(&["bases", "show", "lab"])?;
    ensure!(base["state"] == "imported" && base["system"] == "debian bookworm", "{base:#}");
    let summary = base["summary"].as_str().unwrap_or_default();
    ensure!(summary.contains("lab/ros:jazzy"), "{summary}");
    ensure!(base["ros_packages"]["rclpy"].as_str().is_some_and(|version| version.starts_with("7.")), "{base:#}");
    ensure!(base["debian_packages"]["python3"].is_string(), "{base:#}");
    types(&["base", "import", "lab", "--from", &at("layout")])?.expect_failure(&["--replace"])?;

    // Its own layers are those of the services upon it, and nothing is fetched.
    let arguments = [&["--base", "lab", "--format", "json"][..], COURIER.arguments].concat();
    let pushed = other.deployer().push("courier_ros2", &arguments)?.expect_success()?;
    let events = pushed.stdout.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
    let done = events.into_iter().find(|event| event["type"] == "done").context("a done event")?;
    let layers = done["layers"].as_array().context("layers")?;
    ensure!(layers.iter().any(|layer| layer["name"] == "base"), "{layers:#?}");
    ensure!(!place.path().join(CALLED).exists(), "{}", std::fs::read_to_string(place.path().join(CALLED))?);
    hear_courier(&other, "courier_ros2")?;

    // It outlives the daemon, and is replaced by what is sent as a directory; the service keeps its layers.
    other.stop()?;
    let other = setup.start()?;
    let types = |words: &[&str]| other.deployer().run(words);
    types(&["base", "import", "lab", "--from", &at("layout"), "--replace"])?.expect_success()?;
    let again = other.deployer().run_json(&["bases", "show", "lab"])?;
    ensure!(again["ros_packages"] == base["ros_packages"], "{again:#}");
    let removed = types(&["base", "rm", "lab"])?.expect_success()?;
    ensure!(removed.stdout.contains("is removed"), "{}", removed.output());
    types(&["base", "rm", "lab"])?.expect_failure(&["no base \"lab\""])?;
    hear_courier(&other, "courier_ros2")?;
    let recorded = types(&["--format", "json", "audit", "-n", "100"])?.expect_success()?.stdout;
    ensure!(recorded.contains("\"base lab\""), "{recorded}");
    other.stop()?;
    Ok(())
}

pub fn an_image_of_a_registry_becomes_a_base() -> Verdict {
    // A daemon's own images, of which each has a base and a package.
    let registry = world().setup("registry-of-bases").start()?;
    registry.deployer().push("courier_ros2", COURIER.arguments)?.expect_success()?;
    create_token(&registry, &["chief", "--role", "admin"])?;
    let lab = create_token(&registry, &["lab", "--role", "viewer", "--service", "courier_*"])?;
    let place = world().directory("pulled")?;
    let other = offline_setup("base-of-a-registry", place.path(), "pulled")?.start()?;
    let passwords = place.path().join("auth.json");
    let imports = |image: &str| {
        run(Command::new(binaries::path("cloudroidctl"))
            .args(["base", "import", "pulled", "--from", &format!("docker://{}/{image}", registry.address)])
            .env("CLOUDROID_HOME", &other.home)
            .env("REGISTRY_AUTH_FILE", &passwords)
            .env_remove("CLOUDROID_SERVER"))
    };
    imports("courier_ros2:latest")?.expect_failure(&["asks for a password", "--user"])?;
    // Another client logs in, and leaves the password where all of them look.
    run(Command::new("skopeo")
        .args(["login", "--tls-verify=false", "-u", "lab", "-p", &lab, "--authfile"])
        .arg(&passwords)
        .arg(&registry.address))?
    .expect_success()?;
    imports("courier_ros2:99")?.expect_failure(&["404", "there is no image courier_ros2:99"])?;
    imports("vault:latest")?.expect_failure(&["may not see service vault"])?;
    other.deployer().run(&["bases", "show", "pulled"])?.expect_failure(&["no base \"pulled\""])?;

    let imported = imports("courier_ros2:latest")?.expect_success()?;
    let pulled = format!("pulling {}/courier_ros2:latest", registry.address);
    ensure!(imported.stderr.contains(&pulled), "{}", imported.output());
    let base = other.deployer().run_json(&["bases", "show", "pulled"])?;
    let summary = base["summary"].as_str().unwrap_or_default();
    ensure!(summary.contains(&format!("image {}/courier_ros2:latest", registry.address)), "{summary}");
    ensure!(base["ros_packages"]["rclpy"].is_string() && base["ros_packages"]["courier_ros2"].is_string(), "{base:#}");
    registry.stop()?;
    // What is in the image runs without a build.
    let arguments = ["push", "--apt", "courier_ros2", "--base", "pulled", "--node", "courier"];
    other.deployer().run(&arguments)?.expect_success()?;
    hear_courier(&other, "courier_ros2")?;
    ensure!(!place.path().join(CALLED).exists(), "{}", std::fs::read_to_string(place.path().join(CALLED))?);
    other.stop()?;
    Ok(())
}

pub fn a_root_file_system_made_by_hand_becomes_a_base() -> Verdict {
    let place = world().directory("by-hand")?;
    let at = |name: &str| place.path().join(name).display().to_string();
    let include = "python3,python3-setuptools,libstdc++6,zlib1g";
    let root = at("root");
    // As for robots: its mounts are invisible to others, and disappear when it is killed.
    run(Command::new("unshare")
        .args(["--mount", "--propagation", "private", "--pid", "--fork", "--kill-child", "--mount-proc", "mmdebstrap"])
        .args(["--quiet", "--mode=root", "--variant=minbase", &format!("--include={include}")])
        .args(["--aptopt=APT::Install-Recommends \"false\"", "--aptopt=APT::Sandbox::User \"root\""])
        .args(["bookworm", &root]))?
    .expect_success()?;
    let pack = |file: &str| -> Verdict {
        run(Command::new("tar").args(["--numeric-owner", "-C", &root, "-cf", file, "."]))?.expect_success()?;
        Ok(())
    };
    // Without ROS there is nothing to run packages with.
    pack(&at("plain.tar"))?;
    let wheels = place.path().join("root/opt/ros/jazzy");
    std::fs::create_dir_all(&wheels)?;
    for part in ["lib", "share"] {
        run(Command::new("cp").arg("-a").arg(binaries::ros2().join(part)).arg(&wheels))?.expect_success()?;
    }
    pack(&at("robot.tar"))?;

    let daemon = offline_setup("base-by-hand", place.path(), "robot")?.start()?;
    let types = |words: &[&str]| daemon.deployer().run(words);
    let refused = types(&["base", "import", "robot", "--from", &at("plain.tar")])?;
    refused.expect_failure(&["no ROS was found", "share/ament_index", "/opt"])?;
    types(&["base", "import", "robot", "--from", &root])?.expect_failure(&["tar --numeric-owner"])?;
    let wrong = ["base", "import", "robot", "--ros-distro", "humble", "--from", &at("robot.tar")];
    types(&wrong)?.expect_failure(&["it has no ROS humble; found: jazzy (ROS 2)"])?;
    let imported = types(&["base", "import", "robot", "--from", &at("robot.tar")])?.expect_success()?;
    ensure!(imported.stdout.contains("without the toolchain"), "{}", imported.output());
    let base = daemon.deployer().run_json(&["bases", "show", "robot"])?;
    let [found, consequence] = finding(&base, "compiling")?;
    ensure!(found.contains("missing: g++, cmake") && found.contains("colcon"), "{found}");
    ensure!(consequence.contains("packages in Python and install spaces"), "{consequence}");
    let [found, _] = finding(&base, "Python")?;
    ensure!(found == "3.11", "{found}");
    let [found, consequence] = finding(&base, "launch files")?;
    ensure!(found.contains("missing") && consequence.contains("--node"), "{found}: {consequence}");

    // A package in Python needs no colcon; one that is compiled is refused with what is missing.
    let arguments = [&["--base", "robot"][..], COURIER.arguments].concat();
    daemon.deployer().push("courier_ros2", &arguments)?.expect_success()?;
    hear_courier(&daemon, "courier_ros2")?;
    let arguments = [&["--base", "robot"][..], HERALD.arguments].concat();
    let refused = daemon.deployer().push("herald_ros2", &arguments)?;
    refused.expect_failure(&["base robot cannot compile sources", "g++", "push an install space"])?;
    ensure!(!place.path().join(CALLED).exists(), "{}", std::fs::read_to_string(place.path().join(CALLED))?);
    daemon.stop()?;
    Ok(())
}

pub fn a_base_is_moved_to_a_server_without_network() -> Verdict {
    const BASE: &str = "bookworm-jazzy-wheels";
    let one = world().daemon_with(LOCALISER_TWO)?;
    let place = world().directory("base")?;
    let at = |name: &str| place.path().join(name).display().to_string();
    let (file, called) = (at("base.oci.tar"), place.path().join(CALLED));
    one.deployer().run(&["base", "export", BASE, "-o", &file])?.expect_success()?;
    let before = one.deployer().run_json(&["bases", "show", BASE])?;

    let other = offline_setup("base-imported", place.path(), BASE)?.start()?;
    let types = |words: &[&str]| other.deployer().run(words);
    ensure!(types(&["bases", "show", BASE])?.expect_success()?.stdout.contains("not set up yet"));
    types(&["base", "export", BASE, "-o", &at("none")])?.expect_failure(&["was not set up on this server"])?;
    let bytes = std::fs::read(&file)?;
    std::fs::write(at("torn.tar"), &bytes[..bytes.len() / 2])?;
    let record = bytes.windows(12).position(|part| part == b"\"made_for\":\"");
    let mut changed = bytes;
    changed[record.context("a record")? + 12] ^= 1;
    std::fs::write(at("changed.tar"), changed)?;
    types(&["base", "import", &at("torn.tar")])?.expect_failure(&["next:"])?;
    types(&["base", "import", &at("changed.tar")])?.expect_failure(&["has the content of"])?;
    let imported = types(&["base", "import", &file])?.expect_success()?;
    ensure!(imported.stdout.contains("is imported, with the toolchain"), "{}", imported.output());
    let after = other.deployer().run_json(&["bases", "show", BASE])?;
    ensure!(after["state"] == "imported" && after["ros_packages"] == before["ros_packages"], "{after:#}");
    ensure!(after["ros_packages"]["rclpy"].as_str().is_some_and(|version| version.starts_with("7.")), "{after:#}");
    let arguments = [&["--format", "json"][..], LOCALISER_TWO.arguments].concat();
    let pushed = other.deployer().push("localiser_ros2", &arguments)?.expect_success()?;
    let events = pushed.stdout.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
    let done = events.into_iter().find(|event| event["type"] == "done").context("a done event")?;
    let layers = done["layers"].as_array().context("layers")?;
    let base = layers.iter().filter(|layer| layer["name"] == "base");
    ensure!(base.clone().count() > 0 && base.into_iter().all(|layer| layer["cached"] == true), "{layers:#?}");
    ensure!(!called.exists(), "{}", std::fs::read_to_string(&called)?);
    types(&["base", "rm", BASE])?.expect_success()?;
    types(&["base", "rm", BASE])?.expect_failure(&["was not imported"])?;
    other.stop()?;
    Ok(())
}

pub fn what_nobody_refers_to_is_collected() -> Verdict {
    let daemon = world().daemon_with(ADDER)?;
    let deployer = daemon.deployer();
    deployer
        .push("adder_py", &["--name", "fleeting", "--node", "adder.py", "--param", "offset=7"])?
        .expect_success()?;
    let image = daemon.get_json("/api/v1/services/fleeting")?["image"].as_str().unwrap_or_default().to_owned();
    let blob = daemon.home.join("images/blobs/sha256").join(image.trim_start_matches("sha256:"));
    ensure!(blob.exists(), "{}", blob.display());
    let shared = run(
        Command::new("skopeo").args(["inspect", &format!("oci:{}:adder_py", daemon.home.join("images").display())])
    )?;
    shared.expect_success()?;
    deployer.run(&["rm", "fleeting"])?.expect_success()?;
    ensure!(
        !blob.exists() || daemon.get_json("/api/v1/services/adder_py")?["image"] == image.as_str(),
        "the image of a removed service is collected"
    );
    run(Command::new("skopeo").args(["inspect", &format!("oci:{}:adder_py", daemon.home.join("images").display())]))?
        .expect_success()?;
    Ok(())
}
