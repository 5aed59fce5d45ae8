//! Pool of read-only connections. No writer blocks them, and a long query blocks nobody while another connection is
//! free.

use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use parking_lot::{Mutex, MutexGuard};
use rusqlite::Connection;

use super::{open_files, run_blocking, wait_for_another};

/// Number of connections, and thus of concurrent queries.
const CONNECTIONS: usize = 4;

/// The read-only connections of a database.
pub(super) struct Readers {
    connections: Vec<Mutex<Connection>>,
    /// Connection to wait for next if none is free.
    next: AtomicUsize,
}

impl Readers {
    /// Opens all connections and their files: the threads that query later may not open files.
    pub(super) fn open(path: &Path) -> rusqlite::Result<Readers> {
        let connections = (0..CONNECTIONS).map(|_| open_connection(path).map(Mutex::new));
        Ok(Readers { connections: connections.collect::<Result<_, _>>()?, next: AtomicUsize::new(0) })
    }

    /// Acquires a free connection, or waits for one.
    pub(super) fn acquire(&self) -> MutexGuard<'_, Connection> {
        let free = self.connections.iter().find_map(Mutex::try_lock);
        free.unwrap_or_else(|| {
            let turn = self.next.fetch_add(1, Ordering::Relaxed) % CONNECTIONS;
            run_blocking(|| self.connections[turn].lock())
        })
    }
}

fn open_connection(path: &Path) -> rusqlite::Result<Connection> {
    let mut connection = Connection::open(path)?;
    connection.busy_handler(Some(wait_for_another))?;
    // The kernel caches the file for all connections. Caches of SQLite's own size, 2 MB each, would be filled within
    // hours by old pages that nobody reads again.
    connection.execute_batch("PRAGMA query_only = ON; PRAGMA temp_store = MEMORY; PRAGMA cache_size = -256;")?;
    open_files(&connection)?;
    Ok(connection)
}
