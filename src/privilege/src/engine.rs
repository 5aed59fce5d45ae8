//! The engine's threads, and how work gets there.

use std::cell::Cell;
use std::future::Future;
use std::pin::Pin;
use std::sync::{OnceLock, mpsc};
use std::task::{Context, Poll};
use std::time::Duration;

use tokio::runtime::{Builder, Handle, Runtime};
use tokio::task::{JoinError, JoinHandle};

use crate::{Account, Error};

static ENGINE: OnceLock<(Handle, Account)> = OnceLock::new();

thread_local! {
    /// Whether this is one of the engine's threads.
    static OF_ENGINE: Cell<bool> = const { Cell::new(false) };
}

/// The engine's threads. There is one such set in a process.
pub struct Engine(Runtime);

impl Engine {
    /// Starts them with the rights of the calling thread, for all work that is handed over from now on. `others`: who the
    /// threads are that hand it over.
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

    /// Ends them; what still works after `patience` is left to the process's end.
    pub fn end(self, patience: Duration) {
        self.0.shutdown_timeout(patience);
    }
}

/// Where work is to be handed to: none on the engine's threads themselves, and where there are none.
fn elsewhere() -> Option<&'static Handle> {
    let (engine, _) = ENGINE.get()?;
    (!OF_ENGINE.get()).then_some(engine)
}

/// Who the threads are that have no rights; none where there are no such threads.
pub fn confined() -> Option<Account> {
    ENGINE.get().map(|(_, account)| *account)
}

/// On the engine's threads: who those are that have no rights.
pub(crate) fn is_engines() -> Option<Account> {
    OF_ENGINE.get().then(confined).flatten()
}

/// Work that was handed over; it goes on when this is dropped.
pub struct Task<T>(Handed<T>);

enum Handed<T> {
    Here(JoinHandle<T>),
    There(JoinHandle<Result<T, JoinError>>),
}

impl<T> Future for Task<T> {
    type Output = Result<T, JoinError>;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        match &mut self.0 {
            Handed::Here(task) => Pin::new(task).poll(context),
            Handed::There(task) => Pin::new(task)
                .poll(context)
                .map(|outcome| outcome.and_then(|outcome| outcome)),
        }
    }
}

/// Begins `work`, which blocks, on a thread of the engine where that may be.
pub fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Task<T> {
    Task(match elsewhere() {
        None => Handed::Here(tokio::task::spawn_blocking(work)),
        // From there: a thread has the rights of the one that starts it.
        Some(engine) => {
            Handed::There(engine.spawn(async { tokio::task::spawn_blocking(work).await }))
        }
    })
}

/// Ends the task with whoever awaits it.
struct Awaited<T>(JoinHandle<T>);

impl<T> Drop for Awaited<T> {
    fn drop(&mut self) {
        self.0.abort();
    }
}

/// Awaits `future` on the engine's threads; it is dropped, there, when this is.
pub async fn run<T: Send + 'static>(future: impl Future<Output = T> + Send + 'static) -> T {
    let Some(engine) = elsewhere() else {
        return future.await;
    };
    let mut task = Awaited(engine.spawn(future));
    match (&mut task.0).await {
        Ok(outcome) => outcome,
        Err(error) => match error.try_into_panic() {
            Ok(panic) => std::panic::resume_unwind(panic),
            // The process is ending.
            Err(_) => std::future::pending().await,
        },
    }
}

/// Does `work`, which is short, on a thread of the engine, and waits for it. Tasks that it starts run there.
pub fn now<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    let Some(engine) = elsewhere() else {
        return work();
    };
    let (sender, receiver) = mpsc::sync_channel(1);
    engine.spawn(async move {
        let _ = sender.send(work());
    });
    receiver
        .recv()
        .expect("the engine's threads outlive the others, and their work does not panic")
}

#[cfg(test)]
mod tests;
