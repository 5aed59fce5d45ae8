//! Peculiarities of third-party packages, each reduced to its essence.

use std::path::Path;

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::deployer::path_str;
use support::world::world;

/// Writes files below a directory.
pub fn write_files(directory: &Path, files: &[(&str, String)]) -> anyhow::Result<()> {
    for (path, text) in files {
        let path = directory.join(path);
        std::fs::create_dir_all(path.parent().context("below")?)?;
        std::fs::write(path, text)?;
    }
    Ok(())
}

/// Returns a package.xml with these dependencies and exports.
pub fn manifest(name: &str, needs: &str) -> String {
    format!(
        "<package format=\"3\"><name>{name}</name><version>1.0.0</version><description>A part.</description>\
         <maintainer email=\"a@example.org\">A</maintainer><license>Apache-2.0</license>{needs}</package>\n"
    )
}

const OF_CATKIN: &str = "<buildtool_depend>catkin</buildtool_depend><depend>roscpp</depend>";

/// Services defined in another place, as in tf2_web_republisher, and a pkg-config module, as in csm.
pub fn services_elsewhere_and_modules_of_plain_packages_are_found() -> Verdict {
    let daemon = world().ensure_shared()?;
    let place = tempfile::tempdir()?;
    let plain = "cmake_minimum_required(VERSION 3.0.2)\nproject(plain_matcher C)\n\
                 configure_file(matcher.pc.in matcher.pc @ONLY)\n\
                 install(FILES ${CMAKE_BINARY_DIR}/matcher.pc DESTINATION lib/pkgconfig)\n\
                 install(FILES matcher.h DESTINATION include)\n";
    let asker = "cmake_minimum_required(VERSION 3.0.2)\nproject(asker)\n\
                 find_package(catkin REQUIRED COMPONENTS message_generation roscpp)\n\
                 find_package(PkgConfig REQUIRED)\npkg_check_modules(MATCHER REQUIRED matcher)\n\
                 add_service_files(DIRECTORY services FILES Ask.srv)\ngenerate_messages()\n\
                 catkin_package(CATKIN_DEPENDS message_runtime)\n\
                 add_executable(asker asker.cpp)\nadd_dependencies(asker ${PROJECT_NAME}_generate_messages_cpp)\n\
                 target_include_directories(asker PRIVATE ${catkin_INCLUDE_DIRS} ${MATCHER_INCLUDE_DIRS} \
                 ${CATKIN_DEVEL_PREFIX}/include)\n\
                 target_link_libraries(asker ${catkin_LIBRARIES})\n";
    let module = "prefix=@CMAKE_INSTALL_PREFIX@\nName: matcher\nDescription: d\nVersion: 1.0\n\
                  Cflags: -I${prefix}/include\n";
    let program = "#include <asker/Ask.h>\n#include <matcher.h>\n#include <ros/ros.h>\n\
                   bool answer(asker::Ask::Request& request, asker::Ask::Response& response) {\n\
                   \x20 response.answer = request.question + MATCH;\n  return true;\n}\n\
                   int main(int argc, char** argv) {\n  ros::init(argc, argv, \"asker\");\n  ros::NodeHandle node;\n\
                   \x20 auto asked = node.advertiseService(\"ask\", answer);\n  ros::spin();\n}\n";
    let needs = format!(
        "{OF_CATKIN}<build_depend>message_generation</build_depend><exec_depend>message_runtime</exec_depend>\
         <depend>plain_matcher</depend>"
    );
    let built = "<export><build_type>cmake</build_type></export>";
    let files = [
        ("src/plain/package.xml", manifest("plain_matcher", built)),
        ("src/plain/CMakeLists.txt", plain.to_owned()),
        ("src/plain/matcher.pc.in", module.to_owned()),
        ("src/plain/matcher.h", "#define MATCH 2\n".to_owned()),
        ("src/asker/package.xml", manifest("asker", &needs)),
        ("src/asker/CMakeLists.txt", asker.to_owned()),
        ("src/asker/services/Ask.srv", "int64 question\n---\nint64 answer\n".to_owned()),
        ("src/asker/asker.cpp", program.to_owned()),
    ];
    write_files(place.path(), &files)?;
    let push = ["push", path_str(place.path()), "--name", "asker"];
    daemon.deployer().run(&push)?.expect_success()?;
    let answer = daemon.robot("asker")?.call("/ask", json!({"question": 40}))?;
    ensure!(answer["values"]["answer"] == 42, "{answer}");
    Ok(())
}

/// Missing dependencies like those of A-LOAM.
pub fn all_that_a_package_forgot_is_named_at_once() -> Verdict {
    let daemon = world().ensure_shared()?;
    let place = tempfile::tempdir()?;
    let build = "cmake_minimum_required(VERSION 3.0.2)\nproject(forgetful)\n\
                 find_package(catkin REQUIRED COMPONENTS roscpp rosbag_storage tf)\n\
                 find_package(Eigen3 REQUIRED)\nfind_package(PkgConfig REQUIRED)\n\
                 pkg_check_modules(FROB frob)\npkg_check_modules(GSL REQUIRED gsl)\n\
                 find_package(no_such_package REQUIRED)\ncatkin_package()\n";
    write_files(
        place.path(),
        &[("package.xml", manifest("forgetful", OF_CATKIN)), ("CMakeLists.txt", build.to_owned())],
    )?;
    let push = ["push", path_str(place.path()), "--node", "any"];
    let outcome = daemon.deployer().run(&push)?.expect_failure(&[
        "--with rosbag_storage",
        "--with tf",
        "--with libeigen3-dev",
        "--with libgsl-dev",
        "the CMake package no_such_package is missing, and no package of the archive has it",
    ])?;
    let frob = "the pkg-config module frob is missing";
    ensure!(!outcome.output().contains(frob), "{}", outcome.output());
    Ok(())
}

/// A missing numpy, as in twist_mux.
pub fn a_python_module_that_a_package_forgot_is_named() -> Verdict {
    let daemon = world().ensure_shared()?;
    let place = tempfile::tempdir()?;
    let build = "cmake_minimum_required(VERSION 3.0.2)\nproject(counts_py)\nfind_package(catkin REQUIRED)\n\
                 catkin_package()\n\
                 catkin_install_python(PROGRAMS counts.py DESTINATION ${CATKIN_PACKAGE_BIN_DESTINATION})\n";
    let needs = "<buildtool_depend>catkin</buildtool_depend><exec_depend>rospy</exec_depend>";
    let program = "#!/usr/bin/env python3\nimport rospy\nimport scipy\nrospy.init_node('counts')\nrospy.spin()\n";
    write_files(
        place.path(),
        &[
            ("package.xml", manifest("counts_py", needs)),
            ("CMakeLists.txt", build.to_owned()),
            ("counts.py", program.to_owned()),
            // Named by no build file.
            ("scripts/also.py", program.to_owned()),
        ],
    )?;
    let push = ["push", path_str(place.path())];
    daemon.deployer().run(&push)?.expect_failure(&[
        "exited with status 1 before its interface was found: ModuleNotFoundError: No module named 'scipy'",
        "the Python module scipy is missing: push with `--with python3-scipy`",
        "scripts/also.py of counts_py is installed by no catkin_install_python",
    ])?;
    Ok(())
}

/// The most frequent mistake in a first package of ROS 2.
pub fn a_package_whose_programs_are_not_found_is_refused_at_once() -> Verdict {
    let daemon = world().ensure_shared()?;
    let place = tempfile::tempdir()?;
    let built = "<depend>rclpy</depend><export><build_type>ament_python</build_type></export>";
    let setup = "from setuptools import setup\nsetup(name='lost', version='1.0.0', packages=['lost'],\n\
                 entry_points={'console_scripts': ['talk = lost.node:main']})\n";
    let files = [
        ("package.xml", manifest("lost", built)),
        ("setup.py", setup.to_owned()),
        ("lost/__init__.py", String::new()),
        ("lost/node.py", "def main():\n    pass\n".to_owned()),
    ];
    write_files(place.path(), &files)?;
    let push = ["push", path_str(place.path()), "--node", "talk"];
    let steps = daemon.deployer().run(&push)?.expect_failure(&[
        "there is nothing to run: lost has no setup.cfg that installs its programs (talk) to lib/lost",
        "install_scripts=$base/lib/lost",
    ])?;
    ensure!(!steps.output().contains("bootstrapping"), "{}", steps.output());
    std::fs::write(place.path().join("setup.py"), setup.replace("console_scripts", "other_scripts"))?;
    daemon.deployer().run(&push)?.expect_failure(&["lost has no console_scripts in its setup.py"])?;
    Ok(())
}

/// Tier 1 since Kilted; a servant's nodes would be reached by nobody.
pub fn nodes_that_speak_zenoh_are_refused_before_a_build() -> Verdict {
    let daemon = world().ensure_shared()?;
    let place = tempfile::tempdir()?;
    let refuse = |options: &[&str], words: &[&str]| -> Verdict {
        let push = [&["push", path_str(place.path())][..], options].concat();
        let refused = daemon.deployer().run(&push)?.expect_failure(words)?;
        ensure!(refused.status == 6 && !refused.output().contains("compiling"), "{refused:#?}");
        Ok(())
    };
    let package = [("__init__.py", ""), ("node.py", "def main():\n    pass\n")];
    let needs = "<depend>rclpy</depend><exec_depend>rmw_zenoh_cpp</exec_depend>";
    write_python_package(place.path(), "lab_zenoh", needs, ("lab_zenoh", &package))?;
    let speaks = "rmw_zenoh_cpp speaks Zenoh, and Cloudroid speaks DDS only";
    let depends = ["package lab_zenoh depends on rmw_zenoh_cpp at run time", speaks, "--map rmw_zenoh_cpp="];
    refuse(&["--node", "go"], &depends)?;
    let launch = "from launch import LaunchDescription\nfrom launch.actions import SetEnvironmentVariable\n\n\n\
                  def generate_launch_description():\n    return LaunchDescription([\n\
                  \x20       SetEnvironmentVariable('RMW_IMPLEMENTATION', 'rmw_zenoh_cpp'),\n    ])\n";
    write_files(&place.path().join("src/lab_zenoh/launch"), &[("go.launch.py", launch.to_owned())])?;
    let sets = ["launch file launch/go.launch.py sets RMW_IMPLEMENTATION", speaks, "set it to rmw_fastrtps_cpp"];
    refuse(&["--launch", "go.launch.py", "--map", "rmw_zenoh_cpp="], &sets)?;
    Ok(())
}

/// robot_pose_ekf was only asked about after eleven minutes.
pub fn what_to_run_is_asked_for_before_anything_is_compiled() -> Verdict {
    let daemon = world().ensure_shared()?;
    let place = tempfile::tempdir()?;
    let build = "cmake_minimum_required(VERSION 3.0.2)\nproject(choosy)\n\
                 find_package(catkin REQUIRED COMPONENTS roscpp)\ncatkin_package()\n\
                 add_executable(left it.cpp)\nadd_executable(${PROJECT_NAME}_right it.cpp)\n\
                 target_link_libraries(left ${catkin_LIBRARIES})\n";
    write_files(
        place.path(),
        &[
            ("package.xml", manifest("choosy", OF_CATKIN)),
            ("CMakeLists.txt", build.to_owned()),
            ("it.cpp", "this is never compiled\n".to_owned()),
        ],
    )?;
    let push = ["--format", "json", "push", path_str(place.path())];
    let outcome = daemon.deployer().run(&push)?.expect_failure(&[
        "choose what to run with --node or --launch; executables: choosy_right, left; launch files: none",
        "nothing is compiled yet",
    ])?;
    let events = outcome.stdout.lines();
    let events = events.filter_map(|line| serde_json::from_str::<Value>(line).ok());
    let titles = events.filter_map(|event| Some(event["title"].as_str()?.to_owned()));
    let titles: Vec<String> = titles.collect();
    ensure!(titles.iter().all(|title| !title.contains("compil")), "{titles:?}");
    let push = ["push", path_str(place.path()), "--launch", "lft.launch"];
    let outcome = daemon.deployer().run(&push)?.expect_failure(&["no launch file \"lft.launch\" in the package"])?;
    ensure!(!outcome.output().contains("compil"), "{}", outcome.output());
    Ok(())
}

/// Writes a package of Python for ROS 2 below `workspace`, with one module and a program `go` if it has a `node.py`.
pub fn write_python_package(
    workspace: &Path,
    name: &str,
    needs: &str,
    (module, files): (&str, &[(&str, &str)]),
) -> Verdict {
    let has_program = files.iter().any(|(file, _)| *file == "node.py");
    let program = if has_program { format!("'go = {module}.node:main'") } else { String::new() };
    let setup = format!(
        "from setuptools import setup\nsetup(name='{name}', version='1.0.0', packages=['{module}'],\n\
         data_files=[('share/ament_index/resource_index/packages', ['resource/{name}']),\n\
         ('share/{name}', ['package.xml'])],\nentry_points={{'console_scripts': [{program}]}})\n"
    );
    let built = "<export><build_type>ament_python</build_type></export>";
    let directory = workspace.join("src").join(name);
    write_files(
        &directory,
        &[
            ("package.xml", manifest(name, &format!("{needs}{built}"))),
            ("setup.py", setup),
            ("setup.cfg", format!("[install]\ninstall_scripts=$base/lib/{name}\n")),
            (&format!("resource/{name}"), String::new()),
        ],
    )?;
    let files: Vec<(&str, String)> = files.iter().map(|(file, text)| (*file, (*text).to_owned())).collect();
    write_files(&directory.join(module), &files)
}

/// As tf2_ros, which Python nodes name in their package.xml and find in tf2_ros_py.
pub fn a_dependency_is_met_by_a_package_of_another_name() -> Verdict {
    let daemon = world().ensure_shared()?;
    let place = tempfile::tempdir()?;
    let doubling = [("__init__.py", "def double(number):\n    return 2 * number\n")];
    write_python_package(place.path(), "lab_maths_py", "", ("lab_maths", &doubling))?;
    let node = "import rclpy\nfrom std_msgs.msg import String\n\nfrom lab_maths import double\n\n\n\
                def main():\n    rclpy.init()\n    node = rclpy.create_node('app')\n\
                \x20   said = node.create_publisher(String, '/said', 1)\n\
                \x20   node.create_timer(0.2, lambda: said.publish(String(data=str(double(21)))))\n\
                \x20   rclpy.spin(node)\n";
    let needs = "<depend>rclpy</depend><depend>std_msgs</depend><depend>lab_maths</depend>";
    let package = [("__init__.py", ""), ("node.py", node)];
    write_python_package(place.path(), "lab_app", needs, ("lab_app", &package))?;
    let push = ["push", path_str(place.path()), "--name", "met", "--node", "lab_app/go"];
    daemon.deployer().run(&push)?.expect_success()?;
    let mut robot = daemon.robot("met")?;
    robot.subscribe("/said")?;
    let said = robot.next_message_on("/said")?;
    ensure!(said["data"] == "42", "{said}");
    // What nothing provides is met where the deployer says so.
    let more = format!("{needs}<depend>lab_flags</depend><depend>lab_flux</depend>");
    write_python_package(place.path(), "lab_app", &more, ("lab_app", &package))?;
    daemon.deployer().run(&push)?.expect_failure(&["lab_flags (wanted by lab_app)", "lab_flux", "--map KEY="])?;
    let met = ["--map", "lab_flags=", "--map", "lab_flux=lab_maths_py"];
    daemon.deployer().run(&[&push[..], &met].concat())?.expect_success()?;
    Ok(())
}
