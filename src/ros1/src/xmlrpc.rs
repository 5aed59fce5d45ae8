//! XML-RPC over HTTP/1.1, as used by ROS 1 nodes and their Master (<http://xmlrpc.com/spec.md>).
//!
//! The peers are roscpp's XmlRpcpp and Python's `xmlrpc`; both keep connections open between calls. Parsing is bounded
//! in size, depth and number of elements, and supports no DTDs: there is nothing to expand.

mod client;
mod http;
mod parse;
mod print;
mod server;
mod value;

use std::io;
use std::time::Duration;

pub use client::XmlRpcClient;
pub use parse::{MAX_DEPTH, MAX_ELEMENTS, MethodCall, parse_call, parse_response, weight};
pub(crate) use print::fault_value;
pub use print::{print_call, print_fault, print_response};
pub use server::{MAX_HELD, ServerLimits, XmlRpcHandler, serve};
pub use value::{UnsendableValue, Value};

/// A fault returned by the other side instead of a value.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("fault {code}: {text}")]
pub struct Fault {
    /// Fault code; ROS assigns no meanings.
    pub code: i32,
    /// Fault text.
    pub text: String,
}

impl Fault {
    /// Creates a fault with ROS's usual code.
    pub fn new(text: impl Into<String>) -> Self {
        Self { code: 1, text: text.into() }
    }
}

/// Error of a call or a document.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The connection failed.
    #[error("{peer}: {source}")]
    Io {
        /// The server called.
        peer: String,
        /// The cause.
        source: io::Error,
    },
    /// No answer arrived in time.
    #[error("{peer} did not answer {method} within {after:?}")]
    Timeout {
        /// The server called.
        peer: String,
        /// The method.
        method: String,
        /// Time waited.
        after: Duration,
    },
    /// The peer does not speak HTTP as XML-RPC uses it.
    #[error("{peer} does not speak HTTP as XML-RPC needs it: {reason}")]
    Http {
        /// The server called.
        peer: String,
        /// The problem.
        reason: String,
    },
    /// The document is not XML, or not XML-RPC.
    #[error("malformed XML-RPC at byte {at}: {reason}")]
    Malformed {
        /// Byte offset in the document.
        at: usize,
        /// The problem at that offset.
        reason: String,
    },
    /// The other side answered with a fault.
    #[error("{peer} answered {method} with {fault}")]
    Fault {
        /// The server called.
        peer: String,
        /// The method.
        method: String,
        /// The fault.
        fault: Fault,
    },
    /// The URI is not that of an XML-RPC server.
    #[error("{0:?} is not an XML-RPC address; it should look like http://localhost:11311/")]
    BadUri(String),
}
