use super::*;
use crate::condition::Variables;
use crate::workspace::{PushedDirectory, inspect};

struct InterfaceFixture(tempfile::TempDir);

impl InterfaceFixture {
    /// Creates a package of interfaces, `demo`, whose build file lists these.
    fn new(listed: &str, files: &[(&str, &str)]) -> Self {
        let place = Self(tempfile::tempdir().expect("a directory"));
        let manifest = "<package format='3'><name>demo</name>\
            <member_of_group>rosidl_interface_packages</member_of_group>\
            <export><build_type>ament_cmake</build_type></export></package>";
        place.write("src/demo/package.xml", manifest);
        let build = format!("rosidl_generate_interfaces(${{PROJECT_NAME}} {listed})");
        place.write("src/demo/CMakeLists.txt", &build);
        for (path, text) in files {
            place.write(&format!("src/demo/{path}"), text);
        }
        place
    }

    fn write(&self, path: &str, text: &str) {
        let path = self.0.path().join(path);
        std::fs::create_dir_all(path.parent().expect("below")).expect("made");
        std::fs::write(path, text).expect("written");
    }

    fn check(&self) -> Result<(), Error> {
        let variables = Variables::for_distribution(2, "jazzy");
        let PushedDirectory::Source(workspace) = inspect(self.0.path(), &variables).expect("a workspace") else {
            panic!("sources")
        };
        let known = Definitions::from(
            [
                ("std_msgs/msg/String", "string data\n"),
                ("geometry_msgs/msg/Point", "float64 x\nfloat64 y\nfloat64 z\n"),
            ]
            .map(|(key, text)| (key.to_owned(), text.to_owned())),
        );
        check(&workspace, &known)
    }

    fn refusal(&self) -> String {
        self.check().expect_err("refused").to_string()
    }
}

#[test]
fn interfaces_in_all_languages_are_read() {
    let idl = "module demo { module msg { struct Natural { int32 x; }; }; };";
    let place = InterfaceFixture::new(
        "\"msg/Seen.msg\" \"msg/Natural.idl\" \"srv/Ask.srv\" \"action/Go.action\"",
        &[
            ("msg/Seen.msg", "uint8 A=1\nstring<=10 name 'x'\ngeometry_msgs/Point[<=4] corners\nNatural natural\n"),
            ("msg/Natural.idl", idl),
            ("srv/Ask.srv", "Seen seen\n---\nbool good false\n"),
            ("action/Go.action", "Seen goal\n---\nwstring text\n---\nfloat32[3] at\n"),
        ],
    );
    place.check().expect("all is there");
}

#[test]
fn a_type_without_definition_is_named_with_its_file() {
    let place = InterfaceFixture::new("msg/Seen.msg", &[("msg/Seen.msg", "nav_msgs/Path path\n")]);
    let text = place.refusal();
    for words in ["src/demo/msg/Seen.msg: ", "nav_msgs/msg/Path, which has no definition", "name the package nav_msgs"]
    {
        assert!(text.contains(words), "{text}");
    }
    // Also in a service and an action, and through another message.
    for (file, text) in [("srv/Ask.srv", "---\nnav_msgs/Path path\n"), ("action/Go.action", "---\n---\nWay way\n")] {
        let way = ("msg/Way.msg", "nav_msgs/Path path\n");
        let text = InterfaceFixture::new(file, &[(file, text), way]).refusal();
        assert!(text.contains(file) && text.contains("nav_msgs/msg/Path"), "{text}");
    }
}

#[test]
fn a_mistake_is_told_with_file_and_line() {
    for (file, text, words) in [
        ("msg/Seen.msg", "int32 x\nint32 Y!\n", "msg/Seen.msg: line 2: "),
        ("srv/Ask.srv", "int32 x\n", "srv/Ask.srv: "),
        ("action/Go.action", "int32 x\n---\n", "action/Go.action: "),
        ("msg/Nature.idl", "module demo { nonsense", "msg/Nature.idl: line 1: "),
    ] {
        let told = InterfaceFixture::new(file, &[(file, text)]).refusal();
        assert!(told.contains(words), "{file}: {told}");
    }
}

#[test]
fn only_what_is_built_is_looked_at() {
    let broken = ("msg/Broken.msg", "!!!\n");
    let good = ("msg/Good.msg", "int32 x\n");
    InterfaceFixture::new("msg/Good.msg", &[good, broken]).check().expect("good");
    // A name with the same ending is another name.
    InterfaceFixture::new("msg/Good.msg msg/UnBroken.msg", &[good, broken]).check().expect("good");
    // If none is named, the build file finds them by a pattern.
    let text = InterfaceFixture::new("${files}", &[good, broken]).refusal();
    assert!(text.contains("msg/Broken.msg"), "{text}");
    // Without code generation nothing is checked.
    let place = InterfaceFixture::new("", &[broken]);
    place.write("src/demo/CMakeLists.txt", "project(demo)");
    place.check().expect("not built");
}

#[test]
fn links_and_endless_files_are_not_read() {
    let place = InterfaceFixture::new("msg/Big.msg", &[("msg/Good.msg", "int32 x\n")]);
    place.write("src/demo/msg/Big.msg", &"#".repeat(300 << 10));
    assert!(place.refusal().contains("larger than"), "{}", place.refusal());
    let (place, outside) = (
        InterfaceFixture::new("msg/Out.msg", &[("msg/Good.msg", "int32 x\n")]),
        tempfile::tempdir().expect("a directory"),
    );
    std::fs::write(outside.path().join("Out.msg"), "secret!").expect("written");
    std::os::unix::fs::symlink(outside.path().join("Out.msg"), place.0.path().join("src/demo/msg/Out.msg"))
        .expect("linked");
    let text = place.refusal();
    assert!(text.contains("leads out of") && !text.contains("secret"), "{text}");
}
