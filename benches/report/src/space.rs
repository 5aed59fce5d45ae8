//! A prebuilt install space whose launch file starts `relay /in /out`, a roscpp node that registers at once.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};

/// Writes the install space of `package` in `place`, with this node or that of `topic_tools`.
pub fn write_install_space(place: &Path, package: &str, executable: Option<&Path>) -> Result<PathBuf> {
    let space = place.join(package);
    let share = space.join("share").join(package);
    fs::create_dir_all(share.join("launch"))?;
    let manifest = format!(
        "<package format=\"2\"><name>{package}</name><version>1.0.0</version>\
         <description>One relay.</description><maintainer email=\"bench@example.org\">Bench</maintainer>\
         <license>Apache-2.0</license><buildtool_depend>catkin</buildtool_depend>\
         <exec_depend>topic_tools</exec_depend></package>\n"
    );
    let holder = if executable.is_some() { package } else { "topic_tools" };
    let launch = format!("<launch><node name=\"relay\" pkg=\"{holder}\" type=\"relay\" args=\"/in /out\"/></launch>\n");
    for (path, text) in [
        (space.join(".catkin"), ""),
        (space.join("setup.sh"), "# It runs wherever it is put.\n"),
        (share.join("package.xml"), &manifest),
        (share.join("launch/relay.launch"), &launch),
    ] {
        fs::write(&path, text).with_context(|| format!("writing {}", path.display()))?;
    }
    if let Some(executable) = executable {
        let directory = space.join("lib").join(package);
        fs::create_dir_all(&directory)?;
        fs::copy(executable, directory.join("relay")).with_context(|| format!("copying {}", executable.display()))?;
    }
    Ok(space)
}
