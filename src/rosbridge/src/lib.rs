//! rosbridge protocol v2 as data: parses frames into [`Op`]s and prints them. No sockets, no ROS.
//!
//! A frame is a JSON object (text) or a CBOR map (binary). Only its envelope is read here; a message or a service's
//! arguments stay a [`Payload`]: the slice of the frame that holds them, for a codec that knows the type. So nothing is
//! copied, and no tree of values is built.
//!
//! ```text
//! frame ──parse──▶ Op { topic, id, … , msg: Payload } ──▶ the session
//! frame ◀──print── Writer ◀── an Op, or field by field with the payload written in place
//! ```
//!
//! The protocol is the union of ROSBRIDGE_PROTOCOL.md of the `ros1` and `ros2` branches of rosbridge_suite, with one
//! extension: `"compression": "cbor-raw"` is also understood from clients (publish, services, actions). Such a payload
//! is `{"bytes": …}` with the ROS serialization in it, as it is towards clients.

#![forbid(unsafe_code)]

mod action;
mod advertise;
mod auth;
mod cbor;
mod error;
mod field_kinds;
mod fields;
mod fragment;
mod id;
mod json;
mod message;
mod op;
mod payload;
mod png;
mod publish;
mod qos;
mod service;
mod status;
mod subscribe;
mod writer;

pub use action::{
    ActionFeedback, ActionResult, AdvertiseAction, CancelActionGoal, GoalStatus, SendActionGoal, UnadvertiseAction,
};
pub use advertise::{Advertise, Unadvertise};
pub use auth::Auth;
pub use error::{Error, Problem};
pub use fragment::{Fragment, FragmentError, FragmentLimits, Fragments, split_text};
pub use id::Id;
pub use json::to_ascii;
pub use op::{Op, ProtocolFrame, is_known_op, text_field, unknown_fields};
pub use payload::{Format, Payload, Raw};
pub use png::{Png, PngError, decode_png, encode_png};
pub use publish::Publish;
pub use qos::{DurabilityPolicy, HistoryPolicy, LivelinessPolicy, Period, QosRequest, ReliabilityPolicy};
pub use service::{AdvertiseService, CallService, ServiceResponse, UnadvertiseService};
pub use status::{SetLevel, Status, StatusLevel};
pub use subscribe::{Compression, Subscribe, Unsubscribe};
pub use writer::Writer;
