use super::*;

struct WorkspaceFixture(tempfile::TempDir);

impl WorkspaceFixture {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn write(&self, name: &str, text: &str) -> &Self {
        let path = self.0.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
        self
    }

    /// Creates a package of format 2 in `directory` that depends on `needs`.
    fn package(&self, directory: &str, name: &str, needs: &[&str]) -> &Self {
        let needs: String = needs.iter().map(|need| format!("<depend>{need}</depend>")).collect();
        let text = format!("<package format='2'><name>{name}</name>{needs}<exec_depend>rospy</exec_depend></package>");
        self.write(&format!("{directory}/package.xml"), &text)
    }

    fn link(&self, target: impl AsRef<Path>, name: &str) -> &Self {
        let path = self.0.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::os::unix::fs::symlink(target, path).unwrap();
        self
    }

    fn inspect(&self) -> Result<PushedDirectory, Error> {
        inspect(self.0.path(), &Variables::for_distribution(1, "noetic"))
    }

    fn refusal(&self) -> String {
        self.inspect().unwrap_err().to_string()
    }

    fn found_packages(&self) -> Vec<(String, String)> {
        let pushed = self.inspect().unwrap();
        let packages = pushed.packages().iter();
        packages.map(|p| (p.manifest.name.clone(), p.path.display().to_string())).collect()
    }
}

fn pairs(expected: &[(&str, &str)]) -> Vec<(String, String)> {
    expected.iter().map(|(name, path)| ((*name).to_owned(), (*path).to_owned())).collect()
}

#[test]
fn one_package() {
    let place = WorkspaceFixture::new();
    place.package(".", "single", &["roscpp"]).package("nested", "not_looked_at", &[]);
    assert_eq!(place.found_packages(), pairs(&[("single", "")]));
    let external = place.inspect().unwrap().external_dependencies();
    let names: Vec<_> = external.iter().map(|external| external.name.as_str()).collect();
    assert_eq!(names, ["roscpp", "rospy"]);
    assert_eq!(external[0].kinds, BTreeSet::from([Kind::Build, Kind::BuildExport, Kind::Exec]));
    assert_eq!(external[1].kinds, BTreeSet::from([Kind::Exec]));
    assert_eq!(external[0].needed_by, BTreeSet::from(["single".to_owned()]));
}

#[test]
fn a_workspace_in_build_order() {
    let place = WorkspaceFixture::new();
    place
        .package("src/a", "a", &["z_msgs", "roscpp"])
        .package("src/stack/b", "b", &["a"])
        .package("src/stack/z", "z_msgs", &["std_msgs"])
        .package("src/stack/z/test/inner", "inner", &[])
        .package("elsewhere/c", "c", &[]);
    assert_eq!(place.found_packages(), pairs(&[("z_msgs", "src/stack/z"), ("a", "src/a"), ("b", "src/stack/b")]));
    let external = place.inspect().unwrap().external_dependencies();
    assert!(external.iter().all(|external| external.name != "z_msgs"));
    assert_eq!(external.iter().find(|e| e.name == "rospy").unwrap().needed_by.len(), 3);
}

#[test]
fn packages_side_by_side_without_src() {
    let place = WorkspaceFixture::new();
    place.package("a", "a", &[]).package("b", "b", &[]).package(".hidden/c", "c", &[]);
    assert_eq!(place.found_packages(), pairs(&[("a", "a"), ("b", "b")]));
}

#[test]
fn ignored_and_built_directories_are_left_out() {
    let place = WorkspaceFixture::new();
    place.package("src/a", "a", &[]);
    for (directory, mark) in
        [("x", "CATKIN_IGNORE"), ("y", "COLCON_IGNORE"), ("z", "AMENT_IGNORE"), ("devel", ".catkin")]
    {
        place.package(&format!("src/{directory}/a"), "a", &[]).write(&format!("src/{directory}/{mark}"), "");
    }
    assert_eq!(place.found_packages(), pairs(&[("a", "src/a")]));
}

#[test]
fn links_are_followed_inside_only() {
    let outside = WorkspaceFixture::new();
    outside.package("o", "o", &[]);
    let place = WorkspaceFixture::new();
    place.package("repos/a", "a", &[]);
    place.link("../repos/a", "src/a").link("..", "src/circle").link(outside.0.path().join("o"), "src/o");
    assert_eq!(place.found_packages(), pairs(&[("a", "src/a")]));
    let place = WorkspaceFixture::new();
    place.link(outside.0.path().join("o/package.xml"), "src/o/package.xml");
    assert!(place.refusal().contains("leads out of"), "{}", place.refusal());
}

#[test]
fn two_packages_of_one_name_are_refused() {
    let place = WorkspaceFixture::new();
    place.package("src/a", "same", &[]).package("src/b", "same", &[]);
    let text = place.refusal();
    assert!(text.contains("\"same\": src/a and src/b"), "{text}");
}

#[test]
fn packages_that_need_each_other_are_refused() {
    let place = WorkspaceFixture::new();
    place.package("src/a", "a", &["b"]).package("src/b", "b", &["c"]).package("src/c", "c", &["b"]);
    let text = place.refusal();
    assert!(text.contains("b needs c needs b"), "{text}");
    // Mutual exec dependencies are allowed, and so is a dependency on itself.
    let place = WorkspaceFixture::new();
    place.package("src/a", "a", &["a"]);
    place.write("src/b/package.xml", "<package format='2'><name>b</name><depend>a</depend></package>");
    place.write(
        "src/a/package.xml",
        "<package format='2'><name>a</name><build_depend>a</build_depend><exec_depend>b</exec_depend></package>",
    );
    assert_eq!(place.found_packages(), pairs(&[("a", "src/a"), ("b", "src/b")]));
}

#[test]
fn a_directory_without_packages_is_told_what_was_looked_for() {
    let place = WorkspaceFixture::new();
    place.write("README", "x");
    let text = place.refusal();
    assert!(text.contains("is not a ROS package: no package.xml in it or anywhere below it"), "{text}");
    assert!(text.contains("give the directory of a package"), "{text}");
    place.write("src/CATKIN_IGNORE", "");
    let text = place.refusal();
    assert!(text.contains("below its src") && text.contains("1 directories were skipped"), "{text}");
    let missing = inspect(&place.0.path().join("missing"), &Variables::default()).unwrap_err().to_string();
    assert!(missing.starts_with("cannot open ") && missing.contains("missing"), "{missing}");
    let file = inspect(&place.0.path().join("README"), &Variables::default()).unwrap_err().to_string();
    assert!(file.contains("README") && file.contains("not a directory"), "{file}");
}

#[test]
fn malformed_xml_names_its_file() {
    let place = WorkspaceFixture::new();
    place.write("src/bad/package.xml", "<package>\n<name>x</nam></package>");
    let text = place.refusal();
    assert!(text.contains("src/bad/package.xml, line 2"), "{text}");
}

const SETUP: &str = "#!/usr/bin/env sh\n# since this file is sourced ...\n\
                     : ${_CATKIN_SETUP_DIR:=/home/me/ws/install}\n_SETUP_UTIL=\"$_CATKIN_SETUP_DIR/_setup_util.py\"\n";

#[test]
fn an_install_space_and_where_it_was_built_for() {
    for below in ["", "install/"] {
        let place = WorkspaceFixture::new();
        place.write(&format!("{below}.catkin"), "").write(&format!("{below}setup.sh"), SETUP);
        place.package(&format!("{below}share/b"), "b", &["a"]).package(&format!("{below}share/a"), "a", &[]);
        place.write(&format!("{below}share/doc/readme"), "");
        let PushedDirectory::Installed(space) = place.inspect().unwrap() else { panic!("not an install space") };
        assert_eq!(space.prefix.as_deref(), Some(Path::new("/home/me/ws/install")));
        assert_eq!(space.root, place.0.path().canonicalize().unwrap().join(below));
        let names: Vec<_> =
            space.packages.iter().map(|p| (p.manifest.name.as_str(), p.path.to_str().unwrap())).collect();
        assert_eq!(names, [("a", "share/a"), ("b", "share/b")]);
    }
}

#[test]
fn an_install_space_that_names_no_usable_place() {
    for script in [
        "",
        ": ${_CATKIN_SETUP_DIR:=relative}",
        ": ${_CATKIN_SETUP_DIR:=/a/../../etc}",
        ": ${_CATKIN_SETUP_DIR:=/a;rm}",
    ] {
        let place = WorkspaceFixture::new();
        place.write(".catkin", "").write("setup.sh", script).package("share/a", "a", &[]);
        let PushedDirectory::Installed(space) = place.inspect().unwrap() else { panic!("not an install space") };
        assert_eq!(space.prefix, None, "{script}");
    }
}

#[test]
fn sources_win_over_their_own_install_space() {
    let place = WorkspaceFixture::new();
    place.package("src/a", "a", &[]).write("install/.catkin", "").write("install/setup.sh", SETUP);
    place.package("install/share/a", "a", &[]);
    assert_eq!(place.found_packages(), pairs(&[("a", "src/a")]));
}

#[test]
fn a_devel_space_and_an_empty_install_space_are_refused() {
    let place = WorkspaceFixture::new();
    place.write(".catkin", "/home/me/ws/src").write("setup.sh", SETUP);
    assert!(place.refusal().contains("is a devel space"), "{}", place.refusal());
    place.write(".catkin", "");
    assert!(place.refusal().contains("has no share/*/package.xml"), "{}", place.refusal());
}

/// Prefix statement in colcon's `local_setup.sh`.
const COLCON: &str = "# generated\n_colcon_prefix_sh_COLCON_CURRENT_PREFIX=\"/home/me/ws/install\"\n\
                      if [ -z \"$COLCON_CURRENT_PREFIX\" ]; then\n";
/// Prefix statement in colcon's `setup.sh`.
const COLCON_CHAIN: &str = "_colcon_prefix_chain_sh_COLCON_CURRENT_PREFIX=/home/me/ws/install\n";
/// Prefix statement in ament's own `local_setup.sh`.
const AMENT: &str = ": ${AMENT_CURRENT_PREFIX:=\"/opt/mine\"}\n";

impl WorkspaceFixture {
    /// Creates a ROS 2 package in a prefix.
    fn write_indexed_package(&self, prefix: &str, name: &str) -> &Self {
        self.write(&format!("{prefix}share/ament_index/resource_index/packages/{name}"), "").package(
            &format!("{prefix}share/{name}"),
            name,
            &[],
        )
    }

    fn space(&self) -> InstallSpace {
        match self.inspect().unwrap() {
            PushedDirectory::Installed(space) => space,
            PushedDirectory::Source(_) => panic!("not an install space"),
        }
    }
}

#[test]
fn install_spaces_of_ros_2_in_either_layout() {
    for below in ["", "install/"] {
        for (layout, script, text, prefix) in [
            (Layout::Merged, "local_setup.sh", COLCON, Some("/home/me/ws/install")),
            (Layout::Merged, "setup.sh", COLCON_CHAIN, Some("/home/me/ws/install")),
            (Layout::Merged, "local_setup.sh", AMENT, Some("/opt/mine")),
            (Layout::Merged, "README", "no script at all", None),
            (Layout::Isolated, "local_setup.sh", COLCON, Some("/home/me/ws/install")),
        ] {
            let place = WorkspaceFixture::new();
            place.write(&format!("{below}{script}"), text);
            for name in ["b", "a"] {
                let of_package = match layout {
                    Layout::Isolated => format!("{below}{name}/"),
                    _ => below.to_owned(),
                };
                place.write_indexed_package(&of_package, name);
            }
            let space = place.space();
            assert_eq!(space.layout, layout, "{below}{script}");
            assert_eq!(space.layout.version(), ros::bus::RosVersion::Two);
            assert_eq!(space.prefix.as_deref(), prefix.map(Path::new), "{text}");
            assert_eq!(space.root, place.0.path().canonicalize().unwrap().join(below));
            let paths: Vec<_> = space.packages.iter().map(|p| p.path.clone()).collect();
            let expected = match layout {
                Layout::Isolated => ["a/share/a", "b/share/b"],
                _ => ["share/a", "share/b"],
            };
            assert_eq!(paths, expected.map(PathBuf::from));
        }
    }
}

#[test]
fn sources_side_by_side_are_no_isolated_space() {
    let place = WorkspaceFixture::new();
    // A repository may contain an index among its tests.
    place.package("a", "a", &[]).write("b/share/ament_index/resource_index/packages/x", "").package("b", "b", &[]);
    assert_eq!(place.found_packages(), pairs(&[("a", "a"), ("b", "b")]));
}

#[test]
fn a_space_that_leads_back_to_its_sources_is_refused() {
    let place = WorkspaceFixture::new();
    place
        .write_indexed_package("", "talker")
        .write("local_setup.sh", COLCON)
        .write("share/talker/hook/pythonpath_develop.sh", "");
    let text = place.refusal();
    assert!(text.contains("--symlink-install") && text.contains("push the workspace"), "{text}");
}

#[test]
fn an_index_without_package_xml_is_no_package() {
    let place = WorkspaceFixture::new();
    place.write("share/ament_index/resource_index/packages/x", "");
    assert!(place.refusal().contains("has no share/*/package.xml"), "{}", place.refusal());
}

#[test]
fn members_of_a_group_come_before_those_that_need_it() {
    let place = WorkspaceFixture::new();
    let write = |name: &str, rest: &str| {
        let text = format!("<package format='3'><name>{name}</name>{rest}</package>");
        place.write(&format!("src/{name}/package.xml"), &text);
    };
    write("a_bridge", "<group_depend>rosidl_interface_packages</group_depend>");
    write("z_msgs", "<member_of_group>rosidl_interface_packages</member_of_group>");
    write("m_msgs", "<member_of_group>rosidl_interface_packages</member_of_group>");
    let expected = [("m_msgs", "src/m_msgs"), ("z_msgs", "src/z_msgs"), ("a_bridge", "src/a_bridge")];
    assert_eq!(place.found_packages(), pairs(&expected));
    // A member that needs the group needs the other members, not itself.
    write(
        "m_msgs",
        "<member_of_group>rosidl_interface_packages</member_of_group>\
         <group_depend>rosidl_interface_packages</group_depend>",
    );
    let expected = [("z_msgs", "src/z_msgs"), ("m_msgs", "src/m_msgs"), ("a_bridge", "src/a_bridge")];
    assert_eq!(place.found_packages(), pairs(&expected));
}
