//! A workspace of three packages, each of which depends on the one before.

use std::fs;
use std::path::Path;

use anyhow::{Context, Result, ensure};
use bench_report::{BenchDaemon, BenchReport, Target, TimedPush};

use crate::{PROBE, steps};

/// Number of source files of a library, so that compiling takes a while.
const SOURCES: usize = 6;
/// Limit for a push in which one of three packages changed, as a fraction of a push that compiles all.
const BOUND: f64 = 0.7;

pub(crate) fn measure(report: &mut BenchReport, daemon: &BenchDaemon) -> Result<()> {
    let workspace = daemon.directory().join("bench_ws");
    write_workspace(&workspace)?;
    eprintln!("pushing a workspace whose last package cannot be compiled");
    let app = workspace.join("src/bench_app/src/app.cpp");
    let good = fs::read_to_string(&app)?;
    fs::write(&app, good.replace("ros::spin()", "ros::no_such_function()"))?;
    ensure!(push_workspace(daemon, &workspace).is_err(), "a push that cannot be compiled fails");
    fs::write(&app, &good)?;
    eprintln!("pushing it fixed");
    let fixed = push_workspace(daemon, &workspace)?;
    eprintln!("pushing it unchanged");
    let unchanged = push_workspace(daemon, &workspace)?;
    eprintln!("pushing it with all packages changed");
    for package in ["bench_msgs", "bench_lib", "bench_app"] {
        fs::write(workspace.join("src").join(package).join("NOTE"), "changed")?;
    }
    let all = push_workspace(daemon, &workspace)?;
    steps::report_steps(report, "workspace of three", &all);
    let cost = |pushed: &TimedPush| -> Result<f64> {
        let probe = pushed.step_duration(PROBE).context("a push tells of its probe")?;
        Ok((pushed.total - probe).as_secs_f64())
    };
    for (name, pushed) in [("the last one fixed after it failed", &fixed), ("nothing changed", &unchanged)] {
        let figure = report.figure(format!("workspace of three, {name}: without the probe"), "s", cost(pushed)?);
        figure.relative_to("all changed", cost(&all)?).require(Target::RatioAtMost(BOUND));
    }
    eprintln!("pushing it with a mistake in the last CMakeLists.txt");
    let list = workspace.join("src/bench_app/CMakeLists.txt");
    let text = fs::read_to_string(&list)?;
    fs::write(&list, text.replace("roscpp", "roscpp no_such_package"))?;
    fs::write(workspace.join("src/bench_lib/NOTE"), "changed again")?;
    let begun = std::time::Instant::now();
    ensure!(push_workspace(daemon, &workspace).is_err(), "a push that cannot be configured fails");
    let figure = report.figure(
        "workspace of three: until a mistake in the last CMakeLists.txt is told",
        "s",
        begun.elapsed().as_secs_f64(),
    );
    figure.relative_to("all changed", cost(&all)?).require(Target::BelowFloor);
    Ok(())
}

fn push_workspace(daemon: &BenchDaemon, workspace: &Path) -> Result<TimedPush> {
    let path = workspace.to_str().context("UTF-8")?;
    daemon.push(&[path, "--node", "bench_app/app"])
}

fn write_workspace(workspace: &Path) -> Result<()> {
    let write = |path: &str, text: &str| -> Result<()> {
        let path = workspace.join("src").join(path);
        fs::create_dir_all(path.parent().context("below the workspace")?)?;
        fs::write(&path, text).with_context(|| format!("writing {}", path.display()))
    };
    let manifest = |name: &str, needs: &str| {
        format!(
            "<package format=\"2\"><name>{name}</name><version>1.0.0</version><description>A part.</description>\
             <maintainer email=\"bench@example.org\">Bench</maintainer><license>Apache-2.0</license>\
             <buildtool_depend>catkin</buildtool_depend><depend>roscpp</depend><depend>std_msgs</depend>{needs}\
             <build_depend>message_generation</build_depend><exec_depend>message_runtime</exec_depend></package>\n"
        )
    };
    write("bench_msgs/package.xml", &manifest("bench_msgs", ""))?;
    write("bench_msgs/msg/Part.msg", "std_msgs/Header header\nstring text\n")?;
    write(
        "bench_msgs/CMakeLists.txt",
        "cmake_minimum_required(VERSION 3.0.2)\nproject(bench_msgs)\n\
         find_package(catkin REQUIRED COMPONENTS std_msgs message_generation)\n\
         add_message_files(FILES Part.msg)\ngenerate_messages(DEPENDENCIES std_msgs)\n\
         catkin_package(CATKIN_DEPENDS std_msgs message_runtime)\n",
    )?;
    let needs = "<depend>bench_msgs</depend>";
    write("bench_lib/package.xml", &manifest("bench_lib", needs))?;
    let mut sources = String::new();
    for number in 0..SOURCES {
        sources.push_str(&format!(" src/part{number}.cpp"));
        write(
            &format!("bench_lib/src/part{number}.cpp"),
            &format!(
                "#include <ros/ros.h>\n#include <bench_msgs/Part.h>\n\
                 std::string part{number}(const bench_msgs::Part& part) {{ return part.text + \"{number}\"; }}\n"
            ),
        )?;
    }
    write(
        "bench_lib/CMakeLists.txt",
        &format!(
            "cmake_minimum_required(VERSION 3.0.2)\nproject(bench_lib)\n\
             find_package(catkin REQUIRED COMPONENTS roscpp bench_msgs)\n\
             catkin_package(LIBRARIES bench_lib CATKIN_DEPENDS roscpp bench_msgs)\n\
             include_directories(${{catkin_INCLUDE_DIRS}})\nadd_library(bench_lib{sources})\n\
             target_link_libraries(bench_lib ${{catkin_LIBRARIES}})\n\
             install(TARGETS bench_lib LIBRARY DESTINATION ${{CATKIN_PACKAGE_LIB_DESTINATION}})\n"
        ),
    )?;
    let needs = "<depend>bench_lib</depend><depend>bench_msgs</depend>";
    write("bench_app/package.xml", &manifest("bench_app", needs))?;
    write(
        "bench_app/src/app.cpp",
        "#include <ros/ros.h>\n#include <bench_msgs/Part.h>\n\
         std::string part0(const bench_msgs::Part&);\n\
         int main(int argc, char** argv) {\n  ros::init(argc, argv, \"app\");\n  ros::NodeHandle node;\n\
         \x20 auto parts = node.advertise<bench_msgs::Part>(\"parts\", 1, true);\n\
         \x20 bench_msgs::Part part;\n  part.text = part0(part);\n  parts.publish(part);\n  ros::spin();\n}\n",
    )?;
    write(
        "bench_app/CMakeLists.txt",
        "cmake_minimum_required(VERSION 3.0.2)\nproject(bench_app)\n\
         find_package(catkin REQUIRED COMPONENTS roscpp bench_lib bench_msgs)\ncatkin_package()\n\
         include_directories(${catkin_INCLUDE_DIRS})\nadd_executable(app src/app.cpp)\n\
         target_link_libraries(app ${catkin_LIBRARIES})\n\
         install(TARGETS app RUNTIME DESTINATION ${CATKIN_PACKAGE_BIN_DESTINATION})\n",
    )
}
