//! Limits on the memory that the daemon uses for each client and each servant. A refusal becomes an event.
//!
//! ```text
//!  the daemon ─┬─ client 10.0.0.7    unfinished messages, bodies of requests
//!              └─ servant cam-1      frames of its nodes, records of its links, JSON made of its messages
//! ```

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use budget::{Budget, Exceeded, Shares, WorkLimit};
use parking_lot::Mutex;

use store::{Journal, NewEvent, NoticeThrottle};

/// Processor time that one servant may make the daemon spend on following its graph and answering its nodes: starting
/// nodes fit into the burst, and nodes that register and look without end are followed more slowly.
const SERVANT_WORK: WorkLimit = WorkLimit { cores: 0.2, burst: Duration::from_secs(5) };

/// Limits on memory outside of servants' containers.
#[derive(Debug, Clone)]
pub struct MemoryOptions {
    /// Bytes for all clients and servants together.
    pub daemon: u64,
    /// Bytes for one client: its unfinished messages, and the bodies of its requests.
    pub client: u64,
    /// Bytes for one servant: unfinished messages of its nodes and links, and JSON or CBOR made from its messages.
    pub servant: u64,
    /// Maximum time from the first byte of a message, frame or body to its last.
    pub unfinished: Duration,
}

/// The daemon's memory budgets.
#[derive(Debug)]
pub struct Memory {
    whole: Budget,
    clients: Shares,
    servants: Shares,
    refused: Arc<AtomicU64>,
    /// Maximum time from the first byte of a message, frame or body to its last.
    pub unfinished: Duration,
}

impl Memory {
    /// Creates the budgets as configured; refusals are written to the journal.
    pub fn new(options: &MemoryOptions, journal: Journal) -> Memory {
        let bytes = |size: u64| usize::try_from(size).unwrap_or(usize::MAX);
        let refused = Arc::<AtomicU64>::default();
        let count = Arc::clone(&refused);
        let throttle: Mutex<NoticeThrottle> = Mutex::default();
        let observer = move |who: &str, full: &Exceeded| {
            count.fetch_add(1, Ordering::Relaxed);
            tracing::debug!(who, %full, "memory limit reached");
            let admitted = throttle.lock().admit(who, store::now());
            if admitted.is_some() {
                report(&journal, who, full);
            }
        };
        let whole = Budget::with_observer("the daemon", bytes(options.daemon), Box::new(observer));
        Memory {
            clients: Shares::new(&whole, "client", bytes(options.client)),
            servants: Shares::new(&whole, "servant", bytes(options.servant)).with_work(SERVANT_WORK),
            whole,
            refused,
            unfinished: options.unfinished,
        }
    }

    /// Returns the budget of the client with this name.
    pub fn client(&self, name: &str) -> Budget {
        self.clients.for_name(name)
    }

    /// Returns the budget of a servant.
    pub fn servant(&self, id: &str) -> Budget {
        self.servants.for_name(id)
    }

    /// Returns the number of refused requests for memory.
    pub fn refusal_count(&self) -> u64 {
        self.refused.load(Ordering::Relaxed)
    }

    /// Returns the budget above all others.
    pub fn whole(&self) -> &Budget {
        &self.whole
    }
}

fn report(journal: &Journal, who: &str, full: &Exceeded) {
    let journal = journal.clone();
    let servant = who.strip_prefix("servant ").map(str::to_owned);
    let message =
        format!("{who} reached its memory limit: {full}; the data was dropped (limits: [memory] of the configuration)");
    // Writing to the database may block; a request for memory must not.
    let write = move || {
        let about = NewEvent { servant: servant.as_deref(), ..NewEvent::default() };
        journal.warning("memory-refused", &message, &about);
    };
    match tokio::runtime::Handle::try_current() {
        Ok(runtime) => drop(runtime.spawn_blocking(write)),
        Err(_) => write(),
    }
}

/// The daemon's memory budgets, shared by its parts.
pub(crate) type SharedMemory = Arc<Memory>;
