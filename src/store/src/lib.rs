//! What must survive: services, their revisions, dictionaries and rollouts, who owns a robot's name, which servant is whose,
//! tokens, pairings, people and their sessions, rules and the audit log, and the journal of events. SQLite in WAL mode; short statements; one connection that
//! writes, each time in a transaction ([`State::write`]), and some that only read, which no writer holds up ([`readers`]).
//!
//! Events and servants are written without waiting for the disk (a killed daemon loses none of them, a power cut
//! perhaps the last); publishing waits for it. What only tells of the past is kept in memory while the disk is full or
//! another has locked the database ([`backlog`]); what promises something fails then.

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
mod readers;
mod recordings;
mod robots;
mod rollouts;
mod rules;
mod servants;
mod services;
mod tokens;

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use api::Millis;
use parking_lot::Mutex;
use rusqlite::{Connection, Transaction, TransactionBehavior};
use serde::Serialize;

pub use audit::NewAudited;
use backlog::Backlog;
pub use backlog::watch;
pub use events::{EventFilter, NewEvent, Told};
pub use history::{NewSample, RecordedFilter, RecordedLine};
pub use journal::Journal;
pub use pairings::{CodeRecord, PairingRecord};
pub use people::{AccountEdit, AccountRecord, NewSession, SessionRecord};
pub use provided::ProvidedRecord;
use readers::Readers;
pub use recordings::RecordingRecord;
pub use robots::{Owner, TokenHash};
pub use rules::RuleRecord;
pub use servants::ServantRecord;
pub use services::{Plan, RevisionLine, RevisionRecord};
pub use tokens::{NewToken, TokenRecord};

/// Steps from an empty database to today's; never edited, only added to.
const MIGRATIONS: [&str; 15] = [
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
];

/// What can go wrong.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// SQLite refused.
    #[error("the state database {path}: {source}")]
    Database {
        /// Its file.
        path: String,
        /// What the database said.
        source: rusqlite::Error,
    },
    /// Written by a later version.
    #[error(
        "the state database {path} is of version {found}, this program knows up to {known}; install the newer cloudroidd"
    )]
    TooNew {
        /// Its file.
        path: String,
        /// Its version.
        found: usize,
        /// Ours.
        known: usize,
    },
    /// A record cannot be read back.
    #[error("the record of {what} in the state database cannot be read: {source}")]
    Record {
        /// The table or row.
        what: String,
        /// What the database said.
        source: serde_json::Error,
    },
}

/// The database.
pub struct State {
    connection: Mutex<Connection>,
    readers: Readers,
    path: String,
    backlog: Backlog,
    /// Revisions in use, by service and number.
    revisions: Mutex<HashMap<(String, u64), Arc<RevisionRecord>>>,
}

/// Now, as the API writes it.
pub fn now() -> Millis {
    millis(SystemTime::now())
}

/// `time`, as the API writes it.
pub fn millis(time: SystemTime) -> Millis {
    time.duration_since(UNIX_EPOCH)
        .map_or(0, |since| since.as_millis() as Millis)
}

/// Opens all files of a database: its first question opens the last of them, and the threads that ask later may open none.
fn open_files(connection: &Connection) -> rusqlite::Result<()> {
    connection.query_row("SELECT count(*) FROM sqlite_schema", [], |_| Ok(()))
}

/// What SQLite would say.
fn cannot_open(error: &std::io::Error) -> rusqlite::Error {
    let code = rusqlite::ffi::Error::new(rusqlite::ffi::SQLITE_CANTOPEN);
    rusqlite::Error::SqliteFailure(code, Some(error.to_string()))
}

impl State {
    /// Opens the database, making or migrating it.
    pub fn open(path: &Path) -> Result<State, Error> {
        let name = path.display().to_string();
        let failed = |source| Error::Database {
            path: name.clone(),
            source,
        };
        // It holds hashes of tokens. SQLite's own files beside it get the rights that this one has.
        private::open(path).map_err(|error| failed(cannot_open(&error)))?;
        let mut connection = Connection::open(path).map_err(failed)?;
        connection
            .execute_batch(
                "PRAGMA journal_mode = WAL; PRAGMA synchronous = NORMAL; \
                 PRAGMA foreign_keys = ON; PRAGMA temp_store = MEMORY;",
            )
            .map_err(failed)?;
        connection
            .busy_handler(Some(wait_for_another))
            .map_err(failed)?;
        migrate(&mut connection, &name)?;
        let last = events::last(&connection).map_err(failed)?;
        open_files(&connection).map_err(failed)?;
        Ok(State {
            connection: Mutex::new(connection),
            readers: Readers::open(path).map_err(failed)?,
            backlog: Backlog::new(last),
            path: name,
            revisions: Mutex::default(),
        })
    }

    /// Writes what `work` writes, all or none: where this returns a value, no crash of the daemon loses it.
    fn write<T>(
        &self,
        work: impl FnOnce(&Transaction<'_>) -> rusqlite::Result<T>,
    ) -> Result<T, Error> {
        self.with_writer(|connection| commit(connection, work))
    }

    /// Writes what `work` writes, all or none: where this returns a value, no cut of the power loses it.
    fn write_durably<T>(
        &self,
        work: impl FnOnce(&Transaction<'_>) -> rusqlite::Result<T>,
    ) -> Result<T, Error> {
        self.with_writer(|connection| {
            connection.pragma_update(None, "synchronous", "FULL")?;
            let outcome = commit(connection, work);
            connection.pragma_update(None, "synchronous", "NORMAL")?;
            outcome
        })
    }

    fn with_writer<T>(
        &self,
        work: impl FnOnce(&mut Connection) -> rusqlite::Result<T>,
    ) -> Result<T, Error> {
        let outcome = {
            let mut connection = self
                .connection
                .try_lock()
                .unwrap_or_else(|| aside(|| self.connection.lock()));
            work(&mut connection)
        };
        outcome.map_err(|source| {
            self.write_failed(&source);
            self.failed(source)
        })
    }

    /// Reads by `work` with a connection that no other question is using. Neither a writer nor, while a connection is
    /// free, a longer question holds this up.
    fn read<T>(&self, work: impl FnOnce(&Connection) -> rusqlite::Result<T>) -> Result<T, Error> {
        work(&self.readers.take()).map_err(|source| self.failed(source))
    }

    /// Reads by `work`, which may look at thousands of rows: the tasks that share this thread go on meanwhile.
    fn read_at_length<T>(
        &self,
        work: impl FnOnce(&Connection) -> rusqlite::Result<T>,
    ) -> Result<T, Error> {
        aside(|| self.read(work))
    }

    fn failed(&self, source: rusqlite::Error) -> Error {
        Error::Database {
            path: self.path.clone(),
            source,
        }
    }
}

/// Runs `work` in a transaction and commits it. SQLite says only at the end of a transaction whether what was written
/// could be (the disk may be full then), and `INSERT … RETURNING` gives its rows before that: nothing else may end one.
fn commit<T>(
    connection: &mut Connection,
    work: impl FnOnce(&Transaction<'_>) -> rusqlite::Result<T>,
) -> rusqlite::Result<T> {
    // Immediate: a transaction that began by reading is refused, without waiting, where another wrote meanwhile.
    let transaction = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
    let outcome = work(&transaction)?;
    transaction.commit()?;
    Ok(outcome)
}

/// For so long another may have the database locked before a statement fails.
const LOCKED: Duration = Duration::from_secs(5);
/// Between attempts.
const RETRY: Duration = Duration::from_millis(10);

/// SQLite asks, for the `attempts`th time, whether to wait until another has done with the database.
fn wait_for_another(attempts: i32) -> bool {
    if RETRY * attempts.unsigned_abs() >= LOCKED {
        return false;
    }
    aside(|| std::thread::sleep(RETRY));
    true
}

/// Waits without holding up the tasks that share this thread.
fn aside<T>(wait: impl FnOnce() -> T) -> T {
    use tokio::runtime::{Handle, RuntimeFlavor};
    match Handle::try_current().map(|handle| handle.runtime_flavor()) {
        Ok(RuntimeFlavor::MultiThread) => tokio::task::block_in_place(wait),
        _ => wait(),
    }
}

fn migrate(connection: &mut Connection, path: &str) -> Result<(), Error> {
    let failed = |source| Error::Database {
        path: path.to_owned(),
        source,
    };
    let found: usize = connection
        .query_row("PRAGMA user_version", [], |row| row.get(0))
        .map_err(failed)?;
    if found > MIGRATIONS.len() {
        return Err(Error::TooNew {
            path: path.to_owned(),
            found,
            known: MIGRATIONS.len(),
        });
    }
    for (index, step) in MIGRATIONS.iter().enumerate().skip(found) {
        let transaction = connection.transaction().map_err(failed)?;
        transaction.execute_batch(step).map_err(failed)?;
        transaction
            .pragma_update(None, "user_version", index + 1)
            .map_err(failed)?;
        transaction.commit().map_err(failed)?;
    }
    Ok(())
}

fn to_json(value: &impl Serialize, what: &str) -> Result<String, Error> {
    serde_json::to_string(value).map_err(|source| Error::Record {
        what: what.to_owned(),
        source,
    })
}

#[cfg(test)]
mod tests;
