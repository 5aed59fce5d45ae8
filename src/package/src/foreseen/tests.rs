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

    fn scan(&self, version: RosVersion) -> SourceScan {
        let variables = Variables::for_distribution(version.number(), "any");
        let PushedDirectory::Source(workspace) = inspect(self.0.path(), &variables).expect("a workspace") else {
            panic!("sources")
        };
        scan_sources(&workspace, version)
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
