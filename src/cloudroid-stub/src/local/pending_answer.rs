//! Answers that are waited for.

use bytes::Bytes;
use futures_util::future::BoxFuture;
use qos::Failure;

/// The pending answer of a call to one side.
pub type PendingAnswer = BoxFuture<'static, Result<Bytes, Failure>>;
