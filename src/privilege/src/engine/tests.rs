//! There is one set of the engine's threads in a process, so this is one story.

use std::sync::Arc;

use tokio::sync::Notify;

use super::*;
use crate::confine;

fn user() -> u32 {
    nix::unistd::geteuid().as_raw()
}

#[test]
fn work_is_done_with_the_rights_that_it_needs() {
    let confined = || {
        Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .on_thread_start(|| confine(Account::default()).expect("confined"))
            .build()
            .expect("a runtime")
    };
    let portal = confined();
    let on_portal = |work: Pin<Box<dyn Future<Output = ()> + Send>>| {
        let task = portal.spawn(work);
        portal.block_on(task).expect("no panic");
    };
    // Where there are no threads of an engine, work is done where it is.
    on_portal(Box::pin(async {
        assert_ne!(user(), 0);
        assert_ne!(run(async { user() }).await, 0);
        assert_ne!(now(user), 0);
        assert_ne!(blocking(user).await.expect("no panic"), 0);
    }));
    let engine = Engine::start(Account::default()).expect("threads");
    on_portal(Box::pin(async {
        assert_eq!(run(async { user() }).await, 0);
        assert_eq!(now(user), 0);
        // More than there are threads, so that new ones are started.
        let all: Vec<_> = (0..20)
            .map(|_| {
                blocking(|| {
                    std::thread::yield_now();
                    user()
                })
            })
            .collect();
        for task in all {
            assert_eq!(task.await.expect("no panic"), 0);
        }
        // From there it goes nowhere else, and threads that are started there have the same rights.
        let nested = run(async {
            let below = blocking(|| now(user)).await.expect("no panic");
            (run(async { user() }).await, below)
        });
        assert_eq!(nested.await, (0, 0));
        // Nor does any of it stay with the threads that asked.
        assert_ne!(user(), 0);
        let blocked = tokio::task::spawn_blocking(user).await;
        assert_ne!(blocked.expect("no panic"), 0);
        // Who does not wait any more ends what was handed over, and panics come back.
        let (dropped, heard) = (Arc::new(Notify::new()), Arc::new(Notify::new()));
        struct Told(Arc<Notify>);
        impl Drop for Told {
            fn drop(&mut self) {
                self.0.notify_one();
            }
        }
        let (told, begun) = (Told(Arc::clone(&dropped)), Arc::clone(&heard));
        let waits = tokio::spawn(run(async move {
            let _told = told;
            begun.notify_one();
            std::future::pending::<()>().await;
        }));
        heard.notified().await;
        waits.abort();
        dropped.notified().await;
        let panicked = tokio::spawn(run(async { panic!("on purpose") })).await;
        assert!(panicked.expect_err("a panic").is_panic());
    }));
    drop(portal);
    engine.end(Duration::from_secs(1));
}
