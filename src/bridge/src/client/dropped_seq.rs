//! Notices about the `seq` of headers, which ROS 1 has and ROS 2 has not.

use bytes::Bytes;
use rosbridge::StatusLevel;

use super::decoding::DecodedPayload;
use super::{BridgeClient, ReplyTarget};

impl BridgeClient {
    /// Returns the message of a payload. If a `seq` was dropped from it, warns the client, but only once for each
    /// topic, service or action: clients made for ROS 1 write one into every header. `about` is the kind of name and
    /// the name, `("topic", "/scan")`.
    pub(super) fn take_decoded(
        &self,
        decoded: DecodedPayload,
        op: &str,
        about: (&str, &str),
        reply: &ReplyTarget,
    ) -> Bytes {
        // A client that does not want warnings now may want them later.
        if decoded.dropped_seq && self.wants_level(StatusLevel::Warning) {
            let about = format!("{} {}", about.0, about.1);
            if self.mark_seq_reported(&about) {
                let text = format!(
                    "{op}: {about}: \"seq\" of a std_msgs/msg/Header was dropped, ROS 2 has no such field; this is \
                     said once"
                );
                self.warn(reply, &text);
            }
        }
        decoded.bytes
    }

    /// Marks that the client is told; returns false if it was told before.
    fn mark_seq_reported(&self, about: &str) -> bool {
        let mut reported = self.seq_reported.lock();
        if reported.contains(about) {
            return false;
        }
        // An endless number of names must not fill the memory.
        if reported.len() >= self.shared.options.max_advertisements {
            reported.clear();
        }
        reported.insert(about.to_owned())
    }
}
