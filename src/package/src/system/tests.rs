use std::os::unix::fs::symlink;

use super::*;

/// Layers of a root file system, lowest first.
struct RootFixture {
    place: tempfile::TempDir,
}

fn make_manifest(version: &str) -> String {
    format!("<package><name>x</name><version>{version}</version></package>")
}

impl RootFixture {
    /// Creates a layer with a distribution and Python.
    fn new(release: &str, python: &str) -> Self {
        let root = Self { place: tempfile::tempdir().expect("a directory") };
        root.write("0", "usr/lib/os-release", release);
        root.write("0", &format!("usr/bin/python{python}"), "#!/bin/sh\n");
        symlink(format!("python{python}"), root.place.path().join("0/usr/bin/python3")).expect("linked");
        root
    }

    fn new_ubuntu() -> Self {
        Self::new("ID=ubuntu\nVERSION_CODENAME=noble\nPRETTY_NAME=\"Ubuntu 24.04.1 LTS\"\n", "3.12")
    }

    fn write(&self, layer: &str, path: &str, text: &str) {
        let path = self.place.path().join(layer).join(path);
        std::fs::create_dir_all(path.parent().expect("below")).expect("made");
        std::fs::write(path, text).expect("written");
    }

    /// Writes a package of ROS 2 into a prefix.
    fn write_ament(&self, layer: &str, prefix: &str, name: &str, version: &str) {
        self.write(layer, &format!("{prefix}/share/ament_index/resource_index/packages/{name}"), "");
        self.write(layer, &format!("{prefix}/share/{name}/package.xml"), &make_manifest(version));
    }

    fn write_catkin(&self, layer: &str, prefix: &str, name: &str) {
        self.write(layer, &format!("{prefix}/.catkin"), "");
        self.write(layer, &format!("{prefix}/share/{name}/package.xml"), &make_manifest("1.16.0"));
    }

    fn list_layers(&self) -> Vec<std::path::PathBuf> {
        let entries = std::fs::read_dir(self.place.path()).expect("listed");
        let mut all: Vec<_> = entries.map(|entry| entry.expect("an entry").path()).collect();
        all.sort();
        all
    }

    fn find(&self, environment: &[(&str, &str)], wanted: Option<&str>) -> Result<FoundSystem, SystemError> {
        find_system(&self.list_layers(), &make_variables(environment), wanted)
    }

    fn make_environment(&self, given: &[(&str, &str)]) -> BTreeMap<String, String> {
        let found = self.find(given, None).expect("a system");
        make_environment(&self.list_layers(), &found, &make_variables(given)).expect("read")
    }
}

fn make_variables(pairs: &[(&str, &str)]) -> BTreeMap<String, String> {
    pairs.iter().map(|(name, value)| ((*name).to_owned(), (*value).to_owned())).collect()
}

#[test]
fn an_image_of_ros_2_is_known_by_its_index() {
    let root = RootFixture::new_ubuntu();
    for name in ["rclpy", "rmw_fastrtps_cpp", "gone"] {
        root.write_ament("1", "opt/ros/jazzy", name, "7.1.5");
    }
    root.write("1", "opt/ros/jazzy/lib/python3.12/site-packages/rclpy/__init__.py", "");
    root.write("1", "opt/ros/jazzy/lib/x86_64-linux-gnu/librcl.so", "");
    root.write("1", "opt/ros/jazzy/opt/yaml_vendor/lib/liby.so", "");
    root.write("1", "var/lib/dpkg/status", "Package: a\nStatus: install ok installed\nVersion: 1\nArchitecture: all\n");
    root.write("1", "usr/bin/cmake", "");
    // A later layer replaces the whole list.
    root.write_ament("2", "opt/ros/jazzy", "nav2_msgs", "1.3.4");
    let found = root.find(&[], None).expect("a system");
    let about = (&*found.distribution, &*found.suite, &*found.title, &*found.python);
    assert_eq!(about, ("ubuntu", "noble", "Ubuntu 24.04.1 LTS", "3.12"));
    assert_eq!((found.ros, &*found.ros_distribution), (RosVersion::Two, "jazzy"));
    let packages = found.packages();
    assert_eq!(packages.keys().collect::<Vec<_>>(), ["gone", "nav2_msgs", "rclpy", "rmw_fastrtps_cpp"]);
    assert_eq!(packages["nav2_msgs"], "1.3.4");
    assert!(found.has_any(&["cmake"]) && !found.has_any(&["g++", "colcon"]));
    assert_eq!(found.debian, Some(make_variables(&[("a", "1")])));

    let given = [("PATH", "/usr/bin:/opt/tool/bin"), ("ROS_DOMAIN_ID", "7"), ("LD_PRELOAD", "/x"), ("MY_MODEL", "a b")];
    let environment = root.make_environment(&given);
    for (name, value) in [
        ("AMENT_PREFIX_PATH", "/opt/ros/jazzy"),
        ("CMAKE_PREFIX_PATH", "/opt/ros/jazzy"),
        ("PATH", "/opt/ros/jazzy/bin:/usr/bin:/opt/tool/bin"),
        ("PYTHONPATH", "/opt/ros/jazzy/lib/python3.12/site-packages"),
        (
            "LD_LIBRARY_PATH",
            "/opt/ros/jazzy/opt/yaml_vendor/lib:/opt/ros/jazzy/lib/x86_64-linux-gnu:/opt/ros/jazzy/lib",
        ),
        ("ROS_DISTRO", "jazzy"),
        ("ROS_VERSION", "2"),
        ("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp"),
        ("MY_MODEL", "a b"),
    ] {
        assert_eq!(environment.get(name).map(String::as_str), Some(value), "{name}");
    }
    for name in ["ROS_DOMAIN_ID", "LD_PRELOAD", "ROS_PACKAGE_PATH"] {
        assert_eq!(environment.get(name), None, "{name}");
    }
}

#[test]
fn nodes_use_a_middleware_that_is_there_and_spoken() {
    let root = RootFixture::new_ubuntu();
    root.write_ament("1", "opt/ros/kilted", "rclpy", "9.1.2");
    let chosen = |given: &str| {
        let environment = root.make_environment(&[("RMW_IMPLEMENTATION", given)]);
        environment.get("RMW_IMPLEMENTATION").cloned()
    };
    assert_eq!(chosen("rmw_zenoh_cpp"), None, "one may be added to it");
    assert_eq!(chosen("rmw_cyclonedds_cpp").as_deref(), Some("rmw_cyclonedds_cpp"));
    root.write_ament("1", "opt/ros/kilted", "rmw_zenoh_cpp", "0.6.4");
    let refused = root.find(&[], None).expect_err("no node would be reached").to_string();
    assert!(refused.contains("rmw_zenoh_cpp alone") && refused.contains("add rmw_fastrtps_cpp or"), "{refused}");
    root.write_ament("2", "opt/ros/kilted", "rmw_fastrtps_cpp", "9.3.3");
    for given in ["", "rmw_zenoh_cpp", "rmw_cyclonedds_cpp", "rmw_fastrtps_cpp"] {
        assert_eq!(chosen(given).as_deref(), Some("rmw_fastrtps_cpp"), "{given}");
    }
    root.write_ament("2", "opt/ros/kilted", "rmw_cyclonedds_cpp", "4.0.2");
    assert_eq!(chosen("rmw_cyclonedds_cpp").as_deref(), Some("rmw_cyclonedds_cpp"));
}

#[test]
fn what_an_upper_layer_deletes_is_not_there() {
    let root = RootFixture::new_ubuntu();
    root.write_ament("1", "opt/ros/jazzy", "rclpy", "1");
    root.write_ament("1", "opt/ros/humble", "rclpy", "1");
    std::fs::create_dir_all(root.place.path().join("2/opt/ros")).expect("made");
    let mark = rustix::fs::mknodat(
        rustix::fs::CWD,
        root.place.path().join("2/opt/ros/humble"),
        rustix::fs::FileType::CharacterDevice,
        rustix::fs::Mode::empty(),
        0,
    );
    mark.expect("a deletion; run this test as root");
    assert_eq!(root.find(&[], None).expect("one is left").ros_distribution, "jazzy");
}

#[test]
fn a_robot_of_ros_1_is_known_by_catkins_marker() {
    let root = RootFixture::new("ID=debian\nVERSION_ID=\"11\"\n", "3.9");
    root.write_catkin("1", "opt/ros/noetic", "roscpp");
    root.write("1", "opt/ros/noetic/lib/python3/dist-packages/rospy/__init__.py", "");
    root.write_catkin("1", "home/robot/ws/install", "my_driver");
    root.write("1", "home/robot/ws/devel/.catkin", "/home/robot/ws/src");
    root.write_catkin("1", "root/ws/install", "secret");
    let found = root.find(&[], None).expect("a system");
    assert_eq!((found.ros, &*found.ros_distribution, &*found.suite), (RosVersion::One, "noetic", "11"));
    let spaces: Vec<&str> = found.spaces.iter().map(|space| &*space.path).collect();
    assert_eq!(spaces, ["/home/robot/ws/install", "/opt/ros/noetic"]);
    let unusable: Vec<&str> = found.unusable.iter().map(|(path, _)| &**path).collect();
    assert_eq!(unusable, ["/home/robot/ws/devel", "/root/ws/install"]);
    let environment = root.make_environment(&[]);
    assert_eq!(environment["ROS_PACKAGE_PATH"], "/home/robot/ws/install/share:/opt/ros/noetic/share");
    assert_eq!(environment["ROS_ROOT"], "/opt/ros/noetic/share/ros");
    assert_eq!(environment["PYTHONPATH"], "/opt/ros/noetic/lib/python3/dist-packages");
    assert!(!environment.contains_key("AMENT_PREFIX_PATH") && !environment.contains_key("RMW_IMPLEMENTATION"));
}

#[test]
fn the_distributions_own_ros_has_no_space() {
    let root = RootFixture::new("ID=debian\nVERSION_CODENAME=bookworm\n", "3.11");
    root.write("1", "usr/lib/python3/dist-packages/rospy/__init__.py", "");
    let found = root.find(&[], None).expect("a system");
    assert_eq!((found.ros, &*found.ros_distribution, found.spaces.len()), (RosVersion::One, "noetic", 0));
    assert!(!root.make_environment(&[]).contains_key("ROS_DISTRO"));
}

#[test]
fn a_workspace_is_an_overlay_whether_merged_or_isolated() {
    let root = RootFixture::new_ubuntu();
    root.write_ament("1", "opt/ros/jazzy", "rclpy", "1");
    root.write_ament("1", "opt/ros/jazzy", "talker", "1");
    root.write("2", "ws/install/.colcon_install_layout", "isolated\n");
    for name in ["talker", "listener"] {
        root.write_ament("2", &format!("ws/install/{name}"), name, "2");
    }
    root.write_ament("2", "opt/merged", "extra", "3");
    let found = root.find(&[("AMENT_PREFIX_PATH", "/ws/install/talker:/opt/ros/jazzy")], None).expect("a system");
    let spaces: Vec<(&str, SpaceLayout)> = found.spaces.iter().map(|space| (&*space.path, space.layout)).collect();
    let (merged, isolated) = (SpaceLayout::Merged, SpaceLayout::Isolated);
    assert_eq!(spaces, [("/ws/install", isolated), ("/opt/merged", merged), ("/opt/ros/jazzy", merged)]);
    assert_eq!(found.packages()["talker"], "2");
    let environment = root.make_environment(&[]);
    let expected = "/opt/merged:/ws/install/listener:/ws/install/talker:/opt/ros/jazzy";
    assert_eq!(environment["AMENT_PREFIX_PATH"], expected);
}

#[test]
fn wheels_below_a_prefix_of_any_name_are_of_the_distribution_that_is_said() {
    let root = RootFixture::new_ubuntu();
    root.write_ament("1", "opt/wheels", "rclpy", "7");
    let refused = root.find(&[], None).expect_err("nothing says which").to_string();
    assert!(refused.contains("/opt/wheels does not say which") && refused.contains("--ros-distro"), "{refused}");
    assert_eq!(root.find(&[], Some("kilted")).expect("said").ros_distribution, "kilted");
    assert_eq!(root.find(&[("ROS_DISTRO", "rolling")], None).expect("said").ros_distribution, "rolling");
    root.write("1", "opt/wheels/lib/python3.12/site-packages/ros_rclpy.libs/libssl-1.so", "");
    let environment = root.make_environment(&[("ROS_DISTRO", "jazzy")]);
    let modules = "/opt/wheels/lib/python3.12/site-packages";
    assert_eq!(environment["LD_LIBRARY_PATH"], format!("/opt/wheels/lib:{modules}/ros_rclpy.libs"));
    assert_eq!(environment["_ROS_WHEELS_BOOTSTRAP_COMPLETE"], "1");
    root.write("1", "opt/wheels/share/ros_environment/environment/1.ros_distro.sh", "export ROS_DISTRO=jazzy\n");
    assert_eq!(root.find(&[], None).expect("it says so itself").ros_distribution, "jazzy");
}

#[test]
fn of_several_ros_one_is_named() {
    let root = RootFixture::new_ubuntu();
    root.write_ament("1", "opt/ros/humble", "rclpy", "1");
    root.write_catkin("1", "opt/ros/noetic", "roscpp");
    let refused = root.find(&[], None).expect_err("two").to_string();
    assert!(refused.contains("humble (ROS 2), noetic (ROS 1)"), "{refused}");
    let found = root.find(&[], Some("noetic")).expect("named");
    assert_eq!((found.ros, found.spaces.len()), (RosVersion::One, 1));
    let found = root.find(&[("ROS_DISTRO", "humble")], None).expect("the image's own");
    assert_eq!((found.ros, found.spaces.len()), (RosVersion::Two, 1));
    let refused = root.find(&[], Some("jazzy")).expect_err("not there").to_string();
    assert!(refused.contains("it has no ROS jazzy; found: humble"), "{refused}");
}

#[test]
fn what_cannot_be_used_is_refused_with_the_reason() {
    let root = RootFixture::new_ubuntu();
    root.write_catkin("1", "root/ws/install", "mine");
    let refused = root.find(&[], None).expect_err("hidden").to_string();
    assert!(refused.contains("no ROS was found") && refused.contains("/root/ws/install is hidden"), "{refused}");

    let root = RootFixture::new_ubuntu();
    root.write_catkin("1", "opt/ros/melodic", "roscpp");
    root.write("1", "opt/ros/melodic/lib/python2.7/dist-packages/rospy/__init__.py", "");
    let refused = root.find(&[], None).expect_err("Python 2").to_string();
    assert!(refused.contains("ROS melodic in it is for Python 2"), "{refused}");

    let mut program = b"\x7fELF".to_vec();
    program.resize(64, 0);
    // EM_SPARCV9.
    program[18] = 43;
    let path = root.place.path().join("0/usr/bin/python3.12");
    std::fs::write(&path, &program).expect("written");
    assert!(matches!(root.find(&[], None), Err(SystemError::Architecture { its: "another architecture", .. })));
    std::fs::remove_file(path).expect("removed");
    assert!(matches!(root.find(&[], None), Err(SystemError::NoPython)));
}

#[test]
fn hostile_names_and_links_lead_nowhere() {
    let root = RootFixture::new_ubuntu();
    root.write("0", "usr/lib/os-release", "ID=\"u\u{1b}[31mx\"\nVERSION_CODENAME=-$(reboot)\nPRETTY_NAME='a\\nb'\n");
    root.write_ament("1", "opt/ros/jazzy", "rclpy", "1");
    root.write_ament("1", "opt/a:b", "injected", "1");
    root.write("1", "opt/ros/jazzy/share/rclpy/package.xml", "<package><version>1$(x)</version></package>");
    symlink("/etc", root.place.path().join("1/opt/link")).expect("linked");
    let path = [("AMENT_PREFIX_PATH", "/opt/../../etc:/opt/ros/jazzy:relative")];
    let found = root.find(&path, None).expect("a system");
    assert_eq!((&*found.distribution, &*found.suite, &*found.title), ("u31mx", "reboot", "anb"));
    assert_eq!(found.packages()["rclpy"], "1");
    assert_eq!(found.spaces.len(), 1, "{:?}", found.spaces);
    assert_eq!(found.unusable[0].1, "has a name with special characters");
    // One space under many names is one, and no name ends a list of the environment early.
    let names: Vec<String> = (1..200).map(|more| format!("/opt{}ros/./jazzy", "/".repeat(more))).collect();
    let names = format!("{}:/opt/ros/jazzy", names.join(":"));
    let found = root.find(&[("AMENT_PREFIX_PATH", &names)], None).expect("a system");
    assert_eq!(found.spaces.iter().map(|space| &*space.path).collect::<Vec<_>>(), ["/opt/ros/jazzy"]);
    assert_eq!(root.make_environment(&[("PATH", "/a\0b:/bin")])["PATH"], "/opt/ros/jazzy/bin:/bin");
    root.write("1", "opt/\u{1b}[31mdevel/.catkin", "/src");
    let found = root.find(&[], None).expect("a system");
    assert!(found.unusable.iter().all(|(path, _)| !path.contains('\u{1b}')), "{:?}", found.unusable);
    let refused = root.find(&[], Some("../jazzy")).expect_err("no name").to_string();
    assert!(refused.contains("is no name of a ROS distribution"), "{refused}");
}
