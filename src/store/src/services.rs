//! Services and their revisions.

use std::collections::BTreeMap;
use std::sync::Arc;

use api::Millis;
use rusqlite::{OptionalExtension, Row, params};
use serde::{Deserialize, Serialize};

use super::{Error, State, to_json};

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

/// A published revision in short.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RevisionLine {
    /// Its service.
    pub service: String,
    /// From 1.
    pub number: u64,
    /// Digest of its image manifest.
    pub image: String,
    /// When it was published.
    pub published: Millis,
    /// What was pushed, in words.
    pub source: String,
}

/// How servants of a revision are started.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// Environment of every process.
    #[serde(default)]
    pub environment: BTreeMap<String, String>,
    /// The nodes.
    pub nodes: Vec<servant::spec::NodeSpec>,
    /// Parameters set before the first node starts, absolute names.
    #[serde(default)]
    pub parameters: BTreeMap<String, ros::bus::ParamValue>,
    /// Limits that the push asked for.
    #[serde(default)]
    pub limits: api::Limits,
    /// What the push asked for beyond a container; whether it is allowed is looked at anew at each start.
    #[serde(default)]
    pub grants: api::Grants,
    /// Start a node again when it fails, though it asked for no respawn: nobody else will.
    #[serde(default)]
    pub restart: bool,
    /// Answers depend on earlier requests: stubs are told.
    #[serde(default)]
    pub stateful: bool,
}

impl State {
    /// Makes `revision` the current one of its service, giving it the next number; on disk when this returns.
    pub fn publish(&self, revision: &RevisionRecord) -> Result<u64, Error> {
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

    /// Makes an earlier (or later) revision the current one; false when there is none of that number.
    pub fn set_current(&self, service: &str, number: u64) -> Result<bool, Error> {
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
    pub fn remove_service(&self, name: &str) -> Result<bool, Error> {
        self.durably(|connection| {
            connection.execute("DELETE FROM services WHERE name = ?1", [name])
        })
        .map(|changed| changed == 1)
    }

    /// Names of all services.
    pub fn service_names(&self) -> Result<Vec<String>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached("SELECT name FROM services ORDER BY name")?
                .query_map([], |row| row.get(0))?
                .collect()
        })
    }

    /// The ROS package that a service was first made of.
    pub fn service_package(&self, name: &str) -> Result<Option<String>, Error> {
        self.read(|connection| {
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
    pub fn current(&self, service: &str) -> Result<Option<Arc<RevisionRecord>>, Error> {
        let current: Option<u64> = self.read(|connection| {
            connection
                .prepare_cached("SELECT current FROM services WHERE name = ?1")?
                .query_row([service], |row| row.get(0))
                .optional()
        })?;
        match current {
            Some(number) => self.revision(service, number),
            None => Ok(None),
        }
    }

    /// One revision of a service. Revisions do not change: those in use stay in memory.
    pub fn revision(
        &self,
        service: &str,
        number: u64,
    ) -> Result<Option<Arc<RevisionRecord>>, Error> {
        let key = (service.to_owned(), number);
        if let Some(known) = self.revisions.lock().get(&key) {
            return Ok(Some(Arc::clone(known)));
        }
        let Some(record) = self.read_revision(service, number)? else {
            return Ok(None);
        };
        let record = Arc::new(record);
        let mut known = self.revisions.lock();
        known.retain(|_, record| Arc::strong_count(record) > 1);
        known.insert(key, Arc::clone(&record));
        Ok(Some(record))
    }

    fn read_revision(&self, service: &str, number: u64) -> Result<Option<RevisionRecord>, Error> {
        let read = |row: &Row<'_>| -> rusqlite::Result<(RevisionRecord, String, String)> {
            let record = RevisionRecord {
                service: service.to_owned(),
                number,
                image: row.get(0)?,
                published: row.get::<_, i64>(1)? as Millis,
                package: row.get(2)?,
                source: row.get(3)?,
                plan: Plan::default(),
                interface: package::interface::Interface::default(),
            };
            Ok((record, row.get(4)?, row.get(5)?))
        };
        let found = self.read(|connection| {
            connection
                .prepare_cached(
                    "SELECT r.image, r.published, s.package, r.source, r.plan, r.interface
                     FROM revisions r JOIN services s ON s.name = r.service
                     WHERE r.service = ?1 AND r.number = ?2",
                )?
                .query_row(params![service, number], read)
                .optional()
        })?;
        let Some((record, plan, interface)) = found else {
            return Ok(None);
        };
        let unreadable = |source| Error::Record {
            what: format!("revision {number} of {service}"),
            source,
        };
        Ok(Some(RevisionRecord {
            plan: serde_json::from_str(&plan).map_err(unreadable)?,
            interface: serde_json::from_str(&interface).map_err(unreadable)?,
            ..record
        }))
    }

    /// All revisions of a service in short, newest first.
    pub fn revisions(&self, service: &str) -> Result<Vec<RevisionLine>, Error> {
        self.lines("WHERE service = ?1", [service])
    }

    /// All revisions of all services in short.
    pub fn all_revisions(&self) -> Result<Vec<RevisionLine>, Error> {
        self.lines("", [])
    }

    fn lines(
        &self,
        condition: &str,
        values: impl rusqlite::Params,
    ) -> Result<Vec<RevisionLine>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached(&format!(
                    "SELECT service, number, image, published, source FROM revisions {condition}
                     ORDER BY service, number DESC"
                ))?
                .query_map(values, |row| {
                    Ok(RevisionLine {
                        service: row.get(0)?,
                        number: row.get(1)?,
                        image: row.get(2)?,
                        published: row.get::<_, i64>(3)? as Millis,
                        source: row.get(4)?,
                    })
                })?
                .collect()
        })
    }
}
