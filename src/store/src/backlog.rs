//! Queue of writes for the time when the database cannot be written: the disk is full, or another program has locked
//! it.
//!
//! ```text
//!   writable ──a write fails──▶ unwritable: queued in order ──retried every 0.5 s──▶ all written, writable
//! ```
//!
//! Only writes that record past events are queued, so that nobody waits for them. Both transitions are events
//! themselves.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use api::{Event, Level, Millis};
use parking_lot::Mutex;
use rusqlite::{Connection, ErrorCode, Transaction, params};
use tokio::sync::{Notify, watch};

use super::{State, commit, events, now, wait_for_another};

/// Interval between attempts to write the queue.
const AGAIN: Duration = Duration::from_millis(500);
/// Maximum time that a queueable write waits for the connection while a longer statement uses it.
const MOMENT: Duration = Duration::from_millis(100);
/// Maximum length of the queue; the oldest writes are dropped first.
const MAX_QUEUE: usize = 10_000;

/// A write that can be deferred.
#[derive(Debug, Clone)]
pub(super) enum Write {
    /// An event; its number is assigned when it is queued.
    Event(Event),
    /// A servant has ended.
    ServantGone(String),
    /// A robot has connected.
    RobotSeen(String, Millis),
}

/// Queue of deferred writes, and the numbering of events.
pub(super) struct Backlog {
    waiting: Mutex<PendingWrites>,
    begun: Notify,
    /// Number of the latest readable event.
    last: watch::Sender<i64>,
}

struct PendingWrites {
    last_event: i64,
    writes: VecDeque<Write>,
    dropped: u64,
    /// Start and cause of the current outage.
    outage: Option<(Millis, String)>,
}

impl Backlog {
    pub(super) fn new(last_event: i64) -> Backlog {
        Backlog {
            waiting: Mutex::new(PendingWrites { last_event, writes: VecDeque::new(), dropped: 0, outage: None }),
            begun: Notify::new(),
            last: watch::Sender::new(last_event),
        }
    }

    /// Notifies those who wait for events of the latest readable one.
    fn notify_readers(&self, waiting: &PendingWrites) {
        self.last.send_if_modified(|last| {
            let newer = *last < waiting.last_event;
            *last = waiting.last_event;
            newer
        });
    }

    /// Returns the events after number `since` that have not been written yet.
    pub(super) fn unwritten_events(&self, since: i64) -> Vec<Event> {
        let waiting = self.waiting.lock();
        let event = |write: &Write| match write {
            Write::Event(event) if event.id > since => Some(event.clone()),
            _ => None,
        };
        waiting.writes.iter().filter_map(event).collect()
    }
}

impl PendingWrites {
    fn push(&mut self, write: Write) {
        if self.writes.len() == MAX_QUEUE {
            self.writes.pop_front();
            self.dropped += 1;
        }
        self.writes.push_back(write);
    }

    fn new_event(&mut self, level: Level, kind: &str, message: String) -> Event {
        self.last_event += 1;
        Event {
            id: self.last_event,
            time: now(),
            level,
            kind: kind.to_owned(),
            service: None,
            servant: None,
            robot: None,
            message,
        }
    }
}

impl State {
    /// Returns why the database currently cannot be written, if so.
    pub fn outage_message(&self) -> Option<String> {
        let waiting = self.backlog.waiting.lock();
        let (_, why) = waiting.outage.as_ref()?;
        Some(format!("the state database {} cannot be written: {why}", self.path))
    }

    /// Watches the number of the latest event.
    pub fn watch_events(&self) -> watch::Receiver<i64> {
        self.backlog.last.subscribe()
    }

    /// Writes immediately if that is possible without waiting; otherwise queues the write.
    pub(super) fn write_or_queue(&self, write: Write) {
        let mut waiting = self.backlog.waiting.lock();
        self.write_or_queue_locked(&mut waiting, write);
        self.backlog.notify_readers(&waiting);
    }

    fn write_or_queue_locked(&self, waiting: &mut PendingWrites, mut write: Write) {
        if let Write::Event(event) = &mut write {
            waiting.last_event += 1;
            event.id = waiting.last_event;
        }
        if !waiting.writes.is_empty() {
            return waiting.push(write);
        }
        // Blocked by a longer statement of this process or by another program; may be over in a moment.
        let Some(mut connection) = self.connection.try_lock_for(MOMENT) else {
            waiting.push(write);
            return self.backlog.begun.notify_one();
        };
        let outcome = commit_without_waiting(&mut connection, |transaction| apply(transaction, &write));
        drop(connection);
        let Err(error) = outcome else { return };
        waiting.push(write);
        if is_locked(&error) {
            self.backlog.begun.notify_one();
        } else {
            self.begin_outage(waiting, &error);
        }
    }

    /// Begins an outage if the error of a failed write indicates a lasting condition.
    pub(super) fn on_write_failed(&self, error: &rusqlite::Error) {
        let lasting = is_locked(error)
            || matches!(
                error.sqlite_error_code(),
                Some(ErrorCode::DiskFull | ErrorCode::ReadOnly | ErrorCode::SystemIoFailure | ErrorCode::CannotOpen)
            );
        if lasting {
            let mut waiting = self.backlog.waiting.lock();
            self.begin_outage(&mut waiting, error);
            self.backlog.notify_readers(&waiting);
        }
    }

    fn begin_outage(&self, waiting: &mut PendingWrites, error: &rusqlite::Error) {
        if waiting.outage.is_some() {
            return;
        }
        let why = describe_error(error);
        let message = format!(
            "the state database {} cannot be written: {why}; servants keep running, new ones and pushes are refused, \
                and events are kept in memory until it can be written",
            self.path
        );
        tracing::error!("{message}");
        waiting.outage = Some((now(), why));
        let event = waiting.new_event(Level::Error, "state-unwritable", message);
        waiting.push(Write::Event(event));
        self.backlog.begun.notify_one();
    }

    /// Writes the queue, oldest first; returns whether it is empty.
    fn flush(&self) -> bool {
        let mut waiting = self.backlog.waiting.lock();
        let Some(mut connection) = self.connection.try_lock_for(MOMENT) else {
            return false;
        };
        while let Some(write) = waiting.writes.front() {
            if let Err(error) = commit_without_waiting(&mut connection, |transaction| apply(transaction, write)) {
                self.begin_outage(&mut waiting, &error);
                return false;
            }
            waiting.writes.pop_front();
        }
        let Some((since, _)) = waiting.outage.clone() else {
            return true;
        };
        let lost = match waiting.dropped {
            0 => String::new(),
            dropped => format!("; {dropped} events and records were dropped"),
        };
        let message = format!(
            "the state database {} can be written again, after {:.1} s{lost}",
            self.path,
            now().saturating_sub(since) as f64 / 1000.0
        );
        let event = waiting.new_event(Level::Info, "state-writable", message);
        if commit_without_waiting(&mut connection, |transaction| events::insert(transaction, &event)).is_err() {
            waiting.last_event -= 1;
            return false;
        }
        tracing::info!("{}", event.message);
        self.backlog.notify_readers(&waiting);
        waiting.dropped = 0;
        waiting.outage = None;
        true
    }
}

/// Writes the queue as soon as possible. Polls only while the queue is not empty.
pub async fn flush_pending_writes(state: Arc<State>) {
    loop {
        state.backlog.begun.notified().await;
        loop {
            tokio::time::sleep(AGAIN).await;
            let state = Arc::clone(&state);
            let done = tokio::task::spawn_blocking(move || state.flush());
            if done.await.unwrap_or(true) {
                break;
            }
        }
    }
}

/// Runs `work` in a transaction without waiting for others that have the database locked.
fn commit_without_waiting<T>(
    connection: &mut Connection,
    work: impl FnOnce(&Transaction<'_>) -> rusqlite::Result<T>,
) -> rusqlite::Result<T> {
    connection.busy_timeout(Duration::ZERO)?;
    let outcome = commit(connection, work);
    connection.busy_handler(Some(wait_for_another))?;
    outcome
}

fn apply(connection: &Connection, write: &Write) -> rusqlite::Result<()> {
    match write {
        Write::Event(event) => events::insert(connection, event),
        Write::ServantGone(id) => {
            connection.prepare_cached("DELETE FROM servants WHERE id = ?1")?.execute([id]).map(|_| ())
        }
        Write::RobotSeen(robot, time) => connection
            .prepare_cached("UPDATE robots SET last_seen = ?2 WHERE name = ?1")?
            .execute(params![robot, *time as i64])
            .map(|_| ()),
    }
}

/// Returns whether another connection holds the lock, which it may release at any moment.
fn is_locked(error: &rusqlite::Error) -> bool {
    matches!(error.sqlite_error_code(), Some(ErrorCode::DatabaseBusy | ErrorCode::DatabaseLocked))
}

fn describe_error(error: &rusqlite::Error) -> String {
    match error.sqlite_error_code() {
        Some(ErrorCode::DiskFull) => "its disk is full".to_owned(),
        _ if is_locked(error) => "another program has locked it".to_owned(),
        _ => error.to_string(),
    }
}
