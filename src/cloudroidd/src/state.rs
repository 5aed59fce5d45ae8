//! What must survive: services, their revisions, who owns a robot's name, which servant is whose, and the
//! journal of events. SQLite in WAL mode; one connection, short statements.
//!
//! Events and servants are written without waiting for the disk (a killed daemon loses none of them, a power cut
//! perhaps the last); publishing waits for it.

use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

use api::{Event, Level, Millis};
use parking_lot::Mutex;
use rusqlite::{Connection, OptionalExtension, Row, params};
use serde::{Deserialize, Serialize};

use crate::tokens::TokenHash;

/// Steps from an empty database to today's; never edited, only added to.
const MIGRATIONS: [&str; 1] = [include_str!("state/001-start.sql")];
/// Events beyond are forgotten, oldest first.
const EVENTS_KEPT: i64 = 10_000;

/// What can go wrong.
#[derive(Debug, thiserror::Error)]
pub enum StateError {
    /// SQLite refused.
    #[error("the state database {path}: {source}")]
    Database {
        /// Its file.
        path: String,
        /// Why.
        source: rusqlite::Error,
    },
    /// Written by a later version.
    #[error(
        "the state database {path} is of version {found}, this program knows up to {known}; install the newer cloudroidd"
    )]
    TooNew {
        /// Its file.
        path: String,
        /// Its version.
        found: usize,
        /// Ours.
        known: usize,
    },
    /// A record cannot be read back.
    #[error("the record of {what} in the state database cannot be read: {source}")]
    Record {
        /// Of what.
        what: String,
        /// Why.
        source: serde_json::Error,
    },
}

/// A published revision.
#[derive(Debug, Clone, PartialEq)]
pub struct RevisionRecord {
    /// Its service.
    pub service: String,
    /// From 1.
    pub number: u64,
    /// Digest of its image manifest.
    pub image: String,
    /// When it was published.
    pub published: Millis,
    /// The ROS package.
    pub package: String,
    /// What was pushed, in words.
    pub source: String,
    /// How its servants are started.
    pub plan: Plan,
    /// Its interface, definitions included.
    pub interface: package::interface::Interface,
}

/// How servants of a revision are started.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// Environment of every process.
    #[serde(default)]
    pub environment: std::collections::BTreeMap<String, String>,
    /// The nodes.
    pub nodes: Vec<servant::spec::NodeSpec>,
    /// Parameters set before the first node starts, absolute names.
    #[serde(default)]
    pub parameters: std::collections::BTreeMap<String, ros::bus::ParamValue>,
    /// Limits that the push asked for.
    #[serde(default)]
    pub limits: api::Limits,
    /// Start a node again when it fails, though it asked for no respawn: nobody else will.
    #[serde(default)]
    pub restart: bool,
}

/// Whose a servant is.
#[derive(Debug, Clone, PartialEq, Eq)]
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
}

/// An event about to be written.
#[derive(Debug, Clone, Default)]
pub struct NewEvent<'a> {
    /// The service concerned.
    pub service: Option<&'a str>,
    /// The servant concerned.
    pub servant: Option<&'a str>,
    /// The robot concerned.
    pub robot: Option<&'a str>,
}

/// The database.
pub struct State {
    connection: Mutex<Connection>,
    path: String,
}

/// Now, as the API writes it.
pub fn now() -> Millis {
    millis(SystemTime::now())
}

/// `time`, as the API writes it.
pub fn millis(time: SystemTime) -> Millis {
    time.duration_since(UNIX_EPOCH)
        .map_or(0, |since| since.as_millis() as Millis)
}

impl State {
    /// Opens the database, making or migrating it.
    pub fn open(path: &Path) -> Result<State, StateError> {
        let name = path.display().to_string();
        let failed = |source| StateError::Database {
            path: name.clone(),
            source,
        };
        let mut connection = Connection::open(path).map_err(failed)?;
        connection
            .execute_batch(
                "PRAGMA journal_mode = WAL; PRAGMA synchronous = NORMAL; \
                 PRAGMA foreign_keys = ON; PRAGMA busy_timeout = 5000;",
            )
            .map_err(failed)?;
        migrate(&mut connection, &name)?;
        Ok(State {
            connection: Mutex::new(connection),
            path: name,
        })
    }

    fn run<T>(
        &self,
        work: impl FnOnce(&mut Connection) -> rusqlite::Result<T>,
    ) -> Result<T, StateError> {
        work(&mut self.connection.lock()).map_err(|source| StateError::Database {
            path: self.path.clone(),
            source,
        })
    }

    /// Makes `revision` the current one of its service, giving it the next number; on disk when this returns.
    pub fn publish(&self, revision: &RevisionRecord) -> Result<u64, StateError> {
        let plan = to_json(&revision.plan, &revision.service)?;
        let interface = to_json(&revision.interface, &revision.service)?;
        self.durably(|connection| {
            let transaction = connection.transaction()?;
            // Numbers are never given twice, not even after the service was removed and pushed again.
            let number: u64 = transaction.query_row(
                "INSERT INTO numbers (service, last) VALUES (?1, 1)
                 ON CONFLICT (service) DO UPDATE SET last = last + 1 RETURNING last",
                [&revision.service],
                |row| row.get(0),
            )?;
            transaction.execute(
                "INSERT INTO services (name, package, current) VALUES (?1, ?2, ?3)
                 ON CONFLICT (name) DO UPDATE SET current = ?3",
                params![revision.service, revision.package, number],
            )?;
            transaction.execute(
                "INSERT INTO revisions (service, number, image, published, source, plan, interface)
                 VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)",
                params![
                    revision.service,
                    number,
                    revision.image,
                    revision.published as i64,
                    revision.source,
                    plan,
                    interface
                ],
            )?;
            transaction.commit()?;
            Ok(number)
        })
    }

    /// Runs `work` so that it is on disk when this returns.
    fn durably<T>(
        &self,
        work: impl FnOnce(&mut Connection) -> rusqlite::Result<T>,
    ) -> Result<T, StateError> {
        self.run(|connection| {
            connection.pragma_update(None, "synchronous", "FULL")?;
            let outcome = work(connection);
            connection.pragma_update(None, "synchronous", "NORMAL")?;
            outcome
        })
    }

    /// Makes an earlier (or later) revision the current one; false when there is none of that number.
    pub fn set_current(&self, service: &str, number: u64) -> Result<bool, StateError> {
        self.durably(|connection| {
            connection.execute(
                "UPDATE services SET current = ?2 WHERE name = ?1
                 AND EXISTS (SELECT 1 FROM revisions WHERE service = ?1 AND number = ?2)",
                params![service, number],
            )
        })
        .map(|changed| changed == 1)
    }

    /// Forgets a service and its revisions; false when there is none.
    pub fn remove_service(&self, name: &str) -> Result<bool, StateError> {
        self.durably(|connection| {
            connection.execute("DELETE FROM services WHERE name = ?1", [name])
        })
        .map(|changed| changed == 1)
    }

    /// Names of all services.
    pub fn service_names(&self) -> Result<Vec<String>, StateError> {
        self.run(|connection| {
            connection
                .prepare_cached("SELECT name FROM services ORDER BY name")?
                .query_map([], |row| row.get(0))?
                .collect()
        })
    }

    /// The ROS package that a service was first made of.
    pub fn service_package(&self, name: &str) -> Result<Option<String>, StateError> {
        self.run(|connection| {
            connection
                .query_row(
                    "SELECT package FROM services WHERE name = ?1",
                    [name],
                    |row| row.get(0),
                )
                .optional()
        })
    }

    /// The current revision of a service.
    pub fn current(&self, service: &str) -> Result<Option<RevisionRecord>, StateError> {
        let current: Option<u64> = self.run(|connection| {
            connection
                .query_row(
                    "SELECT current FROM services WHERE name = ?1",
                    [service],
                    |row| row.get(0),
                )
                .optional()
        })?;
        match current {
            Some(number) => self.revision(service, number),
            None => Ok(None),
        }
    }

    /// One revision of a service.
    pub fn revision(
        &self,
        service: &str,
        number: u64,
    ) -> Result<Option<RevisionRecord>, StateError> {
        self.revisions_where("r.service = ?1 AND r.number = ?2", params![service, number])
            .map(|found| found.into_iter().next())
    }

    /// All revisions of a service, newest first.
    pub fn revisions(&self, service: &str) -> Result<Vec<RevisionRecord>, StateError> {
        self.revisions_where("r.service = ?1", params![service])
    }

    /// All revisions of all services.
    pub fn all_revisions(&self) -> Result<Vec<RevisionRecord>, StateError> {
        self.revisions_where("1", [])
    }

    fn revisions_where(
        &self,
        condition: &str,
        values: impl rusqlite::Params,
    ) -> Result<Vec<RevisionRecord>, StateError> {
        type Raw = (RevisionRecord, String, String);
        let read = |row: &Row<'_>| -> rusqlite::Result<Raw> {
            let record = RevisionRecord {
                service: row.get(0)?,
                number: row.get(1)?,
                image: row.get(2)?,
                published: row.get::<_, i64>(3)? as Millis,
                package: row.get(4)?,
                source: row.get(5)?,
                plan: Plan::default(),
                interface: package::interface::Interface::default(),
            };
            Ok((record, row.get(6)?, row.get(7)?))
        };
        let raw: Vec<Raw> = self.run(|connection| {
            connection
                .prepare_cached(&format!(
                    "SELECT r.service, r.number, r.image, r.published, s.package, r.source, r.plan, r.interface
                     FROM revisions r JOIN services s ON s.name = r.service
                     WHERE {condition} ORDER BY r.service, r.number DESC"
                ))?
                .query_map(values, read)?
                .collect()
        })?;
        raw.into_iter()
            .map(|(record, plan, interface)| {
                let what = format!("revision {} of {}", record.number, record.service);
                let unreadable = |source| StateError::Record {
                    what: what.clone(),
                    source,
                };
                Ok(RevisionRecord {
                    plan: serde_json::from_str(&plan).map_err(unreadable)?,
                    interface: serde_json::from_str(&interface).map_err(unreadable)?,
                    ..record
                })
            })
            .collect()
    }

    /// Binds `robot` to `owner` when it is new; then says to whom it is bound.
    pub fn robot_owner(
        &self,
        robot: &str,
        owner: Option<&TokenHash>,
    ) -> Result<Option<TokenHash>, StateError> {
        self.run(|connection| {
            connection.query_row(
                "INSERT INTO robots (name, owner, first_seen, last_seen) VALUES (?1, ?2, ?3, ?3)
                 ON CONFLICT (name) DO UPDATE SET last_seen = ?3 RETURNING owner",
                params![robot, owner, now() as i64],
                |row| row.get(0),
            )
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

    /// Forgets a servant that has ended.
    pub fn remove_servant(&self, id: &str) -> Result<(), StateError> {
        self.run(|connection| connection.execute("DELETE FROM servants WHERE id = ?1", [id]))
            .map(|_| ())
    }

    /// All servants that an earlier daemon may have left.
    pub fn servants(&self) -> Result<Vec<ServantRecord>, StateError> {
        self.run(|connection| {
            connection
                .prepare_cached("SELECT id, service, revision, robot, anonymous, created FROM servants ORDER BY created")?
                .query_map([], |row| {
                    Ok(ServantRecord {
                        id: row.get(0)?,
                        service: row.get(1)?,
                        revision: row.get(2)?,
                        robot: row.get(3)?,
                        anonymous: row.get(4)?,
                        created: row.get::<_, i64>(5)? as Millis,
                    })
                })?
                .collect()
        })
    }

    /// Writes an event into the journal and gives it back with its number.
    pub fn add_event(
        &self,
        level: Level,
        kind: &str,
        message: &str,
        about: &NewEvent<'_>,
    ) -> Result<Event, StateError> {
        let time = now();
        let id = self.run(|connection| {
            connection
                .prepare_cached(
                    "INSERT INTO events (time, level, kind, service, servant, robot, message)
                     VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)",
                )?
                .execute(params![
                    time as i64,
                    level_name(level),
                    kind,
                    about.service,
                    about.servant,
                    about.robot,
                    message
                ])?;
            let id = connection.last_insert_rowid();
            if id % 100 == 0 {
                connection.execute("DELETE FROM events WHERE id <= ?1", [id - EVENTS_KEPT])?;
            }
            Ok(id)
        })?;
        let owned = |text: Option<&str>| text.map(str::to_owned);
        Ok(Event {
            id,
            time,
            level,
            kind: kind.to_owned(),
            service: owned(about.service),
            servant: owned(about.servant),
            robot: owned(about.robot),
            message: message.to_owned(),
        })
    }

    /// The newest `limit` events after number `since`, oldest first.
    pub fn events(&self, since: i64, limit: u32) -> Result<Vec<Event>, StateError> {
        self.run(|connection| {
            connection
                .prepare_cached(
                    "SELECT id, time, level, kind, service, servant, robot, message FROM
                     (SELECT * FROM events WHERE id > ?1 ORDER BY id DESC LIMIT ?2) ORDER BY id",
                )?
                .query_map(params![since, limit], |row| {
                    Ok(Event {
                        id: row.get(0)?,
                        time: row.get::<_, i64>(1)? as Millis,
                        level: level_of(&row.get::<_, String>(2)?),
                        kind: row.get(3)?,
                        service: row.get(4)?,
                        servant: row.get(5)?,
                        robot: row.get(6)?,
                        message: row.get(7)?,
                    })
                })?
                .collect()
        })
    }
}

fn migrate(connection: &mut Connection, path: &str) -> Result<(), StateError> {
    let failed = |source| StateError::Database {
        path: path.to_owned(),
        source,
    };
    let found: usize = connection
        .query_row("PRAGMA user_version", [], |row| row.get(0))
        .map_err(failed)?;
    if found > MIGRATIONS.len() {
        return Err(StateError::TooNew {
            path: path.to_owned(),
            found,
            known: MIGRATIONS.len(),
        });
    }
    for (index, step) in MIGRATIONS.iter().enumerate().skip(found) {
        let transaction = connection.transaction().map_err(failed)?;
        transaction.execute_batch(step).map_err(failed)?;
        transaction
            .pragma_update(None, "user_version", index + 1)
            .map_err(failed)?;
        transaction.commit().map_err(failed)?;
    }
    Ok(())
}

fn to_json(value: &impl Serialize, what: &str) -> Result<String, StateError> {
    serde_json::to_string(value).map_err(|source| StateError::Record {
        what: what.to_owned(),
        source,
    })
}

fn level_name(level: Level) -> &'static str {
    match level {
        Level::Info => "info",
        Level::Warning => "warning",
        Level::Error => "error",
    }
}

fn level_of(name: &str) -> Level {
    match name {
        "info" => Level::Info,
        "warning" => Level::Warning,
        _ => Level::Error,
    }
}

#[cfg(test)]
mod tests;
