//! Pairings of robots, and the codes by which they are made. Of a code itself only its hash is kept.

use rusqlite::{OptionalExtension, Row, params};

use super::{Error, State, now};

/// A pairing code, as it was given out.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CodeRecord {
    /// Its number, never given twice.
    pub id: i64,
    /// The robot that it is for.
    pub robot: String,
    /// What the pairing will be for, in the words of whoever decides by it.
    pub scope: String,
    /// When it was made.
    pub created: u64,
    /// When it ends.
    pub expires: u64,
    /// When it was used.
    pub used: Option<u64>,
    /// When it was taken back.
    pub cancelled: Option<u64>,
}

/// A robot that is paired, or was.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PairingRecord {
    /// Its number, never given twice.
    pub id: i64,
    /// The robot.
    pub robot: String,
    /// What it is for, in the words of whoever decides by it.
    pub scope: String,
    /// SHA-256 of the robot's key; none where another authority than the daemon's signs its certificates.
    pub key: Option<String>,
    /// When it was made.
    pub created: u64,
    /// The end of the newest certificate.
    pub expires: Option<u64>,
    /// When the robot came last, to the minute.
    pub last_used: Option<u64>,
    /// When it was revoked.
    pub revoked: Option<u64>,
}

const CODE: &str = "id, robot, scope, created, expires, used, cancelled";
const PAIRING: &str = "id, robot, scope, key, created, expires, last_used, revoked";

fn code(row: &Row<'_>) -> rusqlite::Result<CodeRecord> {
    Ok(CodeRecord {
        id: row.get(0)?,
        robot: row.get(1)?,
        scope: row.get(2)?,
        created: row.get(3)?,
        expires: row.get(4)?,
        used: row.get(5)?,
        cancelled: row.get(6)?,
    })
}

fn pairing(row: &Row<'_>) -> rusqlite::Result<PairingRecord> {
    Ok(PairingRecord {
        id: row.get(0)?,
        robot: row.get(1)?,
        scope: row.get(2)?,
        key: row.get(3)?,
        created: row.get(4)?,
        expires: row.get(5)?,
        last_used: row.get(6)?,
        revoked: row.get(7)?,
    })
}

impl State {
    /// Writes a code for a robot, by its hash; one that the robot had until now is taken back.
    pub fn add_pairing_code(
        &self,
        robot: &str,
        hash: &str,
        scope: &str,
        expires: u64,
    ) -> Result<(), Error> {
        self.write_durably(|transaction| {
            cancel(transaction, robot)?;
            transaction.execute(
                "INSERT INTO pairing_codes (robot, hash, scope, created, expires) VALUES (?1, ?2, ?3, ?4, ?5)",
                params![robot, hash, scope, now(), expires],
            )?;
            Ok(())
        })
    }

    /// The code of this hash.
    pub fn pairing_code(&self, hash: &str) -> Result<Option<CodeRecord>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached(&format!("SELECT {CODE} FROM pairing_codes WHERE hash = ?1"))?
                .query_row([hash], code)
                .optional()
        })
    }

    /// Codes that could be used at a time.
    pub fn pairing_codes(&self, at: u64) -> Result<Vec<CodeRecord>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached(&format!(
                    "SELECT {CODE} FROM pairing_codes WHERE used IS NULL AND cancelled IS NULL AND expires > ?1 ORDER BY robot"
                ))?
                .query_map([at], code)?
                .collect()
        })
    }

    /// Takes a robot's code back; false where it has none that could be used.
    pub fn cancel_pairing_code(&self, robot: &str) -> Result<bool, Error> {
        self.write_durably(|connection| cancel(connection, robot))
    }

    /// Uses a code, if it still can be: pairs its robot with a key, in place of the one that it was paired with until now. None
    /// where somebody else was faster.
    pub fn use_pairing_code(
        &self,
        id: i64,
        key: &str,
        expires: u64,
    ) -> Result<Option<PairingRecord>, Error> {
        self.write_durably(|transaction| {
            let used = transaction
                .prepare_cached(&format!(
                    "UPDATE pairing_codes SET used = ?2 WHERE id = ?1 AND used IS NULL AND cancelled IS NULL AND expires > ?2
                     RETURNING {CODE}"
                ))?
                .query_row(params![id, now()], code)
                .optional()?;
            let Some(used) = used else { return Ok(None) };
            let made = replace(transaction, &used.robot, &used.scope, Some((key, expires)))?;
            Ok(Some(made))
        })
    }

    /// Pairs a robot whose certificates another authority signs; a code that it has is taken back.
    pub fn add_pairing(&self, robot: &str, scope: &str) -> Result<PairingRecord, Error> {
        self.write_durably(|transaction| {
            cancel(transaction, robot)?;
            let made = replace(transaction, robot, scope, None)?;
            Ok(made)
        })
    }

    /// All pairings there ever were.
    pub fn pairings(&self) -> Result<Vec<PairingRecord>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached(&format!("SELECT {PAIRING} FROM pairings ORDER BY id"))?
                .query_map([], pairing)?
                .collect()
        })
    }

    /// Remembers the end of a pairing's newest certificate; false where it was revoked.
    pub fn pairing_renewed(&self, id: i64, expires: u64) -> Result<bool, Error> {
        self.write_durably(|connection| {
            let changed = connection.execute(
                "UPDATE pairings SET expires = max(expires, ?2) WHERE id = ?1 AND revoked IS NULL",
                params![id, expires],
            )?;
            Ok(changed > 0)
        })
    }

    /// Ends a robot's pairing, and takes back a code that it has; false where there is neither.
    pub fn revoke_pairing(&self, robot: &str) -> Result<bool, Error> {
        self.write_durably(|transaction| {
            let cancelled = cancel(transaction, robot)?;
            let revoked = revoke(transaction, robot)?;
            Ok(cancelled || revoked)
        })
    }

    /// Remembers that a robot came.
    pub fn pairing_used(&self, id: i64, at: u64) -> Result<(), Error> {
        self.write(|connection| {
            connection.execute(
                "UPDATE pairings SET last_used = ?2 WHERE id = ?1",
                params![id, at],
            )
        })
        .map(|_| ())
    }
}

fn cancel(connection: &rusqlite::Connection, robot: &str) -> rusqlite::Result<bool> {
    let changed = connection.execute(
        "UPDATE pairing_codes SET cancelled = ?2 WHERE robot = ?1 AND used IS NULL AND cancelled IS NULL",
        params![robot, now()],
    )?;
    Ok(changed > 0)
}

fn revoke(connection: &rusqlite::Connection, robot: &str) -> rusqlite::Result<bool> {
    let changed = connection.execute(
        "UPDATE pairings SET revoked = ?2 WHERE robot = ?1 AND revoked IS NULL",
        params![robot, now()],
    )?;
    Ok(changed > 0)
}

fn replace(
    connection: &rusqlite::Connection,
    robot: &str,
    scope: &str,
    key: Option<(&str, u64)>,
) -> rusqlite::Result<PairingRecord> {
    revoke(connection, robot)?;
    let (key, expires) = key.unzip();
    connection
        .prepare_cached(&format!(
            "INSERT INTO pairings (robot, scope, key, created, expires) VALUES (?1, ?2, ?3, ?4, ?5) RETURNING {PAIRING}"
        ))?
        .query_row(params![robot, scope, key, now(), expires], pairing)
}
