use proptest::prelude::*;

use super::*;

/// A workspace of packages, given by name and additional elements of their package.xml.
struct FitsFixture(tempfile::TempDir);

impl FitsFixture {
    fn new(packages: &[(&str, &str)]) -> Self {
        let place = Self(tempfile::tempdir().expect("a directory"));
        for (name, rest) in packages {
            let text = format!("<package format='3'><name>{name}</name>{rest}</package>");
            place.write(&format!("src/{name}/package.xml"), &text);
        }
        place
    }

    fn write(&self, path: &str, text: &str) -> &Self {
        let path = self.0.path().join(path);
        std::fs::create_dir_all(path.parent().expect("below")).expect("made");
        std::fs::write(path, text).expect("written");
        self
    }

    fn fits(&self) -> Result<RosSupport, Error> {
        detect(self.0.path(), &distributions())
    }

    fn refusal(&self) -> String {
        self.fits().expect_err("refused").to_string()
    }
}

fn distributions() -> Vec<Distribution> {
    let of = |(version, name): (RosVersion, &str)| Distribution { version, name: name.to_owned() };
    [(RosVersion::One, "noetic"), (RosVersion::Two, "humble"), (RosVersion::Two, "jazzy")].map(of).into()
}

fn build_type(name: &str) -> String {
    format!("<export><build_type>{name}</build_type></export>")
}

/// 1, 2, or 0 for either.
fn number(fits: &RosSupport) -> u8 {
    match fits {
        RosSupport::Either => 0,
        RosSupport::Only { version, .. } => version.number(),
    }
}

const BOTH: &str = "<buildtool_depend condition='$ROS_VERSION == 1'>catkin</buildtool_depend>\
    <buildtool_depend condition='$ROS_VERSION == 2'>ament_cmake</buildtool_depend>\
    <export><build_type condition='$ROS_VERSION == 1'>catkin</build_type>\
    <build_type condition='$ROS_VERSION == 2'>ament_cmake</build_type></export>";

#[test]
fn the_build_type_tells_the_version() {
    for (rest, expected, because) in [
        (build_type("catkin"), 1, "has build type catkin"),
        // The default is catkin.
        (String::new(), 1, "has build type catkin"),
        ("<buildtool_depend>catkin</buildtool_depend>".to_owned(), 1, "has build type catkin"),
        (build_type("ament_cmake"), 2, "has build type ament_cmake"),
        (build_type("ament_python"), 2, "has build type ament_python"),
        (build_type("cmake"), 0, ""),
        (format!("<buildtool_depend>catkin</buildtool_depend>{}", build_type("cmake")), 1, "is built with catkin"),
        (
            format!("<buildtool_depend>ament_cmake</buildtool_depend>{}", build_type("cmake")),
            2,
            "is built with ament_cmake",
        ),
        (format!("<member_of_group>{INTERFACES}</member_of_group>{}", build_type("cmake")), 2, "is built with rosidl"),
        (BOTH.to_owned(), 0, ""),
        // With one distribution of a version only.
        (
            "<export><build_type condition='$ROS_DISTRO == humble'>ament_cmake</build_type>\
             <build_type condition='$ROS_DISTRO != humble'>other</build_type></export>"
                .to_owned(),
            2,
            "has build type ament_cmake",
        ),
    ] {
        let fits = FitsFixture::new(&[("p", &rest)]).fits().expect("it fits");
        assert_eq!(number(&fits), expected, "{rest}");
        if let RosSupport::Only { package, because: why, .. } = fits {
            assert_eq!((&*package, &*why), ("p", because), "{rest}");
        }
    }
}

#[test]
fn two_flavours_name_both_packages() {
    let place = FitsFixture::new(&[
        ("a_both", BOTH),
        ("b_talker", &build_type("catkin")),
        ("c_listener", &build_type("ament_python")),
    ]);
    let text = place.refusal();
    for words in
        ["b_talker has build type catkin (ROS 1)", "c_listener has build type ament_python (ROS 2)", "COLCON_IGNORE"]
    {
        assert!(text.contains(words), "{text}");
    }
    place.write("src/c_listener/COLCON_IGNORE", "");
    assert_eq!(number(&place.fits().expect("one flavour")), 1);
}

#[test]
fn what_nothing_builds_is_told_with_its_file() {
    let text = FitsFixture::new(&[("p", &build_type("bazel"))]).refusal();
    assert!(text.contains("src/p/package.xml: no base supports build type bazel"), "{text}");
    for (tool, add) in [
        ("ament_cmake", "<build_type>ament_cmake</build_type>"),
        ("ament_cmake_auto", "<build_type>ament_cmake</build_type>"),
        ("ament_python", "<build_type>ament_python</build_type>"),
    ] {
        let rest = format!("<buildtool_depend>{tool}</buildtool_depend>");
        let text = FitsFixture::new(&[("p", &rest)]).refusal();
        assert!(text.contains(tool) && text.contains(add), "{text}");
    }
    // An error in a condition is an error for every version.
    let text = FitsFixture::new(&[("p", "<depend condition='$X'>y</depend>")]).refusal();
    assert!(text.contains("invalid condition \"$X\""), "{text}");
}

#[test]
fn install_spaces_are_of_the_tools_that_made_them() {
    let manifest = "<package><name>p</name></package>";
    let place = FitsFixture(tempfile::tempdir().expect("a directory"));
    place.write(".catkin", "").write("setup.sh", "").write("share/p/package.xml", manifest);
    let fits = place.fits().expect("a space");
    assert!(fits.supports(RosVersion::One) && !fits.supports(RosVersion::Two), "{fits:?}");
    let place = FitsFixture(tempfile::tempdir().expect("a directory"));
    place.write("share/ament_index/resource_index/packages/p", "").write("share/p/package.xml", manifest);
    let fits = place.fits().expect("a space");
    assert!(fits.supports(RosVersion::Two) && !fits.supports(RosVersion::One), "{fits:?}");
}

/// Returns the package.xml of a package that supports both versions (0), or one of them (1, 2).
fn package_of_kind(kind: u8) -> String {
    match kind {
        0 => BOTH.to_owned(),
        1 => build_type("catkin"),
        _ => build_type("ament_cmake"),
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// A workspace supports the versions that all its packages support, regardless of their order, and is rejected if
    /// there is none.
    #[test]
    fn a_workspace_fits_what_all_its_packages_fit(kinds in prop::collection::vec(0u8..3, 1..6)) {
        let rests: Vec<(String, String)> = kinds
            .iter()
            .enumerate()
            .map(|(index, kind)| (format!("p{index}"), package_of_kind(*kind)))
            .collect();
        let packages: Vec<(&str, &str)> =
            rests.iter().map(|(name, rest)| (&**name, &**rest)).collect();
        let found = FitsFixture::new(&packages).fits();
        let (one, two) = (kinds.contains(&1), kinds.contains(&2));
        match found {
            Ok(fits) => {
                prop_assert!(!(one && two));
                prop_assert_eq!(fits.supports(RosVersion::One), !two);
                prop_assert_eq!(fits.supports(RosVersion::Two), !one);
            }
            Err(Error::TwoFlavours { .. }) => prop_assert!(one && two),
            Err(other) => prop_assert!(false, "{}", other),
        }
    }
}
