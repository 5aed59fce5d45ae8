//! Access tokens. Only the hash of a token is stored.

use rusqlite::{OptionalExtension, Row, params};

use super::{Error, State, TokenHash, now};

/// A token.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TokenRecord {
    /// Row number; never reused.
    pub id: i64,
    /// Name of the principal.
    pub name: String,
    /// SHA-256 of the token.
    pub hash: TokenHash,
    /// Role of the principal, as encoded by the portal.
    pub role: String,
    /// Scope of the principal, as encoded by the portal.
    pub scope: String,
    /// Creation time.
    pub created: u64,
    /// Expiry time.
    pub expires: Option<u64>,
    /// Last use, to the minute.
    pub last_used: Option<u64>,
    /// Time of revocation.
    pub revoked: Option<u64>,
}

/// A token to create.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NewToken<'a> {
    /// Name of the principal.
    pub name: &'a str,
    /// SHA-256 of the token.
    pub hash: &'a str,
    /// Role of the principal.
    pub role: &'a str,
    /// Scope of the principal.
    pub scope: &'a str,
    /// Expiry time.
    pub expires: Option<u64>,
}

const COLUMNS: &str = "id, name, hash, role, scope, created, expires, last_used, revoked";

fn read_token(row: &Row<'_>) -> rusqlite::Result<TokenRecord> {
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
    /// Returns all tokens, including revoked ones, oldest first.
    pub fn tokens(&self) -> Result<Vec<TokenRecord>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached(&format!("SELECT {COLUMNS} FROM tokens ORDER BY id"))?
                .query_map([], read_token)?
                .collect()
        })
    }

    /// Creates a token durably; returns `None` if an unrevoked token has the same name.
    pub fn add_token(&self, new: &NewToken<'_>) -> Result<Option<TokenRecord>, Error> {
        self.write_durably(|connection| {
            connection
                .prepare_cached(&format!(
                    "INSERT INTO tokens (name, hash, role, scope, created, expires) VALUES (?1, ?2, ?3, ?4, ?5, ?6)
                     ON CONFLICT (name) WHERE revoked IS NULL DO NOTHING RETURNING {COLUMNS}"
                ))?
                .query_row(params![new.name, new.hash, new.role, new.scope, now() as i64, new.expires], read_token)
                .optional()
        })
    }

    /// Replaces the secret of a token; returns `None` if it does not exist or was revoked.
    pub fn rotate_token(&self, name: &str, hash: &str) -> Result<Option<TokenRecord>, Error> {
        self.write_durably(|connection| {
            connection
                .prepare_cached(&format!(
                    "UPDATE tokens SET hash = ?2 WHERE name = ?1 AND revoked IS NULL RETURNING {COLUMNS}"
                ))?
                .query_row([name, hash], read_token)
                .optional()
        })
    }

    /// Revokes a token; returns `None` if it does not exist or was revoked before.
    pub fn revoke_token(&self, name: &str) -> Result<Option<TokenRecord>, Error> {
        self.write_durably(|connection| {
            connection
                .prepare_cached(&format!(
                    "UPDATE tokens SET revoked = ?2 WHERE name = ?1 AND revoked IS NULL RETURNING {COLUMNS}"
                ))?
                .query_row(params![name, now() as i64], read_token)
                .optional()
        })
    }

    /// Records the use of a token.
    pub fn record_token_use(&self, id: i64, at: u64) -> Result<(), Error> {
        self.write(|connection| connection.execute("UPDATE tokens SET last_used = ?2 WHERE id = ?1", params![id, at]))
            .map(|_| ())
    }
}
