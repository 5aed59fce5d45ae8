use super::*;
use package::condition::Variables;
use package::workspace::{PushedDirectory, inspect};

/// A workspace on disk.
struct UnitsFixture {
    root: tempfile::TempDir,
    place: tempfile::TempDir,
}

impl UnitsFixture {
    /// Creates packages with additional elements in their package.xml.
    fn new(packages: &[(&str, &str)]) -> Self {
        let lab =
            Self { root: tempfile::tempdir().expect("a directory"), place: tempfile::tempdir().expect("a directory") };
        for (name, rest) in packages {
            let text = format!(
                "<package format=\"2\"><name>{name}</name><version>1.2.3</version><description>d</description>\
                 <maintainer email=\"a@b.invalid\">m</maintainer><license>l</license>{rest}</package>"
            );
            lab.write(&format!("src/{name}/package.xml"), &text);
        }
        lab
    }

    fn write(&self, path: &str, text: &str) {
        let path = self.root.path().join(path);
        std::fs::create_dir_all(path.parent().expect("below")).expect("made");
        std::fs::write(path, text).expect("written");
    }

    fn read(&self) -> WorkspaceUnits {
        self.read_on(&[Digest::compute("base")], "build")
    }

    fn read_on(&self, below: &[Digest], build_key: &str) -> WorkspaceUnits {
        let pushed = inspect(self.root.path(), &Variables::for_distribution(1, "noetic")).expect("a workspace");
        let PushedDirectory::Source(workspace) = pushed else {
            panic!("sources");
        };
        let place = tempfile::tempdir_in(self.place.path()).expect("a directory").keep();
        WorkspaceUnits::read(&workspace, build_key.into(), below, &place).expect("read")
    }

    /// Returns the keys of all packages by name, with only declared dependencies visible.
    fn keys(&self) -> Vec<(String, String)> {
        keys(&self.read())
    }
}

fn keys(units: &WorkspaceUnits) -> Vec<(String, String)> {
    let mut keys = Vec::new();
    for index in 0..units.units.len() {
        keys.push(units.key(index, SourceVisibility::Named, &keys));
    }
    let names = units.units.iter().map(|unit| unit.name.clone());
    names.zip(keys).collect()
}

/// Returns the names of packages whose keys differ.
fn changed_packages(before: &[(String, String)], after: &[(String, String)]) -> Vec<String> {
    let differ = |(one, other): &(&(String, String), &(String, String))| one != other;
    before.iter().zip(after).filter(differ).map(|(one, _)| one.0.clone()).collect()
}

const CHAIN: [(&str, &str); 4] = [
    ("a_msgs", ""),
    ("b_lib", "<depend>a_msgs</depend>"),
    ("c_app", "<exec_depend>b_lib</exec_depend>"),
    ("d_other", ""),
];

#[test]
fn a_change_costs_the_package_and_those_that_need_it() {
    let lab = UnitsFixture::new(&CHAIN);
    let before = lab.keys();
    assert_eq!(before, lab.keys(), "the same sources have the same keys");
    lab.write("src/b_lib/src/b.cpp", "int b();");
    let after = lab.keys();
    assert_eq!(changed_packages(&before, &after), ["b_lib", "c_app"]);
    lab.write("src/d_other/x.txt", "x");
    assert_eq!(changed_packages(&after, &lab.keys()), ["d_other"]);
}

#[test]
fn what_all_packages_see_changes_all() {
    let lab = UnitsFixture::new(&CHAIN);
    let before = lab.keys();
    lab.write("src/common/flags.cmake", "set(X 1)");
    let all = ["a_msgs", "b_lib", "c_app", "d_other"];
    assert_eq!(changed_packages(&before, &lab.keys()), all);
    let now = lab.keys();
    for (below, build_key) in [(Digest::compute("another base"), "build"), (Digest::compute("base"), "another build")] {
        assert_eq!(changed_packages(&now, &keys(&lab.read_on(&[below], build_key))), all);
    }
}

#[test]
fn with_all_in_sight_every_change_counts() {
    let lab = UnitsFixture::new(&CHAIN);
    let key = |lab: &UnitsFixture| {
        let (units, keys) = (lab.read(), lab.keys());
        let keys: Vec<String> = keys.into_iter().map(|(_, key)| key).collect();
        (units.key(1, SourceVisibility::All, &keys), keys[1].clone())
    };
    let (before, named) = key(&lab);
    assert_ne!(before, named);
    lab.write("src/d_other/x.txt", "x");
    let (after, still) = key(&lab);
    assert_eq!(named, still);
    assert_ne!(before, after);
}

#[test]
fn a_view_shows_a_package_and_what_is_nobodys() {
    let lab = UnitsFixture::new(&CHAIN);
    lab.write("src/common/flags.cmake", "set(X 1)");
    lab.write("src/b_lib/src/b.cpp", "int b();");
    std::os::unix::fs::symlink("../d_other", lab.root.path().join("src/b_lib/link")).expect("linked");
    let units = lab.read();
    let view = units.make_view(1, lab.place.path()).expect("made");
    let text = |path: &str| std::fs::read_to_string(view.join(path)).ok();
    assert_eq!(text("src/b_lib/src/b.cpp").as_deref(), Some("int b();"));
    assert_eq!(text("src/common/flags.cmake").as_deref(), Some("set(X 1)"));
    assert!(!view.join("src/a_msgs").exists() && !view.join("src/d_other").exists());
    assert!(view.join("src/b_lib/link").symlink_metadata().is_ok(), "links stay links");
    assert_eq!(units.needs, [vec![], vec![0], vec![0, 1], vec![]]);
}

#[test]
fn a_package_behind_a_link_is_found_in_its_view() {
    let lab = UnitsFixture::new(&[("a_msgs", "")]);
    let root = lab.root.path();
    std::fs::create_dir(root.join("repositories")).expect("made");
    std::fs::rename(root.join("src/a_msgs"), root.join("repositories/a_msgs")).expect("moved");
    std::os::unix::fs::symlink("../repositories/a_msgs", root.join("src/a_msgs")).expect("linked");
    let units = lab.read();
    let view = units.make_view(0, lab.place.path()).expect("made");
    assert!(view.join("src/a_msgs/package.xml").is_file());
}

#[test]
fn only_what_may_be_for_want_of_sight_is_tried_again() {
    let lab = UnitsFixture::new(&CHAIN);
    let units = lab.read();
    // d_other is built last and declares nothing, so all others are hidden from it.
    for said in [
        "x.cpp:1:10: fatal error: b_lib/b.h: No such file or directory",
        "/usr/bin/ld: cannot find -lb_core",
        "Could not find a package configuration file provided by \"b_lib\"",
    ] {
        assert!(units.misses_something(3, said), "{said}");
    }
    assert!(!units.misses_something(3, "x.cpp:1:1: error: 'y' was not declared in this scope"));
    // c_app sees all packages compiled before it, but no other package's sources.
    assert!(!units.misses_something(2, "x.cpp:1:10: fatal error: foo.h: No such file or directory"));
    assert!(units.misses_something(2, "CMake Error: /build/src/src/b_lib/cmake/x.cmake does not exist"));
}

#[test]
fn packages_that_are_not_built_affect_no_key() {
    let lab = UnitsFixture::new(&[("app", ""), ("demo", "")]);
    let read = || {
        let pushed = inspect(lab.root.path(), &Variables::for_distribution(1, "noetic")).expect("a workspace");
        let PushedDirectory::Source(mut workspace) = pushed else {
            panic!("sources");
        };
        workspace.packages.retain(|package| package.manifest.name == "app");
        workspace.left_out.push("src/demo".into());
        let place = tempfile::tempdir_in(lab.place.path()).expect("a directory").keep();
        WorkspaceUnits::read(&workspace, "build".into(), &[], &place).expect("read")
    };
    let before = read();
    assert!(!before.rest.join("src/demo").exists());
    lab.write("src/demo/src/demo.cpp", "int main() {}");
    assert_eq!(keys(&before), keys(&read()));
    lab.write("shared.cmake", "set(A 1)");
    assert_ne!(keys(&before), keys(&read()));
}
