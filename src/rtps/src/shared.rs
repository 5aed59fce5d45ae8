//! Types that the public API and the engine share: topics, samples, and what was discovered.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;

use bytes::Bytes;

use crate::discovery::{EndpointData, ParticipantData};
use crate::qos::Mismatch;
use crate::sequence::SequenceNumber;
use crate::time::WireTime;
use crate::{Guid, GuidPrefix, SampleIdentity};

/// A Fast DDS discovery server, as clients are configured with it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DiscoveryServer {
    /// Position in the list of servers, with which the server itself is configured; it determines its GUID prefix.
    pub place: u8,
    /// Address at which it receives discovery data.
    pub at: SocketAddr,
}

impl DiscoveryServer {
    /// Returns its GUID prefix: `44.53.PLACE.5f.45.50.52.4f.53.49.4d.41`.
    pub fn prefix(&self) -> GuidPrefix {
        let mut prefix = *b"DS\0_EPROSIMA";
        prefix[2] = self.place;
        GuidPrefix(prefix)
    }
}

/// Other participants and their endpoints.
#[derive(Debug, Clone, Default)]
pub struct DiscoveredGraph {
    /// Incremented with every change.
    pub generation: u64,
    /// The other participants.
    pub participants: BTreeMap<GuidPrefix, Arc<ParticipantData>>,
    /// Their writers.
    pub writers: BTreeMap<Guid, Arc<EndpointData>>,
    /// Their readers.
    pub readers: BTreeMap<Guid, Arc<EndpointData>>,
}

/// The remote endpoints on the topic of a local one.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct EndpointMatches {
    /// Matched endpoints, in the order in which they were discovered.
    pub matched: Vec<Arc<EndpointData>>,
    /// Matched endpoints that have shown that they know this endpoint: what is written from now on reaches them.
    pub confirmed: Vec<Guid>,
    /// Endpoints with incompatible QoS, with the mismatches.
    pub refused: Vec<(Arc<EndpointData>, Vec<Mismatch>)>,
    /// Number of samples that each matched writer of a transient-local reader keeps for late readers.
    pub(crate) kept: Vec<(Guid, usize)>,
}

impl EndpointMatches {
    /// Returns the number of samples that a writer keeps for late readers now, up to a limit of some hundreds; `None`
    /// if it has not said so yet, or reader or writer is not transient-local.
    pub fn kept_samples(&self, writer: Guid) -> Option<usize> {
        self.kept.iter().find(|(kept_by, _)| *kept_by == writer).map(|(_, samples)| *samples)
    }
}

/// A received sample.
#[derive(Debug, Clone)]
pub struct ReceivedSample {
    /// CDR with its header of four bytes.
    pub payload: Bytes,
    /// GUID of the writer.
    pub writer: Guid,
    /// Sequence number.
    pub number: SequenceNumber,
    /// The request that it replies to, or the identity with which a request wants to be answered (inline QoS).
    pub related: Option<SampleIdentity>,
    /// Source timestamp, on the writer's clock.
    pub written: Option<WireTime>,
    /// For an announcement: the endpoint or participant that it disposes of.
    pub(crate) withdrawn: Option<Guid>,
}

/// Receives the samples of a reader, in the order of each writer. Must not block.
pub trait Sink: Send + Sync + 'static {
    /// Handles a sample.
    fn on_sample(&self, sample: ReceivedSample);
}

/// Name and type of a topic.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TopicDescription {
    /// DDS name of the topic: `rt/chatter`.
    pub name: String,
    /// DDS name of the type: `std_msgs::msg::dds_::String_`.
    pub type_name: String,
    /// User data; ROS 2 uses `typehash=RIHS01_…;`.
    pub user_data: Bytes,
}
