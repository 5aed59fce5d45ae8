//! Connections that only read. No writer holds them up, and a long question holds up nobody while another is free.

use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use parking_lot::{Mutex, MutexGuard};
use rusqlite::Connection;

use super::{aside, open_files, wait_for_another};

/// So many questions are answered at once.
const CONNECTIONS: usize = 4;

/// The connections of one database that only read.
pub(super) struct Readers {
    connections: Vec<Mutex<Connection>>,
    /// Which one is waited for next where none is free.
    next: AtomicUsize,
}

impl Readers {
    /// Opens them all, with their files: the threads that ask later may open none.
    pub(super) fn open(path: &Path) -> rusqlite::Result<Readers> {
        let connections = (0..CONNECTIONS).map(|_| open_connection(path).map(Mutex::new));
        Ok(Readers {
            connections: connections.collect::<Result<_, _>>()?,
            next: AtomicUsize::new(0),
        })
    }

    /// Takes a connection that is free, or waits for one.
    pub(super) fn take(&self) -> MutexGuard<'_, Connection> {
        let free = self.connections.iter().find_map(Mutex::try_lock);
        free.unwrap_or_else(|| {
            let turn = self.next.fetch_add(1, Ordering::Relaxed) % CONNECTIONS;
            aside(|| self.connections[turn].lock())
        })
    }
}

fn open_connection(path: &Path) -> rusqlite::Result<Connection> {
    let mut connection = Connection::open(path)?;
    connection.busy_handler(Some(wait_for_another))?;
    connection.execute_batch("PRAGMA query_only = ON; PRAGMA temp_store = MEMORY;")?;
    open_files(&connection)?;
    Ok(connection)
}
