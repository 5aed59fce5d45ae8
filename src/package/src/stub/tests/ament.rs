//! Stubs of ROS 2: an overlay for ament's tools.

use std::path::{Path, PathBuf};
use std::process::Command;

use super::*;

/// Share directory of an ament_cmake package, with the files of its install space.
pub(super) fn contents() -> Contents {
    let shared = [
        "package.xml",
        "launch/a.launch.py",
        "config/p.yaml",
        "environment/world.yaml",
        "environment/path.sh",
        "hook/cmake_prefix_path.dsv",
        "local_setup.bash",
        "package.dsv",
        "cmake/pConfig.cmake",
        "msg/T.msg",
        "msg/T.idl",
        "srv/S.srv",
        "msg/detail/hidden.msg",
    ];
    Contents {
        executables: ["node", "helper_node"].map(str::to_owned).into(),
        share: shared
            .map(|path| (path.to_owned(), file(path, false)))
            .into_iter()
            .chain([("scripts/node".to_owned(), file("#!/bin/sh", true))])
            .collect(),
        components: ["p::Node", "p::Other"].map(str::to_owned).into(),
    }
}

fn compose_ament_stub(outsourced: &[&str]) -> Files {
    compose_stub_for(RosVersion::Two, outsourced, contents())
}

/// Creates an install space with the original package, as on a robot.
fn write_original(place: &Path) -> PathBuf {
    let prefix = place.join("original");
    for (path, text) in [
        ("share/ament_index/resource_index/packages/p", ""),
        ("share/ament_index/resource_index/packages/q", ""),
        ("share/ament_index/resource_index/rclcpp_components/p", "p::Node;lib/libp.so\n"),
        ("share/ament_index/resource_index/p__plugins/p", "plugins.xml"),
        ("share/p/package.xml", "original"),
        ("lib/p/node", "original"),
        ("lib/libp__rosidl_typesupport_cpp.so", ""),
        ("lib/libpq__rosidl_typesupport_cpp.so", ""),
    ] {
        let path = prefix.join(path);
        std::fs::create_dir_all(path.parent().expect("below")).expect("made");
        std::fs::write(path, text).expect("written");
    }
    prefix
}

/// Installs the stub in an overlay; returns whether it succeeded, and the installer's output. `path` is
/// AMENT_PREFIX_PATH.
fn install(stub: &Path, overlay: &Path, path: &Path) -> (bool, String) {
    let output = Command::new("sh")
        .arg(stub.join("install.sh"))
        .arg("--prefix")
        .arg(overlay)
        .env("PATH", "/usr/bin:/bin")
        .env("AMENT_PREFIX_PATH", path)
        .output()
        .expect("a shell");
    let said = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    (output.status.success(), said.into_owned())
}

#[test]
fn all_that_tools_of_ros_2_look_for_is_there() {
    let files = compose_ament_stub(&["node", "made_up"]);
    for name in [
        "setup.sh",
        "setup.bash",
        "setup.zsh",
        "local_setup.sh",
        "local_setup.bash",
        "local_setup.zsh",
        "install.sh",
        "README.md",
        "share/ament_index/resource_index/packages/p",
        "share/p/package.xml",
        "share/p/launch/a.launch.py",
        "share/p/config/p.yaml",
        "share/p/environment/world.yaml",
        "share/p/stub.toml",
        "lib/p/helper_node",
    ] {
        assert!(files.contains_key(name), "{name}");
    }
    // Files of the image's install space are left out, and so are those of catkin.
    for name in [
        ".catkin",
        "share/p/local_setup.bash",
        "share/p/package.dsv",
        "share/p/environment/path.sh",
        "share/p/hook/cmake_prefix_path.dsv",
        "share/p/cmake/pConfig.cmake",
    ] {
        assert!(!files.contains_key(name), "{name}");
    }
    assert_eq!(
        text(&files["share/ament_index/resource_index/rosidl_interfaces/p"]),
        "msg/T.idl\nmsg/T.msg\nsrv/S.srv\n"
    );
    // Executables are searched only in lib/PKG, so each outsourced one is there, whatever else is shared.
    for name in ["node", "made_up"] {
        assert!(text(&files[&format!("lib/p/{name}")]).contains(" run "), "{name}");
    }
    let revision: toml::Table = text(&files["share/p/revision.toml"]).parse().expect("TOML");
    assert_eq!(revision["ros"].as_integer(), Some(2));
    let settings = text(&files["share/p/stub.toml"]);
    assert!(settings.contains("`ros2 run p cloudroid-stub doctor`"), "{settings}");
    assert!(text(&files["README.md"]).contains("ros2 run p made_up\n"));
}

#[test]
fn nothing_of_ros_1_is_said_and_no_placeholder_is_left() {
    for (path, content) in compose_ament_stub(&["node"]) {
        let text = text(&content);
        for word in ["rosrun", "roslaunch ", "odelet", "@ROS@", "@RUN@", "@ORDER@", "@PLUGINS@"] {
            assert!(!text.contains(word), "{path}: {word}");
        }
    }
}

/// A container splits each line at `;` and joins the second part to the prefix, unless it is an absolute path.
#[test]
fn components_name_a_library_that_says_why() {
    let files = compose_ament_stub(&["node"]);
    let list = text(&files["share/ament_index/resource_index/rclcpp_components/p"]);
    let classes: Vec<&str> = list
        .lines()
        .map(|line| {
            let (class, library) = line.split_once(';').expect("two halves");
            assert!(library.starts_with("p runs in the cloud: its components"));
            assert!(!library.contains([';', '/']) && library.len() < 255, "{library}");
            class
        })
        .collect();
    assert_eq!(classes, ["p::Node", "p::Other"]);
    let mut without = contents();
    without.components.clear();
    let files = compose_stub_for(RosVersion::Two, &["node"], without);
    assert!(!files.keys().any(|path| path.contains("rclcpp_components")));
}

#[test]
fn a_launcher_of_ros_2_gives_all_on() {
    let stub = unpack_stub(&compose_ament_stub(&["node"]));
    let arguments = ["--ros-args", "-r", "__node:=x y", "-p", "a:=\"$b\"", "--"];
    let output = run(&stub.path().join("lib/p/node"), &arguments);
    let words = String::from_utf8(output.stdout).expect("text");
    let said: Vec<&str> = words.lines().collect();
    assert_eq!(said[..5], ["run", "--package", "p", "--node", "node"]);
    assert_eq!(said[7..], [&["--"], &arguments[..]].concat());
}

#[test]
fn sourcing_puts_the_overlay_in_front_once() {
    let place = tempfile::tempdir().expect("a directory");
    let stub = unpack_stub(&compose_ament_stub(&["node"]));
    let overlay = place.path().join("over & lay");
    let (good, said) = install(stub.path(), &overlay, Path::new(""));
    assert!(good, "{said}");
    let overlay = overlay.to_str().expect("text");
    let source = |shell: &str, file: &str, before: &str, path: &str| {
        let script = format!(
            "set -u; {before} . '{overlay}/{file}'; . '{overlay}/{file}'; echo \"$AMENT_PREFIX_PATH\"; set | grep \
             -c '^_cloudroid'"
        );
        let output = Command::new(shell)
            .args(["-c", &script, "sh", "caller's own"])
            .env_clear()
            .env("PATH", "/usr/bin:/bin")
            .env("AMENT_PREFIX_PATH", path)
            .output()
            .expect("a shell");
        let text = |bytes| String::from_utf8(bytes).expect("text");
        (text(output.stdout), text(output.stderr))
    };
    for (shell, file) in
        [("sh", "setup.sh"), ("sh", "local_setup.sh"), ("bash", "setup.bash"), ("bash", "local_setup.bash")]
    {
        let (said, wrong) = source(shell, file, "", "/opt/ros/jazzy:/home/me/install");
        let expected = format!("{overlay}:/opt/ros/jazzy:/home/me/install\n0\n");
        assert_eq!((said, wrong), (expected, String::new()), "{file}");
        let again = format!("/home/me/install:{overlay}:/opt/ros/jazzy");
        let (said, _) = source(shell, file, "", &again);
        let expected = format!("{overlay}:/home/me/install:/opt/ros/jazzy\n0\n");
        assert_eq!(said, expected, "{file}: moved to the front");
    }
    // ROS 2 would put its own packages first if it were sourced later.
    let (said, wrong) = source("sh", "setup.sh", "unset AMENT_PREFIX_PATH;", "");
    assert_eq!(said, format!("{overlay}\n0\n"));
    assert!(wrong.contains("ROS 2's own set-up file was not sourced"), "{wrong}");
    // An unpacked but not installed stub is found by colcon's variable.
    let unpacked = stub.path().display();
    let script = format!("COLCON_CURRENT_PREFIX={unpacked}; . {unpacked}/local_setup.sh; echo \"$AMENT_PREFIX_PATH\"");
    let output =
        Command::new("sh").args(["-c", &script]).env("AMENT_PREFIX_PATH", "/opt/ros/jazzy").output().expect("a shell");
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert_eq!(said, format!("{unpacked}:/opt/ros/jazzy\n"));
}

#[test]
fn an_overlay_is_of_one_ros_and_goes_with_its_last_stub() {
    let place = tempfile::tempdir().expect("a directory");
    let key = sign::SigningKey::generate().expect("made").0;
    let stub = unpack_signed_by(&compose_ament_stub(&["node"]), &key);
    let one = unpack_stub(&super::compose_stub(&["node"]));
    let overlay = place.path().join("overlay");
    let original = write_original(place.path());
    let (good, said) = install(stub.path(), &overlay, &original);
    assert!(good && said.contains("ros2 run p cloudroid-stub doctor"), "{said}");
    let (good, said) = install(one.path(), &overlay, &original);
    assert!(
        !good && said.contains("contains stubs of ROS 2, but this one is of ROS 1: choose another --prefix"),
        "{said}"
    );
    // The code of its messages is the original's, for this package only.
    let link = overlay.join("lib/libp__rosidl_typesupport_cpp.so");
    assert_eq!(std::fs::read_link(&link).expect("a link"), original.join("lib/libp__rosidl_typesupport_cpp.so"));
    assert!(!overlay.join("lib/libpq__rosidl_typesupport_cpp.so").exists());
    // A later archive without components registers none.
    let mut without = contents();
    without.components.clear();
    let later = unpack_signed_by(&compose_stub_for(RosVersion::Two, &["node"], without), &key);
    let components = overlay.join("share/ament_index/resource_index/rclcpp_components/p");
    assert!(components.exists());
    let (good, said) = install(later.path(), &overlay, &original);
    assert!(good && !components.exists(), "{said}");
    let uninstall = run(&overlay.join("share/p/install.sh"), &["--uninstall"]);
    assert!(uninstall.status.success(), "{uninstall:?}");
    assert!(!overlay.exists(), "nothing is left");
    // And in the other direction.
    assert!(install(one.path(), &overlay, &original).0);
    let (good, said) = install(stub.path(), &overlay, &original);
    assert!(!good && said.contains("contains stubs of ROS 1"), "{said}");
}

/// ament_index_python of the wheels, as used by launch files and `ros2 run`; the latter searches `lib/PKG` of the
/// prefix that it returns.
#[test]
fn ros_2_s_own_tools_find_the_stub_before_the_original() {
    let ros = std::env::var("CLOUDROID_ROS2_PREFIX")
        .expect("CLOUDROID_ROS2_PREFIX names the environment with ROS 2; run the tests by make test");
    let place = tempfile::tempdir().expect("a directory");
    let place = place.path().canonicalize().expect("there");
    // Tools require names of at least two letters.
    let about = StubInfo {
        ros: RosVersion::Two,
        service_ros: RosVersion::Two,
        service: "serves",
        package: "people",
        revision: 3,
        image: "sha256:0",
        portal: &Portal::default(),
        architecture: "x86_64",
        outsourced: &["node".to_owned()].into(),
        names: &BTreeMap::new(),
        interface: &Interface::default(),
        stateful: false,
        requests: &[],
        times: None,
    };
    let (overlay, original) = (place.join("overlay"), place.join("original"));
    write(&compose(&about, contents()).expect("a stub"), &overlay);
    let index = "share/ament_index/resource_index";
    let of_original = [
        format!("{index}/packages/people"),
        format!("{index}/packages/other"),
        format!("{index}/rclcpp_components/people"),
        format!("{index}/people__plugins/people"),
        "lib/people/node".to_owned(),
    ];
    let of_original = of_original.map(|path| (path, file("original", true)));
    write(&of_original.into(), &original);
    let script = r#"
import os, shutil
from ament_index_python import (get_package_prefix, get_package_share_directory, get_packages_with_prefixes,
    get_resource, has_resource)
lib = os.path.join(get_package_prefix("people"), "lib", "people")
for found in [
    get_package_share_directory("people"),
    shutil.which("node", path=lib),
    get_packages_with_prefixes()["people"],
    get_package_prefix("other"),
    get_resource("rclcpp_components", "people")[1],
    has_resource("rosidl_interfaces", "people"),
    has_resource("people__plugins", "people"),
]:
    print(found)
"#;
    // With bash the overlay is found where it is, installed or not.
    let setup = format!(". '{}'; exec \"$0\" -c \"$1\"", overlay.join("setup.bash").display());
    let output = Command::new("bash")
        .args(["-c", &setup, &format!("{ros}/bin/python"), script])
        .env("AMENT_PREFIX_PATH", format!("{}:{ros}", original.display()))
        .output()
        .expect("a shell");
    let said = String::from_utf8(output.stdout).expect("text");
    let at = |prefix: &Path, path: &str| prefix.join(path).display().to_string();
    let expected = [
        at(&overlay, "share/people"),
        at(&overlay, "lib/people/node"),
        overlay.display().to_string(),
        original.display().to_string(),
        overlay.display().to_string(),
        overlay.display().to_string(),
        // Plugins for other programs of the robot remain those of the original.
        original.display().to_string(),
    ];
    let said: Vec<&str> = said.lines().collect();
    assert_eq!(said, expected, "{}", String::from_utf8_lossy(&output.stderr));
}
