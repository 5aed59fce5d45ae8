//! What of a package's shared files a robot gets: what its launch files, parameters and messages are made of. Sources, what
//! they were compiled with, and files that their author hid are of no use to an interface, and may tell what is nobody's business.

/// Directories of a package's top that only its author needs.
const DIRECTORIES: [&str; 5] = ["include", "cmake", "build", "devel", "debian"];
/// Those in which launch files find what they read beside sources and data of tests.
const MIXED: [&str; 3] = ["src", "test", "tests"];
/// Endings of what launch files read.
const READ: [&str; 11] = [
    ".launch", ".xml", ".yaml", ".yml", ".json", ".urdf", ".xacro", ".srdf", ".sdf", ".rviz",
    ".test",
];
const NAMES: [&str; 4] = ["CMakeLists.txt", "Makefile", "setup.py", "Dockerfile"];
/// Endings of sources, and of what compilers and editors leave.
const ENDINGS: [&str; 16] = [
    ".c", ".cc", ".cpp", ".cxx", ".h", ".hh", ".hpp", ".hxx", ".o", ".a", ".pyc", ".pyo", ".bak",
    ".orig", ".swp", "~",
];

/// Whether a robot gets a file below `share/PACKAGE`. Programs stay where they are: rosrun finds them there.
pub fn is_needed(path: &str, executable: bool) -> bool {
    // No tool writes names with control characters into a list that another reads back.
    if path.chars().any(char::is_control) || path.split('/').any(|part| part.starts_with('.')) {
        return false;
    }
    let (top, name) = match path.split_once('/') {
        Some((top, rest)) => (top, rest.rsplit('/').next().unwrap_or(rest)),
        None => ("", path),
    };
    let ends = |endings: &[&str]| endings.iter().any(|ending| name.ends_with(ending));
    executable
        || !(DIRECTORIES.contains(&top)
            || MIXED.contains(&top) && !ends(&READ)
            || NAMES.contains(&name)
            || ends(&ENDINGS))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_robot_gets_what_an_interface_needs() {
        for (path, executable, needed) in [
            ("package.xml", false, true),
            ("launch/a.launch", false, true),
            ("launch/src/a.launch", false, true),
            ("config/camera.yaml", false, true),
            ("msg/T.msg", false, true),
            ("meshes/arm.stl", false, true),
            ("nodelets.xml", false, true),
            ("scripts/tool.py", true, true),
            ("src/node.py", true, true),
            ("src/node.cpp", false, false),
            ("src/module.py", false, false),
            ("include/p/p.h", false, false),
            ("test/data.bag", false, false),
            ("test/camera.yaml", false, true),
            ("src/robot.urdf.xacro", false, true),
            ("src/robot.xacro~", false, false),
            ("CMakeLists.txt", false, false),
            ("launch/old.launch~", false, false),
            (".git/config", false, false),
            (".env", true, false),
            ("config/.secret.yaml", false, false),
            ("launch/a\nb.launch", false, false),
        ] {
            assert_eq!(is_needed(path, executable), needed, "{path:?}");
        }
    }
}
