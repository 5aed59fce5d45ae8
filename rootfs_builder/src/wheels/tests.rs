use super::*;
use crate::key::sha256;

fn requirements_for(bytes: &[u8]) -> Requirements {
    let text = format!("ros-x==1.0 --hash=sha256:{}\n", sha256(bytes));
    Requirements::parse(&text).expect("valid")
}

#[tokio::test]
async fn only_what_is_whole_is_taken_from_the_cache() {
    let cache = tempfile::tempdir().expect("a directory");
    let wanted = requirements_for(b"good");
    let missing = cached_wheels(&cache.path().join("none"), &wanted).await;
    assert_eq!(missing.expect("looked"), None);
    let file = cache.path().join("ros_x-1.0-py3-none-any.whl");
    fs::write(&file, "damaged").expect("written");
    assert_eq!(cached_wheels(cache.path(), &wanted).await.expect("looked"), None);
    fs::write(&file, "good").expect("written");
    let found = cached_wheels(cache.path(), &wanted).await.expect("looked");
    assert_eq!(found, Some(vec![file]));
}

#[test]
fn pips_errors_are_told_without_its_chatter() {
    let lines = "Looking in indexes: x\nCollecting a\nERROR: No matching distribution found for a==9\n";
    assert_eq!(pip_errors(lines), "No matching distribution found for a==9");
    assert_eq!(pip_errors("boom"), "boom");
}

/// Creates a wheel of these files: names, contents, and whether they are executable.
const MAKE: &str = "import json, sys, zipfile
with zipfile.ZipFile(sys.argv[1], 'w') as archive:
    for name, text, runs in json.loads(sys.argv[2]):
        info = zipfile.ZipInfo(name)
        info.external_attr = (0o100755 if runs else 0o100644) << 16
        archive.writestr(info, text)
";

fn python(arguments: &[&std::ffi::OsStr]) -> std::process::Output {
    let mut python = std::process::Command::new("/usr/bin/python3");
    python.args(arguments).env("SOURCE_DATE_EPOCH", "1");
    python.output().expect("Python runs")
}

/// A directory with wheels, and a prefix.
struct WheelFixture {
    place: tempfile::TempDir,
    wheels: Vec<&'static str>,
}

/// A file in a wheel: path, text, and whether it is a program.
type Packed<'a> = (&'a str, &'a str, bool);

impl WheelFixture {
    fn new(wheels: &[(&'static str, &[Packed<'_>])]) -> Self {
        let place = tempfile::tempdir().expect("a directory");
        for (name, files) in wheels {
            let path = place.path().join(name);
            let files = serde_json::to_string(files).expect("JSON");
            let made = python(&["-c".as_ref(), MAKE.as_ref(), path.as_ref(), files.as_ref()]);
            assert!(made.status.success(), "{made:?}");
        }
        let wheels = wheels.iter().map(|(name, _)| *name).collect();
        Self { place, wheels }
    }

    fn prefix(&self) -> PathBuf {
        self.place.path().join("opt/ros")
    }

    fn install(&self) -> std::process::Output {
        let (script, job) = (self.place.path().join("wheels.py"), self.place.path().join("job.json"));
        let about = serde_json::json!({
            "prefix": self.prefix(),
            "rewrite": { "/builder/python": "/usr" },
            "files": { "setup.sh": "# nothing" },
            "wheels": self.wheels,
        });
        fs::write(&script, INSTALL).expect("written");
        fs::write(&job, about.to_string()).expect("written");
        python(&["-I".as_ref(), script.as_ref(), job.as_ref(), self.place.path().as_ref()])
    }

    fn read(&self, path: &str) -> String {
        let path = self.prefix().join(path);
        fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
    }
}

#[test]
fn the_files_of_wheels_go_where_ros_looks_for_them() {
    use std::os::unix::fs::{MetadataExt, PermissionsExt};
    let lab = WheelFixture::new(&[
        (
            "ros_a-1.0-py3-none-any.whl",
            &[
                ("a/__init__.py", "x = 1\n", false),
                ("a/template.py", "not @Python@\n", false),
                ("a/__pycache__/__init__.cpython-311.pyc", "old", false),
                ("ros_a.libs/libz-0a.so", "machine code", true),
                ("ros_a-1.0.data/data/share/a/a.cmake", "at /builder/python/x", false),
                ("ros_a-1.0.data/data/lib/a/run", "machine code", true),
                ("ros_a-1.0.data/scripts/tool", "#!python\nprint(1)\n", false),
                ("ros_a-1.0.dist-info/entry_points.txt", "[console_scripts]\nask = a.b:c.d\n", false),
            ],
        ),
        ("ros_b-1.0-py3-none-any.whl", &[("ros_b.libs/libz-0a.so", "machine code", true)]),
    ]);
    let said = lab.install();
    assert!(said.status.success(), "{said:?}");
    let version = python(&["-c".as_ref(), "import sys; print('python%d.%d' % sys.version_info[:2])".as_ref()]);
    let version = String::from_utf8(version.stdout).expect("text");
    let site = format!("lib/{}/site-packages", version.trim());
    assert_eq!(lab.read("share/a/a.cmake"), "at /usr/x");
    assert_eq!(lab.read("setup.sh"), "# nothing");
    assert_eq!(lab.read("bin/tool"), "#!/usr/bin/python3\nprint(1)\n");
    let ask = lab.read("bin/ask");
    assert!(ask.contains("from a.b import c\n") && ask.contains("c.d()"), "{ask}");
    for (path, runs) in [("lib/a/run", true), ("bin/ask", true), ("share/a/a.cmake", false)] {
        let about = lab.prefix().join(path).metadata().expect(path);
        assert_eq!(about.permissions().mode() & 0o111 != 0, runs, "{path}");
    }
    // One library with three names.
    let inode = |path: &str| lab.prefix().join(path).metadata().expect("there").ino();
    let (first, second) = (format!("{site}/ros_a.libs/libz-0a.so"), format!("{site}/ros_b.libs/libz-0a.so"));
    assert_eq!(inode("lib/libz-0a.so"), inode(&first));
    assert_eq!(inode("lib/libz-0a.so"), inode(&second));
    // Compiled here, with the source's hash (PEP 552: flags 3).
    let cache = lab.prefix().join(&site).join("a/__pycache__");
    let compiled = fs::read_dir(&cache).expect("there").flatten().next().expect("one");
    let bytes = fs::read(compiled.path()).expect("read");
    assert_eq!(bytes[4..8], [3, 0, 0, 0]);
    assert_eq!(fs::read_dir(&cache).expect("there").count(), 1);
}

#[test]
fn wheels_that_contradict_each_other_or_leave_the_prefix_are_refused() {
    let (one, two) = ("ros_a-1.0-py3-none-any.whl", "ros_b-1.0-py3-none-any.whl");
    for (first, second, words) in [
        (("x/y.py", "1", false), ("x/y.py", "2", false), "different versions of"),
        (("x/y.py", "1", false), ("../../../../../x", "2", false), "outside of the prefix"),
        (("x/y.py", "1", false), ("ros_b-1.0.data/data/../x", "2", false), "outside of the prefix"),
    ] {
        let said = WheelFixture::new(&[(one, &[first]), (two, &[second])]).install();
        let error = String::from_utf8_lossy(&said.stderr).into_owned();
        assert!(!said.status.success() && error.contains(words), "{said:?}");
    }
    let same = ("x/y.py", "1", false);
    let said = WheelFixture::new(&[(one, &[same]), (two, &[same])]).install();
    assert!(said.status.success(), "{said:?}");
}

/// Links a shared library with others of its directory, used or not.
fn link_library(directory: &Path, name: &str, with: &[&str]) {
    let mut compiler = std::process::Command::new("cc");
    compiler.args(["-shared", "-fPIC", "-nostdlib", "-x", "c", "/dev/null", "-x", "none", "-Wl,--no-as-needed", "-o"]);
    let linked = compiler.arg(name).args(with).current_dir(directory).output().expect("cc runs");
    assert!(linked.status.success(), "{linked:?}");
}

#[test]
fn libraries_that_use_no_python_can_be_loaded_without_it() {
    const OF_MODULE: &str = "libx_msgs__rosidl_generator_py.so";
    for (name, needs) in [
        ("librcl.so", &["libbase.so"][..]),
        // Libraries of modules use one another.
        ("liby_msgs__rosidl_generator_py.so", &["libbase.so", OF_MODULE]),
    ] {
        let mut lab = WheelFixture::new(&[]);
        let library = lab.place.path().join("ros_a-1.0.data/data/lib");
        fs::create_dir_all(&library).expect("made");
        for (name, with) in [("libbase.so", &[][..]), (OF_MODULE, &[]), (name, &[OF_MODULE, "libbase.so"])] {
            link_library(&library, name, with);
        }
        fs::remove_file(library.join("libbase.so")).expect("removed");
        fs::remove_file(library.join(OF_MODULE)).expect("removed");
        let mut zip = std::process::Command::new("/usr/bin/python3");
        let packed = zip.args(["-m", "zipfile", "-c", "ros_a-1.0-py3-none-any.whl", "ros_a-1.0.data"]);
        assert!(packed.current_dir(lab.place.path()).status().expect("Python runs").success());
        lab.wheels.push("ros_a-1.0-py3-none-any.whl");
        let said = lab.install();
        assert!(said.status.success(), "{said:?}");
        let found = crate::elf::needed_libraries(&lab.prefix()).expect("read");
        assert!(found.iter().eq(needs), "{name}: {found:?}");
    }
}
