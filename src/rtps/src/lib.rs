//! RTPS 2.5, the protocol by which DDS implementations understand each other: one participant, with raw samples.
//!
//! In: datagrams of other participants, and samples (CDR with its header) of whoever holds a [`Writer`].
//! Out: datagrams, samples of matched writers, and what was discovered.
//!
//! ```text
//!   sockets ─▶ driver ─▶ wire::parse ─▶ engine ─▶ discovery ─▶ who is there, what matches
//!              │  ▲                       │
//!              │  └── datagrams, paced ◀──┤
//!              │                          ├─▶ readers: one WriterProxy for each matched writer ─▶ samples
//!              └─ timers ────────────────▶└── writers: history, one ReaderProxy for each matched reader
//! ```
//! The engine does no input or output and knows no clock: whoever drives it gives it datagrams and the time. What is not
//! read: security, content filters, groups, keys of instances; ROS 2 uses none of them.
//!
//! Source: OMG DDSI-RTPS 2.5 (formal/22-04-01), whose sections are named where they are carried out.

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
mod time;
pub mod wire;
mod writer;

pub use discovery::{EndpointData, ParticipantData};
pub use guid::{EntityId, Guid, GuidPrefix, SampleIdentity, VendorId};
pub use network::{Interface, Interfaces, interfaces};
pub use participant::{
    Config, Discovered, DiscoveryServer, Ends, JoinError, Participant, Place, Reader, Sample, Sink,
    Topic, Writer,
};
pub use qos::{
    Durability, EndpointQos, History, Liveliness, Mismatch, Reliability, Representations,
};
pub use sequence::{FragmentNumber, FragmentSet, SequenceNumber, SequenceSet};
