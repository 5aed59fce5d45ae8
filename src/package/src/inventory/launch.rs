//! Launch files of an installed package.

use std::collections::BTreeSet;

use crate::Error;
use crate::merged::Merged;

/// How deep below `share/PACKAGE/launch` files are looked for.
const MAX_DEPTH: usize = 4;
/// Files of one package that are told.
const MAX_FILES: usize = 1000;

/// Ends of names by which launch files are known wherever they are: of ROS 1, and those of ROS 2's parsers.
const ENDS: [&str; 5] = [
    ".launch",
    "launch.py",
    "launch.xml",
    "launch.yaml",
    "launch.yml",
];
/// In a directory of that name these are launch files, too.
const EXTENSIONS: [&str; 4] = [".py", ".xml", ".yaml", ".yml"];

/// Those of a package, by their paths below `own`, its directory in `share`.
pub(super) fn files(own: &Merged) -> Result<BTreeSet<String>, Error> {
    let mut found = BTreeSet::new();
    for (name, level) in own.names()? {
        let Ok(name) = String::from_utf8(name) else {
            continue;
        };
        if is_launch_file(&name) && !level.is_deletion(name.as_bytes()) {
            found.insert(name);
        } else if name == "launch" {
            below(&own.below(b"launch")?, &name, MAX_DEPTH, &mut found)?;
        }
    }
    Ok(found)
}

fn below(
    directory: &Merged,
    path: &str,
    depth: usize,
    found: &mut BTreeSet<String>,
) -> Result<(), Error> {
    for (name, level) in directory.names()? {
        let Ok(text) = String::from_utf8(name.clone()) else {
            continue;
        };
        if found.len() >= MAX_FILES {
            return Ok(());
        }
        let inner = format!("{path}/{text}");
        let inside = directory.below(&name)?;
        if inside.exists() {
            if depth > 0 {
                below(&inside, &inner, depth - 1, found)?;
            }
        } else if (is_launch_file(&text) || EXTENSIONS.iter().any(|end| text.ends_with(end)))
            && !text.starts_with("__")
            && !level.is_deletion(&name)
        {
            found.insert(inner);
        }
    }
    Ok(())
}

fn is_launch_file(name: &str) -> bool {
    !name.starts_with('.') && ENDS.iter().any(|end| name.ends_with(end))
}
