//! XML-RPC over HTTP/1.1, as ROS 1 nodes and their Master speak it (<http://xmlrpc.com/spec.md>).
//!
//! The peers are roscpp's XmlRpcpp and Python's `xmlrpc`; both keep connections open between calls. Parsing is
//! bounded in size, depth and number of elements, and knows no DTDs: there is nothing to expand.

mod client;
mod http;
mod parse;
mod print;
mod server;
mod value;

use std::io;
use std::time::Duration;

pub use client::Client;
pub use parse::{Call, MAX_DEPTH, MAX_ELEMENTS, parse_call, parse_response, weight};
pub(crate) use print::fault_value;
pub use print::{print_call, print_fault, print_response};
pub use server::{Handler, Limits, MAX_HELD, serve};
pub use value::Value;

/// What the other side answered instead of a value.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("fault {code}: {text}")]
pub struct Fault {
    /// Its number; ROS gives these no meaning.
    pub code: i32,
    /// What it says.
    pub text: String,
}

impl Fault {
    /// A fault with ROS's usual code.
    pub fn new(text: impl Into<String>) -> Self {
        Self {
            code: 1,
            text: text.into(),
        }
    }
}

/// A call that failed, or a document that is none.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The connection failed.
    #[error("{peer}: {source}")]
    Io {
        /// Who was called.
        peer: String,
        /// Why it failed.
        source: io::Error,
    },
    /// No answer in time.
    #[error("{peer} did not answer {method} within {after:?}")]
    Timeout {
        /// Who was called.
        peer: String,
        /// The method.
        method: String,
        /// How long was waited.
        after: Duration,
    },
    /// Not HTTP, or not in the way XML-RPC uses it.
    #[error("{peer} does not speak HTTP as XML-RPC needs it: {reason}")]
    Http {
        /// Who was called.
        peer: String,
        /// What is wrong.
        reason: String,
    },
    /// Not XML, or not XML-RPC.
    #[error("malformed XML-RPC at byte {at}: {reason}")]
    Malformed {
        /// Byte offset in the document.
        at: usize,
        /// What is wrong there.
        reason: String,
    },
    /// The other side answered with a fault.
    #[error("{peer} answered {method} with {fault}")]
    Fault {
        /// Who was called.
        peer: String,
        /// The method.
        method: String,
        /// What it answered.
        fault: Fault,
    },
    /// Not an address of an XML-RPC server.
    #[error("{0:?} is not an XML-RPC address; it should look like http://localhost:11311/")]
    BadUri(String),
}
