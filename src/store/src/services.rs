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
    /// Name of the service.
    pub service: String,
    /// Revision number, starting at 1.
    pub number: u64,
    /// Digest of the image manifest.
    pub image: String,
    /// Time of publication.
    pub published: Millis,
    /// ROS package that the service was first built from.
    pub package: String,
    /// Deployer who first published the service; absent if it was an operator.
    pub owner: Option<String>,
    /// Human-readable description of what was pushed.
    pub source: String,
    /// ROS flavour that the image is built for.
    pub flavour: Flavour,
    /// Launch plan of its servants.
    pub plan: Plan,
    /// Interface, with message definitions.
    pub interface: package::interface::Interface,
}

/// Summary of a published revision.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RevisionSummary {
    /// Name of the service.
    pub service: String,
    /// Revision number, starting at 1.
    pub number: u64,
    /// Digest of the image manifest.
    pub image: String,
    /// Time of publication.
    pub published: Millis,
    /// Human-readable description of what was pushed.
    pub source: String,
}

/// Launch plan of the servants of a revision.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// Environment of every process.
    #[serde(default)]
    pub environment: BTreeMap<String, String>,
    /// Nodes to start.
    pub nodes: Vec<servant::spec::NodeSpec>,
    /// Parameters set before the first node starts, by absolute name.
    #[serde(default)]
    pub parameters: BTreeMap<String, ros::bus::ParamValue>,
    /// Components to load into nodes that are component containers (ROS 2), by node name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub components: BTreeMap<String, Vec<ros::ros2::composition::Component>>,
    /// Limits requested by the push.
    #[serde(default)]
    pub limits: api::Limits,
    /// Upper limits on what robots may request.
    #[serde(default, skip_serializing_if = "api::Caps::is_empty")]
    pub caps: api::Caps,
    /// Default SLA of stubs whose robot states none.
    #[serde(default, skip_serializing_if = "api::Sla::is_empty")]
    pub sla: api::Sla,
    /// Access requested beyond the container; whether it is allowed is checked at each start.
    #[serde(default)]
    pub grants: api::Grants,
    /// True to restart failed nodes that requested no respawn, because nothing else would.
    #[serde(default)]
    pub restart: bool,
    /// True if answers depend on earlier requests; passed on to stubs.
    #[serde(default)]
    pub stateful: bool,
    /// How robots share servants; absent if each robot has a servant of its own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub shared: Option<api::Shared>,
    /// Underlays that the image was built on, with their revisions.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub underlays: BTreeMap<String, u64>,
}

impl State {
    /// Publishes `revision` durably as the current one of its service and assigns it the next number. Package and owner
    /// are recorded for a new service only; an existing one keeps its own. `inventory` is the content of its image.
    pub fn publish(&self, revision: &RevisionRecord, inventory: &Inventory) -> Result<u64, Error> {
        self.publish_revision(revision, inventory, true)
    }

    /// Publishes `revision` without making it the current one, unless the service is new.
    pub fn publish_inactive(&self, revision: &RevisionRecord, inventory: &Inventory) -> Result<u64, Error> {
        self.publish_revision(revision, inventory, false)
    }

    fn publish_revision(&self, revision: &RevisionRecord, inventory: &Inventory, current: bool) -> Result<u64, Error> {
        let flavour = to_json(&revision.flavour, &revision.service)?;
        let inventory = to_json(inventory, &revision.service)?;
        let plan = to_json(&revision.plan, &revision.service)?;
        let interface = to_json(&revision.interface, &revision.service)?;
        self.write_durably(|transaction| {
            // Numbers are never reused, not even after the service was removed and pushed again.
            let number: u64 = transaction.query_row(
                "INSERT INTO numbers (service, last) VALUES (?1, 1)
                 ON CONFLICT (service) DO UPDATE SET last = last + 1 RETURNING last",
                [&revision.service],
                |row| row.get(0),
            )?;
            transaction.execute(
                "INSERT INTO services (name, package, current, owner) VALUES (?1, ?2, ?3, ?5)
                 ON CONFLICT (name) DO UPDATE SET current = CASE WHEN ?4 THEN ?3 ELSE current END",
                params![revision.service, revision.package, number, current, revision.owner],
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

    /// Makes another revision the current one; returns false if it does not exist.
    pub fn set_current_revision(&self, service: &str, number: u64) -> Result<bool, Error> {
        self.write_durably(|connection| {
            connection.execute(
                "UPDATE services SET current = ?2 WHERE name = ?1
                 AND EXISTS (SELECT 1 FROM revisions WHERE service = ?1 AND number = ?2)",
                params![service, number],
            )
        })
        .map(|changed| changed == 1)
    }

    /// Makes revision `to` the current one if the current one is `from` or `to`; otherwise returns false.
    pub fn replace_current_revision(&self, service: &str, from: u64, to: u64) -> Result<bool, Error> {
        self.write_durably(|connection| {
            connection.execute(
                "UPDATE services SET current = ?3 WHERE name = ?1 AND current IN (?2, ?3)
                 AND EXISTS (SELECT 1 FROM revisions WHERE service = ?1 AND number = ?3)",
                params![service, from, to],
            )
        })
        .map(|changed| changed == 1)
    }

    /// Deletes a service and its revisions; returns false if it does not exist.
    pub fn remove_service(&self, name: &str) -> Result<bool, Error> {
        self.write_durably(|connection| connection.execute("DELETE FROM services WHERE name = ?1", [name]))
            .map(|changed| changed == 1)
    }

    /// Returns the names of all services.
    pub fn service_names(&self) -> Result<Vec<String>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached("SELECT name FROM services ORDER BY name")?
                .query_map([], |row| row.get(0))?
                .collect()
        })
    }

    /// Returns the ROS package that a service was first built from.
    pub fn service_package(&self, name: &str) -> Result<Option<String>, Error> {
        self.read(|connection| {
            connection.query_row("SELECT package FROM services WHERE name = ?1", [name], |row| row.get(0)).optional()
        })
    }

    /// Returns the deployer who first published a service. The outer `None` means that the service does not exist, the
    /// inner one that an operator published it.
    pub fn service_owner(&self, name: &str) -> Result<Option<Option<String>>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached("SELECT owner FROM services WHERE name = ?1")?
                .query_row([name], |row| row.get(0))
                .optional()
        })
    }

    /// Returns the current revision of a service.
    pub fn current_revision(&self, service: &str) -> Result<Option<Arc<RevisionRecord>>, Error> {
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

    /// Returns a revision of a service. Revisions are immutable; those in use stay in memory.
    pub fn revision(&self, service: &str, number: u64) -> Result<Option<Arc<RevisionRecord>>, Error> {
        // There is no such revision: the database cannot represent the number.
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
        let unreadable = |source| unreadable_revision(service, number, source);
        Ok(Some(RevisionRecord {
            // Revisions of earlier versions have no flavour until their image has been inspected.
            flavour: flavour
                .map_or(Ok(record.flavour), |flavour| serde_json::from_str(&flavour).map_err(unreadable))?,
            plan: serde_json::from_str(&plan).map_err(unreadable)?,
            interface: serde_json::from_str(&interface).map_err(unreadable)?,
            ..record
        }))
    }

    /// Returns the inventory of a revision's image; `None` if it was published by a version that did not record it.
    pub fn inventory(&self, service: &str, number: u64) -> Result<Option<Inventory>, Error> {
        let found: Option<Option<String>> = self.read(|connection| {
            connection
                .prepare_cached("SELECT inventory FROM revisions WHERE service = ?1 AND number = ?2")?
                .query_row(params![service, number], |row| row.get(0))
                .optional()
        })?;
        let Some(text) = found.flatten() else {
            return Ok(None);
        };
        serde_json::from_str(&text).map(Some).map_err(|source| unreadable_revision(service, number, source))
    }

    /// Records the flavour and inventory of a revision that was published without them.
    pub fn record_inventory(
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

    /// Returns the current revisions whose inventory was not recorded at publication.
    pub fn revisions_without_inventory(&self) -> Result<Vec<RevisionSummary>, Error> {
        self.query_revisions("JOIN services s ON s.name = service AND s.current = number WHERE inventory IS NULL", [])
    }

    /// Returns summaries of all revisions of a service, newest first.
    pub fn revisions(&self, service: &str) -> Result<Vec<RevisionSummary>, Error> {
        self.query_revisions("WHERE service = ?1", [service])
    }

    /// Returns summaries of all revisions of all services.
    pub fn all_revisions(&self) -> Result<Vec<RevisionSummary>, Error> {
        self.query_revisions("", [])
    }

    fn query_revisions(&self, condition: &str, values: impl rusqlite::Params) -> Result<Vec<RevisionSummary>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached(&format!(
                    "SELECT service, number, image, published, source FROM revisions {condition}
                     ORDER BY service, number DESC"
                ))?
                .query_map(values, |row| {
                    Ok(RevisionSummary {
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

fn unreadable_revision(service: &str, number: u64, source: serde_json::Error) -> Error {
    Error::Record { what: format!("revision {number} of {service}"), source }
}
