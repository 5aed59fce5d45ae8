//! Coordinate frames that nodes look up, and an identity tree of them.
//!
//! Transform lookups leave no trace in the graph. The names of frames are found in parameters (`~base_frame`), in
//! complaints of nodes (`/rosout`) and, for nodes with default settings, in REP 105. An unnecessary name does no harm:
//! it is another leaf of the tree.

use std::collections::BTreeSet;

use ros::codec::Time;
use serde_json::{Value, json};

/// Root of the tree.
const ROOT: &str = "map";
/// Common default names (REP 105, and the names that drivers give their sensors).
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
/// Maximum number of frames, since a node could name arbitrarily many.
const MAX_FRAMES: usize = 256;

/// Known frames.
#[derive(Debug, Clone)]
pub(super) struct FrameSet(BTreeSet<String>);

impl Default for FrameSet {
    fn default() -> Self {
        Self(USUAL.map(str::to_owned).into())
    }
}

impl FrameSet {
    /// Adds a frame; returns whether it is new.
    pub(super) fn add(&mut self, name: &str) -> bool {
        let name = name.trim_start_matches('/');
        self.0.len() < MAX_FRAMES && is_name(name) && self.0.insert(name.to_owned())
    }

    /// Adds the frames named in a log line; returns whether any is new.
    pub(super) fn add_from_log(&mut self, line: &str) -> bool {
        let named = parse_frame_names(line);
        named.into_iter().fold(false, |new, name| self.add(&name) | new)
    }

    /// Returns a `tf2_msgs/TFMessage` as JSON with an identity transform for every frame.
    pub(super) fn tree(&self, stamp: Time) -> Value {
        let leaf = |name: &String| {
            json!({
                "header": {"frame_id": ROOT, "stamp": {"secs": stamp.secs, "nsecs": stamp.nsecs}},
                "child_frame_id": name,
                "transform": {"rotation": {"w": 1}},
            })
        };
        let leaves: Vec<Value> = self.0.iter().filter(|name| *name != ROOT).map(leaf).collect();
        json!({ "transforms": leaves })
    }
}

/// Returns whether a parameter is likely to contain the name of a frame, judging by its key.
pub(super) fn is_parameter(key: &str) -> bool {
    let last = key.rsplit('/').next().unwrap_or_default();
    ["frame", "frame_id", "frame_name"]
        .iter()
        .any(|end| last == *end || last.strip_suffix(end).is_some_and(|rest| rest.ends_with('_')))
}

fn is_name(text: &str) -> bool {
    text.len() <= 128
        && text.starts_with(|first: char| first.is_ascii_alphabetic())
        && text.chars().all(|char| char.is_ascii_alphanumeric() || "_/.-".contains(char))
}

/// Returns the likely frame names in a line about transforms: words in quotes, words with an underscore, and words
/// after `from`, `to`, `frame` and the like.
fn parse_frame_names(line: &str) -> BTreeSet<String> {
    const FRAME_WORDS: [&str; 9] =
        ["from", "to", "frame", "frames", "frame_id", "id", "target_frame", "source_frame", "and"];
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
        let likely = quoted || bare.contains('_') || FRAME_WORDS.contains(&before.as_str());
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
                 error: canTransform: target_frame hall does not exist. canTransform: source_frame chassis \
                 does not exist.",
                &["chassis", "hall"][..],
            ),
            ("\"left_gripper\" passed to lookupTransform argument target_frame does not exist.", &["left_gripper"]),
            ("Frame id /spine does not exist! Frames (1):", &["spine"]),
            ("Could not transform from 'a/b' to [c]", &["a/b", "c"]),
            ("waiting for the map from nowhere", &[]),
        ] {
            let mut known = FrameSet::default();
            known.add_from_log(line);
            for frame in frames {
                assert!(known.0.contains(*frame), "{frame} in {line:?}: {known:?}");
            }
            assert!(known.0.len() - USUAL.len() >= frames.len(), "{known:?}");
            assert!(!known.0.contains("the") && !known.0.contains("become"), "{known:?}");
        }
    }

    #[test]
    fn every_frame_hangs_below_one_root() {
        let mut frames = FrameSet::default();
        assert!(frames.add("/chassis"));
        assert!(!frames.add("chassis") && !frames.add("no name"));
        let tree = frames.tree(Time { secs: 1, nsecs: 2 });
        let leaves = tree["transforms"].as_array().expect("a list");
        assert_eq!(leaves.len(), USUAL.len());
        let chassis = leaves.iter().find(|leaf| leaf["child_frame_id"] == "chassis").expect("added");
        assert_eq!(chassis["header"]["frame_id"], "map");
        assert!(leaves.iter().all(|leaf| leaf["child_frame_id"] != "map"));
    }

    #[test]
    fn parameters_that_hold_frames_are_known_by_their_names() {
        for key in ["/a/frame_id", "/a/base_frame", "/frame", "/x/costmap/global_frame", "/a/odom_frame_id"] {
            assert!(is_parameter(key), "{key}");
        }
        for key in ["/a/frames_per_second", "/a/framework", "/a/subframe", "/frame/rate"] {
            assert!(!is_parameter(key), "{key}");
        }
    }
}
