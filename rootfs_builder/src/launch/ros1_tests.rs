//! Tests of the script for ROS 1 in its original form, with a directory in place of the container's root, and stand-ins
//! for rospkg and roslib, which need not be installed.

use std::os::unix::fs::PermissionsExt;
use std::process::Command;

use super::*;

const ROSPKG: &str = "
import os

class ResourceNotFound(Exception):
    pass

class RosPack:
    def get_path(self, name):
        for place in os.environ['ROS_PACKAGE_PATH'].split(':'):
            if os.path.isdir(os.path.join(place, name)):
                return os.path.join(place, name)
        raise ResourceNotFound(name)
";

/// Stand-in that finds what `rosrun` would find.
const ROSLIB: &str = "
import os

def find_node(package, name, rospack):
    prefixes = os.environ['CMAKE_PREFIX_PATH'].split(':')
    places = [os.path.join(prefix, 'lib', package) for prefix in prefixes]
    places += [parent for parent, _, _ in os.walk(rospack.get_path(package))]
    paths = [os.path.join(place, name) for place in places]
    return [path for path in paths if os.access(path, os.X_OK)]
";

struct Ros1Fixture(tempfile::TempDir);

impl Ros1Fixture {
    /// Creates a package `p` with these files below its install space: path, text and mode.
    fn new(files: &[(&str, &str, u32)]) -> Self {
        let lab = Self(tempfile::tempdir().expect("a directory"));
        let (_, script) = plan_scripts(Version::Ros1)[0];
        let inside = format!("{}/cloudroid/", lab.0.path().display());
        for (path, text, mode) in [
            ("cloudroid/out/.keep", "", 0o644),
            ("cloudroid/launch_plan.py", &*script.replace("/cloudroid/", &inside), 0o644),
            ("modules/rospkg/__init__.py", ROSPKG, 0o644),
            ("modules/roslib/__init__.py", "", 0o644),
            ("modules/roslib/packages.py", ROSLIB, 0o644),
            ("space/share/p/package.xml", "", 0o644),
        ] {
            lab.write(path, text, mode);
        }
        for (path, text, mode) in files {
            lab.write(&format!("space/{path}"), text, *mode);
        }
        lab
    }

    fn write(&self, path: &str, text: &str, mode: u32) {
        let path = self.0.path().join(path);
        fs::create_dir_all(path.parent().expect("below")).expect("made");
        fs::write(&path, text).expect("written");
        fs::set_permissions(path, fs::Permissions::from_mode(mode)).expect("set");
    }

    fn ask(&self) -> Result<LaunchAnswer, Error> {
        let ask = LaunchQuery {
            packages: vec!["p".to_owned()],
            prefix: self.0.path().join("space").display().to_string(),
            ..LaunchQuery::default()
        };
        let question = serde_json::to_string(&ask).expect("JSON");
        self.write("cloudroid/ask.json", &question, 0o644);
        let said = Command::new("/usr/bin/python3")
            .arg(self.0.path().join("cloudroid/launch_plan.py"))
            .env_clear()
            .env("PATH", "/usr/bin:/bin")
            .env("PYTHONPATH", self.0.path().join("modules"))
            .env("PYTHONDONTWRITEBYTECODE", "1")
            .output()
            .expect("run");
        assert!(said.status.success(), "{said:?}");
        let text = fs::read(self.0.path().join("cloudroid/out/plan.json")).expect("a plan");
        parse_reply(&text, Version::Ros1)
    }
}

const SCRIPT: &str = "#!/usr/bin/env python3\n";

#[test]
fn what_builds_read_is_no_executable() {
    for (place, program) in [("lib/p", "lib/p/node"), ("share/p", "share/p/scripts/node")] {
        let planner = format!("{place}/cfg/Planner.cfg").replace("lib/p/cfg", "lib/p");
        let lab = Ros1Fixture::new(&[(program, SCRIPT, 0o755), (&planner, SCRIPT, 0o755)]);
        let answer = lab.ask().expect("a plan");
        assert_eq!(answer.nodes[0].executable, "node");
        assert!(answer.warnings.is_empty(), "{:?}", answer.warnings);
    }
    // In some archives all files are executable.
    let lab = Ros1Fixture::new(&[
        ("share/p/scripts/one", SCRIPT, 0o755),
        ("share/p/scripts/two", "\u{7f}ELF", 0o755),
        ("share/p/README.md", "# p", 0o755),
        ("share/p/setup.py", SCRIPT, 0o755),
    ]);
    let text = lab.ask().expect_err("two").to_string();
    assert!(text.contains("executables: one, two; launch files: none"), "{text}");
}

#[test]
fn of_an_executable_and_launch_files_it_is_told_which_is_taken() {
    let lab = Ros1Fixture::new(&[("lib/p/node", SCRIPT, 0o755), ("share/p/launch/demo.launch", "", 0o644)]);
    let answer = lab.ask().expect("a plan");
    assert_eq!(
        answer.warnings,
        ["node is run directly, as the only executable; for remappings and parameters of a launch file push with \
          --launch: launch/demo.launch"]
    );
}
