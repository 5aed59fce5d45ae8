//! Succession of participants: a process that is killed cannot announce that its nodes are gone, so its successor does.

use std::fmt;

use async_trait::async_trait;

/// GUID prefix of a DDS participant (twelve bytes).
pub type ParticipantPrefix = [u8; 12];

/// Records the participants that this process has joined with, for a later process (ROS 2).
#[async_trait]
pub trait Succession: fmt::Debug + Send + Sync {
    /// Records that a node of this name is about to join with this participant. Returns the participants of earlier
    /// processes, whether or not they said goodbye; the other nodes are told that these are gone.
    async fn record_join(&self, node: &str, participant: ParticipantPrefix) -> Vec<ParticipantPrefix>;
}
