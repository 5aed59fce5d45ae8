//! Files that make a ROS 1 stub a catkin install space: catkin's marker, and setup files for both of its search paths.

use std::collections::BTreeSet;

use super::{Contents, Files, RosTerms, StubInfo, nodelets, text_file};

const SETUP_SH: &str = include_str!("inside/setup.sh");
const SETUP_BASH: &str = include_str!("inside/setup.bash");
const SETUP_ZSH: &str = include_str!("inside/setup.zsh");

/// Terms of ROS 1.
pub(super) const TERMS: RosTerms = RosTerms {
    run: "rosrun",
    order: "because sourcing another catkin workspace removes it again",
    plugins: "Nodelets of this package cannot be loaded into a\nmanager that runs on the robot",
    settings: "a parameter of the node or of a namespace around it (~cloudroid/max)",
};

/// Returns the files in addition to those of the package.
pub(super) fn setup_files() -> Files {
    [(".catkin", ""), ("setup.sh", SETUP_SH), ("setup.bash", SETUP_BASH), ("setup.zsh", SETUP_ZSH)]
        .map(|(name, text)| (name.to_owned(), text_file(text)))
        .into()
}

/// Replaces shared files that must differ in the stub.
pub(super) fn replace_plugin_lists(about: &StubInfo<'_>, contents: &mut Contents) {
    for path in nodelets::plugin_lists(&contents.share) {
        if let Some(content) = contents.share.remove(&path) {
            contents.share.insert(path, nodelets::unloadable_plugin_list(about, content));
        }
    }
}

/// Returns the names of all launchers in `lib/PACKAGE`: executables of the image, and outsourced ones.
pub(super) fn launcher_names(about: &StubInfo<'_>, contents: &Contents) -> BTreeSet<String> {
    let in_share = |name: &String| contents.share.keys().any(|path| path.rsplit('/').next() == Some(name.as_str()));
    let mut names = contents.executables.clone();
    // The launcher of a shared script is in place of the script: roslaunch accepts neither of two executables with the
    // same name.
    names.extend(about.outsourced.iter().filter(|name| !in_share(name)).cloned());
    names
}
