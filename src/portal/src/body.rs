//! Reads bodies of requests into memory, within the client's budget and a time.

use std::time::Duration;

use axum::body::{Body, Bytes};
use budget::{Budget, Permit, UNCOUNTED};
use futures_util::StreamExt;

use crate::errors::Error;

/// Bigger ones count in steps of this size.
const STEP: usize = 1 << 20;

/// A body, and the permit to hold it.
#[derive(Debug)]
pub struct Held {
    /// The bytes.
    pub bytes: Bytes,
    /// To be kept for as long as the bytes are.
    pub permit: Permit,
}

/// Reads a body of at most `max` bytes, which must be complete within `unfinished`.
pub async fn read(
    body: Body,
    max: usize,
    budget: &Budget,
    unfinished: Duration,
) -> Result<Held, Error> {
    let reading = async {
        let mut permit = budget.permit();
        let mut bytes = Vec::new();
        let mut parts = body.into_data_stream();
        while let Some(part) = parts.next().await {
            let part = part
                .map_err(|error| Error::BadRequest(format!("the body cannot be read: {error}")))?;
            let length = bytes.len() + part.len();
            if length > max {
                let limit = api::Size(max as u64);
                return Err(Error::BodyTooLarge { limit });
            }
            if length > bytes.capacity() {
                // It may take twice as much while it grows.
                let room = (2 * bytes.capacity()).max(length).min(max);
                if room > UNCOUNTED {
                    // A budget need not be a multiple.
                    permit.grow_to(room.next_multiple_of(STEP).min(budget.most().max(room)))?;
                }
                bytes.reserve_exact(room - bytes.len());
            }
            bytes.extend_from_slice(&part);
        }
        Ok(Held {
            bytes: bytes.into(),
            permit,
        })
    };
    match tokio::time::timeout(unfinished, reading).await {
        Ok(held) => held,
        Err(_) => Err(Error::Unfinished { after: unfinished }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LONG: Duration = Duration::from_secs(3600);

    /// A body of which so many bytes come, and then nothing.
    fn unfinished(length: usize) -> Body {
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
            let body = unfinished(6 << 20);
            reading.spawn(async move { read(body, 512 << 20, &budget, LONG).await });
        }
        for _ in 0..3 {
            let refused = reading.join_next().await.expect("one").expect("no panic");
            let refused = refused.expect_err("they do not fit");
            assert_eq!(refused.problem().status, 503, "{refused}");
            assert!(refused.to_string().contains("client x"), "{refused}");
            assert!(budget.used() <= budget.limit());
        }
        reading.shutdown().await;
        assert_eq!(budget.used(), 0);
    }

    #[tokio::test(start_paused = true)]
    async fn a_body_that_stays_unfinished_is_given_up() {
        let budget = Budget::unlimited();
        let refused = read(unfinished(1 << 20), 2 << 20, &budget, LONG).await;
        let refused = refused.expect_err("it never ends");
        assert_eq!(refused.problem().status, 408, "{refused}");
        assert_eq!(budget.used(), 0);
    }

    #[tokio::test]
    async fn a_body_may_be_as_long_as_its_senders_budget() {
        let most = (8 << 20) + 1000;
        let budget = Budget::new("client x", most);
        let held = read(Body::from(vec![7; most]), most, &budget, LONG).await;
        assert_eq!(held.expect("it fits").bytes.len(), most);
    }

    #[tokio::test]
    async fn a_whole_body_counts_for_as_long_as_it_is_held() {
        let budget = Budget::new("client x", 8 << 20);
        let held = read(Body::from(vec![7; 3 << 20]), 4 << 20, &budget, LONG).await;
        let held = held.expect("it fits");
        assert_eq!(held.bytes, vec![7; 3 << 20]);
        assert!(budget.used() >= 3 << 20);
        drop(held);
        assert_eq!(budget.used(), 0);
        let refused = read(Body::from(vec![7; 100]), 99, &budget, LONG).await;
        assert_eq!(refused.expect_err("too long").problem().status, 413);
    }
}
