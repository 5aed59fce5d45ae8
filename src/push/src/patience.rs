//! Waiting for a body, but not for ever: a thread unpacks it while it comes, and would wait with it, and so would the
//! pushes behind it.

use std::io;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use bytes::Bytes;
use futures_util::{Stream, StreamExt};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use crate::Archive;

/// How slowly a body may come.
#[derive(Debug, Clone, Copy)]
pub(super) struct Patience {
    /// How long it may pause.
    pub(super) pause: Duration,
    /// Bytes a second, over such times; 0 for any.
    pub(super) rate: u64,
}

/// Why a body was not waited for any longer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TooSlow {
    /// Nothing came.
    Paused,
    /// Something came, but less than must.
    Trickled,
}

/// Whether a body came too slowly.
#[derive(Clone, Default)]
pub(super) struct Stalled(Arc<OnceLock<TooSlow>>);

impl Stalled {
    pub(super) fn why(&self) -> Option<TooSlow> {
        self.0.get().copied()
    }
}

/// The chunks of a body. It ends with an error when they come more slowly than they may, which `stalled` then says, or
/// when `ended` is cancelled. Time in which no chunk is asked for does not count.
pub(super) fn chunks(
    archive: Archive,
    patience: Patience,
    stalled: Stalled,
    ended: CancellationToken,
) -> impl Stream<Item = io::Result<Bytes>> + Send {
    let begin = Some((archive, patience.pause));
    // `left`: how long may be waited until the next chunk. Waiting uses it up, and bytes add to it what they may take.
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
                    let left = patience.after(left.saturating_sub(began.elapsed()), chunk.len());
                    Some((Ok(chunk), Some((stream, left))))
                }
                Ok(Some(Err(error))) => Some((Err(error), None)),
                Ok(None) => None,
                Err(_) => {
                    let why = if left < patience.pause {
                        TooSlow::Trickled
                    } else {
                        TooSlow::Paused
                    };
                    let _ = stalled.0.set(why);
                    Some((Err(io::ErrorKind::TimedOut.into()), None))
                }
            }
        }
    })
}

impl Patience {
    /// How long may be waited after a chunk.
    fn after(&self, left: Duration, bytes: usize) -> Duration {
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

    /// How many chunks of a body come through, each so many bytes after such a pause.
    async fn come(pause: u64, bytes: usize, rate: u64, chunks: usize) -> (usize, Option<TooSlow>) {
        let stream = futures_util::stream::iter(0..chunks).then(move |_| async move {
            tokio::time::sleep(Duration::from_secs(pause)).await;
            Ok(Bytes::from(vec![0_u8; bytes]))
        });
        let patience = Patience {
            pause: Duration::from_secs(60),
            rate,
        };
        let (stalled, ended) = (Stalled::default(), CancellationToken::new());
        let through = super::chunks(stream.boxed(), patience, stalled.clone(), ended);
        let through: Vec<_> = through.filter_map(async |chunk| chunk.ok()).collect().await;
        (through.len(), stalled.why())
    }

    #[tokio::test(start_paused = true)]
    async fn a_body_that_trickles_is_not_waited_for() {
        assert_eq!(
            come(59, 1, 16 << 10, 100).await,
            (1, Some(TooSlow::Trickled))
        );
        // A chunk for each pause is enough of them all.
        assert_eq!(come(59, 1 << 20, 16 << 10, 100).await, (100, None));
        assert_eq!(come(1, 20 << 10, 16 << 10, 1000).await, (1000, None));
        let (came, why) = come(1, 15 << 10, 16 << 10, 10_000).await;
        assert!(
            came > 100 && why == Some(TooSlow::Trickled),
            "{came} {why:?}"
        );
        // Without a rate only pauses count.
        assert_eq!(come(59, 1, 0, 100).await, (100, None));
        assert_eq!(come(61, 1 << 20, 0, 100).await, (0, Some(TooSlow::Paused)));
    }
}
