//! The audit log: only added to, which the database itself sees to (`008-audit.sql`).

use api::access::Audited;
use rusqlite::{Connection, Row, params};

use super::{Error, State, now};

/// Records beyond are forgotten, oldest first; the database lets go of no newer ones.
const KEPT: i64 = 1_000_000;

/// What is to be recorded.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct NewAudited<'a> {
    /// Who, with its roles.
    pub who: &'a str,
    /// From where.
    pub peer: &'a str,
    /// Which of the policy's actions.
    pub action: &'a str,
    /// The request.
    pub did: &'a str,
    /// The object that it was done to.
    pub object: &'a str,
    /// The answer's HTTP status.
    pub status: u16,
    /// So many alike before it were not recorded.
    pub more: u64,
}

fn read(row: &Row<'_>) -> rusqlite::Result<Audited> {
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

fn insert(connection: &Connection, new: &NewAudited<'_>) -> rusqlite::Result<i64> {
    let id = connection
        .prepare_cached(
            "INSERT INTO audit (time, who, peer, action, did, object, status, more)
             VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8) RETURNING id",
        )?
        .query_row(
            params![
                now() as i64,
                new.who,
                new.peer,
                new.action,
                new.did,
                new.object,
                new.status,
                new.more
            ],
            |row| row.get(0),
        )?;
    if id % 1_000 == 0 {
        connection.execute("DELETE FROM audit WHERE id <= ?1", [id - KEPT])?;
    }
    Ok(id)
}

impl State {
    /// Records what somebody did, on disk when this returns; gives its number.
    pub fn add_audited(&self, new: &NewAudited<'_>) -> Result<i64, Error> {
        self.write_durably(|connection| insert(connection, new))
    }

    /// The same without waiting for the disk.
    pub fn add_audited_soon(&self, new: &NewAudited<'_>) -> Result<i64, Error> {
        self.write(|connection| insert(connection, new))
    }

    /// The newest `limit` records after number `since`, oldest first.
    pub fn audited(&self, since: i64, limit: u32) -> Result<Vec<Audited>, Error> {
        self.read_at_length(|connection| {
            connection
                .prepare_cached(
                    "SELECT id, time, who, peer, action, did, object, status, more FROM
                     (SELECT * FROM audit WHERE id > ?1 ORDER BY id DESC LIMIT ?2) ORDER BY id",
                )?
                .query_map(params![since, limit], read)?
                .collect()
        })
    }
}
