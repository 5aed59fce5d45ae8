//! Memory limits as a hierarchy of budgets. In: requests for a number of bytes. Out: permits, which count these bytes
//! until they are dropped.
//!
//! ```text
//!   daemon 1 GiB ─┬─ client 10.0.0.7, 256 MiB ─┬─ a permit: a WebSocket message being assembled
//!                 │                            └─ a permit: a body being read
//!                 └─ servant cam-1, 256 MiB ───── a permit: a TCPROS frame being read
//! ```
//! A permit counts in its budget and in all of that budget's ancestors. If one of them has no room, the permit is
//! refused, and the error names the budget that is full. The caller decides what a refusal leads to; other permits are
//! not affected.
//!
//! A budget may also limit the processor time of tasks that work for its owner ([`Budget::meter`]).

#![forbid(unsafe_code)]

mod json;
mod shares;
mod work;

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;

use bytes::Bytes;
use tokio::sync::Notify;

pub use json::JsonWeight;
pub use shares::Shares;
use work::WorkAccount;
pub use work::{MeteredTask, WorkLimit};

/// Size in bytes up to which a single message, body or queue is not counted in any budget: the number of connections
/// limits their sum.
pub const UNCOUNTED: usize = 64 * 1024;

/// A limit in bytes and the bytes in use. Clones are handles to the same budget.
#[derive(Clone)]
pub struct Budget {
    node: Arc<BudgetNode>,
    /// Permits of this handle do not count in the ancestors.
    alone: bool,
}

struct BudgetNode {
    name: String,
    limit: usize,
    used: AtomicUsize,
    refused: AtomicU64,
    /// Notified when bytes are released, here or in a descendant.
    released: Notify,
    above: Option<Budget>,
    /// Processor time of its tasks, if that is limited.
    work: Option<WorkAccount>,
    /// Called for refusals, here and in descendants.
    observer: Option<Observer>,
}

/// Callback for each refusal, with the name of the budget that was asked and the error. Must not block.
pub type Observer = Box<dyn Fn(&str, &Exceeded) + Send + Sync>;

/// A request for bytes that do not fit into a budget.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{asked} bytes more do not fit into the memory for {name}: {used} of {limit} bytes are in use")]
pub struct Exceeded {
    /// Name of the budget that is full.
    pub name: String,
    /// Bytes requested.
    pub asked: usize,
    /// Bytes in use at that moment.
    pub used: usize,
    /// Limit of the budget in bytes.
    pub limit: usize,
}

impl Budget {
    /// Creates a root budget of `limit` bytes; error messages call it `name`.
    pub fn new(name: impl Into<String>, limit: usize) -> Self {
        Self::from_parts(name.into(), limit, None, None, None)
    }

    /// Creates a root budget whose `observer` is called for each refusal, in it and in its descendants.
    pub fn with_observer(name: impl Into<String>, limit: usize, observer: Observer) -> Self {
        Self::from_parts(name.into(), limit, None, Some(observer), None)
    }

    /// Creates a budget of `limit` bytes below this one: its permits count in both.
    pub fn child(&self, name: impl Into<String>, limit: usize) -> Self {
        Self::from_parts(name.into(), limit, Some(self.clone()), None, None)
    }

    /// Creates a budget like [`child`](Self::child) that also limits the processor time of its tasks.
    pub fn child_with_work(&self, name: impl Into<String>, limit: usize, work: WorkLimit) -> Self {
        Self::from_parts(name.into(), limit, Some(self.clone()), None, Some(work))
    }

    /// Creates a budget that never refuses.
    pub fn without_limit() -> Self {
        Self::new("everything", usize::MAX)
    }

    fn from_parts(
        name: String,
        limit: usize,
        above: Option<Budget>,
        observer: Option<Observer>,
        work: Option<WorkLimit>,
    ) -> Self {
        Self::from(Arc::new(BudgetNode {
            name,
            limit,
            used: AtomicUsize::new(0),
            refused: AtomicU64::new(0),
            released: Notify::new(),
            above,
            work: work.map(WorkAccount::new),
            observer,
        }))
    }

    /// Returns a handle to this budget whose permits do not count in its ancestors: for bytes that count there already
    /// because another permit holds them. A message shared by many clients counts once for the daemon, and once in the
    /// budget of each client.
    pub fn without_parents(&self) -> Self {
        Self { node: self.node.clone(), alone: true }
    }

    /// Returns the name used in error messages.
    pub fn name(&self) -> &str {
        &self.node.name
    }

    /// Returns the limit in bytes.
    pub fn limit(&self) -> usize {
        self.node.limit
    }

    /// Returns the bytes held by permits now.
    pub fn used_bytes(&self) -> usize {
        self.node.used.load(Ordering::Relaxed)
    }

    /// Returns the number of refusals caused by this budget's limit.
    pub fn refusal_count(&self) -> u64 {
        self.node.refused.load(Ordering::Relaxed)
    }

    /// Returns the largest permit possible, in bytes, when nothing else is held.
    pub fn max_permit(&self) -> usize {
        self.chain().map(Budget::limit).min().unwrap_or(0)
    }

    /// Returns the bytes that a permit could be granted now.
    pub fn available(&self) -> usize {
        let left = |budget: &Budget| budget.limit().saturating_sub(budget.used_bytes());
        self.chain().map(left).min().unwrap_or(0)
    }

    /// Returns an empty permit.
    pub fn permit(&self) -> Permit {
        Permit { budget: self.clone(), bytes: 0 }
    }

    /// Takes a permit for `bytes` bytes.
    ///
    /// # Errors
    /// Fails if they do not fit into this budget or one of its ancestors.
    pub fn take(&self, bytes: usize) -> Result<Permit, Exceeded> {
        let mut permit = self.permit();
        permit.resize(bytes)?;
        Ok(permit)
    }

    /// Takes a permit for `bytes` bytes, waiting up to `patience` until they fit.
    ///
    /// # Errors
    /// Fails if they do not fit in time; at once if they exceed the limit itself.
    pub async fn wait(&self, bytes: usize, patience: Duration) -> Result<Permit, Exceeded> {
        let mut permit = self.permit();
        permit.wait(bytes, patience).await?;
        Ok(permit)
    }

    /// Returns the task as one whose processor time is charged to the nearest budget above, or this one, that limits
    /// it. While that has used up its share, the task waits.
    pub fn meter<F: Future>(&self, task: F) -> MeteredTask<F> {
        MeteredTask::new(task, self)
    }

    /// Returns the processor time that was charged for tasks of this budget, or of the nearest one above that limits
    /// it.
    pub fn work_time(&self) -> Duration {
        let account = self.find_payer().and_then(|payer| payer.work.as_ref());
        account.map_or(Duration::ZERO, WorkAccount::total)
    }

    fn find_payer(&self) -> Option<&Arc<BudgetNode>> {
        let mut all = std::iter::successors(Some(self), |budget| budget.node.above.as_ref());
        all.find(|budget| budget.node.work.is_some()).map(|budget| &budget.node)
    }

    /// Returns the parent, if permits of this handle count there.
    fn parent(&self) -> Option<&Budget> {
        self.node.above.as_ref().filter(|_| !self.alone)
    }

    /// Iterates over this budget and its ancestors, from the bottom up.
    fn chain(&self) -> impl Iterator<Item = &Budget> {
        std::iter::successors(Some(self), |budget| budget.parent())
    }

    fn add(&self, bytes: usize) -> Result<(), FullBudget> {
        for (depth, budget) in self.chain().enumerate() {
            let node = &budget.node;
            let more = |used: usize| used.checked_add(bytes).filter(|sum| *sum <= node.limit);
            let added = node.used.fetch_update(Ordering::Relaxed, Ordering::Relaxed, more);
            if let Err(used) = added {
                self.chain().take(depth).for_each(|below| below.sub_here(bytes));
                let exceeded = Exceeded { name: node.name.clone(), asked: bytes, used, limit: node.limit };
                return Err(FullBudget { at: node.clone(), exceeded });
            }
        }
        Ok(())
    }

    /// Counts and reports a refusal. Budgets are compared by identity, since two of them may have the same name.
    fn report(&self, full: FullBudget) -> Exceeded {
        full.at.refused.fetch_add(1, Ordering::Relaxed);
        // Observers of ancestors are called even if nothing is counted there.
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

/// The budget that was full, and the error to report.
struct FullBudget {
    at: Arc<BudgetNode>,
    exceeded: Exceeded,
}

impl From<Arc<BudgetNode>> for Budget {
    fn from(node: Arc<BudgetNode>) -> Self {
        Self { node, alone: false }
    }
}

impl fmt::Debug for Budget {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter
            .debug_struct("Budget")
            .field("name", &self.name())
            .field("used", &self.used_bytes())
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
    /// Returns the size in bytes.
    pub fn bytes(&self) -> usize {
        self.bytes
    }

    /// Returns the budget in which it counts.
    pub fn budget(&self) -> &Budget {
        &self.budget
    }

    /// Changes the size to `bytes`.
    ///
    /// # Errors
    /// Fails if additional bytes do not fit; the size then stays as it is. Shrinking always succeeds.
    pub fn resize(&mut self, bytes: usize) -> Result<(), Exceeded> {
        self.try_resize(bytes).map_err(|full| self.budget.report(full))
    }

    fn try_resize(&mut self, bytes: usize) -> Result<(), FullBudget> {
        match bytes.checked_sub(self.bytes) {
            Some(0) => {}
            Some(more) => self.budget.add(more)?,
            None => self.budget.sub(self.bytes - bytes),
        }
        self.bytes = bytes;
        Ok(())
    }

    /// Grows the permit to `bytes`; does nothing if it is that large already.
    pub fn grow_to(&mut self, bytes: usize) -> Result<(), Exceeded> {
        self.resize(bytes.max(self.bytes))
    }

    /// Sets the size for something that holds `bytes` bytes and changes often, such as a queue: in steps of
    /// [`UNCOUNTED`], and zero up to the first step, so that most changes touch no budget.
    ///
    /// # Errors
    /// Fails if additional bytes do not fit; the size then stays as it is.
    pub fn count(&mut self, bytes: usize) -> Result<(), Exceeded> {
        let steps = match bytes {
            0..=UNCOUNTED => 0,
            more => more.checked_next_multiple_of(UNCOUNTED).unwrap_or(more),
        };
        self.resize(steps)
    }

    /// Splits the permit into two that together count like this one: one for its own budget alone, and one for the
    /// ancestors (`None` for a root budget).
    pub fn split(mut self) -> (Permit, Option<Permit>) {
        let bytes = std::mem::take(&mut self.bytes);
        let above = self.budget.parent().cloned();
        let alone = Permit { budget: self.budget.without_parents(), bytes };
        (alone, above.map(|budget| Permit { budget, bytes }))
    }

    /// Wraps `bytes` so that the permit is held until the last handle to any slice of them is dropped.
    pub fn wrap_bytes(self, bytes: impl AsRef<[u8]> + Send + 'static) -> Bytes {
        Bytes::from_owner(BytesWithPermit { bytes, _permit: self })
    }

    /// Grows the permit to `bytes`, waiting up to `patience` until others have released enough.
    pub async fn wait(&mut self, bytes: usize, patience: Duration) -> Result<(), Exceeded> {
        let deadline = tokio::time::Instant::now() + patience;
        let never = bytes > self.budget.max_permit();
        // Every budget that can make room is a descendant of the root, which is notified as well.
        let top = self.budget.chain().last().unwrap_or(&self.budget).clone();
        loop {
            let mut released = Box::pin(top.node.released.notified());
            // Registered before trying, so that no release in between is missed.
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

struct BytesWithPermit<B> {
    bytes: B,
    _permit: Permit,
}

impl<B: AsRef<[u8]>> AsRef<[u8]> for BytesWithPermit<B> {
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
