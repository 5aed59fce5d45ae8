use std::os::unix::fs::symlink;
use std::path::Path;

use image::{ImageSpec, Store, TreeOptions};
use ros::flavour::Version;

use super::*;
use crate::builder::tests::new_builder_with;
use crate::stock::{find_imported, open_index};

/// A builder whose definitions may be added to, and root file systems.
struct ImportFixture {
    place: tempfile::TempDir,
    builder: Builder,
}

fn new_fixture() -> ImportFixture {
    let place = tempfile::tempdir().expect("a directory");
    let definitions = place.path().join("definitions");
    fs::create_dir(&definitions).expect("made");
    let images = Path::new(env!("CARGO_MANIFEST_DIR")).join("../images");
    for entry in fs::read_dir(images).expect("listed") {
        let path = entry.expect("an entry").path();
        fs::copy(&path, definitions.join(path.file_name().expect("a name"))).expect("copied");
    }
    let builder = new_builder_with(place.path(), definitions);
    ImportFixture { place, builder }
}

const STATUS: &str = "Package: libc6\nStatus: install ok installed\nVersion: 2.39\nArchitecture: amd64\n\n\
    Package: ros-jazzy-slam-toolbox\nStatus: install ok installed\nVersion: 2.8.2\nArchitecture: amd64\n";

impl ImportFixture {
    fn write(&self, tree: &str, path: &str, text: &str) {
        let path = self.place.path().join(tree).join(path);
        fs::create_dir_all(path.parent().expect("below")).expect("made");
        fs::write(path, text).expect("written");
    }

    /// Writes a root file system with Python, and with these packages of ROS 2.
    fn write_root(&self, tree: &str, packages: &[&str]) {
        self.write(tree, "usr/lib/os-release", "ID=ubuntu\nVERSION_CODENAME=noble\nPRETTY_NAME=\"Ubuntu 24.04\"\n");
        self.write(tree, "usr/bin/python3.12", "#!/bin/sh\n");
        symlink("python3.12", self.place.path().join(tree).join("usr/bin/python3")).expect("linked");
        for name in packages {
            let text = format!("<package><name>{name}</name><version>1.2.3</version></package>");
            self.write(tree, &format!("opt/ros/jazzy/share/{name}/package.xml"), &text);
            self.write(tree, &format!("opt/ros/jazzy/share/ament_index/resource_index/packages/{name}"), "");
        }
    }

    /// Returns a request to import a tree as an image of one layer.
    fn save_image(&self, name: &str, tree: &str) -> BaseImport {
        self.save_image_with(name, tree, &[("MODEL", "large")])
    }

    /// Returns a request to import a tree as an image of one layer with this environment.
    fn save_image_with(&self, name: &str, tree: &str, env: &[(&str, &str)]) -> BaseImport {
        let sender = self.place.path().join(format!("sender-{tree}"));
        let store = Store::open(&sender.join("images"), &sender.join("layers")).expect("a store");
        let layer = store.layer_from_tree(&self.place.path().join(tree), &TreeOptions::default()).expect("a layer");
        let env = env.iter().map(|(name, value)| ((*name).to_owned(), (*value).to_owned())).collect();
        let image = store.put_image(&ImageSpec { layers: vec![layer], env, ..ImageSpec::default() }).expect("an image");
        store.tag("lab/ros:jazzy", &image).expect("a tag");
        BaseImport {
            name: name.to_owned(),
            source: ImportSource::Image(store.images_dir().to_owned()),
            replace: false,
            ros_distribution: None,
        }
    }

    fn import(&self, import: &BaseImport) -> Result<String, Error> {
        self.builder.import_image(import, &Limits::default())
    }

    fn load_base(&self, name: &str) -> Base {
        base::load(self.builder.bases_dir(), name).expect("valid")
    }
}

#[test]
fn an_image_becomes_a_base_with_what_was_found_in_it() {
    let lab = new_fixture();
    lab.write_root("root", &["rclpy", "slam_toolbox", "rmw_fastrtps_cpp"]);
    lab.write("root", "var/lib/dpkg/status", STATUS);
    lab.write("root", "usr/bin/cmake", "");
    let import = lab.save_image("lab", "root");
    assert_eq!(lab.import(&import).expect("good"), "lab");
    let base = lab.load_base("lab");
    assert_eq!((base.ros, &*base.ros_distribution, &*base.suite), (Version::Ros2, "jazzy", "noble"));
    assert!(base.summary.starts_with("Ubuntu 24.04 with ROS 2 jazzy, from image lab/ros:jazzy"), "{}", base.summary);
    assert_eq!(base.environment["MODEL"], "large");
    assert_eq!(base.environment["AMENT_PREFIX_PATH"], "/opt/ros/jazzy");
    // Keys of the others apply; what the image lacks is what its distribution calls it.
    assert_eq!(base.keys["eigen"], ["libeigen3-dev"]);
    assert!(base.build.packages.contains(&"python3-colcon-common-extensions".to_owned()), "{:?}", base.build);
    assert!(base.build.packages.contains(&"ros-jazzy-ament-cmake".to_owned()), "{:?}", base.build);
    assert!(!base.build.packages.contains(&"cmake".to_owned()), "{:?}", base.build);

    let report = lab.builder.base("lab").expect("valid");
    let stock = report.stock.expect("its layers");
    assert!(stock.is_imported && !stock.has_toolchain() && report.bytes > 0);
    assert_eq!(stock.ros["slam_toolbox"], "1.2.3");
    assert_eq!(stock.debian["libc6"], "2.39");
    assert!(find_imported(lab.builder.layers(), &base).expect("read").is_some());
    let image = base.image.as_ref().expect("an image");
    assert!(lab.builder.layers_to_keep().contains(&image.layers[0]));
    // Without an archive there is what is installed.
    let archive = open_index(lab.builder.layers(), &base).expect("read").expect("an index").with_installed(image);
    assert!(archive.candidates.contains("ros-jazzy-slam-toolbox") && !archive.candidates.contains("libtf-dev"));
    assert_eq!(crate::keys::find_ros_deb(&archive, &base, "slam_toolbox").as_deref(), Some("ros-jazzy-slam-toolbox"));

    let table = |subject: &str| {
        let found = image.findings.iter().find(|finding| finding.subject == subject).expect(subject);
        format!("{} | {}", found.found, found.consequence)
    };
    assert_eq!(table("ROS"), "ROS 2 jazzy in /opt/ros/jazzy, 3 packages | ");
    assert_eq!(table("middleware"), "rmw_fastrtps_cpp | ");
    assert!(
        table("compiling").starts_with("missing: g++, make, setuptools, catkin_pkg, colcon"),
        "{}",
        table("compiling")
    );
    assert!(table("compiling").contains("from the archive of noble; without that, only install spaces"));
    assert!(table("launch files").contains("push with --node"));
    // The definition that outlives the daemon is the same.
    let kept = lab.builder.imported_dir().join("lab.toml");
    let text = fs::read_to_string(lab.builder.bases_dir().join("lab.toml")).expect("there");
    assert_eq!(fs::read_to_string(kept).expect("there"), text);

    lab.builder.forget_base("lab").expect("it was imported");
    assert!(matches!(lab.builder.base("lab"), Err(Error::UnknownBase { .. })));
    assert!(!lab.builder.imported_dir().join("lab.toml").exists());
    assert!(lab.builder.layers_to_keep().is_empty());
}

#[test]
fn an_image_with_all_tools_compiles_and_one_without_dpkg_is_as_it_is() {
    let lab = new_fixture();
    lab.write_root("whole", &["rclpy", "ament_cmake", "rosidl_default_generators"]);
    for program in ["g++", "cmake", "make", "colcon"] {
        lab.write("whole", &format!("usr/bin/{program}"), "");
    }
    for module in ["setuptools", "catkin_pkg", "launch_ros"] {
        lab.write("whole", &format!("usr/lib/python3/dist-packages/{module}/__init__.py"), "");
    }
    lab.import(&lab.save_image("whole", "whole")).expect("good");
    let stock = lab.builder.base("whole").expect("valid").stock.expect("its layers");
    assert_eq!(stock.tool_layers(), lab.load_base("whole").image.as_ref().map(|image| image.layers.clone()));

    lab.write_root("bare", &["rclpy"]);
    lab.write("bare", "usr/lib/python3/dist-packages/setuptools/__init__.py", "");
    lab.import(&lab.save_image("bare", "bare")).expect("good");
    let bare = lab.load_base("bare");
    let image = bare.image.as_ref().expect("an image");
    assert!(image.installs_python && image.debian.is_empty() && bare.build.packages.is_empty());
    let compiling = image.findings.iter().find(|finding| finding.subject == "compiling").expect("a row");
    assert_eq!(compiling.consequence, "packages in Python and install spaces can be pushed");
}

#[test]
fn an_image_whose_nodes_would_speak_zenoh_uses_what_it_has_besides() {
    let lab = new_fixture();
    let zenoh = [("RMW_IMPLEMENTATION", "rmw_zenoh_cpp")];
    lab.write_root("alone", &["rclpy", "rmw_zenoh_cpp"]);
    let refused = lab.import(&lab.save_image_with("lab", "alone", &zenoh)).expect_err("nobody speaks it").to_string();
    assert!(refused.contains("rmw_zenoh_cpp alone") && refused.contains("add rmw_fastrtps_cpp"), "{refused}");
    assert!(matches!(lab.builder.base("lab"), Err(Error::UnknownBase { .. })));
    lab.write_root("both", &["rclpy", "rmw_zenoh_cpp", "rmw_cyclonedds_cpp"]);
    lab.import(&lab.save_image_with("lab", "both", &zenoh)).expect("there is another");
    let base = lab.load_base("lab");
    assert_eq!(base.environment["RMW_IMPLEMENTATION"], "rmw_cyclonedds_cpp");
    let image = base.image.as_ref().expect("an image");
    let row = image.findings.iter().find(|finding| finding.subject == "middleware").expect("a row");
    assert_eq!(row.found, "rmw_cyclonedds_cpp");
    assert!(row.consequence.contains("the image sets: rmw_zenoh_cpp speaks Zenoh"), "{}", row.consequence);
}

#[test]
fn names_are_new_unless_an_imported_base_is_replaced() {
    let lab = new_fixture();
    lab.write_root("root", &["rclpy"]);
    let good = lab.save_image("lab", "root");
    let named = |name: &str, replace: bool| BaseImport { name: name.to_owned(), replace, ..good.clone() };
    for name in ["", "../lab", "a/b", ".hidden", "-x", "lab\n", &"x".repeat(65)] {
        assert!(matches!(lab.import(&named(name, true)), Err(Error::BaseName { .. })), "{name:?}");
    }
    for replace in [false, true] {
        let refused = lab.import(&named(crate::DEFAULT_BASE, replace)).expect_err("a definition").to_string();
        assert!(refused.contains("choose another name"), "{refused}");
    }
    lab.import(&good).expect("new");
    let refused = lab.import(&good).expect_err("taken").to_string();
    assert!(refused.contains("--replace"), "{refused}");
    lab.write_root("newer", &["rclpy", "nav2_msgs"]);
    lab.import(&BaseImport { replace: true, ..lab.save_image("lab", "newer") }).expect("replaced");
    let image = lab.load_base("lab").definition.image.expect("an image");
    assert!(image.ros.contains_key("nav2_msgs"));
}

#[test]
fn what_cannot_become_a_base_leaves_none() {
    let lab = new_fixture();
    lab.write_root("plain", &[]);
    let refused = lab.import(&lab.save_image("lab", "plain")).expect_err("no ROS").to_string();
    assert!(refused.contains("no ROS was found"), "{refused}");
    let file = lab.place.path().join("archive");
    fs::write(&file, "hello").expect("written");
    let root = BaseImport { source: ImportSource::Root(file), ..lab.save_image("lab", "plain") };
    assert!(matches!(lab.import(&root), Err(Error::Image(image::Error::Archive { .. }))));
    assert!(matches!(lab.builder.base("lab"), Err(Error::UnknownBase { .. })));

    lab.write_root("root", &["rclpy"]);
    lab.import(&lab.save_image("lab", "root")).expect("good");
    let base = lab.load_base("lab");
    // Nothing can bring its layers back.
    let images = lab.builder.layers().store().images_dir().to_owned();
    for entry in fs::read_dir(images.join("blobs/sha256")).expect("listed") {
        fs::remove_file(entry.expect("an entry").path()).expect("removed");
    }
    let refused = find_imported(lab.builder.layers(), &base).expect_err("gone").to_string();
    assert!(refused.contains("import its image again, with --replace"), "{refused}");
}

#[test]
fn robots_of_ros_1_have_their_own_way_of_compiling() {
    let lab = new_fixture();
    lab.write_root("robot", &[]);
    lab.write("robot", "opt/ros/noetic/.catkin", "");
    lab.write("robot", "opt/ros/noetic/share/roscpp/package.xml", "<package><version>1.16.0</version></package>");
    lab.write("robot", "opt/ros/noetic/lib/python3/dist-packages/rospy/__init__.py", "");
    lab.write("robot", "var/lib/dpkg/status", STATUS);
    lab.import(&lab.save_image("robot", "robot")).expect("good");
    let base = lab.load_base("robot");
    assert_eq!((base.ros, base.has_distributions_ros()), (Version::Ros1, false));
    assert_eq!(base.environment["ROS_PACKAGE_PATH"], "/opt/ros/noetic/share");
    assert!(base.build.files.is_empty() && base.build.cmake.contains(&"-DCATKIN_ENABLE_TESTING=OFF".to_owned()));
    assert!(base.build.packages.contains(&"ros-noetic-catkin".to_owned()), "{:?}", base.build);
}
