//! Nodelets of an outsourced package must not be loaded into a manager on the robot. The original may be installed
//! besides the stub, and its library would be loaded silently, so the stub's plugin lists name a nonexistent library
//! whose name is the explanation: pluginlib and nodelet print it.

use std::collections::{BTreeMap, BTreeSet};

use super::{Content, StubInfo};

/// Returns the nodelet plugin lists exported by the package, as paths in its share directory.
pub(super) fn plugin_lists(share: &BTreeMap<String, Content>) -> BTreeSet<String> {
    let Some(Content::File { bytes, .. }) = share.get("package.xml") else {
        return BTreeSet::new();
    };
    let Ok(text) = std::str::from_utf8(bytes) else {
        return BTreeSet::new();
    };
    let Ok(document) = crate::xml::parse(text) else {
        return BTreeSet::new();
    };
    document
        .descendants()
        .filter(|node| node.has_tag_name("nodelet"))
        .filter_map(|node| node.attribute("plugin"))
        .filter_map(|path| path.strip_prefix("${prefix}/"))
        .map(|path| path.trim_start_matches("./").to_owned())
        .filter(|path| share.contains_key(path))
        .collect()
}

/// Returns a plugin list with the same classes, none of which can be loaded.
pub(super) fn unloadable_plugin_list(about: &StubInfo<'_>, content: Content) -> Content {
    let Content::File { bytes, .. } = &content else {
        return content;
    };
    let text = String::from_utf8_lossy(bytes);
    // A list that is not XML loads nothing either.
    let Ok(document) = crate::xml::parse(&text) else {
        return content;
    };
    let mut list = format!(
        "<library path=\"{} runs in the cloud: its nodelets cannot be loaded into a manager on this robot; \
         start its executables or launch files instead\">\n",
        about.package
    );
    for class in document.descendants().filter(|node| node.has_tag_name("class")) {
        list.push_str("  <class");
        for name in ["name", "type", "base_class_type"] {
            if let Some(value) = class.attribute(name) {
                list.push_str(&format!(" {name}=\"{}\"", escape_xml(value)));
            }
        }
        list.push_str("/>\n");
    }
    list.push_str("</library>\n");
    Content::File { bytes: list.into_bytes(), executable: false }
}

pub(super) fn escape_xml(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('"', "&quot;")
}
