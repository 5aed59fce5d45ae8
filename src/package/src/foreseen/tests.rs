use super::*;
use crate::condition::Variables;
use crate::workspace::{PushedDirectory, inspect};

struct SourceFixture(tempfile::TempDir);

impl SourceFixture {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("a directory"))
    }

    fn write(&self, path: &str, text: &str) -> &Self {
        let path = self.0.path().join(path);
        std::fs::create_dir_all(path.parent().expect("below")).expect("made");
        std::fs::write(path, text).expect("written");
        self
    }

    fn package(&self, name: &str, build_type: &str, build: &str) -> &Self {
        let manifest = format!(
            "<package format='3'><name>{name}</name><export><build_type>{build_type}</build_type></export></package>"
        );
        self.write(&format!("src/{name}/package.xml"), &manifest);
        self.write(&format!("src/{name}/CMakeLists.txt"), build)
    }

    fn workspace(&self, version: RosVersion) -> Workspace {
        let variables = Variables::for_distribution(version.number(), "any");
        let PushedDirectory::Source(workspace) = inspect(self.0.path(), &variables).expect("a workspace") else {
            panic!("sources")
        };
        workspace
    }

    fn scan(&self, version: RosVersion) -> SourceScan {
        scan_sources(&self.workspace(version), version)
    }

    fn must_be_chosen(&self, version: RosVersion) -> bool {
        self.scan(version).must_be_chosen()
    }
}

/// Creates a ROS 1 package with two executables whose build file continues with `rest`.
fn ros1_package(rest: &str) -> SourceFixture {
    let place = SourceFixture::new();
    let build = format!(
        "project(ekf)\nfind_package(catkin REQUIRED)\ncatkin_package()\n\
         add_executable(${{PROJECT_NAME}} src/ekf.cpp)\n{rest}\n"
    );
    place.package("ekf", "catkin", &build);
    place.write("src/ekf/scripts/wtf.py", "#!/usr/bin/env python\n");
    place
}

const WTF: &str = "catkin_install_python(PROGRAMS scripts/wtf.py DESTINATION ${CATKIN_PACKAGE_BIN_DESTINATION})";

#[test]
fn several_programs_and_launch_files_must_be_chosen_from() {
    let place = ros1_package(WTF);
    place
        .write("src/ekf/launch/a.launch", "")
        .write("src/ekf/example.launch", "")
        .write("src/ekf/test/test.launch", "");
    let foreseen = place.scan(RosVersion::One);
    assert_eq!(foreseen.executables, ["ekf", "wtf.py"]);
    assert_eq!(foreseen.launch_files, ["example.launch", "launch/a.launch"]);
    assert!(foreseen.must_be_chosen());
    // Executables of several packages count together.
    let place = ros1_package("add_executable(${NODE}_b b.cpp)");
    place.package("other", "catkin", "catkin_package()\nadd_subdirectory(src/driver)");
    place.write("src/other/src/driver/CMakeLists.txt", "add_executable(driver driver.cpp)");
    let foreseen = place.scan(RosVersion::One);
    assert_eq!(foreseen.executables, ["ekf", "driver"]);
    assert!(foreseen.must_be_chosen(), "{foreseen:?}");
}

#[test]
fn a_launch_file_that_cannot_be_there_is_known() {
    let lacks = |place: &SourceFixture, launch: &str| {
        lacks_launch_file(&place.workspace(RosVersion::One), launch, RosVersion::One)
    };
    let place = ros1_package(WTF);
    place.write("src/ekf/launch/a.launch", "").write("src/ekf/launch/b.launch.in", "");
    for (launch, is_lacking) in [
        ("a.launch", false),
        ("launch/a.launch", false),
        ("ekf/launch/a.launch", false),
        ("b.launch", false),
        ("/opt/x/c.launch", false),
        ("lft.launch", true),
        ("ekf/a.lunch", true),
    ] {
        assert_eq!(lacks(&place, launch), is_lacking, "{launch}");
    }
    assert!(!lacks(&ros1_package("configure_file(${IN} ${OUT})"), "lft.launch"));
    assert!(!lacks(&ros1_package("install(FILES ${CMAKE_BINARY_DIR}/lft.launch DESTINATION x)"), "lft.launch"));
}

#[test]
fn where_a_push_may_work_nothing_is_asked() {
    for rest in [
        "",
        "if(WITH_TOOLS)\nadd_executable(tool tool.cpp)\nendif()",
        "if(NOT X)\nreturn()\nendif()\nadd_executable(tool tool.cpp)",
        "include(cmake/more.cmake)\nadd_executable(tool tool.cpp)",
        "add_executable(tool tool.cpp)\nset(CMAKE_RUNTIME_OUTPUT_DIRECTORY /tmp)",
        "add_executable(tool EXCLUDE_FROM_ALL tool.cpp)",
        "add_executable(tool IMPORTED)",
        "add_executable(tool ALIAS ekf)",
        "# add_executable(tool tool.cpp)",
        "foreach(name a b)\nadd_executable(${name} x.cpp)\nendforeach()",
        "install(PROGRAMS scripts/gone.py DESTINATION ${CATKIN_PACKAGE_BIN_DESTINATION})",
        "install(PROGRAMS scripts/wtf.py DESTINATION ${CATKIN_GLOBAL_BIN_DESTINATION})",
        "install(PROGRAMS scripts/wtf.py DESTINATION share/ekf RENAME tool)",
        "install(PROGRAMS ${SCRIPTS} DESTINATION ${CATKIN_PACKAGE_BIN_DESTINATION})",
        "add_subdirectory(gone)",
    ] {
        assert!(!ros1_package(rest).must_be_chosen(RosVersion::One), "{rest}");
    }
    // A single launch file is used, and others may be generated.
    let launch = ros1_package(WTF);
    launch.write("src/ekf/launch/a.launch", "");
    assert!(!launch.must_be_chosen(RosVersion::One));
    let made = ros1_package(WTF);
    made.write("src/ekf/a.launch.in", "");
    assert!(!made.must_be_chosen(RosVersion::One));
    let renamed = ros1_package(&format!("{WTF}\nconfigure_file(a.xml a.launch)"));
    assert!(!renamed.must_be_chosen(RosVersion::One));
    // Without `catkin_package` executables may be installed anywhere; unreadable files are ignored.
    for build in ["project(p)", "\u{0}((", ""] {
        let place = SourceFixture::new();
        let build = format!("{build}\nadd_executable(a a.cpp)\nadd_executable(b b.cpp)\ncatkin_package()");
        place.package("p", "catkin", &build);
        assert!(!place.must_be_chosen(RosVersion::One), "{build:?}");
    }
    let plain = SourceFixture::new();
    let two = "catkin_package()\nadd_executable(a a.cpp)\nadd_executable(b b.cpp)";
    plain.package("p", "cmake", two);
    assert!(!plain.must_be_chosen(RosVersion::One));
}

#[test]
fn of_ros_2_what_is_installed_counts() {
    let both = "add_executable(a a.cpp)\nadd_executable(b b.cpp)\n";
    let installed = "install(TARGETS a b DESTINATION lib/${PROJECT_NAME})\n";
    let apart = "install(TARGETS a RUNTIME DESTINATION lib/${PROJECT_NAME})\ninstall(TARGETS b DESTINATION bin)\n";
    let launch = "install(DIRECTORY launch config DESTINATION share/${PROJECT_NAME}/)\n";
    for (build, files, expected) in [
        (format!("{both}{installed}"), &[][..], true),
        (format!("{both}{apart}"), &[], false),
        (both.to_owned(), &[], false),
        (format!("{both}{installed}"), &["launch/x.launch.py"], false),
        (format!("{both}{installed}{launch}"), &["launch/x.launch.py"], false),
        (format!("{both}{installed}{launch}"), &["launch/x.launch.py", "launch/deep/y.launch.xml"], true),
        // Other files of a launch directory may be launch files.
        (format!("{both}{installed}{launch}"), &["launch/x.py"], false),
    ] {
        let place = SourceFixture::new();
        place.package("p", "ament_cmake", &build);
        for file in files {
            place.write(&format!("src/p/{file}"), "");
        }
        let foreseen = place.scan(RosVersion::Two);
        assert_eq!(foreseen.must_be_chosen(), expected, "{build}{foreseen:?}");
    }
}

#[test]
fn scripts_of_python_are_those_that_are_listed_as_texts() {
    let setup = |list: &str| format!("setup(entry_points={{\n'console_scripts': {list},\n}})");
    let places = "[install]\ninstall_scripts=$base/lib/p\n";
    for (list, places, expected) in [
        ("[\n'talk = p.talk:main',  # first, of two\n\"hear=p.hear:main\",\n]", places, &["hear", "talk"][..]),
        ("['talk = p.talk:main', 'hear = p.hear:main']", "", &[]),
        ("[name + ' = p:main' for name in names]", places, &[]),
        ("['a = p:main'] + more", places, &["a"]),
        ("more", places, &[]),
        ("[]", places, &[]),
    ] {
        let place = SourceFixture::new();
        place.package("p", "ament_python", "").write("src/p/setup.py", &setup(list)).write("src/p/setup.cfg", places);
        let foreseen = place.scan(RosVersion::Two);
        assert_eq!(foreseen.executables, expected, "{list}");
        assert_eq!(foreseen.must_be_chosen(), expected.len() > 1, "{list}");
    }
}

#[test]
fn of_ros_2_the_usual_ways_to_install_are_known() {
    let both = "add_executable(a a.cpp)\nadd_executable(b b.cpp)\n";
    let apart = "install(TARGETS a b EXPORT x ARCHIVE DESTINATION lib LIBRARY DESTINATION lib RUNTIME DESTINATION \
                 lib/${PROJECT_NAME})\n";
    let auto = "ament_auto_add_executable(a a.cpp)\nament_auto_add_executable(b b.cpp)\n";
    let registered = "rclcpp_components_register_node(c PLUGIN \"c::A\" EXECUTABLE a)\n\
                      rclcpp_components_register_nodes(c \"c::B\")\n";
    let launch = "install(DIRECTORY launch/ DESTINATION share/${PROJECT_NAME}/launch)\n";
    let files = "install(FILES launch/x.launch.py launch/y.launch.py DESTINATION share/p/launch)\n";
    for (build, launch_files, programs, is_asked) in [
        (format!("{both}{apart}"), 0, &["a", "b"][..], true),
        (format!("{both}{apart}{launch}"), 2, &["a", "b"], true),
        (format!("{both}{apart}{files}"), 2, &["a", "b"], true),
        (format!("{auto}ament_auto_package(INSTALL_TO_SHARE launch config)"), 2, &["a", "b"], true),
        (auto.to_owned(), 0, &[], false),
        (format!("{registered}{both}"), 0, &["a"], false),
    ] {
        let place = SourceFixture::new();
        place.package("p", "ament_cmake", &build);
        if launch_files > 0 {
            place.write("src/p/launch/x.launch.py", "").write("src/p/launch/y.launch.py", "");
        }
        let foreseen = place.scan(RosVersion::Two);
        assert_eq!(foreseen.executables, programs, "{build}");
        assert_eq!((foreseen.launch_files.len(), foreseen.must_be_chosen()), (launch_files, is_asked), "{build}");
    }
}

#[test]
fn launch_files_of_python_packages_are_those_that_its_data_files_name() {
    let setup = |files: &str| {
        format!(
            "setup(data_files=[(os.path.join('share', name, 'launch'), {files})],\n\
             entry_points={{'console_scripts': ['a = p.a:main', 'b = p.b:main']}})"
        )
    };
    for (files, expected) in [
        ("glob('launch/*.launch.py')", true),
        ("glob(\"launch/*\")", true),
        ("glob(os.path.join('launch', '*launch.[pxy][yma]*'))", true),
        ("['launch/x.launch.py', 'launch/y.launch.py']", true),
        ("['launch/x.launch.py']", false),
        ("glob('launch/*.xml')", false),
        ("find_launch_files()", false),
    ] {
        let place = SourceFixture::new();
        place
            .package("p", "ament_python", "")
            .write("src/p/setup.py", &setup(files))
            .write("src/p/setup.cfg", "[install]\ninstall_scripts=$base/lib/p\n")
            .write("src/p/launch/x.launch.py", "")
            .write("src/p/launch/y.launch.py", "");
        assert_eq!(place.must_be_chosen(RosVersion::Two), expected, "{files}");
    }
}

impl SourceFixture {
    /// Writes an executable script of a package.
    fn script(&self, path: &str) -> &Self {
        use std::os::unix::fs::PermissionsExt;
        self.write(path, "#!/usr/bin/env python3\n");
        let mode = std::fs::Permissions::from_mode(0o755);
        std::fs::set_permissions(self.0.path().join(path), mode).expect("set");
        self
    }

    fn problems(&self, version: RosVersion) -> (Vec<String>, bool) {
        let workspace = self.workspace(version);
        let problems = find_problems(&workspace, version).iter().map(ToString::to_string).collect();
        (problems, has_no_programs(&workspace, version))
    }
}

#[test]
fn scripts_of_ros_1_that_nothing_installs_are_programs_and_are_told() {
    let place = SourceFixture::new();
    place.package("p", "catkin", "catkin_package()\n").script("src/p/scripts/a.py").script("src/p/b.py");
    place.script("src/p/test/c.py").script("src/p/setup.py");
    assert_eq!(place.scan(RosVersion::One).executables, ["a.py", "b.py"]);
    assert!(place.must_be_chosen(RosVersion::One));
    let (problems, _) = place.problems(RosVersion::One);
    assert_eq!(problems.len(), 2, "{problems:?}");
    assert!(problems[1].contains("add catkin_install_python(PROGRAMS scripts/a.py DESTINATION"), "{problems:?}");
    for build in [
        "catkin_install_python(PROGRAMS scripts/a.py b.py DESTINATION ${CATKIN_PACKAGE_BIN_DESTINATION})",
        "install(DIRECTORY scripts/ DESTINATION x)\ninstall(PROGRAMS b.py DESTINATION x)",
        "file(GLOB all scripts/*.py)\ninstall(PROGRAMS ${all} DESTINATION x)",
    ] {
        place.package("p", "catkin", build);
        assert_eq!(place.problems(RosVersion::One).0, [""; 0], "{build}");
    }
}

#[test]
fn of_ros_2_mistakes_that_leave_no_program_are_told() {
    let listed = "setup(entry_points={'console_scripts': ['talk = p.talk:main']})";
    let places = "[install]\ninstall_scripts=$base/lib/p\n";
    for (setup, cfg, expected) in [
        (listed, places, None),
        (listed, "", Some("p has no setup.cfg that installs its programs (talk) to lib/p")),
        (listed, "[metadata]\nname=p\n", Some("p has no setup.cfg that installs")),
        ("setup(name='p')", places, None),
        ("setup(name='p')", "", Some("p has no console_scripts in its setup.py")),
    ] {
        let place = SourceFixture::new();
        place.package("p", "ament_python", "").write("src/p/setup.py", setup).write("src/p/setup.cfg", cfg);
        let (problems, has_none) = place.problems(RosVersion::Two);
        assert_eq!((problems.len(), has_none), (usize::from(expected.is_some()), expected.is_some()), "{problems:?}");
        assert!(problems.iter().all(|told| told.starts_with(expected.unwrap_or("?"))), "{problems:?}");
        // Beside a package that may have programs, another one may be meant.
        place.package("q", "ament_cmake", "add_executable(a a.cpp)\n");
        assert!(!place.problems(RosVersion::Two).1);
        place.package("q", "ament_cmake", "rosidl_generate_interfaces(q msg/X.msg)\n");
        assert_eq!(place.problems(RosVersion::Two).1, expected.is_some());
    }
    let place = SourceFixture::new();
    place.package("p", "ament_cmake", "add_executable(a a.cpp)\n").script("src/p/scripts/b.py");
    let (problems, _) = place.problems(RosVersion::Two);
    assert!(problems[0].contains("add install(PROGRAMS scripts/b.py DESTINATION lib/${PROJECT_NAME})"), "{problems:?}");
}

#[test]
fn a_build_file_that_adds_itself_is_read_a_bounded_number_of_times() {
    let place = SourceFixture::new();
    let adding = format!("catkin_package()\nadd_executable(a a.cpp)\n{}", "add_subdirectory(.)\n".repeat(1000));
    place.package("looping", "catkin", &adding);
    place.write("src/looping/scripts/wtf.py", "#!/usr/bin/env python\n");
    let workspace = place.workspace(RosVersion::One);
    let scan = executables::scan_package(&workspace.root, &workspace.packages[0], RosVersion::One);
    assert!(scan.is_cut && scan.programs.is_empty());
    // What was not read may mention anything.
    assert!(!lacks_launch_file(&workspace, "any.launch", RosVersion::One));
    assert_eq!(find_problems(&workspace, RosVersion::One), []);
}

#[test]
fn names_of_scripts_are_searched_in_a_bounded_number_of_bytes() {
    let place = ros1_package("");
    let workspace = place.workspace(RosVersion::One);
    let found = |mut left: usize| {
        problems::find_forgotten_scripts(&workspace, &workspace.packages[0], RosVersion::One, &mut left).len()
    };
    assert_eq!((found(problems::MAX_SEARCHED), found(3)), (1, 0));
}

#[test]
fn many_launch_files_are_not_searched_one_by_one() {
    let scan = |count: usize| {
        let place = SourceFixture::new();
        let setup = "setup(data_files=[('share/p/launch', glob('launch/*.launch.py'))])";
        place.package("p", "ament_python", "").write("src/p/setup.py", setup);
        for number in 0..count {
            place.write(&format!("src/p/launch/n{number}.launch.py"), "");
        }
        let scan = place.scan(RosVersion::Two);
        (scan.launch_files.len(), scan.may_launch_more)
    };
    assert_eq!(scan(100).0, 100);
    assert_eq!(scan(101), (0, true));
}
