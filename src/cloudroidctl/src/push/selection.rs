//! Selection of the files of a push: what is left out, which links are followed, and which files are large.

use std::collections::BTreeSet;
use std::fs::DirEntry;
use std::io;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use anyhow::{Context, bail, ensure};
use api::Size;

use super::ignore::{IGNORE_FILE, IgnoreRules};

/// Directories that never belong to a package.
const EXCLUDED_DIRECTORIES: [&str; 5] = [".git", ".hg", ".svn", ".catkin_tools", "__pycache__"];
/// Directories beside `src` of a workspace that catkin or colcon generate.
const GENERATED_DIRECTORIES: [&str; 6] = ["build", "devel", "install", "log", "logs", "build_isolated"];
/// Size in bytes from which a file is named before it is sent.
const LARGE: u64 = 100_000_000;
/// Maximum number of large files that are named.
const MAX_NAMED_FILES: usize = 10;
/// Maximum numbers of files and of links to packages elsewhere, and maximum depth.
const MAX_ENTRIES: usize = 1_000_000;
const MAX_LINKS: usize = 100;
const MAX_DEPTH: usize = 64;
/// Depth of the search for a package.xml behind a link.
const PACKAGE_DEPTH: usize = 6;

/// A file, directory or link to pack.
#[derive(Debug)]
pub struct SelectedEntry {
    /// Path on this machine.
    pub source: PathBuf,
    /// Path in the archive.
    pub inside: PathBuf,
}

/// Files that are sent of a directory.
#[derive(Debug, Default)]
pub struct Selection {
    /// Entries, each directory before its content.
    pub entries: Vec<SelectedEntry>,
    /// True if there is a package.xml.
    pub has_package: bool,
    /// Time of the newest file, in seconds since 1970.
    pub newest: Option<u64>,
    /// Notes for the deployer before anything is sent: links that were followed, and large files.
    pub notes: Vec<String>,
}

/// Selects the files of a package, a workspace or an install space. A link in a workspace, outside of packages, that
/// leads to packages elsewhere is followed: they are packed in its place. Blocking.
///
/// # Errors
/// A directory or an ignore file cannot be read, there are too many files, or a link leads to a directory around the
/// workspace.
pub fn select_files(root: &Path) -> anyhow::Result<Selection> {
    let real = root.canonicalize().with_context(|| format!("cannot open {}", root.display()))?;
    let is_workspace = root.join("src").is_dir() && !root.join("package.xml").exists();
    let mut walk = SelectionWalk {
        inside_of: vec![real.clone()],
        root: real,
        selection: Selection::default(),
        followed: BTreeSet::new(),
        large: Vec::new(),
    };
    let place = Place { source: root, inside: Path::new(""), is_generated: is_workspace, in_package: false, depth: 0 };
    walk.add_directory(&place, &IgnoreRules::default())?;
    let SelectionWalk { mut selection, mut large, .. } = walk;
    large.sort_by_key(|(_, size)| std::cmp::Reverse(*size));
    for (path, size) in large.iter().take(MAX_NAMED_FILES) {
        let size = Size(*size);
        let text = format!("{} has {size} and is sent; a line in {IGNORE_FILE} leaves it out", path.display());
        selection.notes.push(text);
    }
    if large.len() > MAX_NAMED_FILES {
        selection.notes.push(format!("{} more files of over 100 MB are sent", large.len() - MAX_NAMED_FILES));
    }
    Ok(selection)
}

/// A directory to add.
struct Place<'a> {
    source: &'a Path,
    inside: &'a Path,
    /// True if directories in it may be results of a build.
    is_generated: bool,
    /// True within a package, where links are packed as they are.
    in_package: bool,
    depth: usize,
}

struct SelectionWalk {
    /// Canonical path of what is pushed.
    root: PathBuf,
    /// The root and the targets of followed links around the current directory.
    inside_of: Vec<PathBuf>,
    selection: Selection,
    /// Canonical targets of followed links.
    followed: BTreeSet<PathBuf>,
    /// Large files with their sizes in bytes.
    large: Vec<(PathBuf, u64)>,
}

impl SelectionWalk {
    fn add_directory(&mut self, place: &Place<'_>, above: &IgnoreRules) -> anyhow::Result<()> {
        let directory = place.source;
        ensure!(place.depth <= MAX_DEPTH, "{} is deeper than {MAX_DEPTH} directories", directory.display());
        let mut entries = std::fs::read_dir(directory)
            .and_then(Iterator::collect::<io::Result<Vec<_>>>)
            .with_context(|| format!("cannot read {}", directory.display()))?;
        entries.sort_by_key(DirEntry::file_name);
        let rules = above.with_file_of(directory, place.inside)?;
        let is_package = directory.join("package.xml").exists();
        self.selection.has_package |= is_package;
        for entry in entries {
            let name = entry.file_name();
            let is_left_out = EXCLUDED_DIRECTORIES.iter().any(|left_out| name == *left_out)
                || (place.is_generated && GENERATED_DIRECTORIES.iter().any(|made| name == *made))
                || name == IGNORE_FILE;
            let inside = place.inside.join(&name);
            let kind = entry.file_type()?;
            if is_left_out || rules.is_ignored(&inside, kind.is_dir()) {
                continue;
            }
            let source = entry.path();
            let below = Place {
                source: &source,
                inside: &inside,
                is_generated: false,
                in_package: place.in_package || is_package,
                depth: place.depth + 1,
            };
            if kind.is_symlink() {
                self.add_link(&below, &rules)?;
            } else {
                if kind.is_file() {
                    let metadata = entry.metadata()?;
                    if metadata.len() >= LARGE {
                        self.large.push((inside.clone(), metadata.len()));
                    }
                    let time = metadata.modified()?.duration_since(UNIX_EPOCH).ok();
                    self.selection.newest = self.selection.newest.max(time.map(|since| since.as_secs()));
                }
                self.add_entry(&below)?;
                if kind.is_dir() {
                    self.add_directory(&below, &rules)?;
                }
            }
        }
        Ok(())
    }

    fn add_entry(&mut self, place: &Place<'_>) -> anyhow::Result<()> {
        ensure!(
            self.selection.entries.len() < MAX_ENTRIES,
            "there are more than {MAX_ENTRIES} files; push the directory of a package or workspace, or leave some out \
             with {IGNORE_FILE}"
        );
        let entry = SelectedEntry { source: place.source.to_owned(), inside: place.inside.to_owned() };
        self.selection.entries.push(entry);
        Ok(())
    }

    /// Adds a link, or the packages that it leads to.
    fn add_link(&mut self, link: &Place<'_>, rules: &IgnoreRules) -> anyhow::Result<()> {
        if is_catkins_toplevel(link.source) {
            return Ok(());
        }
        let Some(target) = self.packages_elsewhere(link) else {
            return self.add_entry(link);
        };
        // A pattern that ends with a slash means the directory that is packed in the link's place.
        if rules.is_ignored(link.inside, true) {
            return Ok(());
        }
        let shown = link.inside.display();
        if self.root.starts_with(&target) {
            bail!(
                "{} is a link to {}, which contains what is pushed; remove the link, or add /{shown} to {IGNORE_FILE}",
                link.source.display(),
                target.display(),
            );
        }
        if !self.followed.insert(target.clone()) {
            let text = format!("{shown} is a second link to {} and is left out", target.display());
            self.selection.notes.push(text);
            return Ok(());
        }
        ensure!(
            self.followed.len() <= MAX_LINKS,
            "more than {MAX_LINKS} links lead to packages elsewhere; push a workspace that has copies of them"
        );
        let text = format!("{shown} is a link to {}, whose files are sent in its place", target.display());
        self.selection.notes.push(text);
        let there = Place { source: &target, ..*link };
        self.add_entry(&there)?;
        self.inside_of.push(target.clone());
        let added = self.add_directory(&there, rules);
        self.inside_of.pop();
        added
    }

    /// Returns the canonical target of a link outside of packages that leads to a directory with packages elsewhere.
    fn packages_elsewhere(&self, link: &Place<'_>) -> Option<PathBuf> {
        if link.in_package {
            return None;
        }
        let target = link.source.canonicalize().ok()?;
        let stays = self.inside_of.iter().any(|place| target.starts_with(place));
        (!stays && target.is_dir() && holds_package(&target, PACKAGE_DEPTH)).then_some(target)
    }
}

/// Returns whether there is a package.xml in a directory or below it; unreadable directories are ignored.
fn holds_package(directory: &Path, depth: usize) -> bool {
    if directory.join("package.xml").is_file() {
        return true;
    }
    let Ok(entries) = std::fs::read_dir(directory) else {
        return false;
    };
    depth > 0
        && entries.flatten().any(|entry| {
            let is_skipped = EXCLUDED_DIRECTORIES.iter().any(|name| entry.file_name() == *name);
            let is_directory = entry.file_type().is_ok_and(|kind| kind.is_dir());
            !is_skipped && is_directory && holds_package(&entry.path(), depth - 1)
        })
}

/// Returns whether a link is `src/CMakeLists.txt` of `catkin_init_workspace`, which points to a file of catkin outside
/// of the workspace and contains nothing of the package.
fn is_catkins_toplevel(link: &Path) -> bool {
    std::fs::read_link(link).is_ok_and(|target| target.is_absolute() && target.ends_with("catkin/cmake/toplevel.cmake"))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    fn write(root: &Path, path: &str, text: &str) {
        let path = root.join(path);
        std::fs::create_dir_all(path.parent().expect("below")).expect("made");
        std::fs::write(path, text).expect("written");
    }

    fn selected_paths(selection: &Selection) -> Vec<&str> {
        selection.entries.iter().filter_map(|entry| entry.inside.to_str()).collect()
    }

    #[test]
    fn what_is_ignored_or_generated_is_left_out() {
        let place = tempfile::tempdir().expect("a directory");
        let root = place.path();
        for path in ["src/p/package.xml", "src/p/run.bag", "src/p/keep.bag", "build/x", "src/p/.git/x", "src/p/build/x"]
        {
            write(root, path, "");
        }
        write(root, ".cloudroidignore", "*.bag\n");
        write(root, "src/p/.cloudroidignore", "!keep.bag\n");
        let selection = select_files(root).expect("selected");
        let expected = ["src", "src/p", "src/p/build", "src/p/build/x", "src/p/keep.bag", "src/p/package.xml"];
        assert_eq!(selected_paths(&selection), expected);
        assert!(selection.has_package && selection.notes.is_empty(), "{selection:?}");
    }

    #[test]
    fn the_newest_file_that_is_sent_counts() {
        let place = tempfile::tempdir().expect("a directory");
        for (path, seconds) in
            [("src/p/package.xml", 100), ("src/p/run.py", 200), ("src/p/.git/index", 300), ("build/x", 400)]
        {
            write(place.path(), path, "");
            let file = std::fs::File::options().write(true).open(place.path().join(path)).expect("there");
            file.set_modified(UNIX_EPOCH + std::time::Duration::from_secs(seconds)).expect("set");
        }
        assert_eq!(select_files(place.path()).expect("selected").newest, Some(200));
    }

    #[test]
    fn packages_behind_links_of_a_workspace_are_packed_once_and_told() {
        let place = tempfile::tempdir().expect("a directory");
        let elsewhere = tempfile::tempdir().expect("a directory");
        let (root, there) = (place.path(), elsewhere.path().canonicalize().expect("there"));
        write(root, "src/own/package.xml", "");
        write(&there, "repo/far/package.xml", "");
        write(&there, "repo/far/data.txt", "");
        write(&there, "plain/notes.txt", "");
        symlink(there.join("repo"), root.join("src/a_repo")).expect("linked");
        symlink(there.join("repo"), root.join("src/b_repo")).expect("linked");
        // Back to itself; within the workspace; without packages; within a package.
        symlink(there.join("repo"), there.join("repo/again")).expect("linked");
        symlink("own", root.join("src/near")).expect("linked");
        symlink(there.join("plain"), root.join("src/plain")).expect("linked");
        symlink(there.join("repo"), root.join("src/own/repo")).expect("linked");
        let selection = select_files(root).expect("selected");
        let expected = [
            "src",
            "src/a_repo",
            "src/a_repo/again",
            "src/a_repo/far",
            "src/a_repo/far/data.txt",
            "src/a_repo/far/package.xml",
            "src/near",
            "src/own",
            "src/own/package.xml",
            "src/own/repo",
            "src/plain",
        ];
        assert_eq!(selected_paths(&selection), expected);
        let target = there.join("repo");
        let told = [
            format!("src/a_repo is a link to {}, whose files are sent in its place", target.display()),
            format!("src/b_repo is a second link to {} and is left out", target.display()),
        ];
        assert_eq!(selection.notes, told);
        let packed = selection.entries.iter().find(|entry| entry.inside == Path::new("src/a_repo"));
        assert_eq!(packed.expect("there").source, target);
    }

    #[test]
    fn a_link_around_the_workspace_is_refused_unless_it_is_ignored() {
        let place = tempfile::tempdir().expect("a directory");
        let root = place.path().join("lab_ws");
        write(&root, "src/own/package.xml", "");
        symlink(place.path(), root.join("src/all")).expect("linked");
        let refused = select_files(&root).expect_err("endless").to_string();
        assert!(refused.contains("which contains what is pushed") && refused.contains("/src/all"), "{refused}");
        write(&root, ".cloudroidignore", "/src/all\n");
        assert_eq!(selected_paths(&select_files(&root).expect("ignored")), ["src", "src/own", "src/own/package.xml"]);
    }

    #[test]
    fn large_files_are_named_first() {
        let place = tempfile::tempdir().expect("a directory");
        write(place.path(), "package.xml", "");
        // Sparse, and large all the same: it is sent as it is.
        let file = std::fs::File::create(place.path().join("run.bag")).expect("made");
        file.set_len(3 << 30).expect("set");
        let selection = select_files(place.path()).expect("selected");
        assert_eq!(selection.notes, ["run.bag has 3G and is sent; a line in .cloudroidignore leaves it out"]);
    }
}
