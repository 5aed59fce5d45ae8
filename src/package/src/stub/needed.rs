//! Selection of the shared files that a robot gets: those that launch files, parameters and messages consist of.
//! Sources, build files and hidden files are not needed for an interface and may be confidential.

/// Top-level directories of a package that only its author needs.
const DIRECTORIES: [&str; 5] = ["include", "cmake", "build", "devel", "debian"];
/// Directories in which launch files may find what they read besides sources and test data.
const SEARCHED_DIRECTORIES: [&str; 3] = ["src", "test", "tests"];
/// Suffixes of files that are read by launch files.
const READ: [&str; 11] =
    [".launch", ".xml", ".yaml", ".yml", ".json", ".urdf", ".xacro", ".srdf", ".sdf", ".rviz", ".test"];
const NAMES: [&str; 4] = ["CMakeLists.txt", "Makefile", "setup.py", "Dockerfile"];
/// Suffixes of sources, and of files left behind by compilers and editors.
const ENDINGS: [&str; 16] = [
    ".c", ".cc", ".cpp", ".cxx", ".h", ".hh", ".hpp", ".hxx", ".o", ".a", ".pyc", ".pyo", ".bak", ".orig", ".swp", "~",
];

/// Returns whether a robot gets a file below `share/PACKAGE`. Executables are kept, since rosrun finds them there.
pub fn is_needed(path: &str, executable: bool) -> bool {
    // The tools cannot exchange lists with names that contain control characters.
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
            || SEARCHED_DIRECTORIES.contains(&top) && !ends(&READ)
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
