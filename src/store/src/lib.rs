//! Persistent state: services, their revisions, dictionaries and rollouts, owners of robot names, servants, tokens,
//! pairings, people and their sessions, policy rules, the audit log and the event journal. SQLite in WAL mode with
//! short statements: one connection that writes, always in a transaction ([`State::write`]), and several read-only ones
//! that no writer blocks ([`readers`]).
//!
//! Events and servants are written without waiting for the disk (nothing is lost if the daemon is killed, the latest
//! perhaps in a power failure); publishing waits for the disk. Writes that only record the past are queued in memory
//! while the disk is full or the database is locked by another program ([`backlog`]); other writes fail.

mod audit;
mod backlog;
mod dictionary;
mod events;
mod history;
mod journal;
mod pairings;
mod people;
pub mod private;
mod provided;
mod pushes;
mod readers;
mod recordings;
mod robots;
mod rollouts;
mod rules;
mod servants;
mod services;
mod throttle;
mod tokens;
mod underlays;

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use api::Millis;
use parking_lot::Mutex;
use rusqlite::{Connection, Transaction, TransactionBehavior};
use serde::Serialize;

pub use audit::NewAuditRecord;
use backlog::Backlog;
pub use backlog::flush_pending_writes;
pub use events::{EventFilter, EventVisibility, NewEvent};
pub use history::{NewSample, RecordedSeries, SeriesFilter};
pub use journal::Journal;
pub use pairings::{CodeRecord, PairingRecord};
pub use people::{AccountEdit, AccountRecord, NewSession, SessionRecord};
pub use provided::FederatedPersonRecord;
pub use pushes::PushRecord;
use readers::Readers;
pub use recordings::RecordingRecord;
pub use robots::{Owner, TokenHash};
pub use rules::RuleRecord;
pub use servants::ServantRecord;
pub use services::{Plan, RevisionRecord, RevisionSummary};
pub use throttle::NoticeThrottle;
pub use tokens::{NewToken, TokenRecord};
pub use underlays::{StandingService, UnderlayRecord};

/// Migrations from an empty database to the current schema; append-only.
const MIGRATIONS: [&str; 17] = [
    include_str!("001-start.sql"),
    include_str!("002-limits.sql"),
    include_str!("003-inventory.sql"),
    include_str!("004-terms.sql"),
    include_str!("005-dictionary.sql"),
    include_str!("006-rollouts.sql"),
    include_str!("007-access.sql"),
    include_str!("008-audit.sql"),
    include_str!("009-pairings.sql"),
    include_str!("010-people.sql"),
    include_str!("011-provided.sql"),
    include_str!("012-history.sql"),
    include_str!("013-recordings.sql"),
    include_str!("014-recorded-topics.sql"),
    include_str!("015-events-by-service.sql"),
    include_str!("016-pushes.sql"),
    include_str!("017-underlays.sql"),
];

/// Errors of the state database.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Error of SQLite.
    #[error("the state database {path}: {source}")]
    Database {
        /// Database file.
        path: String,
        /// Error returned by SQLite.
        source: rusqlite::Error,
    },
    /// The database was written by a later version.
    #[error(
        "the state database {path} has version {found}, but this program supports up to {known}; install a newer \
            cloudroidd"
    )]
    TooNew {
        /// Database file.
        path: String,
        /// Schema version of the database.
        found: usize,
        /// Latest schema version known to this program.
        known: usize,
    },
    /// A record cannot be decoded.
    #[error("cannot read the record of {what} in the state database: {source}")]
    Record {
        /// Table or row.
        what: String,
        /// Error of the decoder.
        source: serde_json::Error,
    },
}

/// The state database.
pub struct State {
    connection: Mutex<Connection>,
    readers: Readers,
    path: String,
    backlog: Backlog,
    /// Cache of revisions in use, by service and revision number.
    revisions: Mutex<HashMap<(String, u64), Arc<RevisionRecord>>>,
}

/// Returns the current time in milliseconds since 1970.
pub fn now() -> Millis {
    millis(SystemTime::now())
}

/// Converts a time to milliseconds since 1970.
pub fn millis(time: SystemTime) -> Millis {
    time.duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as Millis)
}

/// Opens all files of a database: SQLite opens the last of them at the first query, and the threads that query later
/// may not open files.
fn open_files(connection: &Connection) -> rusqlite::Result<()> {
    connection.query_row("SELECT count(*) FROM sqlite_schema", [], |_| Ok(()))
}

/// Converts an I/O error to SQLite's error for it.
fn open_error(error: &std::io::Error) -> rusqlite::Error {
    let code = rusqlite::ffi::Error::new(rusqlite::ffi::SQLITE_CANTOPEN);
    rusqlite::Error::SqliteFailure(code, Some(error.to_string()))
}

impl State {
    /// Opens the database, creating or migrating it as needed.
    pub fn open(path: &Path) -> Result<State, Error> {
        let name = path.display().to_string();
        let failed = |source| Error::Database { path: name.clone(), source };
        // The database holds token hashes. SQLite gives its auxiliary files the same permissions.
        private::open(path).map_err(|error| failed(open_error(&error)))?;
        let mut connection = Connection::open(path).map_err(failed)?;
        connection
            .execute_batch(
                "PRAGMA journal_mode = WAL; PRAGMA synchronous = NORMAL; \
                 PRAGMA foreign_keys = ON; PRAGMA temp_store = MEMORY;",
            )
            .map_err(failed)?;
        connection.busy_handler(Some(wait_for_another)).map_err(failed)?;
        migrate(&mut connection, &name)?;
        let last = events::last_event_number(&connection).map_err(failed)?;
        open_files(&connection).map_err(failed)?;
        Ok(State {
            connection: Mutex::new(connection),
            readers: Readers::open(path).map_err(failed)?,
            backlog: Backlog::new(last),
            path: name,
            revisions: Mutex::default(),
        })
    }

    /// Runs `work` in a transaction: if this returns a value, a crash of the daemon does not lose it.
    fn write<T>(&self, work: impl FnOnce(&Transaction<'_>) -> rusqlite::Result<T>) -> Result<T, Error> {
        self.with_writer(|connection| commit(connection, work))
    }

    /// Runs `work` in a durable transaction: if this returns a value, a power failure does not lose it.
    fn write_durably<T>(&self, work: impl FnOnce(&Transaction<'_>) -> rusqlite::Result<T>) -> Result<T, Error> {
        self.with_writer(|connection| {
            connection.pragma_update(None, "synchronous", "FULL")?;
            let outcome = commit(connection, work);
            connection.pragma_update(None, "synchronous", "NORMAL")?;
            outcome
        })
    }

    fn with_writer<T>(&self, work: impl FnOnce(&mut Connection) -> rusqlite::Result<T>) -> Result<T, Error> {
        let outcome = {
            let mut connection = self.connection.try_lock().unwrap_or_else(|| run_blocking(|| self.connection.lock()));
            work(&mut connection)
        };
        outcome.map_err(|source| {
            self.on_write_failed(&source);
            self.database_error(source)
        })
    }

    /// Runs a query on a connection that no other query is using. It is blocked neither by a writer nor, as long as a
    /// connection is free, by a longer query.
    fn read<T>(&self, work: impl FnOnce(&Connection) -> rusqlite::Result<T>) -> Result<T, Error> {
        work(&self.readers.acquire()).map_err(|source| self.database_error(source))
    }

    /// Runs a query that may scan thousands of rows, without blocking other tasks of this thread.
    fn read_at_length<T>(&self, work: impl FnOnce(&Connection) -> rusqlite::Result<T>) -> Result<T, Error> {
        run_blocking(|| self.read(work))
    }

    fn database_error(&self, source: rusqlite::Error) -> Error {
        Error::Database { path: self.path.clone(), source }
    }
}

/// Runs `work` in a transaction and commits it. SQLite reports only at the end of a transaction whether it could be
/// written (the disk may be full by then), and `INSERT … RETURNING` returns its rows before that; transactions must end
/// nowhere else.
fn commit<T>(
    connection: &mut Connection,
    work: impl FnOnce(&Transaction<'_>) -> rusqlite::Result<T>,
) -> rusqlite::Result<T> {
    // Immediate: a deferred transaction that began by reading fails without waiting if another one has written
    // meanwhile.
    let transaction = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
    let outcome = work(&transaction)?;
    transaction.commit()?;
    Ok(outcome)
}

/// Time for which the database may be locked by others before a statement fails.
const LOCK_TIMEOUT: Duration = Duration::from_secs(5);
/// Interval between attempts.
const RETRY: Duration = Duration::from_millis(10);

/// Busy handler: returns whether SQLite should wait for the lock again after `attempts` attempts.
fn wait_for_another(attempts: i32) -> bool {
    if RETRY * attempts.unsigned_abs() >= LOCK_TIMEOUT {
        return false;
    }
    run_blocking(|| std::thread::sleep(RETRY));
    true
}

/// Runs a blocking closure without blocking other tasks of this thread.
fn run_blocking<T>(wait: impl FnOnce() -> T) -> T {
    use tokio::runtime::{Handle, RuntimeFlavor};
    match Handle::try_current().map(|handle| handle.runtime_flavor()) {
        Ok(RuntimeFlavor::MultiThread) => tokio::task::block_in_place(wait),
        _ => wait(),
    }
}

fn migrate(connection: &mut Connection, path: &str) -> Result<(), Error> {
    let failed = |source| Error::Database { path: path.to_owned(), source };
    let found: usize = connection.query_row("PRAGMA user_version", [], |row| row.get(0)).map_err(failed)?;
    if found > MIGRATIONS.len() {
        return Err(Error::TooNew { path: path.to_owned(), found, known: MIGRATIONS.len() });
    }
    for (index, step) in MIGRATIONS.iter().enumerate().skip(found) {
        let transaction = connection.transaction().map_err(failed)?;
        transaction.execute_batch(step).map_err(failed)?;
        transaction.pragma_update(None, "user_version", index + 1).map_err(failed)?;
        transaction.commit().map_err(failed)?;
    }
    Ok(())
}

fn to_json(value: &impl Serialize, what: &str) -> Result<String, Error> {
    serde_json::to_string(value).map_err(|source| Error::Record { what: what.to_owned(), source })
}

#[cfg(test)]
mod tests;
