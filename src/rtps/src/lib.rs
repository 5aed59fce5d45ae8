//! RTPS 2.5, the interoperability protocol of DDS: one participant, exchanging raw samples.
//!
//! Input: datagrams of other participants, and samples (CDR with its header) from the owner of a [`DataWriter`].
//! Output: datagrams, samples of matched writers, and discovery data.
//!
//! ```text
//!   sockets ─▶ driver ─▶ wire::parse ─▶ engine ─▶ discovery ─▶ participants, matching
//!              │  ▲                       │
//!              │  └── datagrams, paced ◀──┤
//!              │                          ├─▶ readers: one WriterProxy for each matched writer ─▶ samples
//!              └─ timers ────────────────▶└── writers: history, one ReaderProxy for each matched reader
//! ```
//! The engine does no I/O and has no clock: the driver passes datagrams and the time to it. Not supported because ROS 2
//! does not use them: security, content filters, groups, instance keys.
//!
//! Source: OMG DDSI-RTPS 2.5 (formal/22-04-01), whose sections are cited where they are implemented.

mod count_filter;
mod discovery;
mod driver;
mod engine;
mod flow;
mod fragments;
mod guid;
mod locator;
mod network;
mod pace;
mod participant;
mod qos;
mod reader;
mod sequence;
mod shared;
mod time;
pub mod wire;
mod writer;

pub use discovery::{EndpointData, ParticipantData};
pub use guid::{EntityId, Guid, GuidPrefix, SampleIdentity, VendorId};
pub use network::{InterfaceAddress, InterfaceSelection};
pub use participant::{Config, DataReader, DataWriter, JoinError, NetworkNamespace, Participant};
pub use qos::{DurabilityKind, EndpointQos, HistoryKind, LivelinessKind, Mismatch, ReliabilityKind, Representations};
pub use sequence::{FragmentNumber, FragmentSet, SequenceNumber, SequenceSet};
pub use shared::{DiscoveredGraph, DiscoveryServer, EndpointMatches, ReceivedSample, Sink, TopicDescription};
