//! What a deployer pushes, and what comes of it.

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, bail, ensure};
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::deployer::{path_str, run};
use support::patience::tell_patience;
use support::world::{ADDER, GREETER, world};
use support::{Verdict, binaries};

/// Asks the greeter of a service for a greeting.
fn greeting(daemon: &Daemon, path: &str, input: &str, output: &str) -> anyhow::Result<Value> {
    let mut robot = daemon.robot(path)?;
    robot.subscribes(output)?;
    robot.says(json!({"op": "advertise", "topic": input, "type": "std_msgs/String"}))?;
    robot.awaits_subscriber(input)?;
    robot.says(json!({"op": "publish", "topic": input, "msg": {"data": "Ada"}}))?;
    robot.hears_on(output)
}

pub fn a_cpp_package_is_compiled_and_greets() -> Verdict {
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

pub fn which_output_answers_which_input_is_found_or_said() -> Verdict {
    let daemon = world().shared()?;
    let deployer = daemon.deployer();
    let pushes = |request: &str| {
        let options = ["--name", "asked", "--node", "greeter", "--request", request];
        deployer.pushes("greeter_cpp", &options)
    };
    let there = "/greeter/nme is no input of this service; its inputs are /greeter/name";
    pushes("/greeter/nme=/greeter/greeting")?.failed_saying(&["--request", there])?;
    let pushed = pushes("/greeter/name=/greeter/greeting")?.succeeded()?;
    let words =
        "an answer on /greeter/greeting is counted against /greeter/name, as --request says";
    ensure!(pushed.said().contains(words), "{}", pushed.said());
    let about = daemon.get_json("/api/v1/services/asked")?;
    let said = &about["interface"]["requests"];
    ensure!(
        said[0]["input"] == "/greeter/name" && said[0]["reason"] == "stated",
        "{said}"
    );
    Ok(())
}

pub fn a_python_package_adds() -> Verdict {
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

pub fn a_launch_file_is_resolved_by_roslaunch() -> Verdict {
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

pub fn a_workspace_is_built_in_order() -> Verdict {
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

/// A workspace of `aa_lib`, a library, and `bb_app`, a node that uses it, below `place`. `names` is what `bb_app`'s
/// package.xml says of it.
fn workspace_of_two(place: &Path, names: &str) -> anyhow::Result<PathBuf> {
    let workspace = place.join("two_ws");
    let manifest = |name: &str, needs: &str| {
        format!(
            "<package format=\"2\"><name>{name}</name><version>1.0.0</version><description>A part.</description>\
             <maintainer email=\"a@example.org\">A</maintainer><license>Apache-2.0</license>\
             <buildtool_depend>catkin</buildtool_depend><depend>roscpp</depend><depend>std_msgs</depend>{needs}\
             </package>\n"
        )
    };
    let list = |name: &str, needs: &str, rest: &str| {
        format!(
            "cmake_minimum_required(VERSION 3.0.2)\nproject({name})\n\
             find_package(catkin REQUIRED COMPONENTS roscpp std_msgs {needs})\n{rest}"
        )
    };
    let library = "catkin_package(INCLUDE_DIRS include LIBRARIES aa_lib)\n\
                   include_directories(include ${catkin_INCLUDE_DIRS})\nadd_library(aa_lib src/aa.cpp)\n\
                   target_link_libraries(aa_lib ${catkin_LIBRARIES})\n\
                   install(TARGETS aa_lib LIBRARY DESTINATION ${CATKIN_PACKAGE_LIB_DESTINATION})\n\
                   install(DIRECTORY include/aa_lib/ DESTINATION ${CATKIN_PACKAGE_INCLUDE_DESTINATION})\n";
    let node = "catkin_package()\ninclude_directories(${catkin_INCLUDE_DIRS})\nadd_executable(app src/app.cpp)\n\
                target_link_libraries(app ${catkin_LIBRARIES})\n\
                install(TARGETS app RUNTIME DESTINATION ${CATKIN_PACKAGE_BIN_DESTINATION})\n";
    // New to every cache: what this story says of compiling is true each time it is told.
    let unique = std::time::SystemTime::now()
        .duration_since(std::time::UNIX_EPOCH)?
        .as_nanos();
    for (path, text) in [
        ("aa_lib/package.xml", manifest("aa_lib", "")),
        ("aa_lib/CMakeLists.txt", list("aa_lib", "", library)),
        (
            "aa_lib/include/aa_lib/aa.h",
            "#pragma once\n#include <string>\nstd::string aa();\n".into(),
        ),
        (
            "aa_lib/src/aa.cpp",
            format!("// {unique}\n#include <aa_lib/aa.h>\nstd::string aa() {{ return \"aa\"; }}\n"),
        ),
        ("bb_app/package.xml", manifest("bb_app", names)),
        ("bb_app/CMakeLists.txt", list("bb_app", "aa_lib", node)),
        (
            "bb_app/src/app.cpp",
            "#include <aa_lib/aa.h>\n#include <ros/ros.h>\n#include <std_msgs/String.h>\n\
             int main(int argc, char** argv) {\n  ros::init(argc, argv, \"app\");\n  ros::NodeHandle node;\n\
             \x20 auto said = node.advertise<std_msgs::String>(\"said\", 1, true);\n\
             \x20 std_msgs::String text;\n  text.data = aa();\n  said.publish(text);\n  ros::spin();\n}\n"
                .into(),
        ),
    ] {
        let path = workspace.join("src").join(path);
        std::fs::create_dir_all(path.parent().context("below")?)?;
        std::fs::write(path, text)?;
    }
    Ok(workspace)
}

/// Pushes a workspace of two; its outcome, and the titles of its steps.
fn push_of_two(
    daemon: &Daemon,
    workspace: &Path,
    name: &str,
) -> anyhow::Result<(support::deployer::Outcome, Vec<String>)> {
    let outcome = daemon.deployer().types(&[
        "--format",
        "json",
        "push",
        path_str(workspace),
        "--name",
        name,
        "--node",
        "bb_app/app",
    ])?;
    let events = outcome.stdout.lines();
    let events = events.filter_map(|line| serde_json::from_str::<Value>(line).ok());
    let steps = events.filter(|event| event["type"] == "step");
    let titles = steps.filter_map(|event| Some(event["title"].as_str()?.to_owned()));
    let titles = titles.collect();
    Ok((outcome, titles))
}

fn compiled(steps: &[String]) -> Vec<&str> {
    let titles = steps
        .iter()
        .filter_map(|step| step.strip_prefix("compiling "));
    titles.filter_map(|rest| rest.split(' ').next()).collect()
}

pub fn what_was_compiled_before_a_failure_stays_compiled() -> Verdict {
    let daemon = world().shared()?;
    let place = tempfile::tempdir()?;
    let workspace = workspace_of_two(place.path(), "<depend>aa_lib</depend>")?;
    let source = workspace.join("src/bb_app/src/app.cpp");
    let good = std::fs::read_to_string(&source)?;
    std::fs::write(
        &source,
        good.replace("ros::spin()", "ros::no_such_function()"),
    )?;
    let (outcome, steps) = push_of_two(&daemon, &workspace, "of_two")?;
    outcome.failed_saying(&["no_such_function"])?;
    ensure!(compiled(&steps) == ["aa_lib", "bb_app"], "{steps:?}");
    std::fs::write(&source, &good)?;
    let (outcome, steps) = push_of_two(&daemon, &workspace, "of_two")?;
    outcome.succeeded()?;
    ensure!(compiled(&steps) == ["bb_app"], "{steps:?}");
    let mut robot = daemon.robot("of_two")?;
    robot.subscribes("/said")?;
    ensure!(robot.hears_on("/said")?["data"] == "aa");
    // A change of what is at the bottom reaches what stands on it.
    let library = workspace.join("src/aa_lib/src/aa.cpp");
    let text = std::fs::read_to_string(&library)?;
    std::fs::write(&library, text.replace("\"aa\"", "\"bb\""))?;
    let (outcome, steps) = push_of_two(&daemon, &workspace, "of_two")?;
    outcome.succeeded()?;
    ensure!(compiled(&steps) == ["aa_lib", "bb_app"], "{steps:?}");
    let mut robot = daemon.robot("of_two?robot=later")?;
    robot.subscribes("/said")?;
    ensure!(robot.hears_on("/said")?["data"] == "bb");
    Ok(())
}

pub fn mistakes_in_cmake_are_told_before_anything_is_compiled() -> Verdict {
    let daemon = world().shared()?;
    let place = tempfile::tempdir()?;
    let workspace = workspace_of_two(place.path(), "<depend>aa_lib</depend>")?;
    let list = workspace.join("src/bb_app/CMakeLists.txt");
    let good = std::fs::read_to_string(&list)?;
    std::fs::write(
        &list,
        good.replace("std_msgs aa_lib", "std_msgs aa_lib no_such_package"),
    )?;
    let (outcome, steps) = push_of_two(&daemon, &workspace, "unconfigured")?;
    outcome.failed_saying(&["the build of bb_app failed", "no_such_package"])?;
    ensure!(compiled(&steps).is_empty(), "{steps:?}");
    Ok(())
}

pub fn a_package_may_use_others_that_it_does_not_name() -> Verdict {
    let daemon = world().shared()?;
    let place = tempfile::tempdir()?;
    let workspace = workspace_of_two(place.path(), "")?;
    let (outcome, _) = push_of_two(&daemon, &workspace, "unnamed")?;
    let outcome = outcome.succeeded()?;
    ensure!(
        outcome
            .stdout
            .contains("bb_app uses other packages of the workspace"),
        "{}",
        outcome.said()
    );
    let mut robot = daemon.robot("unnamed")?;
    robot.subscribes("/said")?;
    ensure!(robot.hears_on("/said")?["data"] == "aa");
    let (outcome, steps) = push_of_two(&daemon, &workspace, "unnamed")?;
    outcome.succeeded()?;
    ensure!(compiled(&steps).is_empty(), "{steps:?}");
    Ok(())
}

pub fn packages_with_the_same_libraries_share_their_layers() -> Verdict {
    let daemon = world().shared()?;
    let mut images = Vec::new();
    for package in ["image_proc", "stereo_image_proc"] {
        let outcome = daemon.deployer().types(&[
            "--format", "json", "push", "--apt", package, "--node", package,
        ])?;
        let outcome = outcome.succeeded()?;
        let events = outcome.stdout.lines();
        let mut events = events.filter_map(|line| serde_json::from_str::<Value>(line).ok());
        let done = events.find(|event| event["type"] == "done");
        let done = done.with_context(|| format!("a done event in {}", outcome.stdout))?;
        let layers = done["layers"].as_array().context("layers")?.clone();
        ensure!(layers.len() < 20, "an image has few layers: {layers:#?}");
        images.push(layers);
    }
    let [first, second] = &images[..] else {
        bail!("two images");
    };
    let bytes = |layers: &[&Value]| -> u64 {
        layers
            .iter()
            .filter_map(|layer| layer["size"].as_u64())
            .sum()
    };
    let above_base = second.iter().filter(|layer| layer["name"] != "base");
    let above_base: Vec<&Value> = above_base.collect();
    let shared = above_base.iter().copied();
    let shared: Vec<&Value> = shared
        .filter(|layer| first.iter().any(|other| other["digest"] == layer["digest"]))
        .collect();
    ensure!(
        bytes(&shared) * 10 > bytes(&above_base) * 9,
        "nine tenths of what stands on the base are the same layers: {images:#?}"
    );
    Ok(())
}

pub fn a_prebuilt_space_is_served() -> Verdict {
    let daemon = world().with(ADDER)?;
    let place = tempfile::tempdir()?;
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

/// The install space that a push has made, taken out of its image.
pub fn extract_install_space(
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
    let space = bundle.join("rootfs/opt/cloudroid/install");
    ensure!(space.is_dir(), "an install space in the image");
    Ok(space)
}

pub fn an_unchanged_push_builds_no_layer() -> Verdict {
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

pub fn a_failed_build_leaves_the_earlier_revision_serving() -> Verdict {
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

pub fn what_package_xml_forgot_is_named_and_added() -> Verdict {
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

pub fn a_revision_is_rolled_back() -> Verdict {
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

pub fn five_packaged_nodes_answer() -> Verdict {
    let daemon = world().shared()?;
    let outcome = run(tell_patience(&mut Command::new(binaries::python()))
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
