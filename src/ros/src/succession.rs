//! Who joined before, and who is to be known to have: a process that is killed cannot say that its nodes are gone.

use std::fmt;

use async_trait::async_trait;

/// The first twelve bytes of the GUIDs of a participant of DDS.
pub type ParticipantPrefix = [u8; 12];

/// Keeps which participants this process has joined with, for a later one (ROS 2).
#[async_trait]
pub trait Succession: fmt::Debug + Send + Sync {
    /// A node of this name is about to join with this participant. Those of earlier processes, which are gone, whether they have
    /// said so or not: the others are told that they are.
    async fn joins(&self, node: &str, participant: ParticipantPrefix) -> Vec<ParticipantPrefix>;
}
