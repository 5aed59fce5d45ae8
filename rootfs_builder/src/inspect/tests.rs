use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use super::*;
use crate::DEFAULT_BASE;
use crate::builder::tests::{new_builder, put_archive};

const WHEELS: &str = "bookworm-jazzy-wheels";

/// Writes packages below `tree`; returns a push of them on a base.
fn write_push(tree: &Path, base: &str, files: &[(&str, &str)]) -> PushRequest {
    for (path, text) in files {
        let path = tree.join(path);
        std::fs::create_dir_all(path.parent().expect("below")).expect("made");
        std::fs::write(path, text).expect("written");
    }
    PushRequest {
        id: "p1".to_owned(),
        source: PushSource::Tree(tree.to_owned()),
        base: Some(base.to_owned()),
        ..PushRequest::default()
    }
}

fn manifest(name: &str, rest: &str) -> String {
    format!(
        "<package format=\"3\"><name>{name}</name><version>1.0.0</version><description>d</description>\
         <maintainer email=\"a@b.invalid\">m</maintainer><license>l</license>{rest}</package>"
    )
}

/// Writes a package of Python on ROS 2 with a program `go`.
fn write_python(tree: &Path, name: &str, needs: &str) {
    let built = "<export><build_type>ament_python</build_type></export>";
    let setup = format!(
        "from setuptools import setup\nsetup(name='{name}', version='1.0.0', packages=['{name}'],\n\
         entry_points={{'console_scripts': ['go = {name}.node:main']}})\n"
    );
    let (manifest, module) = (manifest(name, &format!("{needs}{built}")), format!("{name}/__init__.py"));
    let settings = format!("[install]\ninstall_scripts=$base/lib/{name}\n");
    let files = [("package.xml", &*manifest), ("setup.py", &*setup), ("setup.cfg", &*settings), (&*module, "")];
    write_push(&tree.join("src").join(name), WHEELS, &files);
}

fn push(tree: &Path, base: &str) -> PushRequest {
    PushRequest { nodes: vec!["go".to_owned()], ..write_push(tree, base, &[]) }
}

async fn inspect(builder: &Builder, request: &PushRequest) -> Result<InspectedPush, Error> {
    builder.inspect(request, mpsc::channel(100).0).await
}

#[tokio::test]
async fn what_nothing_provides_is_told_without_a_build() {
    let place = tempfile::tempdir().expect("a directory");
    let builder = new_builder(place.path());
    let contents = "usr/share/tf/package.xml libdevel/libtf-dev\n";
    put_archive(&builder, DEFAULT_BASE, place.path(), (contents, &["libtf-dev"])).await;
    let request = |needs: &str| {
        let files = [("package.xml", &*manifest("app", needs)), ("CMakeLists.txt", "")];
        let request = write_push(&place.path().join("pushed"), DEFAULT_BASE, &files);
        PushRequest { nodes: vec!["tf/static_transform_publisher".to_owned()], ..request }
    };
    inspect(&builder, &request("<depend>tf</depend>")).await.expect("it is there");
    let refused = inspect(&builder, &request("<depend>tf</depend><depend>warp_drive</depend>")).await;
    let refused = refused.expect_err("nothing provides it").to_string();
    assert!(refused.contains("warp_drive (wanted by app)"), "{refused}");
}

#[tokio::test]
async fn of_several_programs_one_must_be_named() {
    let place = tempfile::tempdir().expect("a directory");
    let builder = new_builder(place.path());
    let programs = "project(app)\nfind_package(catkin REQUIRED)\ncatkin_package()\nadd_executable(left a.cpp)\n\
                    add_executable(right a.cpp)\n";
    let files = [("package.xml", &*manifest("app", "")), ("CMakeLists.txt", programs)];
    let request = write_push(&place.path().join("pushed"), DEFAULT_BASE, &files);
    let refused = inspect(&builder, &request).await.expect_err("there are two").to_string();
    assert!(refused.contains("left, right") && refused.contains("--node"), "{refused}");
}

#[tokio::test]
async fn on_ros_2_the_bases_packages_are_those_of_the_last_build() {
    let place = tempfile::tempdir().expect("a directory");
    let builder = new_builder(place.path());
    let archive = put_archive(&builder, WHEELS, place.path(), ("", &["python3-scipy"])).await;
    let tree = place.path().join("pushed");
    write_python(&tree, "app", "<depend>rclpy</depend><depend>python3-scipy</depend><depend>warp_drive</depend>");
    let request = push(&tree, WHEELS);
    inspect(&builder, &request).await.expect("what the base has is not known yet");
    let base = crate::base::load(builder.bases_dir(), WHEELS).expect("valid");
    let there = BTreeSet::from(["rclpy".to_owned()]);
    let there = IndexedPackages { build: there.clone(), run: there, ..IndexedPackages::default() };
    indexed::write_known(builder.layers(), &base, &archive, &there).expect("written");
    let Err(Error::Unresolved(missing)) = inspect(&builder, &request).await else {
        panic!("nothing provides it");
    };
    assert_eq!(missing.iter().map(|one| one.key.as_str()).collect::<Vec<_>>(), ["warp_drive"]);
    let map = BTreeMap::from([("warp_drive".to_owned(), "python3-scipy".to_owned())]);
    inspect(&builder, &PushRequest { map, ..request }).await.expect("it is mapped");
}

#[tokio::test]
async fn a_middleware_that_robots_do_not_speak_is_refused_before_the_build() {
    let place = tempfile::tempdir().expect("a directory");
    let builder = new_builder(place.path());
    put_archive(&builder, WHEELS, place.path(), ("", &["ros-jazzy-rmw-zenoh-cpp"])).await;
    let tree = place.path().join("pushed");
    write_python(&tree, "app", "<depend>rclpy</depend><exec_depend>rmw_zenoh_cpp</exec_depend>");
    let depending = push(&tree, WHEELS);
    let refused = inspect(&builder, &depending).await.expect_err("it is not DDS").to_string();
    assert!(refused.starts_with("package app depends on rmw_zenoh_cpp at run time: "), "{refused}");
    assert!(refused.ends_with("push with `--map rmw_zenoh_cpp=`"), "{refused}");
    let map = [("rmw_zenoh_cpp".to_owned(), String::new())].into();
    let request = PushRequest { map, ..depending };
    inspect(&builder, &request).await.expect("nodes run with Fast DDS");

    let launch = |text: &str| {
        let path = tree.join("src/app/launch/go.launch.py");
        std::fs::create_dir_all(path.parent().expect("below")).expect("made");
        std::fs::write(path, text).expect("written");
        PushRequest { launch: Some("go.launch.py".to_owned()), nodes: Vec::new(), ..request.clone() }
    };
    let set = "SetEnvironmentVariable('RMW_IMPLEMENTATION', 'rmw_zenoh_cpp')\n";
    let refused = inspect(&builder, &launch(set)).await.expect_err("it is not DDS").to_string();
    let by = "launch file launch/go.launch.py sets RMW_IMPLEMENTATION: rmw_zenoh_cpp speaks Zenoh";
    assert!(refused.starts_with(by) && refused.contains("set it to rmw_fastrtps_cpp"), "{refused}");
    inspect(&builder, &launch(&set.replace("zenoh", "cyclonedds"))).await.expect("DDS");
    let with = PushRequest { with: vec!["ros-jazzy-rmw-zenoh-cpp".to_owned()], ..request };
    inspect(&builder, &with).await.expect_err("it is not DDS");
}
