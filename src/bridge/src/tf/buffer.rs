//! The latest transform of every frame, heard on `/tf` and `/tf_static`.

use std::collections::HashMap;
use std::sync::Arc;

use parking_lot::Mutex;
use ros::codec::{Time, Value};
use ros::schema::MessageType;

use super::transform::Transform;
use crate::fanout::{Listener, Listening};
use crate::sample::Sample;
use crate::shared::Shared;

/// Frames remembered.
const MAX_FRAMES: usize = 10_000;
/// Links between a frame and the root.
const MAX_DEPTH: usize = 1000;

/// What is known now; listens for as long as it lives.
pub(super) struct Buffer {
    frames: Arc<Frames>,
    _listening: [Listening; 2],
}

#[derive(Default)]
pub(super) struct Frames {
    /// By child.
    links: Mutex<HashMap<String, Link>>,
}

/// Where a frame is.
struct Link {
    parent: String,
    transform: Transform,
    /// When it was there; none where it never moves.
    time: Option<Time>,
}

/// Where one frame is, seen from another.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Found {
    pub(super) transform: Transform,
    /// The latest time for which all that lies between them is known; none where nothing of it ever moves.
    pub(super) time: Option<Time>,
}

/// Hears one of the topics.
struct Ear {
    frames: Arc<Frames>,
    /// What it says holds for ever.
    fixed: bool,
}

impl Listener for Ear {
    fn sample(&self, sample: &Arc<Sample>, _replay: bool) {
        if let Ok(schema) = sample.schema() {
            self.frames.hear(&schema, &sample.bytes, self.fixed);
        }
    }

    fn failed(&self, reason: &str) {
        tracing::warn!("transforms cannot be heard: {reason}");
    }
}

impl Buffer {
    pub(super) fn new(shared: &Arc<Shared>) -> Self {
        let frames = Arc::new(Frames::default());
        let listening = [("/tf", false), ("/tf_static", true)].map(|(topic, fixed)| {
            let frames = frames.clone();
            let ear = Arc::new(Ear { frames, fixed });
            shared.fanout(topic, None).listen(ear)
        });
        Self {
            frames,
            _listening: listening,
        }
    }

    /// Where `source` is, seen from `target`.
    pub(super) fn find(&self, target: &str, source: &str) -> Option<Found> {
        self.frames.find(target, source)
    }
}

impl Frames {
    /// Takes a `tf2_msgs/TFMessage` (or `tf/tfMessage`, which is the same).
    fn hear(&self, schema: &MessageType, bytes: &[u8], fixed: bool) {
        let said = Value::read(schema, bytes);
        let transforms = said.as_ref().and_then(|said| said.field("transforms"));
        let mut links = self.links.lock();
        for stamped in transforms.map(Value::items).unwrap_or_default() {
            let Some((child, mut link)) = read(stamped) else {
                continue;
            };
            let Some(transform) = link.transform.normalized() else {
                continue;
            };
            link.transform = transform;
            link.time = link.time.filter(|_| !fixed);
            if links.len() < MAX_FRAMES || links.contains_key(&child) {
                links.insert(child, link);
            }
        }
    }

    fn find(&self, target: &str, source: &str) -> Option<Found> {
        let links = self.links.lock();
        // Where the source is in each frame above it.
        let mut above = HashMap::new();
        let mut at = source;
        let mut path = Found {
            transform: Transform::IDENTITY,
            time: None,
        };
        loop {
            // A loop: somebody publishes nonsense.
            if above.len() > MAX_DEPTH || above.insert(at, path).is_some() {
                return None;
            }
            let Some(link) = links.get(at) else { break };
            path = link.before(path);
            at = &link.parent;
        }
        // Up from the target to the first of them: what is above that matters to neither.
        at = target;
        let mut to = Found {
            transform: Transform::IDENTITY,
            time: None,
        };
        for _ in 0..MAX_DEPTH {
            if let Some(from) = above.get(at) {
                return Some(Found {
                    transform: to.transform.inverse().after(&from.transform),
                    time: earlier(to.time, from.time),
                });
            }
            let link = links.get(at)?;
            to = link.before(to);
            at = &link.parent;
        }
        None
    }
}

impl Link {
    /// Where something is in the parent, that is there in the child.
    fn before(&self, found: Found) -> Found {
        Found {
            transform: self.transform.after(&found.transform),
            time: earlier(self.time, found.time),
        }
    }
}

/// The earlier of two times; what never moves is as it was at any of them.
fn earlier(one: Option<Time>, other: Option<Time>) -> Option<Time> {
    match (one, other) {
        (Some(one), Some(other)) => Some(one.min(other)),
        (one, other) => one.or(other),
    }
}

/// tf2 has no leading slashes, tf had.
pub(super) fn plain(frame: &str) -> &str {
    frame.trim_start_matches('/')
}

/// Child and place of a `geometry_msgs/TransformStamped`.
fn read(stamped: &Value<'_>) -> Option<(String, Link)> {
    let header = stamped.field("header")?;
    let moved = stamped.field("transform")?;
    let number = |of: &str, axis: &str| moved.field(of)?.field(axis)?.number();
    let frame = |name: &Value<'_>| Some(plain(&name.text()?).to_owned());
    let transform = Transform {
        translation: [
            number("translation", "x")?,
            number("translation", "y")?,
            number("translation", "z")?,
        ],
        rotation: [
            number("rotation", "x")?,
            number("rotation", "y")?,
            number("rotation", "z")?,
            number("rotation", "w")?,
        ],
    };
    let link = Link {
        parent: frame(header.field("frame_id")?)?,
        transform,
        time: header.field("stamp")?.time(),
    };
    Some((frame(stamped.field("child_frame_id")?)?, link))
}

#[cfg(test)]
mod tests {
    use ros::bus::RosVersion;
    use ros::schema::Registry;

    use super::*;
    use crate::tf::write_transforms;

    fn step(x: f64) -> Transform {
        Transform {
            translation: [x, 0.0, 0.0],
            ..Transform::IDENTITY
        }
    }

    fn at(secs: u32) -> Time {
        Time { secs, nsecs: 0 }
    }

    /// The same as `tf2_msgs/TFMessage`.
    fn schema() -> Arc<MessageType> {
        let registry = Registry::new();
        crate::tf::define(RosVersion::One, &registry);
        registry.message("tf2_web_republisher/TFArray").unwrap()
    }

    fn said(links: &[(&str, &str, f64, u32)]) -> Vec<u8> {
        let links = links.iter();
        let links = links.map(|(parent, child, x, secs)| (*parent, *child, step(*x), at(*secs)));
        write_transforms(&schema(), links).unwrap()
    }

    impl Frames {
        fn hears(&self, bytes: &[u8], fixed: bool) {
            self.hear(&schema(), bytes, fixed);
        }
    }

    #[test]
    fn frames_are_found_through_their_common_ancestor() {
        let frames = Frames::default();
        let message = said(&[
            ("/map", "base", 1.0, 1),
            ("base", "arm", 2.0, 1),
            ("map", "dock", 10.0, 1),
        ]);
        frames.hears(&message, false);
        let x = |target, source| Some(frames.find(target, source)?.transform.translation[0]);
        assert_eq!(x("dock", "arm"), Some(-7.0));
        assert_eq!(x("arm", "map"), Some(-3.0));
        assert_eq!(x("map", "map"), Some(0.0));
        assert_eq!(x("map", "nowhere"), None);
        frames.hears(&said(&[("base", "arm", 5.0, 2)]), false);
        assert_eq!(x("base", "arm"), Some(5.0));
    }

    #[test]
    fn a_transform_is_as_old_as_the_oldest_that_it_is_made_of() {
        let frames = Frames::default();
        frames.hears(
            &said(&[
                ("earth", "map", 1.0, 3),
                ("map", "base", 1.0, 7),
                ("base", "arm", 1.0, 9),
            ]),
            false,
        );
        frames.hears(
            &said(&[("base", "laser", 1.0, 1), ("laser", "dot", 1.0, 1)]),
            true,
        );
        let time = |target, source| frames.find(target, source).unwrap().time;
        assert_eq!(time("base", "arm"), Some(at(9)));
        assert_eq!(time("map", "arm"), Some(at(7)));
        assert_eq!(time("earth", "arm"), Some(at(3)));
        // What never moves makes nothing older, and what is above both does not matter.
        assert_eq!(time("laser", "arm"), Some(at(9)));
        assert_eq!(time("base", "dot"), None);
        assert_eq!(time("map", "dot"), Some(at(7)));
    }

    #[test]
    fn nonsense_does_no_harm() {
        let frames = Frames::default();
        frames.hears(&said(&[("a", "b", 1.0, 1), ("b", "a", 1.0, 1)]), false);
        assert_eq!(frames.find("a", "b"), None);
        let whole = said(&[("map", "base", 1.0, 1)]);
        for end in 0..whole.len() {
            frames.hears(&whole[..end], false);
        }
        assert_eq!(frames.find("map", "base"), None);
        frames.hears(&[0xff; 64], false);
    }
}
