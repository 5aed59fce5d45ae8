//! The audit log. It is append-only, which the database enforces itself (`008-audit.sql`).

use api::access::Audited;
use rusqlite::{Connection, Row, params};

use super::{Error, State, now};

/// Maximum number of records; older ones are deleted first. The database refuses to delete newer ones.
const MAX_RECORDS: i64 = 1_000_000;

/// An audit record to be written.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct NewAuditRecord<'a> {
    /// Principal, with its roles.
    pub who: &'a str,
    /// Origin of the request.
    pub peer: &'a str,
    /// Policy action.
    pub action: &'a str,
    /// Request method and path.
    pub did: &'a str,
    /// Object that the request acted on.
    pub object: &'a str,
    /// HTTP status of the response.
    pub status: u16,
    /// Number of preceding identical requests that were not recorded.
    pub more: u64,
}

fn read_record(row: &Row<'_>) -> rusqlite::Result<Audited> {
    Ok(Audited {
        id: row.get(0)?,
        time: row.get(1)?,
        who: row.get(2)?,
        from: row.get(3)?,
        action: row.get(4)?,
        did: row.get(5)?,
        object: row.get(6)?,
        status: row.get(7)?,
        more: row.get(8)?,
    })
}

fn insert(connection: &Connection, new: &NewAuditRecord<'_>) -> rusqlite::Result<i64> {
    let id = connection
        .prepare_cached(
            "INSERT INTO audit (time, who, peer, action, did, object, status, more)
             VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8) RETURNING id",
        )?
        .query_row(
            params![now() as i64, new.who, new.peer, new.action, new.did, new.object, new.status, new.more],
            |row| row.get(0),
        )?;
    if id % 1_000 == 0 {
        connection.execute("DELETE FROM audit WHERE id <= ?1", [id - MAX_RECORDS])?;
    }
    Ok(id)
}

impl State {
    /// Appends an audit record durably and returns its number.
    pub fn add_audit_record(&self, new: &NewAuditRecord<'_>) -> Result<i64, Error> {
        self.write_durably(|connection| insert(connection, new))
    }

    /// Appends an audit record without waiting for the disk, and returns its number.
    pub fn add_audit_record_without_sync(&self, new: &NewAuditRecord<'_>) -> Result<i64, Error> {
        self.write(|connection| insert(connection, new))
    }

    /// Returns the latest `limit` records after number `since`, oldest first.
    pub fn audit_records(&self, since: i64, limit: u32) -> Result<Vec<Audited>, Error> {
        self.read_at_length(|connection| {
            connection
                .prepare_cached(
                    "SELECT id, time, who, peer, action, did, object, status, more FROM
                     (SELECT * FROM audit WHERE id > ?1 ORDER BY id DESC LIMIT ?2) ORDER BY id",
                )?
                .query_map(params![since, limit], read_record)?
                .collect()
        })
    }
}
