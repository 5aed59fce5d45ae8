//! Reads request bodies into memory, within the client's budget and a timeout, and files into those of responses.

use std::fs::File;
use std::future::Future;
use std::time::Duration;

use axum::body::{Body, Bytes};
use budget::{Budget, Permit, UNCOUNTED};
use futures_util::StreamExt;
use tokio_util::io::ReaderStream;

use crate::app::App;
use crate::caller::Caller;
use crate::errors::Error;

/// Larger bodies are charged in steps of this size.
const STEP: usize = 1 << 20;

/// Maximum size of a recording for a trial or a calibration, if its sender's budget allows: it is held in memory.
const LARGEST_TRIAL: usize = 512 << 20;
/// Maximum size of other bodies.
pub const LARGEST_WORDS: usize = 64 << 10;

/// Bytes of a file that are sent at a time.
const CHUNK: usize = 256 << 10;

/// Returns the content of a file as the body of a response. It is cut off when `ended` completes, which is when the
/// caller may no longer have it.
pub fn file_body(file: File, ended: impl Future<Output = ()> + Send + 'static) -> Body {
    let content = ReaderStream::with_capacity(tokio::fs::File::from_std(file), CHUNK);
    Body::from_stream(content.take_until(Box::pin(ended)))
}

/// A body in memory, with its budget permit.
#[derive(Debug)]
pub struct BufferedBody {
    /// Content of the body.
    pub bytes: Bytes,
    /// Budget permit, to be kept as long as the bytes.
    pub permit: Permit,
}

/// Reads a body of at most `max` bytes, which must be complete within `unfinished`.
pub async fn read(body: Body, max: usize, budget: &Budget, unfinished: Duration) -> Result<BufferedBody, Error> {
    let reading = async {
        let mut permit = budget.permit();
        let mut bytes = Vec::new();
        let mut parts = body.into_data_stream();
        while let Some(part) = parts.next().await {
            let part = part.map_err(|error| Error::BadRequest(format!("the body cannot be read: {error}")))?;
            let length = bytes.len() + part.len();
            if length > max {
                let limit = api::Size(max as u64);
                return Err(Error::BodyTooLarge { limit });
            }
            if length > bytes.capacity() {
                // Growing may take twice the memory.
                let room = (2 * bytes.capacity()).max(length).min(max);
                if room > UNCOUNTED {
                    // The budget need not be a multiple of the step.
                    permit.grow_to(room.next_multiple_of(STEP).min(budget.max_permit().max(room)))?;
                }
                bytes.reserve_exact(room - bytes.len());
            }
            bytes.extend_from_slice(&part);
        }
        Ok(BufferedBody { bytes: bytes.into(), permit })
    };
    match tokio::time::timeout(unfinished, reading).await {
        Ok(held) => held,
        Err(_) => Err(Error::Unfinished { after: unfinished }),
    }
}

/// Reads a body within its sender's memory budget.
pub async fn read_body(app: &App, caller: &Caller, body: Body, max: usize) -> Result<BufferedBody, Error> {
    let memory = app.choreographer.memory();
    let budget = memory.client(&caller.peer.budget_name(None));
    read(body, max, &budget, memory.unfinished).await
}

/// Reads a body that is a recording or pictures.
pub async fn read_recording(app: &App, caller: &Caller, body: Body) -> Result<BufferedBody, Error> {
    let memory = app.choreographer.memory();
    let max = LARGEST_TRIAL.min(memory.client(&caller.peer.budget_name(None)).max_permit());
    let read = read_body(app, caller, body, max).await;
    read.map_err(|error| match error {
        Error::BodyTooLarge { limit } => Error::TrialTooLarge { limit },
        error => error,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const PATIENCE: Duration = Duration::from_secs(3600);

    /// Creates a body that delivers `length` bytes and then stalls.
    fn unfinished_body(length: usize) -> Body {
        let parts = (0..length / STEP).map(|_| Ok::<_, std::io::Error>(vec![7; STEP]));
        let some = futures_util::stream::iter(parts);
        Body::from_stream(some.chain(futures_util::stream::pending()))
    }

    #[tokio::test]
    async fn unfinished_bodies_take_no_more_than_their_budget() {
        let budget = Budget::new("client x", 8 << 20);
        let mut reading = tokio::task::JoinSet::new();
        for _ in 0..4 {
            let budget = budget.clone();
            let body = unfinished_body(6 << 20);
            reading.spawn(async move { read(body, 512 << 20, &budget, PATIENCE).await });
        }
        for _ in 0..3 {
            let refused = reading.join_next().await.expect("one").expect("no panic");
            let refused = refused.expect_err("they do not fit");
            assert_eq!(refused.problem().status, 503, "{refused}");
            assert!(refused.to_string().contains("client x"), "{refused}");
            assert!(budget.used_bytes() <= budget.limit());
        }
        reading.shutdown().await;
        assert_eq!(budget.used_bytes(), 0);
    }

    #[tokio::test(start_paused = true)]
    async fn a_body_that_stays_unfinished_is_given_up() {
        let budget = Budget::without_limit();
        let refused = read(unfinished_body(1 << 20), 2 << 20, &budget, PATIENCE).await;
        let refused = refused.expect_err("it never ends");
        assert_eq!(refused.problem().status, 408, "{refused}");
        assert_eq!(budget.used_bytes(), 0);
    }

    #[tokio::test]
    async fn a_body_may_be_as_long_as_its_senders_budget() {
        let most = (8 << 20) + 1000;
        let budget = Budget::new("client x", most);
        let held = read(Body::from(vec![7; most]), most, &budget, PATIENCE).await;
        assert_eq!(held.expect("it fits").bytes.len(), most);
    }

    #[tokio::test]
    async fn a_file_is_sent_no_further_once_its_reader_may_no_longer_have_it() {
        use std::io::{Seek, SeekFrom, Write};
        let mut file = tempfile::tempfile().expect("a file");
        file.write_all(&vec![7; 4 * CHUNK]).expect("written");
        let mut sent = async |ended: futures_util::future::BoxFuture<'static, ()>, revoke: Option<_>| {
            file.seek(SeekFrom::Start(0)).expect("a file");
            let mut parts = file_body(file.try_clone().expect("a file"), ended).into_data_stream();
            let mut bytes = parts.next().await.expect("a part").expect("read").len();
            if let Some(revoke) = revoke {
                let revoke: tokio::sync::oneshot::Sender<()> = revoke;
                revoke.send(()).expect("it is awaited");
            }
            while let Some(part) = parts.next().await {
                bytes += part.expect("read").len();
            }
            bytes
        };
        assert_eq!(sent(Box::pin(std::future::pending()), None).await, 4 * CHUNK);
        let (revoke, revoked) = tokio::sync::oneshot::channel();
        let ended = async move {
            let _ = revoked.await;
        };
        assert_eq!(sent(Box::pin(ended), Some(revoke)).await, CHUNK);
    }

    #[tokio::test]
    async fn a_whole_body_counts_for_as_long_as_it_is_held() {
        let budget = Budget::new("client x", 8 << 20);
        let held = read(Body::from(vec![7; 3 << 20]), 4 << 20, &budget, PATIENCE).await;
        let held = held.expect("it fits");
        assert_eq!(held.bytes, vec![7; 3 << 20]);
        assert!(budget.used_bytes() >= 3 << 20);
        drop(held);
        assert_eq!(budget.used_bytes(), 0);
        let refused = read(Body::from(vec![7; 100]), 99, &budget, PATIENCE).await;
        assert_eq!(refused.expect_err("too long").problem().status, 413);
    }
}
