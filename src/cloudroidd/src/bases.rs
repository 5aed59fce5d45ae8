//! Base image definitions: those built in, so that the daemon works as a single file, those of the operator, and those
//! of bases that were made from images.

use std::path::{Path, PathBuf};

use anyhow::Context;

use crate::config::Config;
use crate::home::Home;
use store::private;

/// Files of `images/` in the source tree.
const BUILT_IN: [(&str, &str); 7] = [
    (
        "bookworm-jazzy-wheels.build.requirements.txt",
        include_str!("../../../images/bookworm-jazzy-wheels.build.requirements.txt"),
    ),
    ("bookworm-jazzy-wheels.requirements.txt", include_str!("../../../images/bookworm-jazzy-wheels.requirements.txt")),
    ("bookworm-jazzy-wheels.toml", include_str!("../../../images/bookworm-jazzy-wheels.toml")),
    (
        "bookworm-kilted-wheels.build.requirements.txt",
        include_str!("../../../images/bookworm-kilted-wheels.build.requirements.txt"),
    ),
    (
        "bookworm-kilted-wheels.requirements.txt",
        include_str!("../../../images/bookworm-kilted-wheels.requirements.txt"),
    ),
    ("bookworm-kilted-wheels.toml", include_str!("../../../images/bookworm-kilted-wheels.toml")),
    ("bookworm-ros1.toml", include_str!("../../../images/bookworm-ros1.toml")),
];

/// Directory of the home with the definitions of bases that were made from images.
pub const IMPORTED_DIRECTORY: &str = "bases";

/// Returns whether a file is a definition or the requirements of one.
fn is_definition_file(name: &str) -> bool {
    name.ends_with(".toml") || name.ends_with(".requirements.txt")
}

/// Writes all definitions to a directory of the home and returns its path. A definition of the operator replaces a
/// built-in one of the same name, and both replace that of an imported base.
pub fn write_definitions(config: &Config, home: &Home) -> anyhow::Result<PathBuf> {
    let directory = home.path().join("definitions");
    let made = || format!("cannot write the base definitions to {}", directory.display());
    if directory.exists() {
        std::fs::remove_dir_all(&directory).with_context(made)?;
    }
    private::make_directory(&directory).with_context(made)?;
    let imported = home.path().join(IMPORTED_DIRECTORY);
    private::make_directory(&imported).with_context(made)?;
    let copied = copy_definitions(&imported, &directory)?;
    for (name, text) in BUILT_IN {
        std::fs::write(directory.join(name), text).with_context(made)?;
    }
    let theirs = match &config.definitions {
        Some(theirs) => copy_definitions(theirs, &directory)?,
        None => Vec::new(),
    };
    for name in copied {
        if theirs.contains(&name) || BUILT_IN.iter().any(|(built_in, _)| *built_in == name) {
            tracing::warn!("the imported base {name} is hidden by a definition of the same name");
        }
    }
    private::restrict_tree(&directory, 1, &|_| false).with_context(made)?;
    Ok(directory)
}

/// Copies the definitions of a directory and returns the names of the files.
fn copy_definitions(from: &Path, to: &Path) -> anyhow::Result<Vec<String>> {
    let unread = || format!("cannot read the base definitions in {}", from.display());
    let mut copied = Vec::new();
    for entry in std::fs::read_dir(from).with_context(unread)? {
        let path = entry.with_context(unread)?.path();
        if let Some(name) = path.file_name().and_then(|name| name.to_str())
            && is_definition_file(name)
        {
            std::fs::copy(&path, to.join(name)).with_context(unread)?;
            copied.push(name.to_owned());
        }
    }
    Ok(copied)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_definition_of_the_repository_is_built_in() {
        let images = concat!(env!("CARGO_MANIFEST_DIR"), "/../../images");
        let mut there: Vec<String> = std::fs::read_dir(images)
            .expect("the repository's definitions")
            .map(|entry| entry.expect("readable").file_name().to_string_lossy().into_owned())
            .filter(|name| is_definition_file(name))
            .collect();
        there.sort();
        assert_eq!(there, BUILT_IN.map(|(name, _)| name));
    }

    #[test]
    fn the_operators_definitions_win() {
        let theirs = tempfile::tempdir().expect("a directory");
        std::fs::write(theirs.path().join("bookworm-ros1.toml"), "mine").expect("written");
        std::fs::write(theirs.path().join("other.toml"), "other").expect("written");
        std::fs::write(theirs.path().join("other.requirements.txt"), "theirs").expect("written");
        std::fs::write(theirs.path().join("notes.txt"), "no definition").expect("written");
        let parent = tempfile::tempdir().expect("a directory");
        let home = Home::open(parent.path()).expect("free");
        let imported = home.path().join(IMPORTED_DIRECTORY);
        std::fs::create_dir(&imported).expect("made");
        for name in ["bookworm-ros1.toml", "other.toml", "robot.toml"] {
            std::fs::write(imported.join(name), "imported").expect("written");
        }
        let config = Config { definitions: Some(theirs.path().to_owned()), ..Config::default() };
        let directory = super::write_definitions(&config, &home).expect("made");
        let read = |name: &str| std::fs::read_to_string(directory.join(name)).ok();
        assert_eq!(read("bookworm-ros1.toml").as_deref(), Some("mine"));
        assert_eq!(read("other.toml").as_deref(), Some("other"));
        assert_eq!(read("other.requirements.txt").as_deref(), Some("theirs"));
        assert_eq!(read("robot.toml").as_deref(), Some("imported"));
        assert_eq!(read("notes.txt"), None);
    }
}
