//! Limits of memory, in a hierarchy of budgets. In: requests for a number of bytes. Out: permits, which count these bytes
//! until they are dropped.
//!
//! ```text
//!   daemon 1 GiB ─┬─ client 10.0.0.7, 256 MiB ─┬─ a permit: a WebSocket message being assembled
//!                 │                            └─ a permit: a body being read
//!                 └─ servant cam-1, 256 MiB ───── a permit: a TCPROS frame being read
//! ```
//! A permit counts in its budget and in all budgets above it. If it does not fit in one of them it is refused, and the error
//! names the budget that is full. What a refusal costs is the caller's decision; other permits are not affected.

#![forbid(unsafe_code)]

mod json;
mod shares;

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;

use bytes::Bytes;
use tokio::sync::Notify;

pub use json::JsonWeight;
pub use shares::Shares;

/// Up to this size a single message, body or queue counts in no budget: the number of connections limits their sum.
pub const UNCOUNTED: usize = 64 * 1024;

/// A limit in bytes, and how many of them are in use. Clones are handles to the same budget.
#[derive(Clone)]
pub struct Budget {
    node: Arc<Node>,
    /// Permits of this handle do not count in the budgets above.
    alone: bool,
}

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

/// Called for each refusal, with the name of the budget that was asked and the error. Must not block.
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
    /// A topmost budget of `limit` bytes. `name` is what errors call it.
    pub fn new(name: impl Into<String>, limit: usize) -> Self {
        Self::node(name.into(), limit, None, None)
    }

    /// The same; `observer` is called for each refusal in it and in budgets below it.
    pub fn observed(name: impl Into<String>, limit: usize, observer: Observer) -> Self {
        Self::node(name.into(), limit, None, Some(observer))
    }

    /// A budget of `limit` bytes below this one: its permits count in both.
    pub fn within(&self, name: impl Into<String>, limit: usize) -> Self {
        Self::node(name.into(), limit, Some(self.clone()), None)
    }

    /// A budget that refuses nothing.
    pub fn unlimited() -> Self {
        Self::new("everything", usize::MAX)
    }

    fn node(name: String, limit: usize, above: Option<Budget>, observer: Option<Observer>) -> Self {
        Self::from(Arc::new(Node {
            name,
            limit,
            used: AtomicUsize::new(0),
            refused: AtomicU64::new(0),
            released: Notify::new(),
            above,
            observer,
        }))
    }

    /// The same budget without those above it. Its permits are for bytes that count above already, because another permit
    /// holds them: a message that many clients share counts once for the daemon and in the budget of each client.
    pub fn alone(&self) -> Self {
        Self {
            node: self.node.clone(),
            alone: true,
        }
    }

    /// Its name, as errors call it.
    pub fn name(&self) -> &str {
        &self.node.name
    }

    /// Its limit in bytes.
    pub fn limit(&self) -> usize {
        self.node.limit
    }

    /// Bytes of its permits now.
    pub fn used(&self) -> usize {
        self.node.used.load(Ordering::Relaxed)
    }

    /// How many refusals it has caused.
    pub fn refused(&self) -> u64 {
        self.node.refused.load(Ordering::Relaxed)
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

    /// A permit for `bytes` bytes.
    ///
    /// # Errors
    /// They do not fit in this budget or in one above.
    pub fn take(&self, bytes: usize) -> Result<Permit, Exceeded> {
        let mut permit = self.permit();
        permit.resize(bytes)?;
        Ok(permit)
    }

    /// A permit for `bytes` bytes, waiting at most for `patience` until they fit.
    ///
    /// # Errors
    /// They did not fit in time; at once if they exceed the limit itself.
    pub async fn wait(&self, bytes: usize, patience: Duration) -> Result<Permit, Exceeded> {
        let mut permit = self.permit();
        permit.wait(bytes, patience).await?;
        Ok(permit)
    }

    /// The next one in which its permits count.
    fn above(&self) -> Option<&Budget> {
        self.node.above.as_ref().filter(|_| !self.alone)
    }

    /// This budget and those above it, upwards.
    fn chain(&self) -> impl Iterator<Item = &Budget> {
        std::iter::successors(Some(self), |budget| budget.above())
    }

    fn add(&self, bytes: usize) -> Result<(), Full> {
        for (depth, budget) in self.chain().enumerate() {
            let node = &budget.node;
            let more = |used: usize| used.checked_add(bytes).filter(|sum| *sum <= node.limit);
            let added = node
                .used
                .fetch_update(Ordering::Relaxed, Ordering::Relaxed, more);
            if let Err(used) = added {
                self.chain()
                    .take(depth)
                    .for_each(|below| below.sub_here(bytes));
                let exceeded = Exceeded {
                    name: node.name.clone(),
                    asked: bytes,
                    used,
                    limit: node.limit,
                };
                return Err(Full {
                    at: node.clone(),
                    exceeded,
                });
            }
        }
        Ok(())
    }

    /// Counts and reports a refusal. Budgets are compared by identity: two of them may have the same name.
    fn report(&self, full: Full) -> Exceeded {
        full.at.refused.fetch_add(1, Ordering::Relaxed);
        // Those above are told even if nothing is counted there.
        let all = std::iter::successors(Some(self), |budget| budget.node.above.as_ref());
        for observer in all.filter_map(|budget| budget.node.observer.as_ref()) {
            observer(self.name(), &full.exceeded);
        }
        full.exceeded
    }

    fn sub(&self, bytes: usize) {
        self.chain().for_each(|budget| budget.sub_here(bytes));
    }

    fn sub_here(&self, bytes: usize) {
        self.node.used.fetch_sub(bytes, Ordering::Relaxed);
        self.node.released.notify_waiters();
    }
}

/// Where bytes did not fit.
struct Full {
    at: Arc<Node>,
    exceeded: Exceeded,
}

impl From<Arc<Node>> for Budget {
    fn from(node: Arc<Node>) -> Self {
        Self { node, alone: false }
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

/// Bytes that count as in use until this is dropped.
#[derive(Debug)]
pub struct Permit {
    budget: Budget,
    bytes: usize,
}

impl Permit {
    /// Its size in bytes.
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    /// Sets its size to `bytes`.
    ///
    /// # Errors
    /// More bytes do not fit; it keeps its size. Fewer bytes always succeed.
    pub fn resize(&mut self, bytes: usize) -> Result<(), Exceeded> {
        self.try_resize(bytes)
            .map_err(|full| self.budget.report(full))
    }

    fn try_resize(&mut self, bytes: usize) -> Result<(), Full> {
        match bytes.checked_sub(self.bytes) {
            Some(0) => {}
            Some(more) => self.budget.add(more)?,
            None => self.budget.sub(self.bytes - bytes),
        }
        self.bytes = bytes;
        Ok(())
    }

    /// Grows it to `bytes`; fewer bytes than it has change nothing.
    pub fn grow_to(&mut self, bytes: usize) -> Result<(), Exceeded> {
        self.resize(bytes.max(self.bytes))
    }

    /// Sets its size for something that holds `bytes` bytes and changes often, such as a queue: in steps of [`UNCOUNTED`], and
    /// zero up to there, so that most changes touch no budget.
    ///
    /// # Errors
    /// More bytes do not fit; it keeps its size.
    pub fn count(&mut self, bytes: usize) -> Result<(), Exceeded> {
        let steps = match bytes {
            0..=UNCOUNTED => 0,
            more => more.checked_next_multiple_of(UNCOUNTED).unwrap_or(more),
        };
        self.resize(steps)
    }

    /// Divides it in two that together count as it did: one in its budget alone, one in the budgets above (none for a
    /// topmost budget).
    pub fn split(mut self) -> (Permit, Option<Permit>) {
        let bytes = std::mem::take(&mut self.bytes);
        let above = self.budget.above().cloned();
        let alone = Permit {
            budget: self.budget.alone(),
            bytes,
        };
        (alone, above.map(|budget| Permit { budget, bytes }))
    }

    /// These bytes, which hold the permit until the last handle to any part of them is dropped.
    pub fn around(self, bytes: impl AsRef<[u8]> + Send + 'static) -> Bytes {
        Bytes::from_owner(Counted {
            bytes,
            _permit: self,
        })
    }

    /// Grows it to `bytes`, waiting at most for `patience` until others have given back enough.
    pub async fn wait(&mut self, bytes: usize, patience: Duration) -> Result<(), Exceeded> {
        let deadline = tokio::time::Instant::now() + patience;
        let never = bytes > self.budget.most();
        // Whatever can make room stands below the topmost of them, and tells it, too.
        let top = self.budget.chain().last().unwrap_or(&self.budget).clone();
        loop {
            let mut released = Box::pin(top.node.released.notified());
            // Before looking: what is given back in between is not missed.
            released.as_mut().enable();
            let Err(full) = self.try_resize(bytes.max(self.bytes)) else {
                return Ok(());
            };
            if never || tokio::time::timeout_at(deadline, released).await.is_err() {
                return Err(self.budget.report(full));
            }
        }
    }
}

struct Counted<B> {
    bytes: B,
    _permit: Permit,
}

impl<B: AsRef<[u8]>> AsRef<[u8]> for Counted<B> {
    fn as_ref(&self) -> &[u8] {
        self.bytes.as_ref()
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
