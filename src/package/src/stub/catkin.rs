//! What makes a stub of ROS 1 an install space of catkin: catkin's marker, and set-up files for both of its search paths.

use std::collections::BTreeSet;

use super::{About, Contents, Files, Words, nodelets, plain};

const SETUP_SH: &str = include_str!("inside/setup.sh");
const SETUP_BASH: &str = include_str!("inside/setup.bash");
const SETUP_ZSH: &str = include_str!("inside/setup.zsh");

/// What texts call things.
pub(super) const WORDS: Words = Words {
    run: "rosrun",
    order: "because sourcing another catkin workspace removes it again",
    plugins: "Nodelets of this package cannot be loaded into a\nmanager that runs on the robot",
    settings: "a parameter of the node or of a namespace around it (~cloudroid/max)",
};

/// Files beside those of the package.
pub(super) fn files() -> Files {
    [
        (".catkin", ""),
        ("setup.sh", SETUP_SH),
        ("setup.bash", SETUP_BASH),
        ("setup.zsh", SETUP_ZSH),
    ]
    .map(|(name, text)| (name.to_owned(), plain(text)))
    .into()
}

/// Shared files that give way to others.
pub(super) fn replaced(about: &About<'_>, contents: &mut Contents) {
    for path in nodelets::plugin_lists(&contents.share) {
        if let Some(content) = contents.share.remove(&path) {
            contents
                .share
                .insert(path, nodelets::refusing(about, content));
        }
    }
}

/// Every name that has a launcher in `lib/PACKAGE`: those of the image, and those outsourced.
pub(super) fn executables(about: &About<'_>, contents: &Contents) -> BTreeSet<String> {
    let in_share = |name: &String| {
        contents
            .share
            .keys()
            .any(|path| path.rsplit('/').next() == Some(name.as_str()))
    };
    let mut names = contents.executables.clone();
    // One that is a shared script has its launcher in the script's place: of two executables of one name roslaunch takes neither.
    names.extend(
        about
            .outsourced
            .iter()
            .filter(|name| !in_share(name))
            .cloned(),
    );
    names
}
