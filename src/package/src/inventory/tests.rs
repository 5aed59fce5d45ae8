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

    fn take(&self, environment: &[(&str, &str)], commands: &[&[&str]]) -> Inventory {
        let owned = |(key, value): &(&str, &str)| ((*key).to_owned(), (*value).to_owned());
        let environment = environment.iter().map(owned).collect();
        let words = |command: &&[&str]| command.iter().map(|word| (*word).to_owned()).collect();
        let commands: Vec<Vec<String>> = commands.iter().map(words).collect();
        let commands: Vec<&[String]> = commands.iter().map(Vec::as_slice).collect();
        let of = Published {
            package: "p",
            environment: &environment,
            commands: &commands,
        };
        Inventory::take(&self.paths(), of).expect("taken")
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
    for path in [
        "high/opt/mine/share/x",
        "high/opt/other/share/x",
        "low/opt/ros/noetic/share/x",
        "low/opt/alone/lib/p/run",
    ] {
        layers.file(path, 0o644);
    }
    // An absolute link in a layer points into the host.
    symlink("/usr", layers.place("high/opt/linked")).expect("linked");
    let environment = [
        (
            "CMAKE_PREFIX_PATH",
            "/opt/mine:/usr/:/opt/../usr:relative:/gone",
        ),
        ("ROS_PACKAGE_PATH", "/opt/mine/share:/opt/other/share"),
    ];
    let taken = layers.take(&environment, &[&["/opt/alone/lib/p/run"]]);
    assert_eq!(
        taken.prefixes,
        [
            "/opt/mine",
            "/usr",
            "/opt/other",
            "/opt/alone",
            "/opt/ros/noetic"
        ]
    );
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
    let taken = layers.take(&[("CMAKE_PREFIX_PATH", "/opt/mine:/usr")], &[]);
    let installed = |share: &str, lib: &str, executables: &[&str]| Installed {
        share: share.into(),
        lib: lib.into(),
        executables: executables.iter().map(|name| (*name).to_owned()).collect(),
    };
    let expected = [
        (
            "p",
            installed("/usr/share/p", "/usr/lib/p", &["alias", "node"]),
        ),
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
    let taken = layers.take(
        &[],
        &[
            &["/usr/bin/nice", "-n", "5", "/usr/lib/p/node", "__name:=n"],
            &["/usr/share/p/scripts/tool.py", "x:=/lib/p/y"],
            &["/usr/lib/q/other"],
            // Data that a node is given is no program.
            &[
                "/usr/lib/map_server/map_server",
                "/usr/share/p/maps/map.yaml",
            ],
            &["/usr/bin/nice", "/usr/lib/p/model", "/opt/gone/lib/p/lost"],
        ],
    );
    let programs = [
        ("lost", "/opt/gone/lib/p/lost"),
        ("node", "/usr/lib/p/node"),
        ("tool.py", "/usr/share/p/scripts/tool.py"),
    ];
    let programs = programs.map(|(name, path)| (name.to_owned(), path.to_owned()));
    assert_eq!(taken.programs, programs.into());
}

#[test]
fn programs_are_told_from_data() {
    let layers = layers();
    layers
        .file("high/usr/lib/p/hidden", 0o644)
        .file("low/usr/lib/p/hidden", 0o755);
    for (name, target) in [
        ("high/usr/lib/p/alias", "../../share/p/scripts/tool.py"),
        ("high/usr/lib/p/data", "/usr/share/p/maps/map.yaml"),
        ("high/usr/lib/p/lost", "nowhere"),
        ("high/usr/lib/p/round", "round"),
    ] {
        symlink(target, layers.place(name)).expect("linked");
    }
    let stack = merged::open(&layers.paths()).expect("opened");
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
    layers
        .file("secret/share/p/package.xml", 0o600)
        .file("secret/lib/p/tool", 0o755);
    let paths = "/../secret:../secret:/usr/../../secret:/..";
    let taken = layers.take(&[("CMAKE_PREFIX_PATH", paths)], &[]);
    assert_eq!(taken.prefixes, ["/usr"]);
    assert_eq!(taken.packages["p"].share, "/usr/share/p");
    // Nor can endless ones keep the daemon busy.
    let many: Vec<String> = (0..10_000).map(|number| format!("/{number}")).collect();
    let taken = layers.take(&[("CMAKE_PREFIX_PATH", &many.join(":"))], &[]);
    assert_eq!(taken.prefixes, Vec::<String>::new());
}
