//! Archives for robots of the other ROS than the service's, and robots that have the other ROS than an archive.

use super::*;

const INDEX: &str = "share/ament_index/resource_index";

fn assert_installs(files: &Files) {
    let stub = unpack_stub(files);
    let prefix = tempfile::tempdir().expect("a directory");
    let target = prefix.path().join("overlay");
    let output = run(&stub.path().join("install.sh"), &["--prefix", target.to_str().expect("text")]);
    assert!(output.status.success() && target.join("share/p/revision.toml").exists(), "{output:?}");
}

#[test]
fn robots_of_ros_1_get_an_overlay_of_catkin_for_a_service_of_ros_2() {
    let mut contents = ament::contents();
    let launch = "<launch><node pkg='p' type='node' name='n'/></launch>";
    contents.share.insert("launch/robot.launch".into(), file(launch, false));
    let manifest = "<package format='3'><name>p</name><version>1.2.3</version><license>Apache-2.0</license>\
                    <depend>rclcpp</depend></package>";
    contents.share.insert("package.xml".into(), file(manifest, false));
    let files = compose_stub_of(RosVersion::Two, RosVersion::One, &["node"], contents);
    for name in [".catkin", "setup.bash", "share/p/launch/robot.launch", "share/p/config/p.yaml", "lib/p/helper_node"] {
        assert!(files.contains_key(name), "{name}");
    }
    let not_theirs = ["ament_index", "local_setup", ".launch.py", ".idl", "cmake/", "scripts/", "environment/path"];
    let found = files.keys().find(|path| not_theirs.iter().any(|part| path.contains(part)));
    assert_eq!(found, None);
    // Definitions are the twins, not the files of the image.
    assert_eq!(text(&files["share/p/msg/T.msg"]), "int32 x\n");
    assert!(text(&files["share/p/message_packages/p/CMakeLists.txt"]).contains("FILES T.msg)"));
    assert!(text(&files["lib/p/node"]).contains(" run "));
    let manifest = text(&files["share/p/package.xml"]);
    let document = crate::xml::parse(manifest).expect("XML");
    let of = |tag| document.descendants().find(|node| node.has_tag_name(tag)).and_then(|node| node.text());
    assert_eq!((of("name"), of("version"), of("license")), (Some("p"), Some("1.2.3"), Some("Apache-2.0")));
    assert!(of("maintainer").is_some() && of("description").is_some() && of("depend").is_none(), "{manifest}");
    let revision: toml::Table = text(&files["share/p/revision.toml"]).parse().expect("TOML");
    let ros = |key: &str| revision.get(key).and_then(toml::Value::as_integer);
    assert_eq!((ros("ros"), ros("service_ros")), (Some(1), Some(2)));
    let readme = text(&files["README.md"]);
    assert!(readme.contains("The service is of ROS 2, this archive for robots of ROS 1"), "{readme}");
    assert!(readme.contains("rosrun p node\n") && readme.contains("message_packages"), "{readme}");
    assert_installs(&files);
}

#[test]
fn robots_of_ros_2_get_an_overlay_of_ament_for_a_service_of_ros_1() {
    let mut contents = super::contents();
    contents.share.insert("launch/robot.launch.py".into(), file("", false));
    contents.share.insert("msg/T.msg".into(), file("time at\n", false));
    let files = compose_stub_of(RosVersion::One, RosVersion::Two, &["node", "tool.py"], contents);
    for name in ["local_setup.sh", &format!("{INDEX}/packages/p"), "share/p/launch/robot.launch.py"] {
        assert!(files.contains_key(name), "{name}");
    }
    // Programs are found in lib/PKG alone, and those of the image are of no use.
    assert!(text(&files["lib/p/tool.py"]).contains(" run "));
    let not_theirs = [".catkin", "a.launch", "launch/same", "scripts/", "bin/helper", "nodelets.xml"];
    let found = files.keys().find(|path| not_theirs.iter().any(|part| path.contains(part)));
    assert_eq!(found, None);
    assert_eq!(text(&files[&format!("{INDEX}/rosidl_interfaces/p")]), "msg/T.msg\n");
    assert_eq!(text(&files["share/p/msg/T.msg"]), "int32 x\n");
    let revision: toml::Table = text(&files["share/p/revision.toml"]).parse().expect("TOML");
    let ros = |key: &str| revision.get(key).and_then(toml::Value::as_integer);
    assert_eq!((ros("ros"), ros("service_ros")), (Some(2), Some(1)));
    assert!(text(&files["README.md"]).contains("ros2 run p node\n"));
    assert_installs(&files);
}

#[test]
fn an_archive_for_the_services_own_ros_says_nothing_of_another() {
    let files = compose_stub(&["node"]);
    let revision: toml::Table = text(&files["share/p/revision.toml"]).parse().expect("TOML");
    assert!(!revision.contains_key("service_ros"));
    assert!(!text(&files["README.md"]).contains("translates"));
    assert!(!files.keys().any(|path| path.contains("message_packages")));
}

#[test]
fn a_robot_of_the_other_ros_is_refused_before_anything_happens() {
    // The robot's program knows which ROS is set up.
    const REFUSES: &str = r#"#!/bin/sh
case "$*" in
  pair*) touch "${0%/*}/paired" ;;
  "doctor --share "*"/share/p --package p --only ros") echo "FAIL  ros"; exit 1 ;;
esac
"#;
    let mut files = compose_stub(&["node"]);
    files.insert(format!("lib/p/{PROGRAM}"), file(REFUSES, true));
    let stub = unpack_stub(&files);
    let prefix = tempfile::tempdir().expect("a directory");
    let target = prefix.path().join("overlay");
    let line = "cloudroid://here:9090/?robot=rover&code=1";
    let arguments = ["--prefix", target.to_str().expect("text"), "--pair", line];
    let install = |more: &[&str]| {
        let output = run(&stub.path().join("install.sh"), &[&arguments, more].concat());
        let told = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
        (output.status.success(), told.into_owned())
    };
    let paired = stub.path().join("lib/p/paired");
    let (good, said) = install(&[]);
    assert!(!good && said.contains("FAIL  ros") && said.contains("nothing was installed"), "{said}");
    assert!(!target.exists() && !paired.exists(), "{said}");
    let (good, said) = install(&["--force"]);
    assert!(good && target.exists() && paired.exists(), "{said}");
}
