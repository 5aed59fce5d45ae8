//! Tokens: whose they are, and for what. Of a token itself only its hash is kept.

use rusqlite::{OptionalExtension, Row, params};

use super::{Error, State, TokenHash, now};

/// A token, as it was given out.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TokenRecord {
    /// Its number, never given twice.
    pub id: i64,
    /// The principal's name.
    pub name: String,
    /// SHA-256 of it.
    pub hash: TokenHash,
    /// The principal's role, in the words of whoever decides by it.
    pub role: String,
    /// What it is for, likewise.
    pub scope: String,
    /// When it was made.
    pub created: u64,
    /// When it ends.
    pub expires: Option<u64>,
    /// When it was shown last, to the minute.
    pub last_used: Option<u64>,
    /// When it was revoked.
    pub revoked: Option<u64>,
}

/// A token to give out.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewToken<'a> {
    /// The principal's name.
    pub name: &'a str,
    /// SHA-256 of it.
    pub hash: &'a str,
    /// Its role.
    pub role: &'a str,
    /// What it is for.
    pub scope: &'a str,
    /// When it ends.
    pub expires: Option<u64>,
}

const COLUMNS: &str = "id, name, hash, role, scope, created, expires, last_used, revoked";

fn read(row: &Row<'_>) -> rusqlite::Result<TokenRecord> {
    Ok(TokenRecord {
        id: row.get(0)?,
        name: row.get(1)?,
        hash: row.get(2)?,
        role: row.get(3)?,
        scope: row.get(4)?,
        created: row.get(5)?,
        expires: row.get(6)?,
        last_used: row.get(7)?,
        revoked: row.get(8)?,
    })
}

impl State {
    /// All tokens there ever were, oldest first.
    pub fn tokens(&self) -> Result<Vec<TokenRecord>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached(&format!("SELECT {COLUMNS} FROM tokens ORDER BY id"))?
                .query_map([], read)?
                .collect()
        })
    }

    /// Records a token, on disk when this returns; none where its name is another token's, that was not revoked.
    pub fn add_token(&self, new: &NewToken<'_>) -> Result<Option<TokenRecord>, Error> {
        self.write_durably(|connection| {
            connection
                .prepare_cached(&format!(
                    "INSERT INTO tokens (name, hash, role, scope, created, expires) VALUES (?1, ?2, ?3, ?4, ?5, ?6)
                     ON CONFLICT (name) WHERE revoked IS NULL DO NOTHING RETURNING {COLUMNS}"
                ))?
                .query_row(
                    params![new.name, new.hash, new.role, new.scope, now() as i64, new.expires],
                    read,
                )
                .optional()
        })
    }

    /// Gives the token of that name another secret; none where there is no such token, or it was revoked.
    pub fn rotate_token(&self, name: &str, hash: &str) -> Result<Option<TokenRecord>, Error> {
        self.write_durably(|connection| {
            connection
                .prepare_cached(&format!(
                    "UPDATE tokens SET hash = ?2 WHERE name = ?1 AND revoked IS NULL RETURNING {COLUMNS}"
                ))?
                .query_row([name, hash], read)
                .optional()
        })
    }

    /// Ends the token of that name; none where there is no such token, or it was revoked before.
    pub fn revoke_token(&self, name: &str) -> Result<Option<TokenRecord>, Error> {
        self.write_durably(|connection| {
            connection
                .prepare_cached(&format!(
                    "UPDATE tokens SET revoked = ?2 WHERE name = ?1 AND revoked IS NULL RETURNING {COLUMNS}"
                ))?
                .query_row(params![name, now() as i64], read)
                .optional()
        })
    }

    /// Remembers that a token was shown.
    pub fn token_used(&self, id: i64, at: u64) -> Result<(), Error> {
        self.write(|connection| {
            connection.execute(
                "UPDATE tokens SET last_used = ?2 WHERE id = ?1",
                params![id, at],
            )
        })
        .map(|_| ())
    }
}
