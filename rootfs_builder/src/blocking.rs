//! Starts a build's blocking work, and cancels it when the build ends.
//!
//! Dropping a build's future ends its containers, but not the threads that pack, hash and extract for it: those would
//! go on for minutes, and keep the daemon from ending. So such work is started here, under the build's
//! [`foreign::cancel::Cancel`], which its loops ask.

use std::future::Future;

use foreign::cancel::Cancel;
use tokio::task::JoinHandle;

tokio::task_local! {
    static CANCEL: Cancel;
}

/// Awaits `future`. When it ends or is dropped, blocking work that it started is cancelled.
pub async fn cancellable<F: Future>(future: F) -> F::Output {
    let cancel = Cancel::default();
    let _ended = cancel.on_drop();
    CANCEL.scope(cancel.clone(), future).await
}

/// Runs `work` on a thread where it may block; it is cancelled with the [`cancellable`] future that calls this.
pub fn spawn<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> JoinHandle<T> {
    tokio::task::spawn_blocking(cancelled_with_this(work))
}

/// The same for `work` that reads what strangers have written, on a thread that may read every file and do nothing else.
pub fn reading<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> JoinHandle<T> {
    let work = cancelled_with_this(work);
    tokio::task::spawn_blocking(move || privilege::reading(work))
}

/// `work` that is cancelled with the [`cancellable`] future that calls this, wherever it is done.
pub fn cancelled_with_this<T>(work: impl FnOnce() -> T) -> impl FnOnce() -> T {
    let cancel = CANCEL.try_with(Cancel::clone).unwrap_or_default();
    move || cancel.during(work)
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
        tokio::task::spawn_blocking(move || end.recv())
            .await
            .expect("no panic")
            .expect("the work has ended");
    }
}
