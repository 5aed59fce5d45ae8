use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::PathBuf;

use super::*;

struct Layers(tempfile::TempDir);

impl Layers {
    fn file(&self, path: &str, mode: u32) -> &Self {
        let path = self.place(path);
        std::fs::write(&path, "string data\n").expect("written");
        std::fs::set_permissions(path, std::fs::Permissions::from_mode(mode)).expect("set");
        self
    }

    fn place(&self, path: &str) -> PathBuf {
        let path = self.0.path().join(path);
        std::fs::create_dir_all(path.parent().expect("below")).expect("made");
        path
    }

    fn paths(&self) -> [PathBuf; 2] {
        ["low", "high"].map(|layer| self.0.path().join(layer))
    }

    fn collect_inventory(&self, environment: &[(&str, &str)], commands: &[&[&str]]) -> Inventory {
        let owned = |(key, value): &(&str, &str)| ((*key).to_owned(), (*value).to_owned());
        let environment = environment.iter().map(owned).collect();
        let words = |command: &&[&str]| command.iter().map(|word| (*word).to_owned()).collect();
        let commands: Vec<Vec<String>> = commands.iter().map(words).collect();
        let commands: Vec<&[String]> = commands.iter().map(Vec::as_slice).collect();
        let of = SearchHints { package: "p", environment: &environment, commands: &commands };
        Inventory::scan(&self.paths(), of).expect("taken")
    }
}

fn layers() -> Layers {
    let layers = Layers(tempfile::tempdir().expect("a directory"));
    layers
        .file("low/usr/lib/p/node", 0o755)
        .file("low/usr/lib/p/notes.txt", 0o644)
        .file("low/usr/share/p/package.xml", 0o644)
        .file("low/usr/share/p/maps/map.yaml", 0o644)
        .file("low/usr/share/p/msg/Said.msg", 0o644)
        .file("low/usr/share/doc/readme", 0o644)
        .file("high/usr/share/p/scripts/tool.py", 0o755);
    layers
}

#[test]
fn install_spaces_are_in_the_order_in_which_nodes_search_them() {
    let layers = layers();
    for path in
        ["high/opt/mine/share/x", "high/opt/other/share/x", "low/opt/ros/noetic/share/x", "low/opt/alone/lib/p/run"]
    {
        layers.file(path, 0o644);
    }
    // An absolute link in a layer points into the host.
    symlink("/usr", layers.place("high/opt/linked")).expect("linked");
    let environment = [
        ("CMAKE_PREFIX_PATH", "/opt/mine:/usr/:/opt/../usr:relative:/gone"),
        ("ROS_PACKAGE_PATH", "/opt/mine/share:/opt/other/share"),
    ];
    let taken = layers.collect_inventory(&environment, &[&["/opt/alone/lib/p/run"]]);
    assert_eq!(taken.prefixes, ["/opt/mine", "/usr", "/opt/other", "/opt/alone", "/opt/ros/noetic"]);
}

#[test]
fn packages_have_directories_and_programs() {
    let layers = layers();
    layers
        .file("high/opt/mine/share/q/package.xml", 0o644)
        .file("low/usr/share/q/package.xml", 0o644)
        .file("low/usr/lib/q/old", 0o755)
        .file("low/usr/lib/other/tool", 0o755);
    symlink("node", layers.place("high/usr/lib/p/alias")).expect("linked");
    let taken = layers.collect_inventory(&[("CMAKE_PREFIX_PATH", "/opt/mine:/usr")], &[]);
    let installed = |share: &str, lib: &str, executables: &[&str]| InstalledPackage {
        share: share.into(),
        lib: lib.into(),
        executables: executables.iter().map(|name| (*name).to_owned()).collect(),
        ..InstalledPackage::default()
    };
    let expected = [
        ("p", installed("/usr/share/p", "/usr/lib/p", &["alias", "node"])),
        ("q", installed("/opt/mine/share/q", "/usr/lib/q", &["old"])),
    ];
    let expected = expected.map(|(name, installed)| (name.to_owned(), installed));
    assert_eq!(taken.packages, expected.into());
    assert_eq!(taken.definitions.keys().collect::<Vec<_>>(), ["p/msg/Said"]);
}

#[test]
fn what_nodes_run_of_the_package_can_be_started_by_a_stub() {
    let layers = layers();
    layers.file("low/usr/lib/p/model", 0o644);
    let taken = layers.collect_inventory(
        &[],
        &[
            &["/usr/bin/nice", "-n", "5", "/usr/lib/p/node", "__name:=n"],
            &["/usr/share/p/scripts/tool.py", "x:=/lib/p/y"],
            &["/usr/lib/q/other"],
            // A data file among the arguments of a node is not an executable.
            &["/usr/lib/map_server/map_server", "/usr/share/p/maps/map.yaml"],
            &["/usr/bin/nice", "/usr/lib/p/model", "/opt/gone/lib/p/lost"],
        ],
    );
    let programs =
        [("lost", "/opt/gone/lib/p/lost"), ("node", "/usr/lib/p/node"), ("tool.py", "/usr/share/p/scripts/tool.py")];
    let programs = programs.map(|(name, path)| (name.to_owned(), path.to_owned()));
    assert_eq!(taken.programs, programs.into());
}

#[test]
fn programs_are_told_from_data() {
    let layers = layers();
    layers.file("high/usr/lib/p/hidden", 0o644).file("low/usr/lib/p/hidden", 0o755);
    for (name, target) in [
        ("high/usr/lib/p/alias", "../../share/p/scripts/tool.py"),
        ("high/usr/lib/p/data", "/usr/share/p/maps/map.yaml"),
        ("high/usr/lib/p/lost", "nowhere"),
        ("high/usr/lib/p/round", "round"),
    ] {
        symlink(target, layers.place(name)).expect("linked");
    }
    let stack = merged::open_layers(&layers.paths()).expect("opened");
    for (path, expected) in [
        ("/usr/lib/p/node", Some(true)),
        ("/usr/share/p/scripts/tool.py", Some(true)),
        ("/usr/lib/p/alias", Some(true)),
        ("/usr/share/p/maps/map.yaml", Some(false)),
        ("/usr/share/p/maps", Some(false)),
        ("/usr/lib/p/data", Some(false)),
        ("/usr/lib/p/hidden", Some(false)),
        ("/usr/lib/p/lost", None),
        ("/usr/lib/p/round", None),
        ("/usr/lib/p/none", None),
        ("/", None),
    ] {
        let told = is_program(&stack, Path::new(path)).expect("read");
        assert_eq!(told, expected, "{path}");
    }
}

#[test]
fn a_prefix_cannot_lead_out_of_the_layers() {
    let layers = layers();
    layers.file("secret/share/p/package.xml", 0o600).file("secret/lib/p/tool", 0o755);
    let paths = "/../secret:../secret:/usr/../../secret:/..";
    let taken = layers.collect_inventory(&[("CMAKE_PREFIX_PATH", paths)], &[]);
    assert_eq!(taken.prefixes, ["/usr"]);
    assert_eq!(taken.packages["p"].share, "/usr/share/p");
    // Nor can excessive directories keep the daemon busy.
    let many: Vec<String> = (0..10_000).map(|number| format!("/{number}")).collect();
    let taken = layers.collect_inventory(&[("CMAKE_PREFIX_PATH", &many.join(":"))], &[]);
    assert_eq!(taken.prefixes, Vec::<String>::new());
}

/// Creates ROS 2 packages in a merged space, one in an isolated space, and a base below `/opt/ros`.
fn layers_of_two() -> Layers {
    let layers = Layers(tempfile::tempdir().expect("a directory"));
    let index = "share/ament_index/resource_index";
    for (prefix, name) in [
        ("low/opt/ros/jazzy", "std_msgs"),
        ("high/opt/mine", "p"),
        ("high/opt/mine", "unshared"),
        ("high/opt/apart/q", "q"),
    ] {
        layers.file(&format!("{prefix}/{index}/packages/{name}"), 0o644);
    }
    layers
        .file("low/opt/ros/jazzy/share/std_msgs/package.xml", 0o644)
        .file("low/opt/ros/jazzy/share/std_msgs/msg/String.msg", 0o644)
        .file("high/opt/mine/share/p/package.xml", 0o644)
        .file("high/opt/mine/share/p/msg/Said.msg", 0o644)
        .file("high/opt/mine/share/p/launch/up.launch.py", 0o644)
        .file("high/opt/mine/share/p/launch/deep/all.yaml", 0o644)
        .file("high/opt/mine/share/p/launch/notes.txt", 0o644)
        .file("high/opt/mine/share/p/top_launch.xml", 0o644)
        .file("high/opt/mine/share/p/params.yaml", 0o644)
        // The form of console_scripts of a setup.py once installed.
        .file("high/opt/mine/lib/p/talker", 0o755)
        .file("high/opt/mine/lib/python3.11/site-packages/p/talker.py", 0o644)
        .file("high/opt/apart/q/share/q/package.xml", 0o644)
        .file("high/opt/apart/q/lib/q/run", 0o755);
    layers
}

const OF_TWO: (&str, &str) = ("AMENT_PREFIX_PATH", "/opt/mine:/opt/apart/q:/opt/ros/jazzy");

#[test]
fn packages_of_ros_2_are_those_of_aments_index() {
    let taken = layers_of_two().collect_inventory(&[OF_TWO, ("CMAKE_PREFIX_PATH", "/opt/ros/jazzy")], &[]);
    assert_eq!(taken.prefixes[..3], ["/opt/mine", "/opt/apart/q", "/opt/ros/jazzy"]);
    let names: Vec<&str> = taken.packages.keys().map(String::as_str).collect();
    assert_eq!(names, ["p", "q", "std_msgs", "unshared"]);
    let own = &taken.packages["p"];
    assert_eq!((&*own.share, &*own.lib), ("/opt/mine/share/p", "/opt/mine/lib/p"));
    assert_eq!(own.executables, ["talker".to_owned()].into());
    let launch: Vec<&str> = own.launch_files.iter().map(String::as_str).collect();
    assert_eq!(launch, ["launch/deep/all.yaml", "launch/up.launch.py", "top_launch.xml"]);
    assert_eq!(taken.packages["q"].lib, "/opt/apart/q/lib/q");
    let keys: Vec<&String> = taken.definitions.keys().collect();
    assert_eq!(keys, ["p/msg/Said", "std_msgs/msg/String"]);
}

#[test]
fn component_libraries_are_told() {
    let layers = layers_of_two();
    let path = "high/opt/mine/share/ament_index/resource_index/rclcpp_components/p";
    let text = "p::Talker;lib/libtalker.so\np::Bad;../../etc/shadow\nnonsense\nrm -rf;lib/x.so\n\
                p::ns::Other;lib/libtalker.so\n";
    std::fs::write(layers.place(path), text).expect("written");
    let taken = layers.collect_inventory(&[OF_TWO], &[]);
    let expected = [("p::Talker", "/opt/mine/lib/libtalker.so"), ("p::ns::Other", "/opt/mine/lib/libtalker.so")];
    let expected = expected.map(|(class, library)| (class.to_owned(), library.to_owned()));
    assert_eq!(taken.packages["p"].components, expected.into());
    assert!(taken.packages["q"].components.is_empty());
}

#[test]
fn what_an_earlier_version_recorded_is_read() {
    let recorded = r#"{"share":"/usr/share/p","lib":"/usr/lib/p","executables":["node"]}"#;
    let read: InstalledPackage = serde_json::from_str(recorded).expect("read");
    assert!(read.launch_files.is_empty() && read.components.is_empty());
    assert_eq!(serde_json::to_string(&read).expect("written"), recorded);
}

#[test]
fn configurations_of_parameters_are_no_executables() {
    let layers = layers();
    layers.file("low/usr/lib/p/DWAPlanner.cfg", 0o755);
    let taken = layers.collect_inventory(&[], &[]);
    let executables: Vec<&str> = taken.packages["p"].executables.iter().map(String::as_str).collect();
    assert_eq!(executables, ["node"]);
}
