//! Pairings of robots, and pairing codes. Only the hash of a code is stored.

use rusqlite::{OptionalExtension, Row, params};

use super::{Error, State, now};

/// A pairing code.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CodeRecord {
    /// Row number; never reused.
    pub id: i64,
    /// Robot that the code is for.
    pub robot: String,
    /// Scope of the resulting pairing, as encoded by the portal.
    pub scope: String,
    /// Creation time.
    pub created: u64,
    /// Expiry time.
    pub expires: u64,
    /// Time of use.
    pub used: Option<u64>,
    /// Time of cancellation.
    pub cancelled: Option<u64>,
}

/// A pairing, current or revoked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PairingRecord {
    /// Row number; never reused.
    pub id: i64,
    /// Name of the robot.
    pub robot: String,
    /// Scope of the pairing, as encoded by the portal.
    pub scope: String,
    /// SHA-256 of the robot's key; absent if another CA than the daemon's issues its certificates.
    pub key: Option<String>,
    /// Creation time.
    pub created: u64,
    /// Expiry time of the latest certificate.
    pub expires: Option<u64>,
    /// Last connection of the robot, to the minute.
    pub last_used: Option<u64>,
    /// Time of revocation.
    pub revoked: Option<u64>,
}

const CODE: &str = "id, robot, scope, created, expires, used, cancelled";
const PAIRING: &str = "id, robot, scope, key, created, expires, last_used, revoked";

fn read_code(row: &Row<'_>) -> rusqlite::Result<CodeRecord> {
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

fn read_pairing(row: &Row<'_>) -> rusqlite::Result<PairingRecord> {
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
    /// Stores the hash of a new code for a robot; cancels its previous code.
    pub fn add_pairing_code(&self, robot: &str, hash: &str, scope: &str, expires: u64) -> Result<(), Error> {
        self.write_durably(|transaction| {
            cancel_code(transaction, robot)?;
            transaction.execute(
                "INSERT INTO pairing_codes (robot, hash, scope, created, expires) VALUES (?1, ?2, ?3, ?4, ?5)",
                params![robot, hash, scope, now(), expires],
            )?;
            Ok(())
        })
    }

    /// Returns the code with this hash.
    pub fn pairing_code(&self, hash: &str) -> Result<Option<CodeRecord>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached(&format!("SELECT {CODE} FROM pairing_codes WHERE hash = ?1"))?
                .query_row([hash], read_code)
                .optional()
        })
    }

    /// Returns the codes that are valid at a time.
    pub fn pairing_codes(&self, at: u64) -> Result<Vec<CodeRecord>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached(&format!(
                    "SELECT {CODE} FROM pairing_codes WHERE used IS NULL AND cancelled IS NULL AND expires > ?1 \
                     ORDER BY robot"
                ))?
                .query_map([at], read_code)?
                .collect()
        })
    }

    /// Cancels a robot's code; returns false if it has no valid one.
    pub fn cancel_pairing_code(&self, robot: &str) -> Result<bool, Error> {
        self.write_durably(|connection| cancel_code(connection, robot))
    }

    /// Consumes a code if it is still valid: pairs its robot with a key, replacing its previous pairing. Returns `None`
    /// if the code is no longer valid.
    pub fn use_pairing_code(&self, id: i64, key: &str, expires: u64) -> Result<Option<PairingRecord>, Error> {
        self.write_durably(|transaction| {
            let used = transaction
                .prepare_cached(&format!(
                    "UPDATE pairing_codes SET used = ?2 WHERE id = ?1 AND used IS NULL AND cancelled IS NULL \
                     AND expires > ?2
                     RETURNING {CODE}"
                ))?
                .query_row(params![id, now()], read_code)
                .optional()?;
            let Some(used) = used else { return Ok(None) };
            let made = replace_pairing(transaction, &used.robot, &used.scope, Some((key, expires)))?;
            Ok(Some(made))
        })
    }

    /// Pairs a robot whose certificates are issued by another CA; cancels its pairing code.
    pub fn add_pairing(&self, robot: &str, scope: &str) -> Result<PairingRecord, Error> {
        self.write_durably(|transaction| {
            cancel_code(transaction, robot)?;
            let made = replace_pairing(transaction, robot, scope, None)?;
            Ok(made)
        })
    }

    /// Returns all pairings, including revoked ones.
    pub fn pairings(&self) -> Result<Vec<PairingRecord>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached(&format!("SELECT {PAIRING} FROM pairings ORDER BY id"))?
                .query_map([], read_pairing)?
                .collect()
        })
    }

    /// Records the expiry time of a pairing's latest certificate; returns false if it was revoked.
    pub fn extend_pairing(&self, id: i64, expires: u64) -> Result<bool, Error> {
        self.write_durably(|connection| {
            let changed = connection.execute(
                "UPDATE pairings SET expires = max(expires, ?2) WHERE id = ?1 AND revoked IS NULL",
                params![id, expires],
            )?;
            Ok(changed > 0)
        })
    }

    /// Revokes a robot's pairing and cancels its code; returns false if there is neither.
    pub fn revoke_pairing(&self, robot: &str) -> Result<bool, Error> {
        self.write_durably(|transaction| {
            let cancelled = cancel_code(transaction, robot)?;
            let revoked = revoke_row(transaction, robot)?;
            Ok(cancelled || revoked)
        })
    }

    /// Records that a robot has connected.
    pub fn record_pairing_use(&self, id: i64, at: u64) -> Result<(), Error> {
        self.write(|connection| connection.execute("UPDATE pairings SET last_used = ?2 WHERE id = ?1", params![id, at]))
            .map(|_| ())
    }
}

fn cancel_code(connection: &rusqlite::Connection, robot: &str) -> rusqlite::Result<bool> {
    let changed = connection.execute(
        "UPDATE pairing_codes SET cancelled = ?2 WHERE robot = ?1 AND used IS NULL AND cancelled IS NULL",
        params![robot, now()],
    )?;
    Ok(changed > 0)
}

fn revoke_row(connection: &rusqlite::Connection, robot: &str) -> rusqlite::Result<bool> {
    let changed = connection
        .execute("UPDATE pairings SET revoked = ?2 WHERE robot = ?1 AND revoked IS NULL", params![robot, now()])?;
    Ok(changed > 0)
}

fn replace_pairing(
    connection: &rusqlite::Connection,
    robot: &str,
    scope: &str,
    key: Option<(&str, u64)>,
) -> rusqlite::Result<PairingRecord> {
    revoke_row(connection, robot)?;
    let (key, expires) = key.unzip();
    connection
        .prepare_cached(&format!(
            "INSERT INTO pairings (robot, scope, key, created, expires) VALUES (?1, ?2, ?3, ?4, ?5) RETURNING {PAIRING}"
        ))?
        .query_row(params![robot, scope, key, now(), expires], read_pairing)
}
