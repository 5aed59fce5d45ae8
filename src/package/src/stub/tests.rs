mod ament;
mod other_ros;

use std::collections::BTreeMap;

use super::*;
use crate::interface::{Direction, Interface, Topic};

const PACKAGE_XML: &str = r#"<package format="2"><name>p</name>
<export><nodelet plugin="${prefix}/nodelets.xml"/><rviz plugin="${prefix}/rviz.xml"/></export></package>"#;

fn file(text: &str, executable: bool) -> Content {
    Content::File { bytes: text.into(), executable }
}

fn text(content: &Content) -> &str {
    match content {
        Content::File { bytes, .. } => std::str::from_utf8(bytes).expect("text"),
        Content::Link(target) => target,
    }
}

fn contents() -> Contents {
    let share = [
        ("package.xml", file(PACKAGE_XML, false)),
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
        share: share.map(|(path, content)| (path.to_owned(), content)).into(),
        components: BTreeSet::new(),
    }
}

fn compose_stub(outsourced: &[&str]) -> Files {
    compose_stub_from(outsourced, contents())
}

fn compose_stub_from(outsourced: &[&str], contents: Contents) -> Files {
    compose_stub_for(RosVersion::One, outsourced, contents)
}

fn compose_stub_for(ros: RosVersion, outsourced: &[&str], contents: Contents) -> Files {
    compose_stub_of(ros, ros, outsourced, contents)
}

/// Composes the stub of a service of one ROS for robots of the same or the other one.
fn compose_stub_of(service_ros: RosVersion, ros: RosVersion, outsourced: &[&str], contents: Contents) -> Files {
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
            qos: None,
        }],
        ..Interface::default()
    };
    for key in ["p/msg/T", "std_msgs/msg/Header", "p/msg/../X"] {
        interface.definitions.insert(key.into(), "int32 x\n".into());
    }
    let about = StubInfo {
        ros,
        service_ros,
        service: "serves",
        package: "p",
        revision: 3,
        image: "sha256:0",
        portal: &Portal { address: "wss://here:9090".into(), fingerprint: Some("SHA256:00".into()) },
        architecture: "x86_64",
        outsourced: &outsourced,
        names: &[("node".to_owned(), "names_itself".to_owned())].into(),
        interface: &interface,
        stateful: true,
        requests: &[ProgramRequest {
            node: "/node".into(),
            program: Some("node".into()),
            request: "/in -> /out by stamp".parse().expect("a pair"),
        }],
        times: Some((0.1, 0.3)),
    };
    compose(&about, contents).expect("a stub")
}

#[test]
fn every_executable_has_a_launcher_and_only_outsourced_ones_run_in_the_cloud() {
    let files = compose_stub(&["node", "tool.py"]);
    let node = text(&files["lib/p/node"]);
    assert!(node.contains("cloudroid-stub run --package 'p' --node 'node' --share"), "{node}");
    assert!(node.contains("prefix=$here/../..\n"), "{node}");
    assert!(text(&files["lib/p/helper_node"]).contains("exec-original"));
    // An outsourced shared script is replaced in place; others are left unchanged.
    let tool = text(&files["share/p/scripts/tool.py"]);
    assert!(tool.contains(" run ") && tool.contains("prefix=$here/../../..\n"), "{tool}");
    assert_eq!(text(&files["share/p/scripts/other.py"]), "#!/usr/bin/python3");
    assert!(!files.contains_key("lib/p/tool.py"), "two would be found");
    // Machine code is for the server's architecture.
    assert!(text(&files["share/p/bin/helper"]).contains("exec-original"));
}

#[test]
fn an_outsourced_name_that_the_image_has_not_gets_a_launcher_too() {
    let files = compose_stub(&["made_up"]);
    assert!(text(&files["lib/p/made_up"]).contains(" run "));
}

#[test]
fn all_that_is_shared_is_there() {
    let files = compose_stub(&["node"]);
    assert_eq!(text(&files["share/p/package.xml"]), PACKAGE_XML);
    assert_eq!(text(&files["share/p/launch/a.launch"]), "<launch/>");
    assert_eq!(files["share/p/launch/same"], Content::Link("a.launch".into()));
    assert_eq!(text(&files["share/p/msg/T.msg"]), "int32 x\n");
    assert!(!files.keys().any(|path| path.contains("Header") || path.contains("..")));
    let interface =
        Interface::from_toml(text(&files["share/p/interface.toml"]), std::path::Path::new("interface.toml"))
            .expect("its own form");
    assert_eq!(interface.topics[0].name, "/in");
    for name in [".catkin", "setup.sh", "setup.bash", "setup.zsh", "install.sh", "README.md"] {
        assert!(files.contains_key(name), "{name}");
    }
}

#[test]
fn settings_and_origin_are_told_in_toml() {
    let files = compose_stub(&["node"]);
    let stub: toml::Table = text(&files["share/p/stub.toml"]).parse().expect("TOML");
    assert_eq!(stub["server"].as_str(), Some("wss://here:9090"));
    assert_eq!(stub["fingerprint"].as_str(), Some("SHA256:00"));
    assert_eq!(stub["service"].as_str(), Some("serves"));
    assert_eq!(stub["stateful"].as_bool(), Some(true));
    let revision: toml::Table = text(&files["share/p/revision.toml"]).parse().expect("TOML");
    assert_eq!(revision["revision"].as_integer(), Some(3));
    assert_eq!(revision["outsourced"][0].as_str(), Some("node"));
    assert_eq!(revision["original"][0].as_str(), Some("helper_node"));
    assert_eq!(revision["names"]["node"].as_str(), Some("names_itself"));
    let defaults = &revision["defaults"];
    assert_eq!((defaults["desire"].as_float(), defaults["max"].as_float()), (Some(0.1), Some(0.3)));
    assert!(stub.get("desire").is_none(), "that is the robot's own");
    let request = &revision["requests"][0];
    let said = ["node", "program", "request"].map(|key| request[key].as_str().expect("a text"));
    assert_eq!(said, ["/node", "node", "/in -> /out by stamp"]);
}

#[test]
fn no_placeholder_is_left_and_the_same_input_gives_the_same_files() {
    let files = compose_stub(&["node"]);
    for (path, content) in &files {
        for word in text(content).split(|c: char| !(c.is_ascii_uppercase() || c == '@')) {
            let left = word.len() > 2 && word.starts_with('@') && word.ends_with('@') && word != "@@";
            assert!(!left, "{path}: {word}");
        }
    }
    assert_eq!(files, compose_stub(&["node"]));
}

#[test]
fn nodelets_name_a_library_that_says_why() {
    let files = compose_stub(&["node"]);
    let list = text(&files["share/p/nodelets.xml"]);
    let document = crate::xml::parse(list).expect("XML");
    let library = document.root_element();
    assert!(library.attribute("path").is_some_and(|path| path.starts_with("p runs in the cloud")));
    let class = library.children().find(|node| node.is_element()).expect("a class");
    assert_eq!(class.attribute("name"), Some("p/a"));
    assert_eq!(class.attribute("base_class_type"), Some("nodelet::Nodelet"));
    assert!(text(&files["share/p/rviz.xml"]).contains("lib/librv"), "others stay");
}

#[test]
fn without_a_manifest_there_is_no_stub() {
    let interface = Interface::default();
    let about = StubInfo {
        ros: RosVersion::One,
        service_ros: RosVersion::One,
        service: "p",
        package: "p",
        revision: 1,
        image: "",
        portal: &Portal::default(),
        architecture: "x86_64",
        outsourced: &BTreeSet::new(),
        names: &BTreeMap::new(),
        interface: &interface,
        stateful: true,
        requests: &[],
        times: None,
    };
    let error = compose(&about, Contents::default()).expect_err("refused");
    assert!(error.to_string().contains("no package.xml of p"), "{error}");
}

/// A program that prints its arguments.
const PROGRAM_OF_TESTS: &str = "#!/bin/sh\nfor word; do printf '%s\\n' \"$word\"; done\n";

/// Unpacks a signed stub, as on a robot.
fn unpack_stub(files: &Files) -> tempfile::TempDir {
    unpack_signed_by(files, &sign::SigningKey::generate().expect("made").0)
}

fn unpack_signed_by(files: &Files, key: &sign::SigningKey) -> tempfile::TempDir {
    let place = tempfile::tempdir().expect("a directory");
    write_signed(files, key, place.path());
    place
}

/// Writes the files of an unpacked archive.
fn write_signed(files: &Files, key: &sign::SigningKey, place: &std::path::Path) {
    let mut files = files.clone();
    files.entry(format!("lib/p/{PROGRAM}")).or_insert_with(|| file(PROGRAM_OF_TESTS, true));
    let signer = format!("{}\n", key.public_key().allowed_signers_line());
    files.insert(SIGNER.into(), file(&signer, false));
    let list = manifest(&files);
    let digest = sign::digest(&mut list.as_bytes()).expect("read");
    let signature = key.sign("cloudroid-stub", &digest);
    files.insert(SIGNATURE.into(), file(&signature, false));
    files.insert(MANIFEST.into(), file(&list, false));
    write(&files, place);
}

fn write(files: &Files, place: &std::path::Path) {
    use std::os::unix::fs::{PermissionsExt, symlink};
    for (path, content) in files {
        let path = place.join(path);
        std::fs::create_dir_all(path.parent().expect("below")).expect("made");
        match content {
            Content::File { bytes, executable } => {
                std::fs::write(&path, bytes).expect("written");
                let mode = if *executable { 0o755 } else { 0o644 };
                std::fs::set_permissions(&path, PermissionsExt::from_mode(mode)).expect("set");
            }
            Content::Link(target) => symlink(target, &path).expect("linked"),
        }
    }
}

fn run(script: &std::path::Path, arguments: &[&str]) -> std::process::Output {
    run_with_path(script, arguments, "/usr/bin:/bin")
}

fn run_with_path(script: &std::path::Path, arguments: &[&str], path: &str) -> std::process::Output {
    let mut shell = std::process::Command::new("sh");
    let directory = script.parent().expect("in a directory");
    shell.arg(script).args(arguments).current_dir(directory).env("PATH", path);
    shell.output().expect("a shell")
}

#[test]
fn a_launcher_gives_its_nodes_name_on_whatever_is_in_it() {
    let name = "x'$(touch ran)'y";
    let stub = unpack_stub(&compose_stub(&["node", name]));
    let output = run(&stub.path().join("lib/p").join(name), &["--flag"]);
    let words = String::from_utf8(output.stdout).expect("text");
    assert!(words.lines().any(|word| word == name), "{words}");
    assert!(!stub.path().join("lib/p/ran").exists(), "the name was run");
}

proptest::proptest! {
    #![proptest_config(proptest::prelude::ProptestConfig::with_cases(24))]
    /// Names with characters that are special in a shell, outsourced or not.
    #[test]
    fn launchers_quote_every_name(name in r#"[-a'"$`\\(){}\[\]*?~#!;&|<> @=%\.é]{1,12}"#, outsourced: bool) {
        proptest::prop_assume!(name != "." && name != ".." && !name.starts_with('.'));
        let files = if outsourced {
compose_stub(&[&name])
} else {
let mut contents = contents();
                contents.executables.insert(name.clone());
                compose_stub_from(&["node"], contents)
};
        let stub = unpack_stub(&files);
        let before = std::fs::read_dir(stub.path().join("lib/p")).expect("there").count();
        let output = run(&stub.path().join("lib/p").join(&name), &["a b", "$c"]);
        let words = String::from_utf8(output.stdout).expect("text");
        let verb = if outsourced { "run" } else { "exec-original" };
        let said: Vec<&str> = words.lines().collect();
        proptest::prop_assert_eq!(&said[..5], [verb, "--package", "p", "--node", name.as_str()]);
        proptest::prop_assert_eq!(&said[7..], ["--", "a b", "$c"]);
        let after = std::fs::read_dir(stub.path().join("lib/p")).expect("there").count();
        proptest::prop_assert_eq!(before, after);
    }
}

/// Creates a directory with an `ssh-keygen` that cannot verify signatures, so that Python is used instead.
fn old_openssh() -> tempfile::TempDir {
    use std::os::unix::fs::PermissionsExt;
    let place = tempfile::tempdir().expect("a directory");
    let path = place.path().join("ssh-keygen");
    std::fs::write(&path, "#!/bin/sh\necho 'unknown option -- Y' >&2\nexit 1\n").expect("written");
    std::fs::set_permissions(path, PermissionsExt::from_mode(0o755)).expect("set");
    place
}

/// Manipulation of an unpacked stub in transit.
type Meddling = fn(&std::path::Path);

#[test]
fn what_the_server_did_not_sign_is_named_and_nothing_of_it_runs() {
    use std::os::unix::fs::PermissionsExt;
    fn run_and_read(place: &std::path::Path) -> String {
        format!("#!/bin/sh\ntouch {}/ran\n", place.display())
    }
    let table: [(Meddling, &str); 11] = [
        (
            |at| std::fs::write(at.join(format!("lib/p/{PROGRAM}")), run_and_read(at)).expect("written"),
            "./lib/p/cloudroid-stub",
        ),
        (|at| std::fs::write(at.join("share/p/launch/b.launch"), "").expect("written"), "./share/p/launch/b.launch"),
        (|at| std::fs::remove_file(at.join("share/p/launch/a.launch")).expect("removed"), "./share/p/launch/a.launch"),
        (
            |at| {
                let path = at.join("share/p/launch/a.launch");
                std::fs::set_permissions(path, PermissionsExt::from_mode(0o755)).expect("set");
            },
            "./share/p/launch/a.launch",
        ),
        (
            |at| {
                let path = at.join("share/p/launch/same");
                std::fs::remove_file(&path).expect("removed");
                std::os::unix::fs::symlink("/etc/shadow", path).expect("linked");
            },
            "./share/p/launch/same",
        ),
        (
            |at| {
                let status = std::process::Command::new("mkfifo").arg(at.join("share/p/pipe")).status();
                assert!(status.expect("mkfifo").success());
            },
            "./share/p/pipe",
        ),
        (
            |at| std::fs::remove_file(at.join(SIGNATURE)).expect("removed"),
            "this archive is not signed: it has no MANIFEST.sig",
        ),
        (
            |at| std::fs::remove_file(at.join(MANIFEST)).expect("removed"),
            "this archive is not signed: it has no MANIFEST",
        ),
        (|at| std::fs::write(at.join(SIGNATURE), "").expect("written"), "the signature is not the server's"),
        (
            |at| {
                let path = at.join(SIGNATURE);
                let text = std::fs::read_to_string(&path).expect("read");
                std::fs::write(path, &text[..text.len() / 2]).expect("written");
            },
            "the signature is not the server's",
        ),
        (
            // The list was changed together with the file, and signed for another purpose.
            |at| {
                let path = at.join(MANIFEST);
                let text = std::fs::read_to_string(&path).expect("read");
                std::fs::write(path, text.replacen('0', "1", 1)).expect("written");
            },
            "the signature is not the server's",
        ),
    ];
    let (old, prefix) = (old_openssh(), tempfile::tempdir().expect("a directory"));
    let old = format!("{}:/usr/bin:/bin", old.path().display());
    let target = prefix.path().join("overlay");
    for (meddle, words) in table {
        for path in ["/usr/bin:/bin", &old] {
            let stub = unpack_stub(&compose_stub(&["node"]));
            meddle(stub.path());
            let arguments = ["--prefix", target.to_str().expect("text")];
            let output = run_with_path(&stub.path().join("install.sh"), &arguments, path);
            let told = String::from_utf8_lossy(&output.stderr).into_owned();
            assert!(!output.status.success() && told.contains(words), "{words}: {told}");
            assert!(!stub.path().join("ran").exists(), "{words}: it ran");
            assert!(!target.exists(), "{words}: it was installed");
        }
    }
}

#[test]
fn the_key_that_is_known_is_the_one_that_counts() {
    let key = || sign::SigningKey::generate().expect("made").0;
    let (server, other) = (key(), key());
    let files = compose_stub(&["node"]);
    let (stub, strangers) = (unpack_signed_by(&files, &server), unpack_signed_by(&files, &other));
    let old = old_openssh();
    let old = format!("{}:/usr/bin:/bin", old.path().display());
    for path in ["/usr/bin:/bin", &old] {
        let prefix = tempfile::tempdir().expect("a directory");
        let target = prefix.path().join("over & lay");
        let target = target.to_str().expect("text");
        let install = |stub: &tempfile::TempDir, more: &[&str]| {
            let arguments = [&["--prefix", target], more].concat();
            let output = run_with_path(&stub.path().join("install.sh"), &arguments, path);
            let told = String::from_utf8_lossy(&output.stderr).into_owned();
            (output.status.success(), told)
        };
        let refused = install(&strangers, &["--key", &server.public_key().to_string()]);
        assert!(!refused.0 && refused.1.contains("signed by another key"), "{refused:?}");
        let refused = install(&stub, &["--key", "/nowhere"]);
        assert!(!refused.0 && refused.1.contains("neither a key"), "{refused:?}");
        // Trusted on first use, with a message; from then on the same key is required.
        let first = install(&stub, &[]);
        assert!(first.0 && first.1.contains(&server.public_key().to_string()), "{first:?}");
        assert_eq!(install(&stub, &[]), (true, String::new()));
        let refused = install(&strangers, &[]);
        assert!(!refused.0 && refused.1.contains("if the server was reinstalled"), "{refused:?}");
        assert!(refused.1.contains(&other.public_key().to_string()), "{refused:?}");
        // The user has asked the operator of the other server.
        assert!(install(&strangers, &["--key", &other.public_key().to_string()]).0);
        assert!(install(&strangers, &[]).0, "it is that server's by now");
        // The overlay still contains the first server's key, which does not verify the other server's files.
        let refused = install(&stub, &[]);
        assert!(!refused.0 && refused.1.contains("signed by another key"), "{refused:?}");
        let installed = std::path::Path::new(target).join("share/p");
        std::fs::remove_dir_all(installed).expect("removed");
        assert!(install(&stub, &[]).0, "what is nobody's yet");
        let setup = std::fs::read_to_string(format!("{target}/setup.sh")).expect("there");
        assert!(setup.contains(&format!("_cloudroid_installed='{target}'")), "{setup}");
    }
}

#[test]
fn what_is_installed_has_the_modes_that_it_must_have() {
    use std::os::unix::fs::PermissionsExt;
    let stub = unpack_stub(&compose_stub(&["node"]));
    // Unpacked with a restrictive umask, and by a tool that makes everything accessible.
    for (path, mode) in [("lib/p/node", 0o700), ("share/p/package.xml", 0o666), ("share/p", 0o777)] {
        let path = stub.path().join(path);
        std::fs::set_permissions(path, PermissionsExt::from_mode(mode)).expect("set");
    }
    let prefix = tempfile::tempdir().expect("a directory");
    let target = prefix.path().join("overlay");
    let arguments = ["--prefix", target.to_str().expect("text"), "--token", "secret"];
    let output = run(&stub.path().join("install.sh"), &arguments);
    assert!(output.status.success(), "{output:?}");
    let mut left = vec![target.clone()];
    while let Some(path) = left.pop() {
        let about = path.symlink_metadata().expect("there");
        if about.is_symlink() {
            continue;
        }
        let name = path.strip_prefix(&target).expect("below").display().to_string();
        let mode = match &*name {
            "share/p/token" => 0o600,
            _ if about.is_dir() || name.starts_with("lib/p/") => 0o755,
            "share/p/scripts/tool.py" | "share/p/scripts/other.py" | "share/p/bin/helper" => 0o755,
            _ => 0o644,
        };
        assert_eq!(about.permissions().mode() & 0o7777, mode, "{name}");
        if about.is_dir() {
            left.extend(std::fs::read_dir(&path).expect("there").map(|entry| entry.expect("one").path()));
        }
    }
}

#[test]
fn a_robots_token_is_its_own_whatever_the_package_brings() {
    use std::os::unix::fs::PermissionsExt;
    let mut files = compose_stub(&["node"]);
    files.insert("share/p/token".into(), file("the package's", false));
    let stub = unpack_stub(&files);
    let prefix = tempfile::tempdir().expect("a directory");
    let target = prefix.path().join("overlay");
    let target = target.to_str().expect("text");
    let output = run(&stub.path().join("install.sh"), &["--prefix", target, "--token", "secret"]);
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{told}");
    let installed = prefix.path().join("overlay/share/p/token");
    assert_eq!(std::fs::read_to_string(&installed).expect("there"), "secret\n");
    let mode = installed.metadata().expect("there").permissions().mode() & 0o777;
    assert_eq!(mode, 0o600);
}

#[test]
fn a_package_brings_no_settings_and_no_token() {
    let mut contents = contents();
    for name in ["token", "ca.pem", "token/below", "launch/token"] {
        contents.share.insert(name.into(), file("the package's", false));
    }
    let files = compose_stub_from(&["node"], contents);
    let brought: Vec<&String> = files.keys().filter(|path| path.contains("token") || path.contains("ca.pem")).collect();
    assert_eq!(brought, ["share/p/launch/token"]);
}

#[test]
fn a_robot_gets_no_sources_and_nothing_hidden() {
    let mut contents = contents();
    for name in ["src/a.cpp", ".git/config", "launch/.env", "launch/a\nb", "back\\slash"] {
        contents.share.insert(name.into(), file("", false));
    }
    contents.executables.insert("a\nb".into());
    let files = compose_stub_from(&["node"], contents);
    let brought = ["src/", ".git", ".env", "\n"];
    let found = files.keys().find(|path| brought.iter().any(|part| path.contains(part)));
    assert_eq!(found, None);
    // Names that sha256sum escapes are listed with the same escaping.
    let stub = unpack_stub(&files);
    let prefix = tempfile::tempdir().expect("a directory");
    let arguments = ["--prefix", prefix.path().to_str().expect("text")];
    let output = run(&stub.path().join("install.sh"), &arguments);
    assert!(output.status.success(), "{output:?}");
}
