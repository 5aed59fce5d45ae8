//! Services and their revisions.

use std::collections::BTreeMap;
use std::sync::Arc;

use api::Millis;
use package::inventory::Inventory;
use ros::flavour::Flavour;
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
    /// The ROS package that the service was first made of.
    pub package: String,
    /// The deployer who published the service first: none, where an operator did.
    pub owner: Option<String>,
    /// What was pushed, in words.
    pub source: String,
    /// The ROS that its image is built for.
    pub flavour: Flavour,
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
    /// What is loaded into nodes that are component containers (ROS 2), by their names.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub components: BTreeMap<String, Vec<ros::ros2::composition::Component>>,
    /// Limits that the push asked for.
    #[serde(default)]
    pub limits: api::Limits,
    /// The most that robots may ask for.
    #[serde(default, skip_serializing_if = "api::Caps::is_empty")]
    pub caps: api::Caps,
    /// What stubs promise where their robot says nothing.
    #[serde(default, skip_serializing_if = "api::Sla::is_empty")]
    pub sla: api::Sla,
    /// What the push asked for beyond a container; whether it is allowed is looked at anew at each start.
    #[serde(default)]
    pub grants: api::Grants,
    /// Start a node again when it fails, though it asked for no respawn: nobody else will.
    #[serde(default)]
    pub restart: bool,
    /// Answers depend on earlier requests: stubs are told.
    #[serde(default)]
    pub stateful: bool,
    /// Robots share its servants; none: each robot has a servant of its own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub shared: Option<api::Shared>,
}

impl State {
    /// Makes `revision` the current one of its service, giving it the next number; on disk when this returns. Package and owner
    /// are those of a service that is new: one that exists keeps its own. `inventory`: what its image holds.
    pub fn publish(&self, revision: &RevisionRecord, inventory: &Inventory) -> Result<u64, Error> {
        self.publish_as(revision, inventory, true)
    }

    /// The same beside the current revision, if there is one.
    pub fn publish_beside(
        &self,
        revision: &RevisionRecord,
        inventory: &Inventory,
    ) -> Result<u64, Error> {
        self.publish_as(revision, inventory, false)
    }

    fn publish_as(
        &self,
        revision: &RevisionRecord,
        inventory: &Inventory,
        current: bool,
    ) -> Result<u64, Error> {
        let flavour = to_json(&revision.flavour, &revision.service)?;
        let inventory = to_json(inventory, &revision.service)?;
        let plan = to_json(&revision.plan, &revision.service)?;
        let interface = to_json(&revision.interface, &revision.service)?;
        self.write_durably(|transaction| {
            // Numbers are never given twice, not even after the service was removed and pushed again.
            let number: u64 = transaction.query_row(
                "INSERT INTO numbers (service, last) VALUES (?1, 1)
                 ON CONFLICT (service) DO UPDATE SET last = last + 1 RETURNING last",
                [&revision.service],
                |row| row.get(0),
            )?;
            transaction.execute(
                "INSERT INTO services (name, package, current, owner) VALUES (?1, ?2, ?3, ?5)
                 ON CONFLICT (name) DO UPDATE SET current = CASE WHEN ?4 THEN ?3 ELSE current END",
                params![
                    revision.service,
                    revision.package,
                    number,
                    current,
                    revision.owner
                ],
            )?;
            transaction.execute(
                "INSERT INTO revisions
                     (service, number, image, published, source, plan, interface, flavour, inventory)
                 VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9)",
                params![
                    revision.service,
                    number,
                    revision.image,
                    revision.published as i64,
                    revision.source,
                    plan,
                    interface,
                    flavour,
                    inventory
                ],
            )?;
            Ok(number)
        })
    }

    /// Makes an earlier (or later) revision the current one; false when there is none of that number.
    pub fn set_current(&self, service: &str, number: u64) -> Result<bool, Error> {
        self.write_durably(|connection| {
            connection.execute(
                "UPDATE services SET current = ?2 WHERE name = ?1
                 AND EXISTS (SELECT 1 FROM revisions WHERE service = ?1 AND number = ?2)",
                params![service, number],
            )
        })
        .map(|changed| changed == 1)
    }

    /// Makes revision `to` the current one where `from` is it, or `to` itself; false where another one is.
    pub fn replace_current(&self, service: &str, from: u64, to: u64) -> Result<bool, Error> {
        self.write_durably(|connection| {
            connection.execute(
                "UPDATE services SET current = ?3 WHERE name = ?1 AND current IN (?2, ?3)
                 AND EXISTS (SELECT 1 FROM revisions WHERE service = ?1 AND number = ?3)",
                params![service, from, to],
            )
        })
        .map(|changed| changed == 1)
    }

    /// Forgets a service and its revisions; false when there is none.
    pub fn remove_service(&self, name: &str) -> Result<bool, Error> {
        self.write_durably(|connection| {
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

    /// The deployer who published a service first: none, where an operator did; outer none, where there is no such service.
    pub fn service_owner(&self, name: &str) -> Result<Option<Option<String>>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached("SELECT owner FROM services WHERE name = ?1")?
                .query_row([name], |row| row.get(0))
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
        // Of no revision: the database counts no farther.
        if i64::try_from(number).is_err() {
            return Ok(None);
        }
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
        type Texts = (String, String, Option<String>);
        let read = |row: &Row<'_>| -> rusqlite::Result<(RevisionRecord, Texts)> {
            let record = RevisionRecord {
                service: service.to_owned(),
                number,
                image: row.get(0)?,
                published: row.get::<_, i64>(1)? as Millis,
                package: row.get(2)?,
                owner: row.get(7)?,
                source: row.get(3)?,
                flavour: Flavour::default(),
                plan: Plan::default(),
                interface: package::interface::Interface::default(),
            };
            Ok((record, (row.get(4)?, row.get(5)?, row.get(6)?)))
        };
        let found = self.read(|connection| {
            connection
                .prepare_cached(
                    "SELECT r.image, r.published, s.package, r.source, r.plan, r.interface, r.flavour, s.owner
                     FROM revisions r JOIN services s ON s.name = r.service
                     WHERE r.service = ?1 AND r.number = ?2",
                )?
                .query_row(params![service, number], read)
                .optional()
        })?;
        let Some((record, (plan, interface, flavour))) = found else {
            return Ok(None);
        };
        let unreadable = |source| unreadable(service, number, source);
        Ok(Some(RevisionRecord {
            // Revisions of earlier versions have none until their image was asked.
            flavour: flavour.map_or(Ok(record.flavour), |flavour| {
                serde_json::from_str(&flavour).map_err(unreadable)
            })?,
            plan: serde_json::from_str(&plan).map_err(unreadable)?,
            interface: serde_json::from_str(&interface).map_err(unreadable)?,
            ..record
        }))
    }

    /// What the image of a revision holds; none for one that was published by a version that did not record it.
    pub fn inventory(&self, service: &str, number: u64) -> Result<Option<Inventory>, Error> {
        let found: Option<Option<String>> = self.read(|connection| {
            connection
                .prepare_cached(
                    "SELECT inventory FROM revisions WHERE service = ?1 AND number = ?2",
                )?
                .query_row(params![service, number], |row| row.get(0))
                .optional()
        })?;
        let Some(text) = found.flatten() else {
            return Ok(None);
        };
        serde_json::from_str(&text)
            .map(Some)
            .map_err(|source| unreadable(service, number, source))
    }

    /// Records what was not when the revision was published.
    pub fn complete(
        &self,
        service: &str,
        number: u64,
        flavour: &Flavour,
        inventory: &Inventory,
    ) -> Result<(), Error> {
        let (flavour, inventory) = (to_json(flavour, service)?, to_json(inventory, service)?);
        self.write_durably(|connection| {
            connection.execute(
                "UPDATE revisions SET flavour = ?3, inventory = ?4 WHERE service = ?1 AND number = ?2",
                params![service, number, flavour, inventory],
            )
        })?;
        self.revisions.lock().remove(&(service.to_owned(), number));
        Ok(())
    }

    /// Current revisions that were published by a version that did not record what their images hold.
    pub fn incomplete(&self) -> Result<Vec<RevisionLine>, Error> {
        self.lines(
            "JOIN services s ON s.name = service AND s.current = number WHERE inventory IS NULL",
            [],
        )
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

fn unreadable(service: &str, number: u64, source: serde_json::Error) -> Error {
    Error::Record {
        what: format!("revision {number} of {service}"),
        source,
    }
}
