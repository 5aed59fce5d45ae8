//! Minimum transfer rate of request bodies. A thread unpacks the body while it arrives; it must not wait forever, nor
//! keep the pushes behind it waiting.

use std::io;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use bytes::Bytes;
use futures_util::{Stream, StreamExt};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use crate::Archive;

/// Minimum transfer rate of a body.
#[derive(Debug, Clone, Copy)]
pub(super) struct BodyRateLimit {
    /// Maximum pause between chunks.
    pub(super) pause: Duration,
    /// Minimum average rate over `pause`, in bytes per second; 0 for none.
    pub(super) rate: u64,
}

/// Reason why a body was too slow.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TooSlow {
    /// No data arrived.
    Paused,
    /// Data arrived at less than the minimum rate.
    Trickled,
}

/// Flag that records whether and why a body was too slow.
#[derive(Clone, Default)]
pub(super) struct StallFlag(Arc<OnceLock<TooSlow>>);

impl StallFlag {
    pub(super) fn reason(&self) -> Option<TooSlow> {
        self.0.get().copied()
    }
}

/// Returns the chunks of a body. The stream ends with an error if they arrive too slowly, which sets `stalled`, or when
/// `ended` is cancelled. Time in which no chunk is polled does not count.
pub(super) fn timed_chunks(
    archive: Archive,
    patience: BodyRateLimit,
    stalled: StallFlag,
    ended: CancellationToken,
) -> impl Stream<Item = io::Result<Bytes>> + Send {
    let begin = Some((archive, patience.pause));
    // `left` is the time to wait for the next chunk. Waiting uses it up, and each chunk adds the time that its bytes
    // may take.
    futures_util::stream::unfold(begin, move |state| {
        let (stalled, ended) = (stalled.clone(), ended.clone());
        async move {
            let (mut stream, left) = state?;
            let began = Instant::now();
            let next = tokio::select! {
                biased;
                () = ended.cancelled() => {
                    return Some((Err(io::Error::other("the push was cancelled")), None));
                }
                next = tokio::time::timeout(left, stream.next()) => next,
            };
            match next {
                Ok(Some(Ok(chunk))) => {
                    let left = patience.remaining_after(left.saturating_sub(began.elapsed()), chunk.len());
                    Some((Ok(chunk), Some((stream, left))))
                }
                Ok(Some(Err(error))) => Some((Err(error), None)),
                Ok(None) => None,
                Err(_) => {
                    let why = if left < patience.pause { TooSlow::Trickled } else { TooSlow::Paused };
                    let _ = stalled.0.set(why);
                    Some((Err(io::ErrorKind::TimedOut.into()), None))
                }
            }
        }
    })
}

impl BodyRateLimit {
    /// Returns how long to wait for the chunk after this one.
    fn remaining_after(&self, left: Duration, bytes: usize) -> Duration {
        match self.rate {
            0 => self.pause,
            rate => {
                let earned = Duration::from_secs_f64(bytes as f64 / rate as f64);
                left.saturating_add(earned).min(self.pause)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the number of chunks of a body that get through, each of `bytes` bytes after the given pause.
    async fn receive_chunks(pause: u64, bytes: usize, rate: u64, chunks: usize) -> (usize, Option<TooSlow>) {
        let stream = futures_util::stream::iter(0..chunks).then(move |_| async move {
            tokio::time::sleep(Duration::from_secs(pause)).await;
            Ok(Bytes::from(vec![0_u8; bytes]))
        });
        let patience = BodyRateLimit { pause: Duration::from_secs(60), rate };
        let (stalled, ended) = (StallFlag::default(), CancellationToken::new());
        let through = super::timed_chunks(stream.boxed(), patience, stalled.clone(), ended);
        let through: Vec<_> = through.filter_map(async |chunk| chunk.ok()).collect().await;
        (through.len(), stalled.reason())
    }

    #[tokio::test(start_paused = true)]
    async fn a_body_that_trickles_is_not_waited_for() {
        assert_eq!(receive_chunks(59, 1, 16 << 10, 100).await, (1, Some(TooSlow::Trickled)));
        // One chunk per pause is sufficient.
        assert_eq!(receive_chunks(59, 1 << 20, 16 << 10, 100).await, (100, None));
        assert_eq!(receive_chunks(1, 20 << 10, 16 << 10, 1000).await, (1000, None));
        let (came, why) = receive_chunks(1, 15 << 10, 16 << 10, 10_000).await;
        assert!(came > 100 && why == Some(TooSlow::Trickled), "{came} {why:?}");
        // Without a rate only pauses count.
        assert_eq!(receive_chunks(59, 1, 0, 100).await, (100, None));
        assert_eq!(receive_chunks(61, 1 << 20, 0, 100).await, (0, Some(TooSlow::Paused)));
    }
}
