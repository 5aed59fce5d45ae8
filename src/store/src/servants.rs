//! Servants and their robots.

use api::{Limits, Millis, Terms};
use rusqlite::params;

use super::backlog::Write;
use super::{Error, State, to_json};

/// A servant.
#[derive(Debug, Clone, PartialEq)]
pub struct ServantRecord {
    /// Servant id.
    pub id: String,
    /// Service of the servant.
    pub service: String,
    /// Revision that the servant was started from.
    pub revision: u64,
    /// Robot of the servant.
    pub robot: String,
    /// True if the robot stated no name.
    pub anonymous: bool,
    /// Time when the servant was requested.
    pub created: Millis,
    /// Limits changed by the operator while the servant was running.
    pub limits: Limits,
    /// The robot's statement and the resulting terms; absent for servants started by an earlier version.
    pub terms: Option<Terms>,
}

impl State {
    /// Records a servant.
    pub fn add_servant(&self, servant: &ServantRecord) -> Result<(), Error> {
        let terms = servant.terms.as_ref();
        let terms = terms.map(|terms| to_json(terms, &servant.id)).transpose()?;
        self.write(|connection| {
            connection.execute(
                "INSERT OR REPLACE INTO servants (id, service, revision, robot, anonymous, created, terms)
                 VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)",
                params![
                    servant.id,
                    servant.service,
                    servant.revision,
                    servant.robot,
                    servant.anonymous,
                    servant.created as i64,
                    terms
                ],
            )
        })
        .map(|_| ())
    }

    /// Records the limits that a running servant was given.
    pub fn set_servant_limits(&self, id: &str, limits: &Limits) -> Result<(), Error> {
        let limits = to_json(limits, id)?;
        self.write(|connection| {
            connection.execute("UPDATE servants SET limits = ?2 WHERE id = ?1", [id, limits.as_str()])
        })
        .map(|_| ())
    }

    /// Records the current statement of the servant's robot, and the resulting terms.
    pub fn set_servant_terms(&self, id: &str, terms: &Terms) -> Result<(), Error> {
        let terms = to_json(terms, id)?;
        self.write(|connection| {
            connection.execute("UPDATE servants SET terms = ?2 WHERE id = ?1", [id, terms.as_str()])
        })
        .map(|_| ())
    }

    /// Deletes a servant that has ended, or queues the deletion if the database cannot be written now.
    pub fn remove_servant(&self, id: &str) {
        self.write_or_queue(Write::ServantGone(id.to_owned()));
    }

    /// Returns all servants that an earlier daemon may have left behind.
    pub fn servants(&self) -> Result<Vec<ServantRecord>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached(
                    "SELECT id, service, revision, robot, anonymous, created, limits, terms FROM servants \
                                 ORDER BY created",
                )?
                .query_map([], |row| {
                    Ok(ServantRecord {
                        id: row.get(0)?,
                        service: row.get(1)?,
                        revision: row.get(2)?,
                        robot: row.get(3)?,
                        anonymous: row.get(4)?,
                        created: row.get::<_, i64>(5)? as Millis,
                        // If written by a later version, the limits of the push apply.
                        limits: serde_json::from_str(&row.get::<_, String>(6)?).unwrap_or_default(),
                        terms: row.get::<_, Option<String>>(7)?.and_then(|terms| serde_json::from_str(&terms).ok()),
                    })
                })?
                .collect()
        })
    }
}
