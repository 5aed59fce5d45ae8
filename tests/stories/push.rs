//! What a deployer pushes, and what comes of it.

use std::process::Command;

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::deployer::{path_str, run};
use support::world::{ADDER, GREETER, world};
use support::{Told, binaries};

/// Asks the greeter of a service for a greeting.
fn greeting(daemon: &Daemon, path: &str, input: &str, output: &str) -> anyhow::Result<Value> {
    let mut robot = daemon.robot(path)?;
    robot.subscribes(output)?;
    robot.says(json!({"op": "advertise", "topic": input, "type": "std_msgs/String"}))?;
    robot.awaits_subscriber(input)?;
    robot.says(json!({"op": "publish", "topic": input, "msg": {"data": "Ada"}}))?;
    robot.hears_on(output)
}

pub fn a_cpp_package_is_compiled_and_greets() -> Told {
    let daemon = world().with(GREETER)?;
    let heard = greeting(&daemon, "greeter_cpp", "/greeter/name", "/greeter/greeting")?;
    ensure!(heard["text"] == "hi Ada" && heard["count"] == 1, "{heard}");
    let answer = daemon
        .robot("greeter_cpp")?
        .calls("/greeter/count", json!({}))?;
    ensure!(
        answer["result"] == true && answer["values"]["style"] == "plain",
        "yaml-cpp was found: {answer}"
    );
    Ok(())
}

pub fn a_python_package_adds() -> Told {
    let daemon = world().with(ADDER)?;
    let mut robot = daemon.robot("adder_py")?;
    robot.subscribes("/sums")?;
    let answer = robot.calls("/add_two", json!({"a": 20, "b": 22}))?;
    ensure!(
        answer["result"] == true && answer["values"]["sum"] == 42,
        "{answer}"
    );
    Ok(())
}

pub fn a_launch_file_is_resolved_by_roslaunch() -> Told {
    let daemon = world().shared()?;
    let deployer = daemon.deployer();
    deployer
        .pushes(
            "greeter_cpp",
            &[
                "--name",
                "launched",
                "--launch",
                "two.launch",
                "--arg",
                "word:=bonjour",
            ],
        )?
        .succeeded()?;
    let heard = greeting(
        &daemon,
        "launched",
        "/left/first/name",
        "/left/first/greeting",
    )?;
    ensure!(
        heard["text"] == "bonjour Ada",
        "the argument and the private parameter arrived: {heard}"
    );
    let heard = greeting(&daemon, "launched", "/names", "/second/greeting")?;
    ensure!(
        heard["text"] == "hello Ada",
        "the remapping arrived: {heard}"
    );
    // What roslaunch refuses is refused in its own words.
    deployer
        .pushes(
            "greeter_cpp",
            &["--name", "unlaunched", "--launch", "needy.launch"],
        )?
        .failed_saying(&["requires the 'who' arg to be set"])?;
    Ok(())
}

pub fn a_workspace_is_built_in_order() -> Told {
    let daemon = world().shared()?;
    let place = tempfile::tempdir()?;
    let source = place.path().join("lab_ws/src");
    std::fs::create_dir_all(&source)?;
    for package in ["greeter_cpp", "adder_py"] {
        run(Command::new("cp")
            .arg("-r")
            .arg(binaries::package(package))
            .arg(&source))?
        .succeeded()?;
    }
    let workspace = place.path().join("lab_ws");
    daemon
        .deployer()
        .types(&[
            "push",
            path_str(&workspace),
            "--name",
            "lab",
            "--node",
            "greeter_cpp/greeter",
            "--node",
            "adder_py/adder.py",
        ])?
        .succeeded()?;
    let mut robot = daemon.robot("lab?robot=both")?;
    ensure!(robot.calls("/add_two", json!({"a": 1, "b": 2}))?["values"]["sum"] == 3);
    ensure!(robot.calls("/greeter/count", json!({}))?["result"] == true);
    Ok(())
}

pub fn a_prebuilt_space_is_served() -> Told {
    let daemon = world().with(ADDER)?;
    let place = tempfile::tempdir()?;
    // The install space that the push of the source package made, taken out of its image.
    let space = extract_install_space(&daemon, "adder_py", place.path())?;
    daemon
        .deployer()
        .types(&[
            "push",
            path_str(&space),
            "--name",
            "prebuilt",
            "--node",
            "adder.py",
        ])?
        .succeeded()?;
    let answer = daemon
        .robot("prebuilt")?
        .calls("/add_two", json!({"a": 2, "b": 3}))?;
    ensure!(answer["values"]["sum"] == 5, "{answer}");
    Ok(())
}

fn extract_install_space(
    daemon: &Daemon,
    service: &str,
    to: &std::path::Path,
) -> anyhow::Result<std::path::PathBuf> {
    let bundle = to.join("bundle");
    let image = format!("{}:{service}", daemon.home.join("images").display());
    run(Command::new("umoci")
        .args(["unpack", "--image", &image])
        .arg(&bundle))?
    .succeeded()?;
    let marker = run(Command::new("find")
        .arg(bundle.join("rootfs/opt"))
        .args(["-name", ".catkin"]))?
    .succeeded()?;
    let marker = marker
        .stdout
        .lines()
        .next()
        .context("an install space in the image")?
        .to_owned();
    Ok(std::path::Path::new(&marker)
        .parent()
        .context("its directory")?
        .to_owned())
}

pub fn an_unchanged_push_builds_no_layer() -> Told {
    let daemon = world().with(GREETER)?;
    let outcome = daemon
        .deployer()
        .pushes("greeter_cpp", &["--name", "again", "--node", "greeter"])?
        .succeeded()?;
    ensure!(outcome.stdout.contains("again"), "{}", outcome.said());
    let first = daemon.get_json("/api/v1/services/again")?;
    let answer = daemon.deployer().types(&[
        "--format",
        "json",
        "push",
        path_str(&binaries::package("greeter_cpp")),
        "--name",
        "again",
        "--node",
        "greeter",
    ])?;
    let answer = answer.succeeded()?;
    let done: Value = answer
        .stdout
        .lines()
        .filter_map(|line| serde_json::from_str::<Value>(line).ok())
        .find(|event| event["type"] == "done")
        .with_context(|| format!("a done event in {}", answer.stdout))?;
    let layers = done["layers"].as_array().context("layers")?;
    ensure!(
        !layers.is_empty() && layers.iter().all(|layer| layer["cached"] == true),
        "{layers:#?}"
    );
    let second = daemon.get_json("/api/v1/services/again")?;
    ensure!(
        first["image"] == second["image"],
        "the same inputs give the same digest"
    );
    Ok(())
}

pub fn a_failed_build_leaves_the_earlier_revision_serving() -> Told {
    let daemon = world().with(GREETER)?;
    let place = tempfile::tempdir()?;
    run(Command::new("cp")
        .arg("-r")
        .arg(binaries::package("greeter_cpp"))
        .arg(place.path()))?
    .succeeded()?;
    let package = place.path().join("greeter_cpp");
    let push = [
        "push",
        path_str(&package),
        "--name",
        "steady",
        "--node",
        "greeter",
    ];
    daemon.deployer().types(&push)?.succeeded()?;
    let source = package.join("src/greeter.cpp");
    let text = std::fs::read_to_string(&source)?;
    std::fs::write(
        &source,
        text.replace("ros::spin()", "ros::no_such_function()"),
    )?;
    daemon
        .deployer()
        .types(&push)?
        .failed_saying(&["no_such_function", "greeter.cpp:4"])?;
    let answer = daemon.robot("steady")?.calls("/greeter/count", json!({}))?;
    ensure!(answer["result"] == true, "{answer}");
    ensure!(daemon.get_json("/api/v1/services/steady")?["revision"] == 1);
    Ok(())
}

pub fn what_package_xml_forgot_is_named_and_added() -> Told {
    let daemon = world().shared()?;
    let deployer = daemon.deployer();
    let node = ["--node", "recorder", "--param", "file=/tmp/heard.bag"];
    // CMake's question for roslint, which no package of the distribution has, is answered; this one is not.
    deployer.pushes("undeclared_cpp", &node)?.failed_saying(&[
        "the CMake package rosbag_storage is missing",
        "--with rosbag_storage",
    ])?;
    let missed = ["--param", "/recorder/file=/tmp/nobody.bag"];
    let added = ["--with", "rosbag_storage"];
    let pushed = deployer
        .pushes("undeclared_cpp", &[&node[..], &missed, &added].concat())?
        .succeeded()?;
    // An anonymous node: its program's name without what makes it unique, and its parameters there.
    let service = deployer.asks(&["services", "undeclared_cpp"])?;
    ensure!(
        service["nodes"][0]["name"] == "/bag_recorder",
        "{service:#}"
    );
    let parameters = service["interface"]["parameters"]
        .as_array()
        .context("a list")?;
    ensure!(
        parameters
            .iter()
            .any(|one| one["name"] == "/bag_recorder/file" && one["value"] == "/tmp/heard.bag"),
        "{service:#}"
    );
    ensure!(
        pushed
            .said()
            .contains("parameter /recorder/file is given for a name that no node has"),
        "{}",
        pushed.said()
    );
    Ok(())
}

pub fn a_revision_is_rolled_back() -> Told {
    let daemon = world().with(ADDER)?;
    let deployer = daemon.deployer();
    deployer
        .pushes(
            "adder_py",
            &[
                "--name", "moody", "--node", "adder.py", "--param", "offset=1",
            ],
        )?
        .succeeded()?;
    deployer
        .pushes(
            "adder_py",
            &[
                "--name",
                "moody",
                "--node",
                "adder.py",
                "--param",
                "offset=100",
            ],
        )?
        .succeeded()?;
    let sum = |robot: &str| -> anyhow::Result<Value> {
        let mut robot = daemon.robot(&format!("moody?robot={robot}"))?;
        Ok(robot.calls("/add_two", json!({"a": 1, "b": 1}))?["values"]["sum"].clone())
    };
    ensure!(sum("new")? == 102);
    deployer.types(&["rollback", "moody"])?.succeeded()?;
    ensure!(sum("old")? == 3);
    deployer.types(&["rm", "moody"])?.succeeded()?;
    ensure!(
        daemon.servants_of("moody")?.is_empty(),
        "its servants went with it"
    );
    ensure!(daemon.get("/api/v1/services/moody")?.0 == 404);
    Ok(())
}

pub fn five_packaged_nodes_answer() -> Told {
    let daemon = world().shared()?;
    let outcome = run(Command::new(binaries::python())
        .arg(binaries::checkout().join("tests/robots/packaged_nodes.py"))
        .arg(&daemon.address)
        .arg(binaries::path("cloudroidctl"))
        .env("CLOUDROID_HOME", &daemon.home))?;
    let outcome = outcome.succeeded()?;
    for node in [
        "people_detect",
        "face_detection",
        "fback_flow",
        "image_proc",
        "stereo_image_proc",
    ] {
        ensure!(
            outcome.stdout.contains(&format!("{node}: answered")),
            "{}",
            outcome.said()
        );
    }
    Ok(())
}
