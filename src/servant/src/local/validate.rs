//! Validation of a container's description before anything is created.

use std::collections::BTreeSet;
use std::path::{Component, Path};

use crate::Error;
use crate::container::{ContainerSpec, Profile};

/// Maximum number of mounts, whose descriptors are sent to the shim one by one.
const MOUNTS: usize = 128;

/// Returns an error if the description is invalid.
pub(super) fn validate(spec: &ContainerSpec) -> Result<(), Error> {
    find_problem(spec).map_or(Ok(()), |reason| Err(Error::InvalidSpec { id: spec.id.clone(), reason }))
}

fn find_problem(spec: &ContainerSpec) -> Option<String> {
    let allowed = |byte: u8| byte.is_ascii_lowercase() || byte.is_ascii_digit() || byte == b'-';
    if spec.id.is_empty() || spec.id.len() > 48 || !spec.id.bytes().all(allowed) || spec.id.starts_with('-') {
        return Some("an id has 1 to 48 of a-z, 0-9 and -, and does not begin with -".into());
    }
    if spec.layers.is_empty() {
        return Some("it has no layers: give at least one directory".into());
    }
    if let Some(layer) = spec.layers.iter().find(|layer| !layer.is_absolute() || !layer.is_dir()) {
        return Some(format!("layer {} is not a directory with an absolute path", layer.display()));
    }
    match (&spec.writable, spec.profile) {
        (None, Profile::Compile | Profile::Install) => {
            return Some("a build needs a writable directory".into());
        }
        (Some(path), _) if !is_plain_path(path) || path.parent().is_none() => {
            return Some(format!("the writable directory {} needs an absolute path", path.display()));
        }
        _ => {}
    }
    if let Some(path) = spec.owned_directories.iter().find(|path| !is_plain_path(path)) {
        return Some(format!("owned directory {} needs an absolute path without dots", path.display()));
    }
    if spec.writable.is_none() && !spec.owned_directories.is_empty() {
        return Some("owned directories need a writable directory to be made in".into());
    }
    if spec.mounts.len() > MOUNTS {
        return Some(format!("it has more than {MOUNTS} mounts"));
    }
    for mount in &spec.mounts {
        if !is_plain_path(&mount.target) || mount.target.parent().is_none() {
            return Some(format!("mount target {} needs an absolute path without dots", mount.target.display()));
        }
        let there = mount.opened.is_some() || mount.source.exists();
        if !mount.source.is_absolute() || !there {
            return Some(format!("mount source {} does not exist", mount.source.display()));
        }
    }
    let unprintable = |name: &str| name.is_empty() || name.contains(char::is_whitespace);
    if let Some((_, name)) = spec.hosts.iter().find(|(_, name)| unprintable(name)) {
        return Some(format!("{name:?} is not a host name"));
    }
    if let Err(unusable) = spec.limits.check() {
        return Some(unusable.to_string());
    }
    let mut names = BTreeSet::new();
    for node in &spec.nodes {
        if node.name.is_empty() || !names.insert(&node.name) {
            return Some(format!("node name {:?} is empty or given twice", node.name));
        }
        if node.argv.first().is_none_or(|program| !program.starts_with('/')) {
            return Some(format!("node {} needs the absolute path of its program", node.name));
        }
    }
    let variables = spec.nodes.iter().flat_map(|node| &node.environment).chain(&spec.environment);
    for (name, value) in variables {
        if name.is_empty() || name.contains(['=', '\0']) || value.contains('\0') {
            return Some(format!("environment variable {name:?} cannot be passed to a program"));
        }
    }
    None
}

/// Returns whether the path is absolute and contains neither `.` nor `..`.
fn is_plain_path(path: &Path) -> bool {
    path.is_absolute() && path.components().all(|part| matches!(part, Component::RootDir | Component::Normal(_)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::container::Mount;
    use crate::spec::{Limits, NodeSpec, Size};

    fn good() -> ContainerSpec {
        ContainerSpec {
            id: "a-1".into(),
            layers: vec!["/usr".into()],
            writable: None,
            profile: Profile::Servant,
            limits: Limits::default(),
            environment: Default::default(),
            nodes: vec![],
            owned_directories: vec![],
            mounts: vec![],
            hosts: Vec::new(),
            resident: serde_json::Value::Null,
        }
    }

    fn node(name: &str, program: &str) -> NodeSpec {
        serde_json::from_value(serde_json::json!({ "name": name, "argv": [program] })).unwrap()
    }

    #[test]
    fn each_fault_is_named() {
        assert_eq!(find_problem(&good()), None);
        let mount = |target: &str| Mount {
            source: "/usr".into(),
            target: target.into(),
            writable: false,
            device: false,
            opened: None,
        };
        let faults = [
            (ContainerSpec { id: "A".into(), ..good() }, "an id has"),
            (ContainerSpec { id: "../x".into(), ..good() }, "an id has"),
            (ContainerSpec { layers: vec![], ..good() }, "no layers"),
            (ContainerSpec { layers: vec!["/nonexistent".into()], ..good() }, "/nonexistent"),
            (ContainerSpec { profile: Profile::Compile, ..good() }, "writable"),
            (ContainerSpec { mounts: vec![mount("/a/../b")], ..good() }, "/a/../b"),
            (ContainerSpec { mounts: vec![mount("/")], ..good() }, "mount target /"),
            (ContainerSpec { limits: Limits { cpus: Some(f64::NAN), ..Limits::default() }, ..good() }, "cpus = NaN"),
            (ContainerSpec { limits: Limits { memory: Some(Size(1)), ..Limits::default() }, ..good() }, "4M"),
            (ContainerSpec { nodes: vec![node("/a", "true")], ..good() }, "absolute path of its program"),
            (ContainerSpec { nodes: vec![node("/a", "/x"), node("/a", "/x")], ..good() }, "given twice"),
            (ContainerSpec { environment: [("A=B".into(), "".into())].into(), ..good() }, "A=B"),
        ];
        for (spec, words) in faults {
            let text = find_problem(&spec).unwrap_or_else(|| panic!("{words} was not noticed"));
            assert!(text.contains(words), "{text}");
        }
    }
}
