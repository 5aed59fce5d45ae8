//! Contents of a package for robots of the other ROS than the service's. They get what does not depend on the ROS
//! (parameters, maps, models), launch files of their own ROS, where the package has them, and a manifest without
//! dependencies that they cannot have. Programs and definitions are those of the service's ROS: launchers and twins
//! stand in for them.

use std::collections::BTreeSet;
use std::ops::Bound;
use std::path::Path;

use ros::bus::RosVersion;
use roxmltree::Node;

use super::nodelets::{self, escape_xml};
use super::{Content, Contents, StubInfo, ament};
use crate::condition::Variables;
use crate::manifest::Manifest;

/// Directories of definitions, whose files the interface's definitions replace.
const DEFINITIONS: [&str; 3] = ["msg", "srv", "action"];

/// Returns the part of a package's contents that robots of the other ROS get.
pub(super) fn adapt_contents(about: &StubInfo<'_>, mut contents: Contents) -> Contents {
    for list in nodelets::plugin_lists(&contents.share) {
        contents.share.remove(&list);
    }
    contents.components.clear();
    contents.share.retain(|path, content| match &*content {
        Content::File { executable: true, .. } => false,
        Content::File { bytes, .. } => {
            let is_of_install_space =
                about.service_ros == RosVersion::Two && ament::belongs_to_install_space(path, content);
            !is_of_install_space
                && !is_definition(path)
                && launch_file_ros(path, bytes).is_none_or(|ros| ros == about.ros)
        }
        Content::Link(_) => true,
    });
    // Links lead nowhere if their files were left out.
    let kept: BTreeSet<String> = contents.share.keys().cloned().collect();
    contents.share.retain(|path, content| match content {
        Content::Link(target) => is_kept(path, target, &kept),
        Content::File { .. } => true,
    });
    if let Some(Content::File { bytes, .. }) = contents.share.get_mut("package.xml") {
        *bytes = manifest(about, bytes).into_bytes();
    }
    contents
}

fn is_definition(path: &str) -> bool {
    let (top, name) = path.split_once('/').unwrap_or_default();
    let ending = name.rsplit_once('.').map(|(_, ending)| ending);
    DEFINITIONS.contains(&top) && ending.is_some_and(|ending| ending == top || matches!(ending, "idl" | "json"))
}

/// Returns whether a link at `path` leads to a file, or to a directory with files, among `kept`.
fn is_kept(path: &str, target: &str, kept: &BTreeSet<String>) -> bool {
    let mut parts: Vec<&str> = path.split('/').collect();
    parts.pop();
    for part in target.split('/') {
        match part {
            "" | "." => {}
            ".." => drop(parts.pop()),
            part => parts.push(part),
        }
    }
    let target = parts.join("/");
    // Not by reading all names: a package may have as many links as files.
    let below = format!("{target}/");
    let first = kept.range::<str, _>((Bound::Included(below.as_str()), Bound::Unbounded)).next();
    kept.contains(&target) || first.is_some_and(|path| path.starts_with(&below))
}

/// Returns the ROS whose tools read a launch file; `None` for other files, and for launch files that say nothing of one
/// ROS alone.
fn launch_file_ros(path: &str, bytes: &[u8]) -> Option<RosVersion> {
    let name = path.rsplit('/').next().unwrap_or(path);
    // launch's parsers; ROS 1 has none for these.
    if ["launch.py", "launch.yaml", "launch.yml"].iter().any(|ending| name.ends_with(ending)) {
        return Some(RosVersion::Two);
    }
    let is_launch = name.ends_with(".launch");
    if !is_launch && !name.ends_with(".xml") {
        return None;
    }
    let usual = is_launch.then_some(RosVersion::One);
    let text = std::str::from_utf8(bytes).unwrap_or_default();
    let Ok(document) = crate::xml::parse(text) else {
        return usual;
    };
    if !document.root_element().has_tag_name("launch") {
        return usual;
    }
    // The attribute for a node's program, and the substitution for a package's directory, have other names.
    let nodes = || document.descendants().filter(Node::is_element);
    let says = |sign: fn(&Node<'_, '_>) -> bool| nodes().any(|node| sign(&node));
    let substitutes = |word: &str| nodes().any(|node| node.attributes().any(|of| of.value().contains(word)));
    if says(|node| node.has_tag_name("node") && node.has_attribute("exec"))
        || substitutes("$(find-pkg-share ")
        || substitutes("$(var ")
    {
        return Some(RosVersion::Two);
    }
    if says(|node| node.has_tag_name("node") && node.has_attribute("type"))
        || substitutes("$(find ")
        || substitutes("$(arg ")
    {
        return Some(RosVersion::One);
    }
    usual
}

/// Returns the manifest of the stub. Tools need one to find the package; its dependencies are the original's.
fn manifest(about: &StubInfo<'_>, original: &[u8]) -> String {
    let text = String::from_utf8_lossy(original);
    let variables = Variables::for_distribution(about.service_ros.number(), "");
    // Of a manifest that cannot be read tools need no more than a valid one.
    let read = Manifest::parse(&text, Path::new("package.xml"), &variables);
    let (version, licenses) = read.map(|manifest| (manifest.version, manifest.licenses)).unwrap_or_default();
    let version = if version.is_empty() { "0.0.0" } else { &version };
    let license = if licenses.is_empty() { "see the original".to_owned() } else { licenses.join(", ") };
    manifest_head(about, about.package, version, &license, "Stub of a package") + "</package>\n"
}

/// Returns the beginning of a manifest of format 2 (REP 140), which tools of both ROSes read.
pub(super) fn manifest_head(about: &StubInfo<'_>, package: &str, version: &str, license: &str, what: &str) -> String {
    let (ros, service_ros) = (about.ros.number(), about.service_ros.number());
    let (version, license, service) = (escape_xml(version), escape_xml(license), escape_xml(about.service));
    format!(
        "<?xml version=\"1.0\"?>\n<package format=\"2\">\n  <name>{package}</name>\n  <version>{version}</version>\n  \
         <description>{what} of ROS {service_ros} for robots of ROS {ros}, made for the service \
         {service}</description>\n  <maintainer email=\"cloudroid@localhost\">Cloudroid</maintainer>\n  \
         <license>{license}</license>\n"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn launch_files_are_known_by_what_is_in_them() {
        use RosVersion::{One, Two};
        let node_one = "<launch><node pkg='p' type='n' name='n'/></launch>";
        let node_two = "<launch><group><node pkg='p' exec='n'/></group></launch>";
        for (path, text, expected) in [
            ("launch/a.launch.py", "", Some(Two)),
            ("launch/a_launch.yaml", "", Some(Two)),
            ("launch/a.launch", node_one, Some(One)),
            ("launch/a.launch", node_two, Some(Two)),
            ("launch/a.launch.xml", node_one, Some(One)),
            ("launch/a.launch.xml", node_two, Some(Two)),
            ("launch/includes/a.xml", "<launch><include file='$(find p)/b.launch'/></launch>", Some(One)),
            ("launch/a.xml", "<launch><include file='$(find-pkg-share p)/b.xml'/></launch>", Some(Two)),
            ("launch/a.launch", "<launch>", Some(One)),
            ("launch/a.launch.xml", "<launch/>", None),
            ("nodelets.xml", "<library/>", None),
            ("config/p.yaml", "", None),
        ] {
            assert_eq!(launch_file_ros(path, text.as_bytes()), expected, "{path} {text}");
        }
    }

    #[test]
    fn many_links_among_many_files_are_looked_at_in_no_time() {
        let kept: BTreeSet<String> = (0..100_000).map(|number| format!("maps/lab/tiles/tile-{number}.png")).collect();
        let begun = std::time::Instant::now();
        assert!((0..50_000).all(|_| !is_kept("launch/link", "../maps/lab/tiles/tile", &kept)));
        assert!(begun.elapsed() < std::time::Duration::from_secs(20), "{:?}", begun.elapsed());
    }

    #[test]
    fn links_are_kept_with_their_files() {
        let kept = ["launch/a.launch", "maps/lab-2", "maps/lab/map.yaml"].map(str::to_owned).into();
        for (path, target, expected) in [
            ("launch/same", "a.launch", true),
            ("same", "launch/a.launch", true),
            ("launch/map", "../maps/lab", true),
            ("launch/gone", "b.launch", false),
            ("launch/part", "a.lau", false),
            ("launch/all", "../maps/la", false),
            ("launch/file", "../maps/lab-2", true),
        ] {
            assert_eq!(is_kept(path, target, &kept), expected, "{path} -> {target}");
        }
    }
}
