use super::*;
use crate::interface::{Direction, Topic};

const MANIFEST: &str = r#"<package format="2"><name>p</name>
<export><nodelet plugin="${prefix}/nodelets.xml"/><rviz plugin="${prefix}/rviz.xml"/></export></package>"#;

fn file(text: &str, executable: bool) -> Content {
    Content::File {
        bytes: text.into(),
        executable,
    }
}

fn text(content: &Content) -> &str {
    match content {
        Content::File { bytes, .. } => std::str::from_utf8(bytes).expect("text"),
        Content::Link(target) => target,
    }
}

fn contents() -> Contents {
    let share = [
        ("package.xml", file(MANIFEST, false)),
        ("launch/a.launch", file("<launch/>", false)),
        ("scripts/tool.py", file("#!/usr/bin/python3", true)),
        ("scripts/other.py", file("#!/usr/bin/python3", true)),
        ("bin/helper", file("\x7fELF...", true)),
        (
            "nodelets.xml",
            file(
                r#"<class_libraries><library path="lib/libp"><class name="p/a" type="p::A" base_class_type="nodelet::Nodelet"><description>x</description></class></library></class_libraries>"#,
                false,
            ),
        ),
        ("rviz.xml", file("<library path=\"lib/librv\"/>", false)),
        ("launch/same", Content::Link("a.launch".into())),
    ];
    Contents {
        executables: ["node", "helper_node"].map(str::to_owned).into(),
        share: share
            .map(|(path, content)| (path.to_owned(), content))
            .into(),
    }
}

fn composed(outsourced: &[&str]) -> Files {
    composed_of(outsourced, contents())
}

fn composed_of(outsourced: &[&str], contents: Contents) -> Files {
    let outsourced = outsourced.iter().map(|name| (*name).to_owned()).collect();
    let mut interface = Interface {
        topics: vec![Topic {
            name: "/in".into(),
            type_name: "p/T".into(),
            md5: "0".into(),
            direction: Direction::Input,
            nodes: vec![],
            latched: false,
            lazy: true,
        }],
        ..Interface::default()
    };
    for key in ["p/msg/T", "std_msgs/msg/Header", "p/msg/../X"] {
        interface.definitions.insert(key.into(), "int32 x\n".into());
    }
    let about = About {
        service: "serves",
        package: "p",
        revision: 3,
        image: "sha256:0",
        server: "ws://here:9090",
        architecture: "x86_64",
        outsourced: &outsourced,
        interface: &interface,
        stateful: true,
        times: Some((0.1, 0.3)),
    };
    compose(&about, contents).expect("a stub")
}

#[test]
fn every_executable_has_a_launcher_and_only_outsourced_ones_run_in_the_cloud() {
    let files = composed(&["node", "tool.py"]);
    let node = text(&files["lib/p/node"]);
    assert!(
        node.contains("cloudroid-stub\" run --package p --node 'node' --share"),
        "{node}"
    );
    assert!(node.contains("prefix=$here/../..\n"), "{node}");
    assert!(text(&files["lib/p/helper_node"]).contains("exec-original"));
    // A shared script that is outsourced gives way where it is; one that is not stays what it was.
    let tool = text(&files["share/p/scripts/tool.py"]);
    assert!(
        tool.contains(" run ") && tool.contains("prefix=$here/../../..\n"),
        "{tool}"
    );
    assert_eq!(
        text(&files["share/p/scripts/other.py"]),
        "#!/usr/bin/python3"
    );
    assert!(!files.contains_key("lib/p/tool.py"), "two would be found");
    // Machine code is of the server's architecture.
    assert!(text(&files["share/p/bin/helper"]).contains("exec-original"));
}

#[test]
fn an_outsourced_name_that_the_image_has_not_gets_a_launcher_too() {
    let files = composed(&["made_up"]);
    assert!(text(&files["lib/p/made_up"]).contains(" run "));
}

#[test]
fn all_that_is_shared_is_there() {
    let files = composed(&["node"]);
    assert_eq!(text(&files["share/p/package.xml"]), MANIFEST);
    assert_eq!(text(&files["share/p/launch/a.launch"]), "<launch/>");
    assert_eq!(
        files["share/p/launch/same"],
        Content::Link("a.launch".into())
    );
    assert_eq!(text(&files["share/p/msg/T.msg"]), "int32 x\n");
    assert!(
        !files
            .keys()
            .any(|path| path.contains("Header") || path.contains(".."))
    );
    let interface = Interface::from_toml(
        text(&files["share/p/interface.toml"]),
        std::path::Path::new("interface.toml"),
    )
    .expect("its own form");
    assert_eq!(interface.topics[0].name, "/in");
    for name in [
        ".catkin",
        "setup.sh",
        "setup.bash",
        "setup.zsh",
        "install.sh",
        "README.md",
    ] {
        assert!(files.contains_key(name), "{name}");
    }
}

#[test]
fn settings_and_origin_are_told_in_toml() {
    let files = composed(&["node"]);
    let stub: toml::Table = text(&files["share/p/stub.toml"]).parse().expect("TOML");
    assert_eq!(stub["server"].as_str(), Some("ws://here:9090"));
    assert_eq!(stub["service"].as_str(), Some("serves"));
    assert_eq!(stub["stateful"].as_bool(), Some(true));
    let revision: toml::Table = text(&files["share/p/revision.toml"]).parse().expect("TOML");
    assert_eq!(revision["revision"].as_integer(), Some(3));
    assert_eq!(revision["outsourced"][0].as_str(), Some("node"));
    assert_eq!(revision["original"][0].as_str(), Some("helper_node"));
    let defaults = &revision["defaults"];
    assert_eq!(
        (defaults["desire"].as_float(), defaults["max"].as_float()),
        (Some(0.1), Some(0.3))
    );
    assert!(stub.get("desire").is_none(), "that is the robot's own");
}

#[test]
fn no_placeholder_is_left_and_the_same_input_gives_the_same_files() {
    let files = composed(&["node"]);
    for (path, content) in &files {
        for word in text(content).split(|c: char| !(c.is_ascii_uppercase() || c == '@')) {
            let left =
                word.len() > 2 && word.starts_with('@') && word.ends_with('@') && word != "@@";
            assert!(!left, "{path}: {word}");
        }
    }
    assert_eq!(files, composed(&["node"]));
}

#[test]
fn nodelets_name_a_library_that_says_why() {
    let files = composed(&["node"]);
    let list = text(&files["share/p/nodelets.xml"]);
    let document = roxmltree::Document::parse(list).expect("XML");
    let library = document.root_element();
    assert!(
        library
            .attribute("path")
            .is_some_and(|path| path.starts_with("p runs in the cloud"))
    );
    let class = library
        .children()
        .find(|node| node.is_element())
        .expect("a class");
    assert_eq!(class.attribute("name"), Some("p/a"));
    assert_eq!(class.attribute("base_class_type"), Some("nodelet::Nodelet"));
    assert!(
        text(&files["share/p/rviz.xml"]).contains("lib/librv"),
        "others stay"
    );
}

#[test]
fn without_a_manifest_there_is_no_stub() {
    let interface = Interface::default();
    let about = About {
        service: "p",
        package: "p",
        revision: 1,
        image: "",
        server: "",
        architecture: "x86_64",
        outsourced: &BTreeSet::new(),
        interface: &interface,
        stateful: true,
        times: None,
    };
    let error = compose(&about, Contents::default()).expect_err("refused");
    assert!(error.to_string().contains("no package.xml of p"), "{error}");
}

/// A stub as it lies on a robot, with a program that prints what it was called with.
fn unpacked(files: &Files) -> tempfile::TempDir {
    use std::os::unix::fs::PermissionsExt;
    let place = tempfile::tempdir().expect("a directory");
    let write = |path: &str, bytes: &[u8], mode: u32| {
        let path = place.path().join(path);
        std::fs::create_dir_all(path.parent().expect("below")).expect("made");
        std::fs::write(&path, bytes).expect("written");
        std::fs::set_permissions(&path, PermissionsExt::from_mode(mode)).expect("set");
    };
    for (path, content) in files {
        if let Content::File { bytes, executable } = content {
            write(path, bytes, if *executable { 0o755 } else { 0o644 });
        }
    }
    let program = b"#!/bin/sh\nfor word; do printf '%s\\n' \"$word\"; done\n";
    write(&format!("lib/p/{PROGRAM}"), program, 0o755);
    place
}

fn run(script: &std::path::Path, arguments: &[&str]) -> std::process::Output {
    let mut shell = std::process::Command::new("sh");
    let directory = script.parent().expect("in a directory");
    shell
        .arg(script)
        .args(arguments)
        .current_dir(directory)
        .env("PATH", "/usr/bin:/bin");
    shell.output().expect("a shell")
}

#[test]
fn a_launcher_gives_its_nodes_name_on_whatever_is_in_it() {
    let name = "x'$(touch ran)'y";
    let stub = unpacked(&composed(&["node", name]));
    let output = run(&stub.path().join("lib/p").join(name), &["--flag"]);
    let words = String::from_utf8(output.stdout).expect("text");
    assert!(words.lines().any(|word| word == name), "{words}");
    assert!(!stub.path().join("lib/p/ran").exists(), "the name was run");
}

#[test]
fn a_robots_token_is_its_own_whatever_the_package_brings() {
    use std::os::unix::fs::PermissionsExt;
    let stub = unpacked(&composed(&["node"]));
    let brought = stub.path().join("share/p/token");
    std::fs::write(&brought, "the package's").expect("written");
    std::fs::set_permissions(&brought, PermissionsExt::from_mode(0o644)).expect("set");
    let prefix = tempfile::tempdir().expect("a directory");
    let target = prefix.path().join("overlay");
    let target = target.to_str().expect("text");
    let output = run(
        &stub.path().join("install.sh"),
        &["--prefix", target, "--token", "secret"],
    );
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{told}");
    let installed = prefix.path().join("overlay/share/p/token");
    assert_eq!(
        std::fs::read_to_string(&installed).expect("there"),
        "secret\n"
    );
    let mode = installed.metadata().expect("there").permissions().mode() & 0o777;
    assert_eq!(mode, 0o600);
}

#[test]
fn a_package_brings_no_settings_and_no_token() {
    let mut contents = contents();
    for name in ["token", "ca.pem", "token/below", "launch/token"] {
        contents
            .share
            .insert(name.into(), file("the package's", false));
    }
    let files = composed_of(&["node"], contents);
    let brought: Vec<&String> = files
        .keys()
        .filter(|path| path.contains("token") || path.contains("ca.pem"))
        .collect();
    assert_eq!(brought, ["share/p/launch/token"]);
}
