//! Finds Python modules that programs of an image import and the image lacks. Each would make its node exit at startup,
//! one after the other; here all are reported at once in advance.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use foreign::{DirectoryLookup, Tree};
use package::inventory::Inventory;

use crate::advice::AdviceIndex;
use crate::imports;

/// Maximum size of a program that is inspected, in bytes.
const MAX_BYTES: u64 = 1 << 20;
/// Maximum number of modules that are looked for, for all programs: each in many directories.
const MOST_MODULES: usize = 5000;
/// Directory of modules in an install space.
const MODULES: &str = "lib/python3/dist-packages";
const LIBRARIES: &str = "usr/lib";

/// Returns advice for each missing module. `trees` are extracted layers, lowest first. Unreadable files are ignored.
/// Blocking.
pub(crate) fn missing_module_advice(trees: &[PathBuf], inventory: &Inventory, known: AdviceIndex<'_>) -> Vec<String> {
    let trees: Vec<Tree> = trees.iter().filter_map(|tree| Tree::open(tree).ok()).collect();
    let shared = inventory.prefixes.iter();
    let mut shared: Vec<PathBuf> = shared.map(|prefix| relative_to_root(prefix).join(MODULES)).collect();
    shared.extend(trees.iter().flat_map(standard_library));
    let mut told = BTreeSet::new();
    let mut left = MOST_MODULES;
    for (name, path) in &inventory.programs {
        let path = relative_to_root(path);
        let text = trees.iter().rev().find_map(|tree| {
            let file = tree.read_file(path, MAX_BYTES).ok()??;
            imports::program_imports(&file.bytes)
        });
        for module in text.unwrap_or_default() {
            // A program may import any number of names; nothing can be advised about most.
            let Some(deb) = known.module(&module) else {
                continue;
            };
            if left == 0 {
                return told.into_iter().collect();
            }
            left -= 1;
            // Modules in the program's own directory are found first.
            let own = path.parent().map(Path::to_owned);
            let mut places = shared.iter().chain(&own);
            if places.any(|place| trees.iter().any(|tree| has_module(tree, place, &module))) {
                continue;
            }
            told.insert(format!(
                "{name} imports the Python module {module}, which the image lacks: push with `--with {deb}`"
            ));
        }
    }
    told.into_iter().collect()
}

/// Converts an absolute path of the image to one relative to a tree.
fn relative_to_root(path: &str) -> &Path {
    Path::new(path.trim_start_matches('/'))
}

/// Returns the directories of Python's own modules: `usr/lib/python3.11`.
fn standard_library(tree: &Tree) -> Vec<PathBuf> {
    let Ok(DirectoryLookup::Directory(libraries)) = tree.open_directory(LIBRARIES) else {
        return Vec::new();
    };
    let names = libraries.names().unwrap_or_default().into_iter();
    let of_python = names.filter(|name| name.to_string_lossy().starts_with("python3."));
    of_python.map(|name| Path::new(LIBRARIES).join(name)).collect()
}

fn has_module(tree: &Tree, place: &Path, module: &str) -> bool {
    // A link points to something, and a directory without `__init__.py` is a Python package as well.
    !matches!(tree.open_directory(place.join(module)), Ok(DirectoryLookup::Nothing))
        || tree.has_file(place.join(format!("{module}.py")))
        || has_extension(tree, place, module)
}

/// Returns whether a module exists as an extension, such as `yaml.cpython-311-x86_64-linux-gnu.so`.
fn has_extension(tree: &Tree, place: &Path, module: &str) -> bool {
    let Ok(DirectoryLookup::Directory(directory)) = tree.open_directory(place) else {
        return false;
    };
    let start = format!("{module}.");
    let is_library = |name: &str| name.starts_with(&start) && name.ends_with(".so");
    let names = directory.names().unwrap_or_default();
    names.iter().any(|name| name.to_str().is_some_and(is_library))
}

#[cfg(test)]
mod tests {
    use crate::contents::{Contents, tests::list};

    use super::*;

    #[test]
    fn all_modules_that_an_image_lacks_are_named() {
        let root = tempfile::tempdir().expect("a directory");
        let shared = "usr/lib/python3/dist-packages";
        let program = "#!/usr/bin/env python3\nimport os, rospy, numpy\nimport cv2, yaml\nfrom near import it\n\
                       import own.part, nobodys\ntry:\n    import scipy\nexcept ImportError:\n    pass\n";
        for (path, text) in [
            ("low/usr/lib/python3/dist-packages/rospy/__init__.py", ""),
            ("low/usr/lib/python3/dist-packages/yaml.cpython-311-x86_64-linux-gnu.so", ""),
            ("low/usr/lib/python3.11/os.py", ""),
            ("high/opt/x/lib/python3/dist-packages/own/part.py", ""),
            ("high/opt/x/lib/p/near.py", ""),
            ("high/opt/x/lib/p/run", program),
            ("high/opt/x/lib/p/compiled", "\u{7f}ELF import scipy"),
        ] {
            let path = root.path().join(path);
            std::fs::create_dir_all(path.parent().expect("below")).expect("made");
            std::fs::write(path, text).expect("written");
        }
        let names = ["rospy", "numpy", "cv2", "yaml", "near", "own", "scipy", "os"];
        let text: String =
            names.iter().map(|name| format!("{shared}/{name}/__init__.py python/python3-{name}\n")).collect();
        let lists = [list(root.path(), "c.gz", &text)];
        let contents = Contents::open(root.path(), &lists).expect("read");
        let programs = ["run", "compiled", "gone"];
        let programs = programs.map(|name| (name.to_owned(), format!("/opt/x/lib/p/{name}")));
        let inventory = Inventory {
            prefixes: vec!["/opt/x".to_owned(), "/usr".to_owned()],
            programs: programs.into(),
            ..Inventory::default()
        };
        let trees = ["low", "high"].map(|layer| root.path().join(layer));
        let told = |name: &str| {
            format!("run imports the Python module {name}, which the image lacks: push with `--with python3-{name}`")
        };
        assert_eq!(
            missing_module_advice(&trees, &inventory, AdviceIndex::for_ros1(&contents)),
            [told("cv2"), told("numpy")]
        );
    }
}
