//! Coordinate frames that nodes ask for, and an identity tree of them.
//!
//! A lookup of a transform leaves no trace in the graph. The names of frames are in parameters (`~base_frame`), in
//! what nodes complain of (`/rosout`), and, where a node keeps to its defaults, those of REP 105. A name too many does
//! no harm: it is one more leaf of the tree.

use std::collections::BTreeSet;

use ros::codec::Time;
use serde_json::{Value, json};

/// The root of the tree.
const ROOT: &str = "map";
/// Names that nodes use unless they are told others (REP 105, and what drivers call their sensors).
const USUAL: [&str; 13] = [
    "map",
    "odom",
    "odom_combined",
    "world",
    "earth",
    "base_link",
    "base_footprint",
    "base_stabilized",
    "laser",
    "base_laser",
    "base_laser_link",
    "camera_link",
    "imu_link",
];
/// A tree of more is of no use, and a node could make it as large as it likes.
const MOST: usize = 256;

/// Frames known so far.
#[derive(Debug, Clone)]
pub(super) struct Frames(BTreeSet<String>);

impl Default for Frames {
    fn default() -> Self {
        Self(USUAL.map(str::to_owned).into())
    }
}

impl Frames {
    /// Adds a frame; whether it is new.
    pub(super) fn add(&mut self, name: &str) -> bool {
        let name = name.trim_start_matches('/');
        self.0.len() < MOST && is_name(name) && self.0.insert(name.to_owned())
    }

    /// Adds what a line of a node's log names; whether any of it is new.
    pub(super) fn hear(&mut self, line: &str) -> bool {
        let named = named(line);
        named
            .into_iter()
            .fold(false, |new, name| self.add(&name) | new)
    }

    /// A `tf2_msgs/TFMessage` as JSON: every frame where its parent is.
    pub(super) fn tree(&self, stamp: Time) -> Value {
        let leaf = |name: &String| {
            json!({
                "header": {"frame_id": ROOT, "stamp": {"secs": stamp.secs, "nsecs": stamp.nsecs}},
                "child_frame_id": name,
                "transform": {"rotation": {"w": 1}},
            })
        };
        let leaves: Vec<Value> = self
            .0
            .iter()
            .filter(|name| *name != ROOT)
            .map(leaf)
            .collect();
        json!({ "transforms": leaves })
    }
}

/// Whether a parameter's key says that its value is a frame.
pub(super) fn is_parameter(key: &str) -> bool {
    let last = key.rsplit('/').next().unwrap_or_default();
    ["frame", "frame_id", "frame_name"].iter().any(|end| {
        last == *end
            || last
                .strip_suffix(end)
                .is_some_and(|rest| rest.ends_with('_'))
    })
}

fn is_name(text: &str) -> bool {
    text.len() <= 128
        && text.starts_with(|first: char| first.is_ascii_alphabetic())
        && text
            .chars()
            .all(|char| char.is_ascii_alphanumeric() || "_/.-".contains(char))
}

/// Words that a line about transforms uses for frames: quoted ones, those with an underscore, and those after `from`,
/// `to`, `frame` and the like.
fn named(line: &str) -> BTreeSet<String> {
    const BEFORE: [&str; 9] = [
        "from",
        "to",
        "frame",
        "frames",
        "frame_id",
        "id",
        "target_frame",
        "source_frame",
        "and",
    ];
    const NEVER: [&str; 14] = [
        "to",
        "from",
        "the",
        "become",
        "be",
        "available",
        "frame",
        "frames",
        "does",
        "not",
        "target_frame",
        "source_frame",
        "transform",
        "tf",
    ];
    let lower = line.to_lowercase();
    if !lower.contains("frame") && !lower.contains("transform") {
        return BTreeSet::new();
    }
    let mut names = BTreeSet::new();
    let mut before = String::new();
    for word in line.split_whitespace() {
        let bare = word.trim_matches(|char: char| !char.is_ascii_alphanumeric() && char != '_');
        let quoted = word.starts_with(['"', '\'', '[', '`']);
        let likely = quoted || bare.contains('_') || BEFORE.contains(&before.as_str());
        if likely && is_name(bare) && !NEVER.contains(&bare) {
            names.insert(bare.to_owned());
        }
        before = bare.to_lowercase();
    }
    names
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_heard_in_what_nodes_complain_of() {
        for (line, frames) in [
            (
                "Timed out waiting for transform from chassis to hall to become available before running costmap, tf \
                 error: canTransform: target_frame hall does not exist. canTransform: source_frame chassis does not exist.",
                &["chassis", "hall"][..],
            ),
            (
                "\"left_gripper\" passed to lookupTransform argument target_frame does not exist.",
                &["left_gripper"],
            ),
            ("Frame id /spine does not exist! Frames (1):", &["spine"]),
            ("Could not transform from 'a/b' to [c]", &["a/b", "c"]),
            ("waiting for the map from nowhere", &[]),
        ] {
            let mut known = Frames::default();
            known.hear(line);
            for frame in frames {
                assert!(known.0.contains(*frame), "{frame} in {line:?}: {known:?}");
            }
            assert!(known.0.len() - USUAL.len() >= frames.len(), "{known:?}");
            assert!(
                !known.0.contains("the") && !known.0.contains("become"),
                "{known:?}"
            );
        }
    }

    #[test]
    fn every_frame_hangs_below_one_root() {
        let mut frames = Frames::default();
        assert!(frames.add("/chassis"));
        assert!(!frames.add("chassis") && !frames.add("no name"));
        let tree = frames.tree(Time { secs: 1, nsecs: 2 });
        let leaves = tree["transforms"].as_array().expect("a list");
        assert_eq!(leaves.len(), USUAL.len());
        let chassis = leaves
            .iter()
            .find(|leaf| leaf["child_frame_id"] == "chassis")
            .expect("added");
        assert_eq!(chassis["header"]["frame_id"], "map");
        assert!(leaves.iter().all(|leaf| leaf["child_frame_id"] != "map"));
    }

    #[test]
    fn parameters_that_hold_frames_are_known_by_their_names() {
        for key in [
            "/a/frame_id",
            "/a/base_frame",
            "/frame",
            "/x/costmap/global_frame",
            "/a/odom_frame_id",
        ] {
            assert!(is_parameter(key), "{key}");
        }
        for key in [
            "/a/frames_per_second",
            "/a/framework",
            "/a/subframe",
            "/frame/rate",
        ] {
            assert!(!is_parameter(key), "{key}");
        }
    }
}
