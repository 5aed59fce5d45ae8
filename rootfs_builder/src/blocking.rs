//! Blocking work of a build, cancelled when the build ends.
//!
//! Dropping the future of a build ends its containers, but not the threads that pack, hash and extract for it: those
//! would continue for minutes and delay the daemon's shutdown. So such work is started here, under the build's
//! [`foreign::cancel::Cancel`], which its loops check. Layers that are complete but for their archives are the
//! exception: they outlive a cancelled build, for the next one to go on from, and end with the daemon
//! or when the disk is full.

use std::future::Future;

use foreign::cancel::Cancel;
use tokio::task::JoinHandle;
use tracing::Span;

tokio::task_local! {
    static CANCEL: Cancel;
}

/// Awaits `future`. When it completes or is dropped, the blocking work that it started is cancelled.
pub async fn cancellable<F: Future>(future: F) -> F::Output {
    let cancel = Cancel::default();
    let _ended = cancel.drop_guard();
    CANCEL.scope(cancel.clone(), future).await
}

/// Runs `work` on a blocking thread; cancelled with the [`cancellable`] future that calls this.
pub fn spawn<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> JoinHandle<T> {
    tokio::task::spawn_blocking(cancel_with_caller(work))
}

/// Runs `work` on a blocking thread, also after the [`cancellable`] future that calls this was dropped: until it is
/// done or `given_up` is cancelled.
pub(crate) fn spawn_until<T: Send + 'static>(
    given_up: Cancel,
    work: impl FnOnce() -> T + Send + 'static,
) -> JoinHandle<T> {
    let span = Span::current();
    tokio::task::spawn_blocking(move || span.in_scope(|| given_up.run(work)))
}

/// Runs `work`, which reads untrusted data, on a blocking thread with no other privileges than reading all files.
pub fn spawn_reader<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> JoinHandle<T> {
    let work = cancel_with_caller(work);
    tokio::task::spawn_blocking(move || privilege::run_as_reader(work))
}

/// Wraps `work` so that it is cancelled with the [`cancellable`] future that calls this, wherever it runs, and logs in
/// the caller's span.
pub fn cancel_with_caller<T>(work: impl FnOnce() -> T) -> impl FnOnce() -> T {
    let cancel = CANCEL.try_with(Cancel::clone).unwrap_or_default();
    let span = Span::current();
    move || span.in_scope(|| cancel.run(work))
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;

    #[tokio::test]
    async fn work_ends_with_the_future_that_started_it() {
        let (started, on) = tokio::sync::oneshot::channel();
        let (ended, end) = mpsc::channel();
        let build = tokio::spawn(cancellable(async move {
            let work = spawn(move || {
                let _ = started.send(());
                while foreign::cancel::check().is_ok() {
                    std::thread::yield_now();
                }
                let _ = ended.send(());
            });
            let _ = work.await;
        }));
        on.await.expect("it runs");
        build.abort();
        tokio::task::spawn_blocking(move || end.recv()).await.expect("no panic").expect("the work has ended");
    }
}
