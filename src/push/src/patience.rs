//! Waiting for a body, but not for ever: a thread unpacks it while it comes, and would wait with it.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use bytes::Bytes;
use futures_util::{Stream, StreamExt};
use tokio_util::sync::CancellationToken;

use crate::Archive;

/// Whether a body stopped coming.
#[derive(Clone, Default)]
pub(super) struct Stalled(Arc<AtomicBool>);

impl Stalled {
    pub(super) fn is(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// The chunks of a body. It ends with an error when none comes for `patience`, which `stalled` then says, or when
/// `ended` is cancelled.
pub(super) fn chunks(
    archive: Archive,
    patience: Duration,
    stalled: Stalled,
    ended: CancellationToken,
) -> impl Stream<Item = io::Result<Bytes>> + Send {
    futures_util::stream::unfold(Some(archive), move |stream| {
        let (stalled, ended) = (stalled.clone(), ended.clone());
        async move {
            let mut stream = stream?;
            let next = tokio::select! {
                biased;
                () = ended.cancelled() => {
                    return Some((Err(io::Error::other("the push was cancelled")), None));
                }
                next = tokio::time::timeout(patience, stream.next()) => next,
            };
            match next {
                Ok(Some(Ok(chunk))) => Some((Ok(chunk), Some(stream))),
                Ok(Some(Err(error))) => Some((Err(error), None)),
                Ok(None) => None,
                Err(_) => {
                    stalled.0.store(true, Ordering::Relaxed);
                    Some((Err(io::ErrorKind::TimedOut.into()), None))
                }
            }
        }
    })
}
