//! Servants and their robots.

use api::{Limits, Millis, Terms};
use rusqlite::params;

use super::backlog::Write;
use super::{Error, State, to_json};

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
    /// Limits that the operator changed while it lived.
    pub limits: Limits,
    /// What its robot stated, and what follows; none of one that an earlier version started.
    pub terms: Option<Terms>,
}

impl State {
    /// Remembers whose a servant is.
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

    /// Remembers the limits that a servant was given while it lived.
    pub fn set_servant_limits(&self, id: &str, limits: &Limits) -> Result<(), Error> {
        let limits = to_json(limits, id)?;
        self.write(|connection| {
            connection.execute(
                "UPDATE servants SET limits = ?2 WHERE id = ?1",
                [id, limits.as_str()],
            )
        })
        .map(|_| ())
    }

    /// Remembers what the robot of a servant states now, and what follows.
    pub fn set_servant_terms(&self, id: &str, terms: &Terms) -> Result<(), Error> {
        let terms = to_json(terms, id)?;
        self.write(|connection| {
            connection.execute(
                "UPDATE servants SET terms = ?2 WHERE id = ?1",
                [id, terms.as_str()],
            )
        })
        .map(|_| ())
    }

    /// Forgets a servant that has ended; where nothing can be written now, later.
    pub fn remove_servant(&self, id: &str) {
        self.write_or_keep(Write::ServantGone(id.to_owned()));
    }

    /// All servants that an earlier daemon may have left.
    pub fn servants(&self) -> Result<Vec<ServantRecord>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached("SELECT id, service, revision, robot, anonymous, created, limits, terms FROM servants ORDER BY created")?
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
                        terms: row
                            .get::<_, Option<String>>(7)?
                            .and_then(|terms| serde_json::from_str(&terms).ok()),
                    })
                })?
                .collect()
        })
    }
}
