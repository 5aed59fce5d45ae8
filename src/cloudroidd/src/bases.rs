//! Base image definitions: those built in, so that the daemon works as a single file, and those of the operator.

use std::path::PathBuf;

use anyhow::Context;

use crate::config::Config;
use crate::home::Home;
use store::private;

/// Files of `images/` in the source tree.
const BUILT_IN: [(&str, &str); 6] = [
    (
        "bookworm-jazzy-wheels.build.requirements.txt",
        include_str!("../../../images/bookworm-jazzy-wheels.build.requirements.txt"),
    ),
    ("bookworm-jazzy-wheels.requirements.txt", include_str!("../../../images/bookworm-jazzy-wheels.requirements.txt")),
    ("bookworm-jazzy-wheels.toml", include_str!("../../../images/bookworm-jazzy-wheels.toml")),
    ("bookworm-ros1.toml", include_str!("../../../images/bookworm-ros1.toml")),
    ("jammy-humble.toml", include_str!("../../../images/jammy-humble.toml")),
    ("noble-jazzy.toml", include_str!("../../../images/noble-jazzy.toml")),
];

/// Returns whether a file is a definition or the requirements of one.
fn is_definition_file(name: &str) -> bool {
    name.ends_with(".toml") || name.ends_with(".requirements.txt")
}

/// Writes all definitions to a directory of the home and returns its path. A definition of the operator replaces a
/// built-in one of the same name.
pub fn write_definitions(config: &Config, home: &Home) -> anyhow::Result<PathBuf> {
    let directory = home.path().join("definitions");
    let made = || format!("cannot write the base definitions to {}", directory.display());
    if directory.exists() {
        std::fs::remove_dir_all(&directory).with_context(made)?;
    }
    private::make_directory(&directory).with_context(made)?;
    for (name, text) in BUILT_IN {
        std::fs::write(directory.join(name), text).with_context(made)?;
    }
    if let Some(theirs) = &config.definitions {
        let unread = || format!("cannot read the base definitions in {}", theirs.display());
        for entry in std::fs::read_dir(theirs).with_context(unread)? {
            let path = entry.with_context(unread)?.path();
            if let Some(name) = path.file_name().and_then(|name| name.to_str())
                && is_definition_file(name)
            {
                std::fs::copy(&path, directory.join(name)).with_context(unread)?;
            }
        }
    }
    private::restrict_tree(&directory, 1, &|_| false).with_context(made)?;
    Ok(directory)
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
        let config = Config { definitions: Some(theirs.path().to_owned()), ..Config::default() };
        let directory = super::write_definitions(&config, &home).expect("made");
        let read = |name: &str| std::fs::read_to_string(directory.join(name)).ok();
        assert_eq!(read("bookworm-ros1.toml").as_deref(), Some("mine"));
        assert_eq!(read("other.toml").as_deref(), Some("other"));
        assert_eq!(read("other.requirements.txt").as_deref(), Some("theirs"));
        assert_eq!(read("notes.txt"), None);
    }
}
