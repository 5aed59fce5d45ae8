//! Launch files of an installed package.

use std::collections::BTreeSet;

use crate::Error;
use crate::merged::MergedDirectory;

/// Maximum depth of the search below `share/PACKAGE/launch`.
const MAX_DEPTH: usize = 4;
/// Maximum number of files reported for a package.
const MAX_FILES: usize = 1000;

/// File name suffixes of launch files in any directory: of ROS 1, and of ROS 2's parsers.
const ENDS: [&str; 5] = [".launch", "launch.py", "launch.xml", "launch.yaml", "launch.yml"];
/// Further suffixes of launch files in a directory `launch`.
const EXTENSIONS: [&str; 4] = [".py", ".xml", ".yaml", ".yml"];

/// Returns the launch files of a package as paths below `own`, its share directory.
pub(super) fn find_launch_files(own: &MergedDirectory) -> Result<BTreeSet<String>, Error> {
    let mut found = BTreeSet::new();
    for (name, level) in own.names()? {
        let Ok(name) = String::from_utf8(name) else {
            continue;
        };
        if is_launch_file(&name) && !level.is_deletion(name.as_bytes()) {
            found.insert(name);
        } else if name == "launch" {
            collect_launch_files(&own.open_child(b"launch")?, &name, MAX_DEPTH, &mut found)?;
        }
    }
    Ok(found)
}

fn collect_launch_files(
    directory: &MergedDirectory,
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
        let inside = directory.open_child(&name)?;
        if inside.exists() {
            if depth > 0 {
                collect_launch_files(&inside, &inner, depth - 1, found)?;
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
