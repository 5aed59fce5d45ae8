//! Tests of `inside/compile.py` in its original form, with a directory in place of the container's root and a shell
//! script in place of CMake.

use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;
use std::process::{Command, Output};

use super::*;

/// Stand-in for CMake. Configures a package according to its own files: `packages` and `modules` list what it requires,
/// `optional` a module that it does not require. Installs the content of `install`.
const CMAKE: &str = r#"#!/bin/sh
if [ "$1" = --build ]; then exit 0; fi
if [ "$1" = --install ]; then
  if [ -d "$(cat source)/install" ]; then mkdir -p "$(cat prefix)" && cp -r "$(cat source)/install/." "$(cat prefix)"; fi
  exit 0
fi
echo "$1" > source
for word; do
  case "$word" in
  -DCMAKE_INSTALL_PREFIX=*) echo "${word#*=}" > prefix ;;
  -DCMAKE_PROJECT_TOP_LEVEL_INCLUDES=*) again=1 ;;
  esac
done
if [ -n "$again" ]; then echo "-- ::looking again"; fi
lists() { if [ -e "$(cat source)/$1" ]; then cat "$(cat source)/$1"; fi }
for name in $(lists packages); do
  if [ -n "$again" ]; then echo "-- ::missing $name"; continue; fi
  echo "CMake Error at CMakeLists.txt:3 (find_package):"
  echo "  Could not find a package configuration file provided by \"$name\" with"
  exit 1
done
for name in $(lists optional) $(lists modules); do
  found=
  for place in $(echo "$PKG_CONFIG_PATH" | tr : ' '); do [ ! -e "$place/$name.pc" ] || found=1; done
  if [ -n "$found" ]; then continue; fi
  if [ -z "$again" ] || lists modules | grep -qx "$name"; then
    echo "-- Checking for module '$name'"
    echo "--   Package '$name', required by 'virtual:world', not found"
  fi
  if [ -z "$again" ] && lists modules | grep -qx "$name"; then
    echo "CMake Error at /usr/share/cmake-3.25/Modules/FindPkgConfig.cmake:607 (message):"
    echo "  A required package was not found"
    exit 1
  fi
done
"#;

struct ScriptFixture(tempfile::TempDir);

impl ScriptFixture {
    /// Creates a fixture with these files below the pushed packages.
    fn new(files: &[(&str, &str)]) -> Self {
        let lab = Self(tempfile::tempdir().expect("a directory"));
        lab.write("bin/cmake", CMAKE);
        fs::set_permissions(lab.path("bin/cmake"), fs::Permissions::from_mode(0o755)).expect("set");
        for (name, text) in [
            ("compile.py", include_str!("../inside/compile.py")),
            ("second_look.py", include_str!("../inside/second_look.py")),
        ] {
            let mut text = text.to_owned();
            for place in ["cloudroid", "build"] {
                let inside = format!("\"{}/{place}/", lab.0.path().display());
                text = text.replace(&format!("\"/{place}/"), &inside);
            }
            lab.write(&format!("cloudroid/{name}"), &text);
        }
        for (path, text) in files {
            lab.write(&format!("cloudroid/source/{path}"), text);
        }
        fs::create_dir(lab.path("build")).expect("made");
        lab
    }

    fn path(&self, path: &str) -> PathBuf {
        self.0.path().join(path)
    }

    fn write(&self, path: &str, text: &str) {
        let path = self.path(path);
        fs::create_dir_all(path.parent().expect("below")).expect("made");
        fs::write(path, text).expect("written");
    }

    /// Performs a task with packages of these names and build types.
    fn run(&self, task: Task, packages: &[(&str, &str)]) -> Output {
        let unit = |(name, build_type): &(&str, &str)| BuildUnit {
            name: (*name).to_owned(),
            path: (*name).into(),
            build_type: (*build_type).to_owned(),
        };
        let units: Vec<BuildUnit> = packages.iter().map(unit).collect();
        let prefix = self.path("prefix");
        let job = Job {
            check: task == Task::Check,
            packages: units.iter().map(|unit| JobPackage { unit, needs: Vec::new() }).collect(),
            workspace: units.iter().map(|unit| unit.name.as_str()).collect(),
            prefix: &prefix,
            cmake: &[],
            jobs: 2,
        };
        self.write("cloudroid/job.json", &serde_json::to_string(&job).expect("JSON"));
        let path = format!("{}:/usr/bin:/bin", self.path("bin").display());
        Command::new("/usr/bin/python3")
            .arg(self.path("cloudroid/compile.py"))
            .env_clear()
            .env("PATH", path)
            .env("HOME", self.path("build/home"))
            .env("PYTHONDONTWRITEBYTECODE", "1")
            .output()
            .expect("run")
    }
}

fn stdout_text(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// A plain CMake package that installs a pkg-config module, and a catkin package that requires it.
const OF_MODULES: [(&str, &str); 4] = [
    ("csm/csm.pc.in", ""),
    ("csm/install/lib/pkgconfig/csm.pc", ""),
    ("matcher/modules", "csm\n"),
    ("matcher/optional", "frob\n"),
];
const PACKAGES: [(&str, &str); 2] = [("csm", "cmake"), ("matcher", "catkin")];

#[test]
fn pkg_config_finds_plain_packages_before_any_of_catkin_is_installed() {
    let lab = ScriptFixture::new(&OF_MODULES);
    let output = lab.run(Task::Compile, &PACKAGES);
    assert!(output.status.success(), "{}", stdout_text(&output));
    assert!(lab.path("prefix/lib/pkgconfig/csm.pc").exists());
}

#[test]
fn a_module_that_another_package_may_bring_is_not_missed() {
    let lab = ScriptFixture::new(&OF_MODULES);
    let output = lab.run(Task::Check, &PACKAGES);
    assert!(output.status.success(), "{}", stdout_text(&output));
    assert_eq!(stdout_text(&output).matches("::configured ").count(), 2);
    // If no package provides it, the error is reported before anything is compiled.
    let alone = ScriptFixture::new(&OF_MODULES[2..]);
    let output = alone.run(Task::Check, &PACKAGES[1..]);
    let text = stdout_text(&output);
    assert!(!output.status.success());
    assert!(text.contains("::failed matcher") && text.contains("\nNo package 'csm' found"), "{text}");
}

#[test]
fn all_that_is_missing_is_named_in_one_round() {
    let files = [("loam/packages", "cv_bridge PCL Ceres\n"), ("loam/modules", "csm\n"), ("loam/optional", "frob\n")];
    for task in [Task::Check, Task::Compile] {
        let output = ScriptFixture::new(&files).run(task, &[("loam", "catkin")]);
        let text = stdout_text(&output);
        assert_eq!(output.status.code(), Some(1), "{text}");
        let (_, told) = text.split_once("Missing requirements:\n").expect("a summary");
        for words in ["\"cv_bridge\"", "\"PCL\"", "\"Ceres\"", "'csm'"] {
            assert!(told.contains(words), "{text}");
        }
        assert!(!told.contains("frob"), "{text}");
    }
}

#[test]
fn what_is_wrong_otherwise_is_not_looked_at_again() {
    let files = [("loam/optional", "frob\n"), ("loam/modules", "")];
    let lab = ScriptFixture::new(&files);
    lab.write("bin/cmake", "#!/bin/sh\necho 'CMake Error: syntax'\nexit 1\n");
    let output = lab.run(Task::Compile, &[("loam", "catkin")]);
    let text = stdout_text(&output);
    assert!(!text.contains("not there") && !lab.path("build/build/loam-again").exists(), "{text}");
}
