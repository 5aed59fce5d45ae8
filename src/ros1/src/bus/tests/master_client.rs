//! Limiting of concurrent calls to the Master.

use std::sync::atomic::{AtomicUsize, Ordering};

use futures_util::future::join_all;
use tokio::sync::Semaphore;

use super::*;
use crate::bus::master_client::{AT_A_TIME, CallLimiter, MasterClient};
use crate::xmlrpc::{Fault, ServerLimits, Value, XmlRpcHandler, serve};

/// A Master that counts concurrent calls, and answers them when allowed to.
struct Busy {
    now: AtomicUsize,
    most: AtomicUsize,
    answers: Semaphore,
}

#[async_trait::async_trait]
impl XmlRpcHandler for Busy {
    async fn call(&self, _: &str, _: Vec<Value>) -> Result<Value, Fault> {
        let now = self.now.fetch_add(1, Ordering::Relaxed) + 1;
        self.most.fetch_max(now, Ordering::Relaxed);
        self.answers.acquire().await.unwrap().forget();
        self.now.fetch_sub(1, Ordering::Relaxed);
        Ok(Value::Array(vec![1.into(), "".into(), 0.into()]))
    }
}

#[tokio::test]
async fn many_calls_at_once_do_not_flood_the_master() {
    let busy = Arc::new(Busy { now: AtomicUsize::new(0), most: AtomicUsize::new(0), answers: Semaphore::new(0) });
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let serving = tokio::spawn(serve(listener, busy.clone(), ServerLimits::default()));
    let unlimited = budget::Budget::without_limit();
    let master = MasterClient::new(Arc::new(HostSockets), address, "/node", &unlimited).unwrap();
    let count = 5 * AT_A_TIME;
    let calls = join_all((0..count).map(|_| master.call("getPid", vec![])));
    let answering = async {
        while busy.now.load(Ordering::Relaxed) < AT_A_TIME {
            tokio::task::yield_now().await;
        }
        busy.answers.add_permits(count);
    };
    let both = async { tokio::join!(calls, answering) };
    let (answers, ()) = tokio::time::timeout(PATIENCE, both).await.unwrap();
    for answer in answers {
        answer.unwrap();
    }
    assert_eq!(busy.most.load(Ordering::Relaxed), AT_A_TIME);
    serving.abort();
}

#[tokio::test(start_paused = true)]
async fn who_waits_for_a_turn_gives_up_when_the_master_answers_nobody() {
    let turns = CallLimiter::new();
    let mut taken = Vec::new();
    for _ in 0..AT_A_TIME {
        taken.push(turns.acquire().await.unwrap());
    }
    // As long as it answers other calls, however slowly, it is not gone.
    let waiting = async { turns.acquire().await.is_some() };
    let answering = async {
        for _ in 0..10 {
            tokio::time::sleep(Duration::from_secs(9)).await;
            turns.record_answer();
        }
        taken.pop();
    };
    let (came, ()) = tokio::join!(waiting, answering);
    assert!(came);
    taken.push(turns.acquire().await.unwrap());
    assert!(turns.acquire().await.is_none());
}
