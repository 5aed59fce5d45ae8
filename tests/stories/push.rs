//! Pushes of a deployer, and their results.

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, bail, ensure};
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::deployer::{path_str, run};
use support::patience::tell_patience;
use support::world::{ADDER, GREETER, world};
use support::{Verdict, binaries};

/// Requests a greeting from the greeter of a service.
fn request_greeting(daemon: &Daemon, path: &str, input: &str, output: &str) -> anyhow::Result<Value> {
    let mut robot = daemon.robot(path)?;
    robot.subscribe(output)?;
    robot.send(json!({"op": "advertise", "topic": input, "type": "std_msgs/String"}))?;
    robot.wait_for_subscriber(input)?;
    robot.send(json!({"op": "publish", "topic": input, "msg": {"data": "Ada"}}))?;
    robot.next_message_on(output)
}

pub fn a_cpp_package_is_compiled_and_greets() -> Verdict {
    let daemon = world().daemon_with(GREETER)?;
    let heard = request_greeting(&daemon, "greeter_cpp", "/greeter/name", "/greeter/greeting")?;
    ensure!(heard["text"] == "hi Ada" && heard["count"] == 1, "{heard}");
    let answer = daemon.robot("greeter_cpp")?.call("/greeter/count", json!({}))?;
    ensure!(answer["result"] == true && answer["values"]["style"] == "plain", "yaml-cpp was found: {answer}");
    Ok(())
}

pub fn which_output_answers_which_input_is_found_or_said() -> Verdict {
    let daemon = world().ensure_shared()?;
    let deployer = daemon.deployer();
    let pushes = |request: &str| {
        let options = ["--name", "asked", "--node", "greeter", "--request", request];
        deployer.push("greeter_cpp", &options)
    };
    let there = "/greeter/nme is not an input of this service; its inputs are /greeter/name";
    pushes("/greeter/nme=/greeter/greeting")?.expect_failure(&["--request", there])?;
    let pushed = pushes("/greeter/name=/greeter/greeting")?.expect_success()?;
    let words = "answers on /greeter/greeting count for /greeter/name, as set by --request";
    ensure!(pushed.output().contains(words), "{}", pushed.output());
    let about = daemon.get_json("/api/v1/services/asked")?;
    let said = &about["interface"]["requests"];
    ensure!(said[0]["input"] == "/greeter/name" && said[0]["reason"] == "stated", "{said}");
    Ok(())
}

pub fn a_python_package_adds() -> Verdict {
    let daemon = world().daemon_with(ADDER)?;
    let mut robot = daemon.robot("adder_py")?;
    robot.subscribe("/sums")?;
    let answer = robot.call("/add_two", json!({"a": 20, "b": 22}))?;
    ensure!(answer["result"] == true && answer["values"]["sum"] == 42, "{answer}");
    // What its base has is listed.
    let deployer = daemon.deployer();
    let base = deployer.run_json(&["bases", "show", "bookworm-ros1"])?;
    let version = base["ros_packages"]["rospy"].as_str().unwrap_or_default();
    ensure!(version.starts_with("1.") && base["state"] == "ready" && base["toolchain"] == true, "{base:#}");
    let listed = deployer.run(&["bases"])?.expect_success()?.stdout;
    ensure!(listed.contains("bookworm-ros1") && listed.contains("debian bookworm"), "{listed}");
    deployer.run(&["bases", "show", "nothing"])?.expect_failure(&["no base \"nothing\"", "available: bookworm-"])?;
    Ok(())
}

pub fn a_launch_file_is_resolved_by_roslaunch() -> Verdict {
    let daemon = world().ensure_shared()?;
    let deployer = daemon.deployer();
    deployer
        .push("greeter_cpp", &["--name", "launched", "--launch", "two.launch", "--arg", "word:=bonjour"])?
        .expect_success()?;
    let heard = request_greeting(&daemon, "launched", "/left/first/name", "/left/first/greeting")?;
    ensure!(heard["text"] == "bonjour Ada", "the argument and the private parameter arrived: {heard}");
    let heard = request_greeting(&daemon, "launched", "/names", "/second/greeting")?;
    ensure!(heard["text"] == "hello Ada", "the remapping arrived: {heard}");
    // Errors of roslaunch are reported in its own words.
    deployer
        .push("greeter_cpp", &["--name", "unlaunched", "--launch", "needy.launch"])?
        .expect_failure(&["requires the 'who' arg to be set"])?;
    Ok(())
}

pub fn a_workspace_is_built_in_order() -> Verdict {
    let daemon = world().ensure_shared()?;
    let place = tempfile::tempdir()?;
    let source = place.path().join("lab_ws/src");
    std::fs::create_dir_all(&source)?;
    for package in ["greeter_cpp", "adder_py"] {
        run(Command::new("cp").arg("-r").arg(binaries::package(package)).arg(&source))?.expect_success()?;
    }
    let workspace = place.path().join("lab_ws");
    daemon
        .deployer()
        .run(&[
            "push",
            path_str(&workspace),
            "--name",
            "lab",
            "--node",
            "greeter_cpp/greeter",
            "--node",
            "adder_py/adder.py",
        ])?
        .expect_success()?;
    let mut robot = daemon.robot("lab?robot=both")?;
    ensure!(robot.call("/add_two", json!({"a": 1, "b": 2}))?["values"]["sum"] == 3);
    ensure!(robot.call("/greeter/count", json!({}))?["result"] == true);
    Ok(())
}

/// Writes a workspace below `place` with a library, `aa_lib`, and a node that uses it, `bb_app`. `names` is inserted
/// into the package.xml of `bb_app`.
fn write_workspace(place: &Path, names: &str) -> anyhow::Result<PathBuf> {
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
    // Unique, so that no cache contains it and the story's claims about compiling hold in every run.
    let unique = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH)?.as_nanos();
    for (path, text) in [
        ("aa_lib/package.xml", manifest("aa_lib", "")),
        ("aa_lib/CMakeLists.txt", list("aa_lib", "", library)),
        ("aa_lib/include/aa_lib/aa.h", "#pragma once\n#include <string>\nstd::string aa();\n".into()),
        ("aa_lib/src/aa.cpp", format!("// {unique}\n#include <aa_lib/aa.h>\nstd::string aa() {{ return \"aa\"; }}\n")),
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

/// Pushes such a workspace; returns the result and the titles of the steps.
fn push_workspace(
    daemon: &Daemon,
    workspace: &Path,
    name: &str,
) -> anyhow::Result<(support::deployer::CommandOutcome, Vec<String>)> {
    let outcome = daemon.deployer().run(&[
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

fn compiled_packages(steps: &[String]) -> Vec<&str> {
    let titles = steps.iter().filter_map(|step| step.strip_prefix("compiling "));
    titles.filter_map(|rest| rest.split(' ').next()).collect()
}

pub fn what_was_compiled_before_a_failure_stays_compiled() -> Verdict {
    let daemon = world().ensure_shared()?;
    let place = tempfile::tempdir()?;
    let workspace = write_workspace(place.path(), "<depend>aa_lib</depend>")?;
    let source = workspace.join("src/bb_app/src/app.cpp");
    let good = std::fs::read_to_string(&source)?;
    std::fs::write(&source, good.replace("ros::spin()", "ros::no_such_function()"))?;
    let (outcome, steps) = push_workspace(&daemon, &workspace, "of_two")?;
    outcome.expect_failure(&["no_such_function"])?;
    ensure!(compiled_packages(&steps) == ["aa_lib", "bb_app"], "{steps:?}");
    std::fs::write(&source, &good)?;
    let (outcome, steps) = push_workspace(&daemon, &workspace, "of_two")?;
    outcome.expect_success()?;
    ensure!(compiled_packages(&steps) == ["bb_app"], "{steps:?}");
    let mut robot = daemon.robot("of_two")?;
    robot.subscribe("/said")?;
    ensure!(robot.next_message_on("/said")?["data"] == "aa");
    // A change of the library also rebuilds the node.
    let library = workspace.join("src/aa_lib/src/aa.cpp");
    let text = std::fs::read_to_string(&library)?;
    std::fs::write(&library, text.replace("\"aa\"", "\"bb\""))?;
    let (outcome, steps) = push_workspace(&daemon, &workspace, "of_two")?;
    outcome.expect_success()?;
    ensure!(compiled_packages(&steps) == ["aa_lib", "bb_app"], "{steps:?}");
    let mut robot = daemon.robot("of_two?robot=later")?;
    robot.subscribe("/said")?;
    ensure!(robot.next_message_on("/said")?["data"] == "bb");
    Ok(())
}

pub fn what_a_cancelled_push_has_compiled_stays_compiled() -> Verdict {
    let daemon = world().ensure_shared()?;
    let deployer = daemon.deployer();
    let place = tempfile::tempdir()?;
    let workspace = write_workspace(place.path(), "<depend>aa_lib</depend>")?;
    let list = workspace.join("src/bb_app/CMakeLists.txt");
    let good = std::fs::read_to_string(&list)?;
    // Not while it is configured, which comes before the library is compiled.
    std::fs::write(&list, format!("{good}add_custom_target(endless ALL COMMAND sleep infinity)\n"))?;
    let push = ["push", path_str(&workspace), "--name", "called_off", "--node", "bb_app/app", "--detach"];
    let number: u64 = deployer.run(&push)?.expect_success()?.stdout.trim().parse()?;
    daemon.wait_for("/api/v1/pushes", "the node is compiled", |pushes| {
        let push = pushes.as_array()?.iter().find(|push| push["number"] == number)?;
        push["step"].as_str()?.starts_with("compiling bb_app").then_some(())
    })?;
    deployer.run(&["pushes", "cancel", &number.to_string()])?.expect_success()?;
    std::fs::write(&list, &good)?;
    let (outcome, steps) = push_workspace(&daemon, &workspace, "called_off")?;
    outcome.expect_success()?;
    ensure!(compiled_packages(&steps) == ["bb_app"], "{steps:?}");
    Ok(())
}

pub fn mistakes_in_cmake_are_told_before_anything_is_compiled() -> Verdict {
    let daemon = world().ensure_shared()?;
    let place = tempfile::tempdir()?;
    let workspace = write_workspace(place.path(), "<depend>aa_lib</depend>")?;
    let list = workspace.join("src/bb_app/CMakeLists.txt");
    let good = std::fs::read_to_string(&list)?;
    std::fs::write(&list, good.replace("std_msgs aa_lib", "std_msgs aa_lib no_such_package"))?;
    let (outcome, steps) = push_workspace(&daemon, &workspace, "unconfigured")?;
    outcome.expect_failure(&["the build of bb_app failed", "no_such_package"])?;
    ensure!(compiled_packages(&steps).is_empty(), "{steps:?}");
    Ok(())
}

pub fn a_package_may_use_others_that_it_does_not_name() -> Verdict {
    let daemon = world().ensure_shared()?;
    let place = tempfile::tempdir()?;
    let workspace = write_workspace(place.path(), "")?;
    // A demo that needs what this host has not; the node does not need the demo.
    let demo = workspace.join("src/cc_demo");
    std::fs::create_dir(&demo)?;
    std::fs::write(
        demo.join("package.xml"),
        "<package format=\"2\"><name>cc_demo</name><version>1.0.0</version><description>A demo.</description>\
         <maintainer email=\"a@example.org\">A</maintainer><license>Apache-2.0</license>\
         <buildtool_depend>catkin</buildtool_depend><depend>bb_app</depend><depend>no_such_simulator</depend>\
         </package>\n",
    )?;
    let path = path_str(&workspace);
    for (option, words) in [
        (["--packages-up-to", "cc_demo"], &["no_such_simulator"][..]),
        (["--packages-up-to", "cc_dmeo"], &["no package \"cc_dmeo\" was pushed", "aa_lib, bb_app, cc_demo"]),
        (["--cmake-args", "-DCMAKE_INSTALL_PREFIX=/usr"], &["the server sets this variable"]),
    ] {
        let push = [&["push", path, "--name", "unnamed", "--node", "bb_app/app"][..], &option].concat();
        daemon.deployer().run(&push)?.expect_failure(words)?;
    }
    let (outcome, steps) = push_workspace(&daemon, &workspace, "unnamed")?;
    let outcome = outcome.expect_success()?;
    let selected = "building 2 of 3 packages; not needed, or skipped: cc_demo";
    ensure!(steps.iter().any(|title| title == selected), "{steps:?}");
    ensure!(outcome.stdout.contains("bb_app uses packages of the workspace"), "{}", outcome.output());
    let mut robot = daemon.robot("unnamed")?;
    robot.subscribe("/said")?;
    ensure!(robot.next_message_on("/said")?["data"] == "aa");
    let (outcome, steps) = push_workspace(&daemon, &workspace, "unnamed")?;
    outcome.expect_success()?;
    ensure!(compiled_packages(&steps).is_empty(), "{steps:?}");
    Ok(())
}

pub fn packages_with_the_same_libraries_share_their_layers() -> Verdict {
    let daemon = world().ensure_shared()?;
    let mut images = Vec::new();
    for package in ["image_proc", "stereo_image_proc"] {
        let outcome = daemon.deployer().run(&["--format", "json", "push", "--apt", package, "--node", package])?;
        let outcome = outcome.expect_success()?;
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
    let bytes = |layers: &[&Value]| -> u64 { layers.iter().filter_map(|layer| layer["size"].as_u64()).sum() };
    let above_base = second.iter().filter(|layer| layer["name"] != "base");
    let above_base: Vec<&Value> = above_base.collect();
    let shared = above_base.iter().copied();
    let shared: Vec<&Value> =
        shared.filter(|layer| first.iter().any(|other| other["digest"] == layer["digest"])).collect();
    ensure!(
        bytes(&shared) * 10 > bytes(&above_base) * 9,
        "nine tenths of what stands on the base are the same layers: {images:#?}"
    );
    Ok(())
}

pub fn a_prebuilt_space_is_served() -> Verdict {
    let daemon = world().daemon_with(ADDER)?;
    let place = tempfile::tempdir()?;
    let space = extract_install_space(&daemon, "adder_py", place.path())?;
    daemon.deployer().run(&["push", path_str(&space), "--name", "prebuilt", "--node", "adder.py"])?.expect_success()?;
    let answer = daemon.robot("prebuilt")?.call("/add_two", json!({"a": 2, "b": 3}))?;
    ensure!(answer["values"]["sum"] == 5, "{answer}");
    Ok(())
}

/// Extracts the install space of a service from its image.
pub fn extract_install_space(
    daemon: &Daemon,
    service: &str,
    to: &std::path::Path,
) -> anyhow::Result<std::path::PathBuf> {
    let bundle = to.join("bundle");
    let image = format!("{}:{service}", daemon.home.join("images").display());
    run(Command::new("umoci").args(["unpack", "--image", &image]).arg(&bundle))?.expect_success()?;
    let space = bundle.join("rootfs/opt/cloudroid/install");
    ensure!(space.is_dir(), "an install space in the image");
    Ok(space)
}

pub fn an_unchanged_push_builds_no_layer_and_makes_no_revision() -> Verdict {
    let daemon = world().daemon_with(GREETER)?;
    let place = tempfile::tempdir()?;
    let deployer = daemon.deployer();
    let copy = |name: &str| -> anyhow::Result<PathBuf> {
        let to = place.path().join(name);
        run(Command::new("cp").arg("-r").arg(binaries::package("greeter_cpp")).arg(&to))?.expect_success()?;
        Ok(to)
    };
    let push = |from: &Path, more: &[&str]| {
        let words = ["--format", "json", "push", path_str(from), "--name", "again", "--node", "greeter"];
        let pushed = deployer.run(&[&words[..], more].concat())?.expect_success()?;
        let events = pushed.stdout.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
        let done = events.into_iter().find(|event| event["type"] == "done");
        done.with_context(|| format!("a done event in {}", pushed.stdout))
    };
    let told = push(&copy("first")?, &[])?;
    ensure!(told.get("unchanged").is_none(), "{told:#}");
    let first = daemon.get_json("/api/v1/services/again")?;
    // The image is as old as its newest source, not of 1970.
    let inspected = format!("oci:{}:again", daemon.home.join("images").display());
    let inspected = run(Command::new("skopeo").args(["inspect", "--config", &inspected]))?.expect_success()?;
    let config: Value = serde_json::from_str(&inspected.stdout)?;
    let created = config["created"].as_str().unwrap_or_default();
    ensure!(created > "2024", "it was copied just now: {created:?}");
    // The same sources, elsewhere and newer.
    let done = push(&copy("second")?, &[])?;
    let layers = done["layers"].as_array().context("layers")?;
    ensure!(!layers.is_empty() && layers.iter().all(|layer| layer["cached"] == true), "{layers:#?}");
    ensure!(done["unchanged"] == true && done["service"]["revision"] == 1, "{done:#}");
    let second = daemon.get_json("/api/v1/services/again")?;
    ensure!(first["image"] == second["image"] && first["revisions"] == second["revisions"], "{second:#}");
    // Another setting is another revision.
    let done = push(&copy("third")?, &["--cpus", "0.5"])?;
    ensure!(done["service"]["revision"] == 2, "{done:#}");
    Ok(())
}

pub fn a_failed_build_leaves_the_earlier_revision_serving() -> Verdict {
    let daemon = world().daemon_with(GREETER)?;
    let place = tempfile::tempdir()?;
    run(Command::new("cp").arg("-r").arg(binaries::package("greeter_cpp")).arg(place.path()))?.expect_success()?;
    let package = place.path().join("greeter_cpp");
    let push = ["push", path_str(&package), "--name", "steady", "--node", "greeter"];
    daemon.deployer().run(&push)?.expect_success()?;
    let source = package.join("src/greeter.cpp");
    let text = std::fs::read_to_string(&source)?;
    std::fs::write(&source, text.replace("ros::spin()", "ros::no_such_function()"))?;
    daemon.deployer().run(&push)?.expect_failure(&["no_such_function", "greeter.cpp:4"])?;
    let answer = daemon.robot("steady")?.call("/greeter/count", json!({}))?;
    ensure!(answer["result"] == true, "{answer}");
    ensure!(daemon.get_json("/api/v1/services/steady")?["revision"] == 1);
    Ok(())
}

pub fn what_package_xml_forgot_is_named_and_added() -> Verdict {
    let daemon = world().ensure_shared()?;
    let deployer = daemon.deployer();
    let node = ["--node", "recorder", "--param", "file=/tmp/heard.bag"];
    // CMake's search for roslint, which the distribution does not package, is satisfied; this one is not.
    deployer
        .push("undeclared_cpp", &node)?
        .expect_failure(&["the CMake package rosbag_storage is missing", "--with rosbag_storage"])?;
    let missed = ["--param", "/recorder/file=/tmp/nobody.bag"];
    let added = ["--with", "rosbag_storage"];
    let pushed = deployer.push("undeclared_cpp", &[&node[..], &missed, &added].concat())?.expect_success()?;
    // An anonymous node has its program's name without the unique suffix, also for its parameters.
    let service = deployer.run_json(&["services", "undeclared_cpp"])?;
    ensure!(service["nodes"][0]["name"] == "/bag_recorder", "{service:#}");
    let parameters = service["interface"]["parameters"].as_array().context("a list")?;
    ensure!(
        parameters.iter().any(|one| one["name"] == "/bag_recorder/file" && one["value"] == "/tmp/heard.bag"),
        "{service:#}"
    );
    ensure!(pushed.output().contains("parameter /recorder/file matches no node"), "{}", pushed.output());
    Ok(())
}

pub fn what_is_packed_follows_links_and_leaves_out_what_is_ignored() -> Verdict {
    let daemon = world().daemon_with(ADDER)?;
    let place = tempfile::tempdir()?;
    let (elsewhere, workspace) = (place.path().join("checkout"), place.path().join("linked_ws"));
    std::fs::create_dir_all(&elsewhere)?;
    std::fs::create_dir_all(workspace.join("src"))?;
    run(Command::new("cp").arg("-r").arg(binaries::package("adder_py")).arg(&elsewhere))?.expect_success()?;
    std::os::unix::fs::symlink(elsewhere.join("adder_py"), workspace.join("src/adder_py"))?;
    // Files with holes: one that is sent as it is, and a recording that need not be sent.
    for (name, bytes) in [("map.db", 1 << 20), ("run.bag", 1 << 40)] {
        std::fs::File::create(elsewhere.join("adder_py").join(name))?.set_len(bytes)?;
    }
    std::fs::write(workspace.join(".cloudroidignore"), "# recordings\n*.bag\n")?;
    let parameters = ["--param", "offset:=5", "--param", "ofset=6"];
    let push = ["push", path_str(&workspace), "--name", "linked", "--node", "adder.py"];
    let pushed = daemon.deployer().run(&[&push[..], &parameters].concat())?.expect_success()?;
    let said = pushed.output();
    ensure!(said.contains("src/adder_py is a link to ") && !said.contains("run.bag"), "{said}");
    ensure!(said.contains("no node has read a parameter ofset since it was started"), "{said}");
    ensure!(!said.contains("no node has read a parameter offset"), "{said}");
    let answer = daemon.robot("linked")?.call("/add_two", json!({"a": 1, "b": 1}))?;
    ensure!(answer["values"]["sum"] == 7, "{answer}");
    Ok(())
}

pub fn a_revision_is_rolled_back() -> Verdict {
    let daemon = world().daemon_with(ADDER)?;
    let deployer = daemon.deployer();
    deployer.push("adder_py", &["--name", "moody", "--node", "adder.py", "--param", "offset=1"])?.expect_success()?;
    deployer.push("adder_py", &["--name", "moody", "--node", "adder.py", "--param", "offset=100"])?.expect_success()?;
    let sum = |robot: &str| -> anyhow::Result<Value> {
        let mut robot = daemon.robot(&format!("moody?robot={robot}"))?;
        Ok(robot.call("/add_two", json!({"a": 1, "b": 1}))?["values"]["sum"].clone())
    };
    ensure!(sum("new")? == 102);
    let diff = || deployer.run_json(&["diff", "moody"]);
    let compared = |found: &Value| (found["from"].as_u64(), found["to"].as_u64());
    ensure!(compared(&diff()?) == (Some(1), Some(2)));
    deployer.run(&["rollback", "moody"])?.expect_success()?;
    ensure!(sum("old")? == 3);
    // What the rollback changed, not what led to revision 1.
    let found = diff()?;
    let offset = json!({"part": "parameter", "name": "/adder/offset", "before": "100", "after": "1"});
    ensure!(compared(&found) == (Some(2), Some(1)), "{found:#}");
    ensure!(found["differences"].as_array().is_some_and(|all| all.contains(&offset)), "{found:#}");
    deployer.run(&["rm", "moody"])?.expect_success()?;
    ensure!(daemon.servants_of("moody")?.is_empty(), "its servants went with it");
    ensure!(daemon.get("/api/v1/services/moody")?.0 == 404);
    Ok(())
}

pub fn five_packaged_nodes_answer() -> Verdict {
    let daemon = world().ensure_shared()?;
    let outcome = run(tell_patience(&mut Command::new(binaries::python()))
        .arg(binaries::checkout().join("tests/robots/packaged_nodes.py"))
        .arg(&daemon.address)
        .arg(binaries::path("cloudroidctl"))
        .env("CLOUDROID_HOME", &daemon.home))?;
    let outcome = outcome.expect_success()?;
    for node in ["people_detect", "face_detection", "fback_flow", "image_proc", "stereo_image_proc"] {
        ensure!(outcome.stdout.contains(&format!("{node}: answered")), "{}", outcome.output());
    }
    Ok(())
}
