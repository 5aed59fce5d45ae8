//! Underlays: compiled workspaces that other packages are compiled and run upon.

use std::path::Path;

use anyhow::ensure;
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::deployer::path_str;
use support::world::world;

use crate::access::{create_token, run_with_token};
use crate::borrowed::{manifest, write_files, write_python_package};

/// Writes an underlay of ROS 1 below `place`: messages, and a library that says `word`, which needs yaml-cpp.
fn write_library(place: &Path, word: &str) -> Verdict {
    let messages = "cmake_minimum_required(VERSION 3.0.2)\nproject(lab_msgs)\n\
                    find_package(catkin REQUIRED COMPONENTS message_generation)\n\
                    add_message_files(FILES Word.msg)\ngenerate_messages()\n\
                    catkin_package(CATKIN_DEPENDS message_runtime)\n";
    let library = "cmake_minimum_required(VERSION 3.0.2)\nproject(lab_words)\n\
                   find_package(catkin REQUIRED COMPONENTS roscpp lab_msgs)\nfind_package(yaml-cpp REQUIRED)\n\
                   catkin_package(INCLUDE_DIRS include LIBRARIES lab_words CATKIN_DEPENDS lab_msgs)\n\
                   include_directories(include ${catkin_INCLUDE_DIRS})\n\
                   add_library(lab_words words.cpp)\nadd_dependencies(lab_words ${catkin_EXPORTED_TARGETS})\n\
                   target_link_libraries(lab_words ${catkin_LIBRARIES} yaml-cpp)\n\
                   install(TARGETS lab_words LIBRARY DESTINATION ${CATKIN_PACKAGE_LIB_DESTINATION})\n\
                   install(DIRECTORY include/lab_words/ DESTINATION ${CATKIN_PACKAGE_INCLUDE_DESTINATION})\n";
    let catkin = "<buildtool_depend>catkin</buildtool_depend>";
    let of_messages =
        format!("{catkin}<build_depend>message_generation</build_depend><depend>message_runtime</depend>");
    let of_library = format!("{catkin}<depend>roscpp</depend><depend>lab_msgs</depend><depend>yaml-cpp</depend>");
    write_files(
        &place.join("src"),
        &[
            ("lab_msgs/package.xml", manifest("lab_msgs", &of_messages)),
            ("lab_msgs/CMakeLists.txt", messages.to_owned()),
            ("lab_msgs/msg/Word.msg", "string word\n".to_owned()),
            ("lab_words/package.xml", manifest("lab_words", &of_library)),
            ("lab_words/CMakeLists.txt", library.to_owned()),
            (
                "lab_words/include/lab_words/words.h",
                "#pragma once\n#include <lab_msgs/Word.h>\nlab_msgs::Word find_word();\n".to_owned(),
            ),
            (
                "lab_words/words.cpp",
                format!(
                    "#include <lab_words/words.h>\n#include <yaml-cpp/yaml.h>\nlab_msgs::Word find_word() {{\n\
                     \x20 lab_msgs::Word word;\n  word.word = YAML::Load(\"{word}\").as<std::string>();\n\
                     \x20 return word;\n}}\n"
                ),
            ),
        ],
    )
}

/// Writes a node of ROS 1 that says the word of the library.
fn write_speaker(place: &Path) -> Verdict {
    let list = "cmake_minimum_required(VERSION 3.0.2)\nproject(lab_speaker)\n\
                find_package(catkin REQUIRED COMPONENTS roscpp lab_msgs lab_words)\ncatkin_package()\n\
                include_directories(${catkin_INCLUDE_DIRS})\nadd_executable(speaker speaker.cpp)\n\
                target_link_libraries(speaker ${catkin_LIBRARIES})\n\
                install(TARGETS speaker RUNTIME DESTINATION ${CATKIN_PACKAGE_BIN_DESTINATION})\n";
    let node = "#include <lab_words/words.h>\n#include <ros/ros.h>\nint main(int argc, char** argv) {\n\
                \x20 ros::init(argc, argv, \"speaker\");\n  ros::NodeHandle node;\n\
                \x20 auto said = node.advertise<lab_msgs::Word>(\"said\", 1, true);\n\
                \x20 said.publish(find_word());\n  ros::spin();\n}\n";
    let needs = "<buildtool_depend>catkin</buildtool_depend><depend>roscpp</depend><depend>lab_msgs</depend>\
                 <depend>lab_words</depend>";
    write_files(
        place,
        &[
            ("package.xml", manifest("lab_speaker", needs)),
            ("CMakeLists.txt", list.to_owned()),
            ("speaker.cpp", node.to_owned()),
        ],
    )
}

/// Returns the word that a robot hears of a service.
fn hear(daemon: &Daemon, service: &str, robot: &str) -> anyhow::Result<Value> {
    let mut robot = daemon.robot(&format!("{service}?robot={robot}"))?;
    robot.subscribe("/said")?;
    Ok(robot.next_message_on("/said")?["word"].clone())
}

/// Returns the titles of the steps of a push that succeeds.
fn push_steps(daemon: &Daemon, words: &[&str]) -> anyhow::Result<Vec<String>> {
    let outcome = daemon.deployer().run(&[&["--format", "json", "push"][..], words].concat())?.expect_success()?;
    let events = outcome.stdout.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
    Ok(events.filter_map(|event| Some(event["title"].as_str()?.to_owned())).collect())
}

pub fn a_node_is_compiled_and_runs_upon_a_compiled_workspace() -> Verdict {
    let daemon = world().setup("underlays").start()?;
    let deployer = daemon.deployer();
    let place = world().directory("underlay-packages")?;
    let (library, speaker) = (place.path().join("lab_ws"), place.path().join("lab_speaker"));
    write_library(&library, "hello")?;
    write_speaker(&speaker)?;
    // What an earlier run has compiled is not compiled again.
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH)?.as_nanos();
    let mut cmake = std::fs::OpenOptions::new().append(true).open(speaker.join("CMakeLists.txt"))?;
    std::io::Write::write_all(&mut cmake, format!("# written at {now}\n").as_bytes())?;
    let on_words = ["push", path_str(&speaker), "--node", "speaker", "--on", "words"];
    deployer.run(&on_words)?.expect_failure(&["there is no underlay \"words\"", "--as-underlay"])?;
    let publish = ["push", path_str(&library), "--as-underlay", "words"];
    deployer.run(&publish)?.expect_success()?;
    let steps = push_steps(&daemon, &on_words[1..])?;
    let compiled: Vec<&String> = steps.iter().filter(|title| title.starts_with("compiling ")).collect();
    ensure!(compiled == ["compiling lab_speaker (1 of 1)"], "{steps:?}");
    ensure!(hear(&daemon, "lab_speaker", "first")? == "hello");
    // Who stands on it is listed, and is told apart when it changes.
    let listed = || deployer.run_json(&["underlays"]);
    let first = listed()?[0].clone();
    ensure!(first["revision"] == 1 && first["packages"] == json!(["lab_msgs", "lab_words"]), "{first:#}");
    ensure!(first["services"] == json!([{"service": "lab_speaker", "on": 1}]), "{first:#}");
    deployer.run(&["underlay", "remove", "words"])?.expect_failure(&["lab_speaker", "stand on underlay words"])?;
    let again = deployer.run(&publish)?.expect_success()?;
    ensure!(again.output().contains("unchanged"), "{}", again.output());
    write_library(&library, "goodbye")?;
    let changed = deployer.run(&publish)?.expect_success()?;
    let words = "lab_speaker (on revision 1) stand on an earlier revision of words; push them again";
    ensure!(changed.output().contains(words), "{}", changed.output());
    ensure!(hear(&daemon, "lab_speaker", "second")? == "hello", "it stays on what it was built on");
    deployer.run(&on_words)?.expect_success()?;
    ensure!(hear(&daemon, "lab_speaker", "third")? == "goodbye");
    ensure!(listed()?[0]["services"][0]["on"] == 2);
    // A package of it is not pushed beside it.
    let mixed = ["push", path_str(&library), "--on", "words", "--as-underlay", "more"];
    deployer.run(&mixed)?.expect_failure(&["also in underlay words", "--packages-skip"])?;
    // Its names have rights, as those of services.
    let ada = create_token(&daemon, &["ada", "--role", "deployer", "--service", "ada_*"])?;
    run_with_token(&daemon, &ada, &publish)?.expect_failure(&["may not"])?;
    run_with_token(&daemon, &ada, &on_words)?.expect_failure(&["there is no underlay \"words\""])?;
    ensure!(run_with_token(&daemon, &ada, &["underlays"])?.expect_success()?.stdout.contains("no underlays"));
    deployer.run(&["rm", "lab_speaker"])?.expect_success()?;
    deployer.run(&["underlays", "rm", "words"])?.expect_success()?;
    ensure!(listed()? == json!([]));
    Ok(())
}

pub fn an_underlay_of_ros_2_has_interfaces_and_modules() -> Verdict {
    let daemon = world().setup("underlays-of-two").start()?;
    let deployer = daemon.deployer();
    let place = world().directory("underlay-packages-of-two")?;
    let underlay = place.path().join("lab2_ws");
    let messages = "cmake_minimum_required(VERSION 3.8)\nproject(lab2_msgs)\nfind_package(ament_cmake REQUIRED)\n\
                    find_package(rosidl_default_generators REQUIRED)\n\
                    rosidl_generate_interfaces(${PROJECT_NAME} \"msg/Word.msg\")\nament_package()\n";
    let of_messages = "<buildtool_depend>ament_cmake</buildtool_depend>\
                       <buildtool_depend>rosidl_default_generators</buildtool_depend>\
                       <exec_depend>rosidl_default_runtime</exec_depend>\
                       <member_of_group>rosidl_interface_packages</member_of_group>\
                       <export><build_type>ament_cmake</build_type></export>";
    let doubling = "from lab2_msgs.msg import Word\n\n\ndef make(text):\n    return Word(word=2 * text)\n";
    write_files(
        &underlay.join("src/lab2_msgs"),
        &[
            ("package.xml", manifest("lab2_msgs", of_messages)),
            ("CMakeLists.txt", messages.to_owned()),
            ("msg/Word.msg", "string word\n".to_owned()),
        ],
    )?;
    let module = [("__init__.py", doubling)];
    write_python_package(&underlay, "lab2_words_py", "<depend>lab2_msgs</depend>", ("lab2_words", &module))?;
    let node = "import rclpy\nfrom lab2_msgs.msg import Word\n\nfrom lab2_words import make\n\n\ndef main():\n\
                \x20   rclpy.init()\n    node = rclpy.create_node('speaker')\n\
                \x20   said = node.create_publisher(Word, '/said', 1)\n\
                \x20   node.create_timer(0.2, lambda: said.publish(make('ha')))\n    rclpy.spin(node)\n";
    // By the name of the module, as tf2_ros is named for tf2_ros_py.
    let needs = "<depend>rclpy</depend><depend>lab2_msgs</depend><depend>lab2_words</depend>";
    let module = [("__init__.py", ""), ("node.py", node)];
    write_python_package(place.path(), "lab2_speaker", needs, ("lab2_speaker", &module))?;
    let speaker = place.path().join("src/lab2_speaker");
    deployer.run(&["push", path_str(&underlay), "--as-underlay", "words2"])?.expect_success()?;
    deployer.run(&["push", path_str(&speaker), "--node", "go", "--on", "words2"])?.expect_success()?;
    ensure!(hear(&daemon, "lab2_speaker", "first")? == "haha");
    // It is in the image, which is exported with it.
    let exported = place.path().join("speaker.oci.tar");
    deployer.run(&["export", "lab2_speaker", "-o", path_str(&exported)])?.expect_success()?;
    deployer.run(&["rm", "lab2_speaker"])?.expect_success()?;
    deployer.run(&["underlays", "rm", "words2"])?.expect_success()?;
    deployer.run(&["import", path_str(&exported)])?.expect_success()?;
    ensure!(hear(&daemon, "lab2_speaker", "second")? == "haha");
    Ok(())
}
