//! Who is who while servants live: robots' names and their owners, servants and their robots.

use api::{Limits, Millis};
use rusqlite::{OptionalExtension, params};

use super::backlog::Write;
use super::{State, StateError, now, to_json};
use crate::tokens::TokenHash;

/// Whose a servant is.
#[derive(Debug, Clone, PartialEq)]
pub struct ServantRecord {
    /// Its id.
    pub id: String,
    /// Its service.
    pub service: String,
    /// The revision it was started from.
    pub revision: u64,
    /// Its robot.
    pub robot: String,
    /// The robot named no name.
    pub anonymous: bool,
    /// When it was asked for.
    pub created: Millis,
    /// Limits that were changed while it lived.
    pub limits: Limits,
}

impl State {
    /// Binds `robot` to `owner` when it is new, and with `claim` also when nobody owns it yet; then says to whom it
    /// is bound.
    pub fn robot_owner(
        &self,
        robot: &str,
        owner: Option<&TokenHash>,
        claim: bool,
    ) -> Result<Option<TokenHash>, StateError> {
        // Who is known comes in even while nothing can be written.
        let known: Option<Option<TokenHash>> = self.read(|connection| {
            connection
                .prepare_cached("SELECT owner FROM robots WHERE name = ?1")?
                .query_row([robot], |row| row.get(0))
                .optional()
        })?;
        if let Some(known) = known
            && (known.is_some() || !claim)
        {
            self.robot_seen(robot);
            return Ok(known);
        }
        self.run(|connection| {
            connection
                .prepare_cached(
                    "INSERT INTO robots (name, owner, first_seen, last_seen) VALUES (?1, ?2, ?3, ?3)
                     ON CONFLICT (name) DO UPDATE SET last_seen = ?3,
                     owner = CASE WHEN ?4 THEN COALESCE(owner, ?2) ELSE owner END RETURNING owner",
                )?
                .query_row(params![robot, owner, now() as i64, claim], |row| row.get(0))
        })
    }

    /// Forgets robots bound to tokens that are not in `tokens` any more, so that their names can be used again.
    pub fn release_robots(&self, tokens: &[TokenHash]) -> Result<usize, StateError> {
        let kept = serde_json::Value::from(tokens).to_string();
        self.run(|connection| {
            connection.execute(
                "DELETE FROM robots WHERE owner IS NOT NULL AND owner NOT IN (SELECT value FROM json_each(?1))",
                [kept],
            )
        })
    }

    /// Remembers whose a servant is.
    pub fn add_servant(&self, servant: &ServantRecord) -> Result<(), StateError> {
        self.run(|connection| {
            connection.execute(
                "INSERT OR REPLACE INTO servants (id, service, revision, robot, anonymous, created)
                 VALUES (?1, ?2, ?3, ?4, ?5, ?6)",
                params![
                    servant.id,
                    servant.service,
                    servant.revision,
                    servant.robot,
                    servant.anonymous,
                    servant.created as i64
                ],
            )
        })
        .map(|_| ())
    }

    /// Remembers the limits that a servant was given while it lived.
    pub fn set_servant_limits(&self, id: &str, limits: &Limits) -> Result<(), StateError> {
        let limits = to_json(limits, id)?;
        self.run(|connection| {
            connection.execute(
                "UPDATE servants SET limits = ?2 WHERE id = ?1",
                [id, limits.as_str()],
            )
        })
        .map(|_| ())
    }

    /// Forgets a servant that has ended; where nothing can be written now, later.
    pub fn remove_servant(&self, id: &str) {
        self.write_or_keep(Write::ServantGone(id.to_owned()));
    }

    /// Remembers that a robot came.
    fn robot_seen(&self, robot: &str) {
        self.write_or_keep(Write::RobotSeen(robot.to_owned(), now()));
    }

    /// All servants that an earlier daemon may have left.
    pub fn servants(&self) -> Result<Vec<ServantRecord>, StateError> {
        self.read(|connection| {
            connection
                .prepare_cached("SELECT id, service, revision, robot, anonymous, created, limits FROM servants ORDER BY created")?
                .query_map([], |row| {
                    Ok(ServantRecord {
                        id: row.get(0)?,
                        service: row.get(1)?,
                        revision: row.get(2)?,
                        robot: row.get(3)?,
                        anonymous: row.get(4)?,
                        created: row.get::<_, i64>(5)? as Millis,
                        // Written by a later version: then the push's own limits apply.
                        limits: serde_json::from_str(&row.get::<_, String>(6)?).unwrap_or_default(),
                    })
                })?
                .collect()
        })
    }
}
