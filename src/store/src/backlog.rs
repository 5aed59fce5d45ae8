//! What is to be written and cannot be: the disk is full, or another program has locked the database.
//!
//! ```text
//!   writable ──a write fails──▶ unwritable: kept here, in order ──tried every half second──▶ all written, writable
//! ```
//!
//! Kept is what only tells of what has happened, so that nobody waits for it. Both changes are events themselves.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use api::{Event, Level, Millis};
use parking_lot::Mutex;
use rusqlite::{Connection, ErrorCode, Transaction, params};
use tokio::sync::{Notify, watch};

use super::{State, commit, events, now, wait_for_another};

/// Between attempts to write what is kept.
const AGAIN: Duration = Duration::from_millis(500);
/// For the connection that a longer statement uses; what tells of the past waits no longer than that.
const MOMENT: Duration = Duration::from_millis(100);
/// More is not kept: the oldest is dropped.
const KEPT: usize = 10_000;

/// Something that can be written later.
#[derive(Debug, Clone)]
pub(super) enum Write {
    /// An event; it is given its number here.
    Event(Event),
    /// A servant has ended.
    ServantGone(String),
    /// A robot came.
    RobotSeen(String, Millis),
}

/// What is kept, and how events are numbered.
pub(super) struct Backlog {
    waiting: Mutex<Waiting>,
    begun: Notify,
    /// The number of the last event that can be read.
    last: watch::Sender<i64>,
}

struct Waiting {
    last_event: i64,
    writes: VecDeque<Write>,
    dropped: u64,
    /// Since when nothing can be written, and why.
    outage: Option<(Millis, String)>,
}

impl Backlog {
    pub(super) fn new(last_event: i64) -> Backlog {
        Backlog {
            waiting: Mutex::new(Waiting {
                last_event,
                writes: VecDeque::new(),
                dropped: 0,
                outage: None,
            }),
            begun: Notify::new(),
            last: watch::Sender::new(last_event),
        }
    }

    /// Tells who waits for events of those that can be read now.
    fn tell(&self, waiting: &Waiting) {
        self.last.send_if_modified(|last| {
            let newer = *last < waiting.last_event;
            *last = waiting.last_event;
            newer
        });
    }

    /// Events after number `since` that are not written yet.
    pub(super) fn events(&self, since: i64) -> Vec<Event> {
        let waiting = self.waiting.lock();
        let event = |write: &Write| match write {
            Write::Event(event) if event.id > since => Some(event.clone()),
            _ => None,
        };
        waiting.writes.iter().filter_map(event).collect()
    }
}

impl Waiting {
    fn keep(&mut self, write: Write) {
        if self.writes.len() == KEPT {
            self.writes.pop_front();
            self.dropped += 1;
        }
        self.writes.push_back(write);
    }

    fn event(&mut self, level: Level, kind: &str, message: String) -> Event {
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
    /// Why nothing can be written now, if so.
    pub fn unwritable(&self) -> Option<String> {
        let waiting = self.backlog.waiting.lock();
        let (_, why) = waiting.outage.as_ref()?;
        Some(format!(
            "the state database {} cannot be written: {why}",
            self.path
        ))
    }

    /// The number of the last event, whenever there is a newer one.
    pub fn watch_events(&self) -> watch::Receiver<i64> {
        self.backlog.last.subscribe()
    }

    /// Writes at once if that needs no waiting, and later otherwise.
    pub(super) fn write_or_keep(&self, write: Write) {
        let mut waiting = self.backlog.waiting.lock();
        self.write_now_or_keep(&mut waiting, write);
        self.backlog.tell(&waiting);
    }

    fn write_now_or_keep(&self, waiting: &mut Waiting, mut write: Write) {
        if let Write::Event(event) = &mut write {
            waiting.last_event += 1;
            event.id = waiting.last_event;
        }
        if !waiting.writes.is_empty() {
            return waiting.keep(write);
        }
        // Held up by a statement of our own that takes longer, or by another program: that may be over in a moment.
        let Some(mut connection) = self.connection.try_lock_for(MOMENT) else {
            waiting.keep(write);
            return self.backlog.begun.notify_one();
        };
        let outcome = impatiently(&mut connection, |transaction| apply(transaction, &write));
        drop(connection);
        let Err(error) = outcome else { return };
        waiting.keep(write);
        if is_locked(&error) {
            self.backlog.begun.notify_one();
        } else {
            self.begin_outage(waiting, &error);
        }
    }

    /// Another write has failed: does it tell of more than itself?
    pub(super) fn write_failed(&self, error: &rusqlite::Error) {
        let lasting = is_locked(error)
            || matches!(
                error.sqlite_error_code(),
                Some(
                    ErrorCode::DiskFull
                        | ErrorCode::ReadOnly
                        | ErrorCode::SystemIoFailure
                        | ErrorCode::CannotOpen
                )
            );
        if lasting {
            let mut waiting = self.backlog.waiting.lock();
            self.begin_outage(&mut waiting, error);
            self.backlog.tell(&waiting);
        }
    }

    fn begin_outage(&self, waiting: &mut Waiting, error: &rusqlite::Error) {
        if waiting.outage.is_some() {
            return;
        }
        let why = in_words(error);
        let message = format!(
            "the state database {} cannot be written: {why}; servants work on, new ones and pushes are refused, \
             and events are kept in memory until it can",
            self.path
        );
        tracing::error!("{message}");
        waiting.outage = Some((now(), why));
        let event = waiting.event(Level::Error, "state-unwritable", message);
        waiting.keep(Write::Event(event));
        self.backlog.begun.notify_one();
    }

    /// Writes what is kept, oldest first; whether nothing is left.
    fn catch_up(&self) -> bool {
        let mut waiting = self.backlog.waiting.lock();
        let Some(mut connection) = self.connection.try_lock_for(MOMENT) else {
            return false;
        };
        while let Some(write) = waiting.writes.front() {
            if let Err(error) =
                impatiently(&mut connection, |transaction| apply(transaction, write))
            {
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
            dropped => format!("; {dropped} events and records were too many to keep"),
        };
        let message = format!(
            "the state database {} can be written again, after {:.1} s{lost}",
            self.path,
            now().saturating_sub(since) as f64 / 1000.0
        );
        let event = waiting.event(Level::Info, "state-writable", message);
        if impatiently(&mut connection, |transaction| {
            events::insert(transaction, &event)
        })
        .is_err()
        {
            waiting.last_event -= 1;
            return false;
        }
        tracing::info!("{}", event.message);
        self.backlog.tell(&waiting);
        waiting.dropped = 0;
        waiting.outage = None;
        true
    }
}

/// Writes what is kept as soon as that is possible. Only while something is kept is anything done at intervals.
pub async fn watch(state: Arc<State>) {
    loop {
        state.backlog.begun.notified().await;
        loop {
            tokio::time::sleep(AGAIN).await;
            let state = Arc::clone(&state);
            let done = tokio::task::spawn_blocking(move || state.catch_up());
            if done.await.unwrap_or(true) {
                break;
            }
        }
    }
}

/// Writes what `work` writes, all or none, without waiting for others that have the database locked.
fn impatiently<T>(
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
        Write::ServantGone(id) => connection
            .prepare_cached("DELETE FROM servants WHERE id = ?1")?
            .execute([id])
            .map(|_| ()),
        Write::RobotSeen(robot, time) => connection
            .prepare_cached("UPDATE robots SET last_seen = ?2 WHERE name = ?1")?
            .execute(params![robot, *time as i64])
            .map(|_| ()),
    }
}

/// Another has the database, and may give it back at any moment.
fn is_locked(error: &rusqlite::Error) -> bool {
    matches!(
        error.sqlite_error_code(),
        Some(ErrorCode::DatabaseBusy | ErrorCode::DatabaseLocked)
    )
}

fn in_words(error: &rusqlite::Error) -> String {
    match error.sqlite_error_code() {
        Some(ErrorCode::DiskFull) => "its disk is full".to_owned(),
        _ if is_locked(error) => "another program has locked it".to_owned(),
        _ => error.to_string(),
    }
}
