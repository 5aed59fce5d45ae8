use super::*;

const SMALLEST: &str = "summary = \"x\"\ndistribution = \"debian\"\nsuite = \"bookworm\"\nros = \"ros1\"\n\
    ros_distribution = \"noetic\"\n\
    [runtime]\npackages = [\"libroscpp4d\"]\n[build]\npackages = []\nprefix = \"/opt/x\"\n";

fn repository_bases() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../images")
}

#[test]
fn every_definition_of_the_repository_is_valid() {
    let names = names(&repository_bases()).expect("the directory is there");
    assert!(names.contains(&"bookworm-ros1".to_owned()), "{names:?}");
    for name in names {
        let base = load(&repository_bases(), &name).expect("valid");
        assert!(base.keys.contains_key("eigen"), "{name} knows rosdep keys");
    }
}

#[test]
fn directories_of_man_pages_stay_for_the_links_that_scripts_make_in_them() {
    let base = load(&repository_bases(), "bookworm-ros1").expect("valid");
    // Matches like dpkg (fnmatch without flags): a star also matches slashes.
    fn matches(pattern: &[u8], path: &[u8]) -> bool {
        match (pattern.first(), path.first()) {
            (None, None) => true,
            (Some(b'*'), _) => matches(&pattern[1..], path) || (!path.is_empty() && matches(pattern, &path[1..])),
            (Some(a), Some(b)) if a == b => matches(&pattern[1..], &path[1..]),
            _ => false,
        }
    }
    let excluded = |path: &str| {
        let rules = base.strip.unpacked.iter();
        rules
            .filter_map(|rule| rule.strip_prefix("path-exclude="))
            .any(|rule| matches(rule.as_bytes(), path.as_bytes()))
    };
    assert!(!excluded("/usr/share/man/man1"));
    assert!(excluded("/usr/share/man/man1/java.1.gz"));
    assert!(excluded("/usr/share/man/de/man1/apt.1.gz"));
}

#[test]
fn what_packages_of_strangers_asked_for_is_known() {
    let base = load(&repository_bases(), "bookworm-ros1").expect("valid");
    for key in
        ["bfl", "liborocos-bfl-dev", "libgsl", "libcairo2-dev", "python3-cairosvg", "python3-joblib", "lm-sensors"]
    {
        assert!(base.keys.contains_key(key), "{key}");
    }
}

#[test]
fn tools_that_only_check_have_a_stand_in_and_are_not_missed() {
    let base = load(&repository_bases(), "bookworm-ros1").expect("valid");
    for tool in ["roslint", "code_coverage", "ros_pytest"] {
        let config = format!("/usr/share/{tool}/cmake/{tool}Config.cmake");
        assert!(base.build.files.contains_key(Path::new(&config)), "{tool}");
        assert!(base.ros_packages.ignore.contains(tool), "{tool}");
    }
}

#[test]
fn an_unknown_base_is_answered_with_those_known() {
    for name in ["nonesuch", "../images/bookworm-ros1", ""] {
        let error = load(&repository_bases(), name).expect_err("not there").to_string();
        assert!(error.contains("bookworm-ros1"), "{error}");
    }
}

#[test]
fn mistakes_are_named_with_their_line() {
    parse(SMALLEST).expect("valid");
    let cases = [
        (SMALLEST.replace("prefix", "prefixx"), "line 10"),
        (SMALLEST.replace("libroscpp4d", "Lib Roscpp"), "line 7"),
        (SMALLEST.replace("/opt/x", "/opt/../x"), "line 10"),
        (SMALLEST.replace("[\"libroscpp4d\"]", "[]"), "line 6"),
        (SMALLEST.replace("ros1", "ros7"), "line 4"),
        (format!("{SMALLEST}[strip]\nunpacked = [\"rm -rf\"]\n"), "line 12"),
        (format!("{SMALLEST}[keys]\neigen = [\"LIBEIGEN\"]\n"), "line 12"),
        (
            format!("{SMALLEST}[environment]\nRMW_IMPLEMENTATION = \"rmw_zenoh_cpp\"\n").replace("ros1", "ros2"),
            "line 12: environment: rmw_zenoh_cpp speaks Zenoh",
        ),
    ];
    for (text, line) in cases {
        let problem = parse(&text).expect_err("a mistake").to_string();
        assert!(problem.starts_with(line), "{problem}");
    }
}

#[test]
fn there_are_bases_of_both_versions_of_ros() {
    for (name, ros, distribution) in [
        ("bookworm-ros1", Version::Ros1, "noetic"),
        ("bookworm-jazzy-wheels", Version::Ros2, "jazzy"),
        ("bookworm-kilted-wheels", Version::Ros2, "kilted"),
    ] {
        let flavour = load(&repository_bases(), name).expect("valid").flavour();
        assert_eq!((flavour.ros, &*flavour.distribution), (ros, distribution));
    }
}

#[test]
fn both_bases_of_wheels_have_the_same_packages_and_settings() {
    let [jazzy, kilted] =
        ["jazzy", "kilted"].map(|name| load(&repository_bases(), &format!("bookworm-{name}-wheels")).expect("valid"));
    let names = |base: &Base| -> BTreeSet<String> {
        let lists = [&base.required.runtime, &base.required.build];
        let lines = lists.into_iter().flat_map(|list| list.text().lines());
        lines.filter_map(|line| Some(line.split_once("==")?.0.to_owned())).collect()
    };
    let only = |one: &Base, other: &Base| -> Vec<String> { names(one).difference(&names(other)).cloned().collect() };
    // Kilted's Fast DDS has another name, and what was one package is two, or is not needed any more.
    let gone = ["ros-domain-coordinator", "ros-fastrtps", "ros-fastrtps-cmake-module", "ros-python-cmake-module"];
    assert_eq!(only(&jazzy, &kilted), gone);
    assert_eq!(only(&kilted, &jazzy), ["ros-ament-cmake-ros-core", "ros-fastdds", "ros-rmw-security-common"]);
    assert_eq!((&jazzy.keys, &jazzy.ros_packages.ignore), (&kilted.keys, &kilted.ros_packages.ignore));
    assert_eq!(jazzy.keys["osrf_pycommon"], ["python3-osrf-pycommon"]);
    let rename = |values: &BTreeMap<String, String>| -> BTreeMap<String, String> {
        values.iter().map(|(name, value)| (name.clone(), value.replace("jazzy", "kilted"))).collect()
    };
    assert_eq!(rename(&jazzy.environment), kilted.environment);
    // CMake and compilers need these to build C++ against the wheels.
    let rewrite = |base: &Base| base.wheels.as_ref().expect("wheels").rewrite.clone();
    assert_eq!(rename(&rewrite(&jazzy)), rewrite(&kilted));
    assert_eq!(jazzy.build.environment, kilted.build.environment);
}

/// Creates a directory with these files.
fn write_definitions(files: &[(&str, &str)]) -> tempfile::TempDir {
    let directory = tempfile::tempdir().expect("a directory");
    for (name, text) in files {
        fs::write(directory.path().join(name), text).expect("written");
    }
    directory
}

#[test]
fn a_base_may_have_the_keys_of_another_and_its_own_come_before() {
    let one = format!("{SMALLEST}[keys]\neigen = [\"libeigen3-dev\"]\nfmt = [\"libfmt-dev\"]\n");
    let two = format!("keys_of = \"one\"\n{SMALLEST}[keys]\nfmt = [\"libfmt9-dev\"]\n");
    let lab = write_definitions(&[("one.toml", &one), ("two.toml", &two)]);
    let base = load(lab.path(), "two").expect("valid");
    assert_eq!(base.keys["eigen"], ["libeigen3-dev"]);
    assert_eq!(base.keys["fmt"], ["libfmt9-dev"]);
    let alone = self::write_definitions(&[("two.toml", &two)]);
    let error = load(alone.path(), "two").expect_err("it names another");
    assert!(error.to_string().contains("\"one\""), "{error}");
}

#[test]
fn wheels_are_those_of_the_lists_beside_a_definition() {
    let text = format!(
        "{SMALLEST}[wheels]\npython = \"3.11\"\nglibc = \"2.36\"\nprefix = \"/opt/ros/jazzy\"\n\
         runtime = \"a.requirements.txt\"\nbuild = \"b.requirements.txt\"\n"
    );
    let pinned = format!("ros-x==1.0 --hash=sha256:{}\n", "0".repeat(64));
    let a = ("a.requirements.txt", &*pinned);
    let lab = |b: (&str, &str)| write_definitions(&[("x.toml", &text), a, b]);
    let base = load(lab(("b.requirements.txt", "")).path(), "x").expect("valid");
    assert_eq!((base.required.runtime.len(), base.required.build.len()), (1, 0));
    for (name, text, words) in
        [("other.txt", "", "b.requirements.txt"), ("b.requirements.txt", "\nros-x\n", "line 2: ")]
    {
        let error = load(lab((name, text)).path(), "x").expect_err(words);
        let error = error.to_string();
        assert!(error.contains(words) && error.contains("b.requirements.txt"), "{error}");
    }
    let elsewhere = text.replace("/opt/ros/jazzy", "opt/../x");
    let problem = parse(&elsewhere).expect_err("no absolute path").to_string();
    assert!(problem.contains("opt/../x"), "{problem}");
}
