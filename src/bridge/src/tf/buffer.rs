//! The latest transform of every frame, heard on `/tf` and `/tf_static`.

use std::collections::HashMap;
use std::sync::Arc;

use parking_lot::Mutex;

use super::transform::Transform;
use crate::hub::{Listener, Listening};
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
    /// By child: its parent, and where it is there.
    links: Mutex<HashMap<String, (String, Transform)>>,
}

impl Listener for Frames {
    fn sample(&self, sample: &Arc<Sample>, _replay: bool) {
        self.hear(&sample.bytes);
    }

    fn failed(&self, reason: &str) {
        tracing::warn!("transforms cannot be heard: {reason}");
    }
}

impl Buffer {
    pub(super) fn new(shared: &Arc<Shared>) -> Self {
        let frames = Arc::new(Frames::default());
        let listening =
            ["/tf", "/tf_static"].map(|topic| shared.hub(topic, None).listen(frames.clone()));
        Self {
            frames,
            _listening: listening,
        }
    }

    /// Where `source` is, seen from `target`.
    pub(super) fn find(&self, target: &str, source: &str) -> Option<Transform> {
        self.frames.find(target, source)
    }
}

impl Frames {
    /// Takes a `tf2_msgs/TFMessage` (or `tf/tfMessage`, which is the same); a torn one as far as it goes.
    fn hear(&self, bytes: &[u8]) {
        let mut reader = Reader { bytes };
        let count = reader.word().unwrap_or(0);
        let mut links = self.links.lock();
        for _ in 0..count {
            let Some((parent, child, transform)) = reader.link() else {
                return;
            };
            let Some(transform) = transform.normalized() else {
                continue;
            };
            if links.len() < MAX_FRAMES || links.contains_key(&child) {
                links.insert(child, (parent, transform));
            }
        }
    }

    fn find(&self, target: &str, source: &str) -> Option<Transform> {
        let links = self.links.lock();
        let up = |frame: &str| {
            let (mut at, mut path) = (frame.to_owned(), Transform::IDENTITY);
            for _ in 0..MAX_DEPTH {
                match links.get(&at) {
                    Some((parent, transform)) => {
                        path = transform.after(&path);
                        at.clone_from(parent);
                    }
                    None => return Some((at, path)),
                }
            }
            // A loop: somebody publishes nonsense.
            None
        };
        let ((root, from), (other_root, to)) = (up(source)?, up(target)?);
        (root == other_root).then(|| to.inverse().after(&from))
    }
}

/// tf2 has no leading slashes, tf had.
pub(super) fn plain(frame: &str) -> &str {
    frame.trim_start_matches('/')
}

struct Reader<'b> {
    bytes: &'b [u8],
}

impl Reader<'_> {
    fn take(&mut self, count: usize) -> Option<&[u8]> {
        let (taken, rest) = self.bytes.split_at_checked(count)?;
        self.bytes = rest;
        Some(taken)
    }

    fn word(&mut self) -> Option<u32> {
        self.take(4)?.try_into().ok().map(u32::from_le_bytes)
    }

    fn number(&mut self) -> Option<f64> {
        self.take(8)?.try_into().ok().map(f64::from_le_bytes)
    }

    fn frame(&mut self) -> Option<String> {
        let length = self.word()? as usize;
        let text = String::from_utf8_lossy(self.take(length)?);
        Some(plain(&text).to_owned())
    }

    /// A `geometry_msgs/TransformStamped`.
    fn link(&mut self) -> Option<(String, String, Transform)> {
        self.take(12)?;
        let (parent, child) = (self.frame()?, self.frame()?);
        let mut numbers = [0.0; 7];
        for number in &mut numbers {
            *number = self.number()?;
        }
        let [x, y, z, rx, ry, rz, rw] = numbers;
        let transform = Transform {
            translation: [x, y, z],
            rotation: [rx, ry, rz, rw],
        };
        Some((parent, child, transform))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tf::write_transforms;

    fn step(x: f64) -> Transform {
        Transform {
            translation: [x, 0.0, 0.0],
            ..Transform::IDENTITY
        }
    }

    #[test]
    fn frames_are_found_through_their_common_ancestor() {
        let frames = Frames::default();
        let message = write_transforms([
            ("/map", "base", step(1.0)),
            ("base", "arm", step(2.0)),
            ("map", "dock", step(10.0)),
        ]);
        frames.hear(&message);
        assert_eq!(
            frames.find("dock", "arm").unwrap().translation,
            [-7.0, 0.0, 0.0]
        );
        assert_eq!(
            frames.find("arm", "map").unwrap().translation,
            [-3.0, 0.0, 0.0]
        );
        assert_eq!(frames.find("map", "map"), Some(Transform::IDENTITY));
        assert_eq!(frames.find("map", "nowhere"), None);
        frames.hear(&write_transforms([("base", "arm", step(5.0))]));
        assert_eq!(
            frames.find("base", "arm").unwrap().translation,
            [5.0, 0.0, 0.0]
        );
    }

    #[test]
    fn nonsense_does_no_harm() {
        let frames = Frames::default();
        frames.hear(&write_transforms([
            ("a", "b", step(1.0)),
            ("b", "a", step(1.0)),
        ]));
        assert_eq!(frames.find("a", "b"), None);
        let whole = write_transforms([("map", "base", step(1.0))]);
        for end in 0..whole.len() {
            frames.hear(&whole[..end]);
        }
        assert_eq!(frames.find("map", "base"), None);
        frames.hear(&[0xff; 64]);
    }
}
