//! Bytes that may be held at a time, in a hierarchy: in go requests for bytes, out come permits, which give them back
//! when they are dropped.
//!
//! ```text
//!   daemon 1 GiB ─┬─ client 10.0.0.7, 256 MiB ─┬─ a permit: a WebSocket message being assembled
//!                 │                            └─ a permit: a body being read
//!                 └─ servant cam-1, 256 MiB ───── a permit: a TCPROS frame being read
//! ```
//! A permit counts in its budget and in all those above it. One that does not fit in any of them is refused, and the
//! refusal names the budget that is full: whoever asked loses what it was about, and nobody else anything.

#![forbid(unsafe_code)]

mod shares;

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;

use tokio::sync::Notify;

pub use shares::Shares;

/// A number of bytes that may be held at a time. Clones are handles to the same one.
#[derive(Clone)]
pub struct Budget(Arc<Node>);

struct Node {
    name: String,
    limit: usize,
    used: AtomicUsize,
    refused: AtomicU64,
    /// Bytes were given back, here or below.
    released: Notify,
    above: Option<Budget>,
    /// Is told of refusals, here and below.
    observer: Option<Observer>,
}

/// Is told who asked (the name of the budget that was asked) and why that was refused. Must not block.
pub type Observer = Box<dyn Fn(&str, &Exceeded) + Send + Sync>;

/// Bytes that were asked for and do not fit.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{asked} bytes more do not fit into the memory for {name}: {used} of {limit} bytes are in use"
)]
pub struct Exceeded {
    /// Which budget is full.
    pub name: String,
    /// Bytes that were asked for.
    pub asked: usize,
    /// Bytes held at that moment.
    pub used: usize,
    /// Bytes that may be held.
    pub limit: usize,
}

impl Budget {
    /// One that nothing stands above. `name` is what it is for, as refusals are to say it.
    pub fn new(name: impl Into<String>, limit: usize) -> Self {
        Self::node(name.into(), limit, None, None)
    }

    /// The same, whose `observer` is told of all refusals in it and in those below it.
    pub fn observed(name: impl Into<String>, limit: usize, observer: Observer) -> Self {
        Self::node(name.into(), limit, None, Some(observer))
    }

    /// One whose permits count in this one, too.
    pub fn within(&self, name: impl Into<String>, limit: usize) -> Self {
        Self::node(name.into(), limit, Some(self.clone()), None)
    }

    /// One that refuses nothing.
    pub fn unlimited() -> Self {
        Self::new("everything", usize::MAX)
    }

    fn node(name: String, limit: usize, above: Option<Budget>, observer: Option<Observer>) -> Self {
        Self(Arc::new(Node {
            name,
            limit,
            used: AtomicUsize::new(0),
            refused: AtomicU64::new(0),
            released: Notify::new(),
            above,
            observer,
        }))
    }

    /// What it is for.
    pub fn name(&self) -> &str {
        &self.0.name
    }

    /// Bytes that may be held in it.
    pub fn limit(&self) -> usize {
        self.0.limit
    }

    /// Bytes held in it now.
    pub fn used(&self) -> usize {
        self.0.used.load(Ordering::Relaxed)
    }

    /// How often it was too full.
    pub fn refused(&self) -> u64 {
        self.0.refused.load(Ordering::Relaxed)
    }

    /// The most bytes that one permit can hold, when nothing else is held.
    pub fn most(&self) -> usize {
        self.chain().map(Budget::limit).min().unwrap_or(0)
    }

    /// Bytes that a permit could be given now.
    pub fn left(&self) -> usize {
        let left = |budget: &Budget| budget.limit().saturating_sub(budget.used());
        self.chain().map(left).min().unwrap_or(0)
    }

    /// A permit for nothing yet.
    pub fn permit(&self) -> Permit {
        Permit {
            budget: self.clone(),
            bytes: 0,
        }
    }

    /// A permit for so many bytes.
    pub fn take(&self, bytes: usize) -> Result<Permit, Exceeded> {
        let mut permit = self.permit();
        permit.resize(bytes)?;
        Ok(permit)
    }

    /// A permit for so many bytes, as soon as they are there; refused after `patience`, and at once where they never can
    /// be.
    pub async fn wait(&self, bytes: usize, patience: Duration) -> Result<Permit, Exceeded> {
        let mut permit = self.permit();
        permit.wait(bytes, patience).await?;
        Ok(permit)
    }

    /// This one and those above it.
    fn chain(&self) -> impl Iterator<Item = &Budget> {
        std::iter::successors(Some(self), |budget| budget.0.above.as_ref())
    }

    fn add(&self, bytes: usize) -> Result<(), Exceeded> {
        for (depth, budget) in self.chain().enumerate() {
            let node = &budget.0;
            let more = |used: usize| used.checked_add(bytes).filter(|sum| *sum <= node.limit);
            let added = node
                .used
                .fetch_update(Ordering::Relaxed, Ordering::Relaxed, more);
            if let Err(used) = added {
                self.chain()
                    .take(depth)
                    .for_each(|below| below.sub_here(bytes));
                return Err(Exceeded {
                    name: node.name.clone(),
                    asked: bytes,
                    used,
                    limit: node.limit,
                });
            }
        }
        Ok(())
    }

    fn tell(&self, full: &Exceeded) {
        for budget in self.chain() {
            if budget.name() == full.name {
                budget.0.refused.fetch_add(1, Ordering::Relaxed);
            }
            if let Some(observer) = &budget.0.observer {
                observer(self.name(), full);
            }
        }
    }

    fn sub(&self, bytes: usize) {
        self.chain().for_each(|budget| budget.sub_here(bytes));
    }

    fn sub_here(&self, bytes: usize) {
        self.0.used.fetch_sub(bytes, Ordering::Relaxed);
        self.0.released.notify_waiters();
    }
}

impl fmt::Debug for Budget {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter
            .debug_struct("Budget")
            .field("name", &self.name())
            .field("used", &self.used())
            .field("limit", &self.limit())
            .finish_non_exhaustive()
    }
}

/// Bytes that are held, until this is dropped.
#[derive(Debug)]
pub struct Permit {
    budget: Budget,
    bytes: usize,
}

impl Permit {
    /// How many bytes it is for.
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    /// Makes it one for `bytes` in all. Refused, it stays as it was; for fewer bytes it never is.
    pub fn resize(&mut self, bytes: usize) -> Result<(), Exceeded> {
        self.try_resize(bytes)
            .inspect_err(|full| self.budget.tell(full))
    }

    fn try_resize(&mut self, bytes: usize) -> Result<(), Exceeded> {
        match bytes.checked_sub(self.bytes) {
            Some(0) => {}
            Some(more) => self.budget.add(more)?,
            None => self.budget.sub(self.bytes - bytes),
        }
        self.bytes = bytes;
        Ok(())
    }

    /// The same for what only ever grows: fewer bytes change nothing.
    pub fn grow_to(&mut self, bytes: usize) -> Result<(), Exceeded> {
        self.resize(bytes.max(self.bytes))
    }

    /// The same, waiting at most for `patience` until others have given back enough.
    pub async fn wait(&mut self, bytes: usize, patience: Duration) -> Result<(), Exceeded> {
        let deadline = tokio::time::Instant::now() + patience;
        let never = bytes > self.budget.most();
        // Whatever can make room stands below the topmost of them, and tells it, too.
        let top = self.budget.chain().last().unwrap_or(&self.budget).clone();
        loop {
            let mut released = Box::pin(top.0.released.notified());
            // Before looking: what is given back in between is not missed.
            released.as_mut().enable();
            let Err(full) = self.try_resize(bytes.max(self.bytes)) else {
                return Ok(());
            };
            if never || tokio::time::timeout_at(deadline, released).await.is_err() {
                self.budget.tell(&full);
                return Err(full);
            }
        }
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        if self.bytes > 0 {
            self.budget.sub(self.bytes);
        }
    }
}

#[cfg(test)]
mod tests;
