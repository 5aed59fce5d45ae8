//! A process has one set of the engine's threads, so this is a single test.

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
    // Without engine threads, work is done on the calling thread.
    on_portal(Box::pin(async {
        assert_ne!(user(), 0);
        assert_ne!(run(async { user() }).await, 0);
        assert_ne!(run_sync(user), 0);
        assert_ne!(spawn_blocking(user).await.expect("no panic"), 0);
    }));
    tracing::subscriber::set_global_default(tracing_subscriber::registry()).expect("the first");
    let engine = Engine::start(Account::default()).expect("threads");
    on_portal(Box::pin(async {
        assert_eq!(run(async { user() }).await, 0);
        assert_eq!(run_sync(user), 0);
        // More tasks than threads, so that new ones are started.
        let all: Vec<_> = (0..20)
            .map(|_| {
                spawn_blocking(|| {
                    std::thread::yield_now();
                    user()
                })
            })
            .collect();
        for task in all {
            assert_eq!(task.await.expect("no panic"), 0);
        }
        // Work on the engine is not handed over again, and threads started there have the same privileges.
        let nested = run(async {
            let below = spawn_blocking(|| run_sync(user)).await.expect("no panic");
            (run(async { user() }).await, below)
        });
        assert_eq!(nested.await, (0, 0));
        // None of it stays with the calling threads.
        assert_ne!(user(), 0);
        let blocked = tokio::task::spawn_blocking(user).await;
        assert_ne!(blocked.expect("no panic"), 0);
        // Work keeps the span of the log in which it was handed over.
        let span = tracing::error_span!("caller");
        let caller = span.id().expect("a subscriber");
        let current = || Span::current().id();
        let handed_over = async move {
            let blocking = spawn_blocking(current).await.expect("no panic");
            let awaited = run(async move { current() }).await;
            [awaited, run_sync(current), blocking]
        };
        let spans = handed_over.instrument(span).await;
        assert!(spans.iter().all(|span| span.as_ref() == Some(&caller)), "{spans:?}");
        // Dropping the future ends the work that was handed over, and panics are propagated.
        let (dropped, heard) = (Arc::new(Notify::new()), Arc::new(Notify::new()));
        struct DropNotifier(Arc<Notify>);
        impl Drop for DropNotifier {
            fn drop(&mut self) {
                self.0.notify_one();
            }
        }
        let (told, begun) = (DropNotifier(Arc::clone(&dropped)), Arc::clone(&heard));
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
