//! The engine's threads, and the handover of work to them. The work keeps the span of the log in which it was handed
//! over.

use std::cell::Cell;
use std::future::Future;
use std::pin::Pin;
use std::sync::{OnceLock, mpsc};
use std::task::{Context, Poll};
use std::time::Duration;

use tokio::runtime::{Builder, Handle, Runtime};
use tokio::task::{JoinError, JoinHandle};
use tracing::{Instrument, Span};

use crate::{Account, Error};

static ENGINE: OnceLock<(Handle, Account)> = OnceLock::new();

thread_local! {
    /// Set on the engine's threads.
    static OF_ENGINE: Cell<bool> = const { Cell::new(false) };
}

/// The engine's threads. A process has one such set.
pub struct Engine(Runtime);

impl Engine {
    /// Starts the threads with the privileges of the calling thread, for all work handed over from now on. `others` is
    /// the account of the threads that hand it over.
    pub fn start(others: Account) -> Result<Self, Error> {
        let runtime = Builder::new_multi_thread()
            .enable_all()
            .thread_name("engine")
            .on_thread_start(|| OF_ENGINE.set(true))
            .build()
            .map_err(Error::Threads)?;
        let _ = ENGINE.set((runtime.handle().clone(), others));
        Ok(Self(runtime))
    }

    /// Stops the threads; work that still runs after `patience` is abandoned to the end of the process.
    pub fn end(self, patience: Duration) {
        self.0.shutdown_timeout(patience);
    }
}

/// Returns the runtime to hand work to; `None` on the engine's threads themselves, and if there are none.
fn handoff_target() -> Option<&'static Handle> {
    let (engine, _) = ENGINE.get()?;
    (!OF_ENGINE.get()).then_some(engine)
}

/// Returns the account of the confined threads; `None` if there are no such threads.
pub fn confined_account() -> Option<Account> {
    ENGINE.get().map(|(_, account)| *account)
}

/// Returns the account of the confined threads, on the engine's threads.
pub(crate) fn account_on_engine() -> Option<Account> {
    OF_ENGINE.get().then(confined_account).flatten()
}

/// Work that was handed over; it continues when this is dropped.
pub struct Task<T>(EngineHandle<T>);

enum EngineHandle<T> {
    Here(JoinHandle<T>),
    There(JoinHandle<Result<T, JoinError>>),
}

impl<T> Future for Task<T> {
    type Output = Result<T, JoinError>;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        match &mut self.0 {
            EngineHandle::Here(task) => Pin::new(task).poll(context),
            EngineHandle::There(task) => {
                Pin::new(task).poll(context).map(|outcome| outcome.and_then(|outcome| outcome))
            }
        }
    }
}

/// Runs blocking `work` on a thread of the engine if there is one.
pub fn spawn_blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Task<T> {
    let span = Span::current();
    let work = move || span.in_scope(work);
    Task(match handoff_target() {
        None => EngineHandle::Here(tokio::task::spawn_blocking(work)),
        // Spawned from there, since a thread inherits the privileges of the one that starts it.
        Some(engine) => EngineHandle::There(engine.spawn(async { tokio::task::spawn_blocking(work).await })),
    })
}

/// Aborts the task when the future that awaits it is dropped.
struct AbortOnDrop<T>(JoinHandle<T>);

impl<T> Drop for AbortOnDrop<T> {
    fn drop(&mut self) {
        self.0.abort();
    }
}

/// Awaits `future` on the engine's threads; it is dropped there when the returned future is.
pub async fn run<T: Send + 'static>(future: impl Future<Output = T> + Send + 'static) -> T {
    let Some(engine) = handoff_target() else {
        return future.await;
    };
    let mut task = AbortOnDrop(engine.spawn(future.in_current_span()));
    match (&mut task.0).await {
        Ok(outcome) => outcome,
        Err(error) => match error.try_into_panic() {
            Ok(panic) => std::panic::resume_unwind(panic),
            // The process is exiting.
            Err(_) => std::future::pending().await,
        },
    }
}

/// Runs short `work` on a thread of the engine and waits for it. Tasks that it spawns run there.
pub fn run_sync<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    let Some(engine) = handoff_target() else {
        return work();
    };
    let (sender, receiver) = mpsc::sync_channel(1);
    let handed_over = async move {
        let _ = sender.send(work());
    };
    engine.spawn(handed_over.in_current_span());
    receiver.recv().expect("the engine's threads outlive the others, and their work does not panic")
}

#[cfg(test)]
mod tests;
