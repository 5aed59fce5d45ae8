//! Install spaces of an image: where its packages have their programs and what they share.

use std::collections::BTreeSet;
use std::path::{Component, Path, PathBuf};

use store::RevisionRecord;

use crate::definitions;

/// Install spaces of a revision with these layers, as its environment and its nodes name them, absolute, in the order in
/// which they are searched.
pub fn prefixes(revision: &RevisionRecord, layers: &[PathBuf]) -> Vec<PathBuf> {
    let plan = &revision.plan;
    let paths = plan
        .environment
        .get("CMAKE_PREFIX_PATH")
        .map_or("", String::as_str);
    let mut prefixes: Vec<PathBuf> = std::env::split_paths(paths).collect();
    let programs = plan.nodes.iter().filter_map(|node| node.argv.first());
    prefixes.extend(
        programs.filter_map(|program| Some(Path::new(program).ancestors().nth(3)?.to_owned())),
    );
    prefixes.push("/usr".into());
    for layer in layers {
        let distributions = definitions::directories(layer, "opt/ros");
        prefixes.extend(distributions.iter().map(|path| Path::new("/").join(path)));
    }
    let mut seen = BTreeSet::new();
    let below = |prefix: &PathBuf| {
        let mut parts = prefix.components();
        prefix.is_absolute() && parts.all(|part| part != Component::ParentDir)
    };
    prefixes.retain(|prefix| below(prefix) && seen.insert(prefix.clone()));
    prefixes
}
