//! Tests of the scripts for ROS 2 in their original form, with a directory in place of the container's root.

use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;
use std::process::Command;

use super::*;

/// Directory with the content of an image, and the queries to it.
pub(super) struct Ros2Fixture {
    root: tempfile::TempDir,
}

impl Ros2Fixture {
    pub(super) fn new() -> Self {
        let lab = Self { root: tempfile::tempdir().expect("a directory") };
        lab.write("cloudroid/out/.keep", "", 0o644);
        for (name, text) in plan_scripts(Version::Ros2) {
            let inside = format!("{}/cloudroid/", lab.root.path().display());
            let text = text.replace("/cloudroid/", &inside);
            lab.write(&format!("cloudroid/{name}"), &text, 0o644);
        }
        // The base has a package of its own.
        lab.package("base", "turtle", &["swim"]);
        lab
    }

    pub(super) fn path(&self, path: &str) -> PathBuf {
        self.root.path().join(path)
    }

    pub(super) fn write(&self, path: &str, text: &str, mode: u32) {
        let path = self.path(path);
        fs::create_dir_all(path.parent().expect("below")).expect("made");
        fs::write(&path, text).expect("written");
        fs::set_permissions(path, fs::Permissions::from_mode(mode)).expect("set");
    }

    /// Installs a package with these programs.
    pub(super) fn package(&self, prefix: &str, name: &str, programs: &[&str]) {
        let index = format!("{prefix}/share/ament_index/resource_index/packages/{name}");
        self.write(&index, "", 0o644);
        self.write(&format!("{prefix}/share/{name}/package.xml"), "", 0o644);
        for program in programs {
            self.write(&format!("{prefix}/lib/{name}/{program}"), "#!/bin/sh\n", 0o755);
        }
    }

    pub(super) fn ask(&self, ask: &LaunchQuery) -> Result<LaunchAnswer, Error> {
        let question = serde_json::to_string(ask).expect("JSON");
        self.write("cloudroid/ask.json", &question, 0o644);
        let (first, _) = plan_scripts(Version::Ros2)[0];
        let said = Command::new("/usr/bin/python3")
            .arg(self.path("cloudroid").join(first))
            .env_clear()
            .env("PATH", "/usr/bin:/bin")
            .env("AMENT_PREFIX_PATH", self.path("base"))
            .env("HOME", self.root.path())
            .output()
            .expect("run");
        assert!(said.status.success(), "{said:?}");
        let text = fs::read(self.path("cloudroid/out/plan.json")).expect("a plan");
        let answer = parse_reply(&text, Version::Ros2)?;
        plan::check_plan(&answer)?;
        Ok(answer)
    }

    pub(super) fn query(&self, prefix: &str, nodes: &[&str]) -> LaunchQuery {
        LaunchQuery {
            packages: vec!["talk".to_owned()],
            prefix: self.path(prefix).display().to_string(),
            nodes: nodes.iter().map(|&node| node.to_owned()).collect(),
            ..LaunchQuery::default()
        }
    }
}

pub(super) fn argv(answer: &LaunchAnswer, index: usize) -> Vec<&str> {
    let words = answer.nodes[index].argv.iter().skip(1);
    words.map(String::as_str).collect()
}

#[test]
fn programs_of_an_installed_package_are_nodes() {
    let lab = Ros2Fixture::new();
    lab.package("space", "talk", &["talker", "listener"]);
    // Written there by colcon: the space is relocatable by an environment variable.
    lab.write(
        "space/local_setup.sh",
        "export AMENT_PREFIX_PATH=\"$COLCON_CURRENT_PREFIX:$AMENT_PREFIX_PATH\" HOOKED=1\n",
        0o644,
    );
    let mut ask = lab.query("space", &["talker --loud", "talker", "turtle/swim"]);
    ask.params = [("rate".to_owned(), serde_json::json!(2)), ("/all".to_owned(), serde_json::json!("x"))].into();
    ask.remaps = [("in".to_owned(), "out".to_owned())].into();
    let answer = lab.ask(&ask).expect("a plan");
    let names: Vec<&str> = answer.nodes.iter().map(|node| &*node.name).collect();
    assert_eq!(names, ["/talker", "/talker_2", "/swim"]);
    let talker = &answer.nodes[0];
    assert_eq!(talker.argv[0], lab.path("space/lib/talk/talker").display().to_string());
    // The programs name their nodes themselves.
    assert!(answer.nodes.iter().all(|node| !node.named));
    let remapped = ["--ros-args", "-r", "in:=out", "--"];
    assert_eq!(argv(&answer, 0), [&["--loud"][..], &remapped].concat());
    assert_eq!(argv(&answer, 1), remapped);
    assert_eq!(answer.nodes[2].package, "turtle");
    let keys: Vec<&str> = answer.parameters.keys().map(String::as_str).collect();
    assert_eq!(keys, ["/all", "/swim/rate", "/talker/rate", "/talker_2/rate"]);
    let (space, base) = (lab.path("space"), lab.path("base"));
    let both = format!("{}:{}", space.display(), base.display());
    assert_eq!(answer.environment["AMENT_PREFIX_PATH"], both);
    assert_eq!(answer.environment["HOOKED"], "1");
    for name in ["COLCON_CURRENT_PREFIX", "AMENT_CURRENT_PREFIX", "PWD", "HOME"] {
        assert!(!answer.environment.contains_key(name), "{name}");
    }
}

#[test]
fn a_space_without_scripts_gets_what_it_needs() {
    let lab = Ros2Fixture::new();
    for (prefix, name, programs) in [("space/talk", "talk", &["talker"][..]), ("space/msgs", "msgs", &[])] {
        lab.package(prefix, name, programs);
        lab.write(&format!("{prefix}/lib/python3/dist-packages/{name}/__init__.py"), "", 0o644);
    }
    // A single program is the default.
    let answer = lab.ask(&lab.query("space", &[])).expect("a plan");
    assert_eq!(answer.nodes[0].name, "/talker");
    for (variable, below) in [
        ("AMENT_PREFIX_PATH", ""),
        ("CMAKE_PREFIX_PATH", ""),
        ("LD_LIBRARY_PATH", "/lib"),
        ("PYTHONPATH", "/lib/python3/dist-packages"),
    ] {
        for name in ["talk", "msgs"] {
            let path = format!("{}{below}", lab.path("space").join(name).display());
            let value = &answer.environment[variable];
            assert!(value.split(':').any(|part| part == path), "{variable}={value}");
        }
    }
}

#[test]
fn nodes_are_named_as_on_either_command_line() {
    let lab = Ros2Fixture::new();
    lab.package("space", "talk", &["talker"]);
    let asked = [
        "talker __name:=one",
        "talker --loud __node:=two __ns:=/below",
        "talker --ros-args -r __node:=three -p rate:=1",
    ];
    let answer = lab.ask(&lab.query("space", &asked)).expect("a plan");
    let names: Vec<&str> = answer.nodes.iter().map(|node| &*node.name).collect();
    assert_eq!(names, ["/one", "/below/two", "/three"]);
    assert!(answer.nodes.iter().all(|node| node.named));
    assert_eq!(argv(&answer, 0), ["--ros-args", "-r", "__name:=one"]);
    let words = ["--loud", "--ros-args", "-r", "__node:=two", "-r", "__ns:=/below"];
    assert_eq!(argv(&answer, 1), words);
    let words = ["--ros-args", "-r", "__node:=three", "-p", "rate:=1"];
    assert_eq!(argv(&answer, 2), words);
    // A name that is taken gets a number, in a rule before the one that requests it; in another namespace it is not
    // taken.
    let asked = ["talker __node:=one", "talker __node:=one", "talker __node:=one __ns:=/below"];
    let answer = lab.ask(&lab.query("space", &asked)).expect("a plan");
    let names: Vec<&str> = answer.nodes.iter().map(|node| &*node.name).collect();
    assert_eq!(names, ["/one", "/one_2", "/below/one"]);
    let rules = ["--ros-args", "-r", "__node:=one_2", "--", "--ros-args", "-r", "__node:=one"];
    assert_eq!(argv(&answer, 1), rules);
}

#[test]
fn what_cannot_be_run_is_told_with_what_there_is() {
    let lab = Ros2Fixture::new();
    lab.package("space", "talk", &["talker", "listener"]);
    lab.write("space/share/talk/launch/both.launch.py", "", 0o644);
    lab.write("space/share/talk/config/all.yaml", "", 0o644);
    let refused = |ask: &LaunchQuery| lab.ask(ask).expect_err("refused").to_string();
    let text = refused(&lab.query("space", &[]));
    assert!(text.contains("executables: listener, talker; launch files: launch/both.launch.py"), "{text}");
    let text = refused(&lab.query("space", &["walker"]));
    assert!(text.contains("no executable \"walker\"") && text.contains("listener, talker"), "{text}");
    let mut ask = lab.query("space", &[]);
    ask.launch = "none.launch.py".to_owned();
    let text = refused(&ask);
    assert!(text.contains("no launch file \"none.launch.py\"") && text.contains("both.launch.py"), "{text}");
    // This Python has no launch, like the base with wheels.
    ask.launch = "both.launch.py".to_owned();
    let text = refused(&ask);
    assert!(text.contains("no Python package launch") && text.contains("--node"), "{text}");
}

#[test]
fn a_space_for_another_python_is_refused() {
    let lab = Ros2Fixture::new();
    lab.package("space", "talk", &["talker"]);
    lab.write("space/lib/python3.2/site-packages/talk/__init__.py", "", 0o644);
    let text = lab.ask(&lab.query("space", &["talker"])).expect_err("another").to_string();
    assert!(text.contains("built for python3.2, but the base has python3."), "{text}");
    lab.write("space/local_setup.sh", "return 3\n", 0o644);
    fs::remove_dir_all(lab.path("space/lib/python3.2")).expect("removed");
    let text = lab.ask(&lab.query("space", &["talker"])).expect_err("it fails").to_string();
    assert!(text.contains("ended with status 3"), "{text}");
}

/// Evaluates a Python expression in the second script's module.
pub(super) fn evaluate(lab: &Ros2Fixture, expression: &str) -> String {
    let code = format!("from ros2_launch_plan import *; import ros2_components as components; print({expression})");
    let said =
        Command::new("/usr/bin/python3").args(["-c", &code]).current_dir(lab.path("cloudroid")).output().expect("run");
    assert!(said.status.success(), "{said:?}");
    String::from_utf8_lossy(&said.stdout).trim().to_owned()
}

#[test]
fn parameters_of_launch_files_keep_their_types() {
    let lab = Ros2Fixture::new();
    for (value, expected) in [
        ("True", "true"),
        ("7", "7"),
        ("2.0", "2.0"),
        ("1e300", "1.0e+300"),
        ("float('inf')", ".inf"),
        ("'10'", "\"10\""),
        ("'a\\n\"b\"'", "\"a\\n\\\"b\\\"\""),
        ("[1.5, 2.0]", "[1.5, 2.0]"),
        ("['a', 'b']", "[\"a\", \"b\"]"),
        ("[]", "[]"),
    ] {
        assert_eq!(evaluate(&lab, &format!("written({value})")), expected, "{value}");
    }
    let nested = "sorted(flattened({'a': {'b': 1, 'c': {'d': 2}}, 'e': 3}, '').items())";
    assert_eq!(evaluate(&lab, nested), "[('a.b', 1), ('a.c.d', 2), ('e', 3)]");
}

#[test]
fn sections_of_parameter_files_apply_by_name() {
    let lab = Ros2Fixture::new();
    for (pattern, node, expected) in [
        ("/**", "'/a/b'", "True"),
        ("/**", "None", "True"),
        ("/a/b", "'/a/b'", "True"),
        ("a/b", "'/a/b'", "True"),
        ("/a/*", "'/a/b'", "True"),
        ("/*", "'/a/b'", "False"),
        ("/a/b", "'/b'", "False"),
        ("/a/b", "None", "False"),
        ("/**/b", "'/a/c/b'", "True"),
    ] {
        let expression = format!("applies('{pattern}', {node})");
        assert_eq!(evaluate(&lab, &expression), expected, "{pattern} {node}");
    }
    let tree = "{'/ns': {'n': {'ros__parameters': {'k': 1}}}, '/**': {'ros__parameters': None}}";
    assert_eq!(evaluate(&lab, &format!("list(sections({tree}, ''))")), "[('/ns/n', {'k': 1}), ('/**', {})]");
}

/// Returns the arguments that result from a parameters file followed by a launch file's own parameters, for a node
/// whose name is known.
fn arguments_behind(file: &str, own: &str, given: &[&str]) -> String {
    let lab = Ros2Fixture::new();
    lab.write("board.yaml", file, 0o644);
    lab.write("launch_params_1", own, 0o644);
    let (file, own) = (lab.path("board.yaml"), lab.path("launch_params_1"));
    let params: BTreeMap<&str, i32> = given.iter().map(|name| (*name, 1)).collect();
    let program = format!(
        "import ros2_launch_plan as plan\nplan.OURS = {own:?}\nrecorder = plan.Recorder(None, None, {{}}, {})\n\
         words = ['/x', '--ros-args', '--params-file', {file:?}, '--params-file', {own:?}, '-r', 'a:=b']\n\
         print(' '.join(recorder.arguments(words, '/front/board')))",
        serde_json::to_string(&params).expect("JSON"),
    );
    let said = Command::new("/usr/bin/python3")
        .args(["-c", &program])
        .env("PYTHONPATH", lab.path("cloudroid"))
        .output()
        .expect("run");
    assert!(said.status.success(), "{said:?}");
    let words = String::from_utf8(said.stdout).expect("UTF-8");
    let words = words.trim().replace(&*file.to_string_lossy(), "FILE");
    words.strip_prefix("/x --ros-args ").expect("the same").to_owned()
}

#[test]
fn what_a_launch_file_changes_of_a_parameters_file_counts() {
    let file = "/front/board:\n  ros__parameters:\n    f: 2.0\n    gains: \
                {p: 1e3, words: [1, 'a, b', c]}\n    on: yes\n";
    let own = |text: &str| format!("/front/board:\n  ros__parameters:\n    {text}\n");
    // Nothing in the file is overridden: it is kept and read when the node runs.
    let other = arguments_behind(file, &own("g: 1.0"), &[]);
    assert_eq!(other, "--params-file FILE -p g:=1.0 -r a:=b");
    // Numbers keep their notation, so that they keep their types.
    let all = "-p f:=2.0 -p gains.p:=1e3 -p gains.words:=[1, \"a, b\", c] -p on:=yes";
    let changed = arguments_behind(file, &own("f: 1.0"), &[]);
    assert_eq!(changed, format!("{all} -p f:=1.0 -r a:=b"));
    // The same holds for parameters given by the deployer.
    for given in ["f", "~gains/p", "/front/board/on"] {
        let changed = arguments_behind(file, &own("g: 1.0"), &[given]);
        assert_eq!(changed, format!("{all} -p g:=1.0 -r a:=b"), "{given}");
    }
    // A file for other nodes, and an invalid one.
    let others = arguments_behind("/back/board:\n  ros__parameters: {f: 2.0}\n", &own("f: 1.0"), &[]);
    assert_eq!(others, "--params-file FILE -p f:=1.0 -r a:=b");
    let none = arguments_behind(": [", &own("f: 1.0"), &[]);
    assert_eq!(none, "--params-file FILE -p f:=1.0 -r a:=b");
}
