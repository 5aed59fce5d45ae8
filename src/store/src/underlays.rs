//! Underlays, and what stands on them.

use std::collections::BTreeMap;

use api::Millis;
use ros::flavour::Flavour;
use rusqlite::{OptionalExtension, Row, params};
use serde_json::Value;

use super::{Error, State, to_json};

/// A published underlay.
#[derive(Debug, Clone, PartialEq)]
pub struct UnderlayRecord {
    /// Name of the underlay.
    pub name: String,
    /// Revision number, starting at 1.
    pub number: u64,
    /// Digest of the manifest of the image that keeps its layers.
    pub image: String,
    /// Time of publication.
    pub published: Millis,
    /// Deployer who first published it; absent if it was an operator.
    pub owner: Option<String>,
    /// Human-readable description of what was pushed.
    pub source: String,
    /// Base and ROS version.
    pub flavour: Flavour,
    /// Packages, layers and dependencies, as the builder describes them.
    pub contents: Value,
}

/// A service that stands on an underlay.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StandingService {
    /// Name of the service.
    pub service: String,
    /// Revision of the underlay that its current revision was built on.
    pub on: u64,
}

const COLUMNS: &str = "name, number, image, published, owner, source, flavour, contents";

impl State {
    /// Publishes an underlay durably in place of its earlier revision and assigns it the next number, which is
    /// returned. An existing one keeps its owner.
    pub fn publish_underlay(&self, underlay: &UnderlayRecord) -> Result<u64, Error> {
        let flavour = to_json(&underlay.flavour, &underlay.name)?;
        let contents = to_json(&underlay.contents, &underlay.name)?;
        self.write_durably(|transaction| {
            // Numbers are never reused, not even after it was removed. No service has such a name.
            let number: u64 = transaction.query_row(
                "INSERT INTO numbers (service, last) VALUES ('underlay:' || ?1, 1)
                 ON CONFLICT (service) DO UPDATE SET last = last + 1 RETURNING last",
                [&underlay.name],
                |row| row.get(0),
            )?;
            transaction.execute(
                "INSERT INTO underlays (name, number, image, published, owner, source, flavour, contents)
                 VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8)
                 ON CONFLICT (name) DO UPDATE SET number = ?2, image = ?3, published = ?4, source = ?6, flavour = ?7,
                     contents = ?8",
                params![
                    underlay.name,
                    number,
                    underlay.image,
                    underlay.published as i64,
                    underlay.owner,
                    underlay.source,
                    flavour,
                    contents
                ],
            )?;
            Ok(number)
        })
    }

    /// Returns an underlay.
    pub fn underlay(&self, name: &str) -> Result<Option<UnderlayRecord>, Error> {
        let found = self.read(|connection| {
            connection
                .prepare_cached(&format!("SELECT {COLUMNS} FROM underlays WHERE name = ?1"))?
                .query_row([name], read_row)
                .optional()
        })?;
        found.map(StoredUnderlay::parse).transpose()
    }

    /// Returns all underlays by name.
    pub fn underlays(&self) -> Result<Vec<UnderlayRecord>, Error> {
        let found: Vec<StoredUnderlay> = self.read(|connection| {
            connection
                .prepare_cached(&format!("SELECT {COLUMNS} FROM underlays ORDER BY name"))?
                .query_map([], read_row)?
                .collect()
        })?;
        found.into_iter().map(StoredUnderlay::parse).collect()
    }

    /// Deletes an underlay; returns false if it does not exist.
    pub fn remove_underlay(&self, name: &str) -> Result<bool, Error> {
        self.write_durably(|connection| connection.execute("DELETE FROM underlays WHERE name = ?1", [name]))
            .map(|changed| changed == 1)
    }

    /// Returns, by underlay, the services whose current revision was built on it.
    pub fn services_on_underlays(&self) -> Result<BTreeMap<String, Vec<StandingService>>, Error> {
        let found: Vec<(String, StandingService)> = self.read_at_length(|connection| {
            connection
                .prepare_cached(
                    "SELECT u.key, s.name, u.value FROM services s
                     JOIN revisions r ON r.service = s.name AND r.number = s.current
                     JOIN json_each(r.plan, '$.underlays') u ORDER BY s.name",
                )?
                .query_map([], |row| Ok((row.get(0)?, StandingService { service: row.get(1)?, on: row.get(2)? })))?
                .collect()
        })?;
        let mut standing: BTreeMap<String, Vec<StandingService>> = BTreeMap::new();
        for (underlay, service) in found {
            standing.entry(underlay).or_default().push(service);
        }
        Ok(standing)
    }
}

/// A row whose texts are not parsed yet.
struct StoredUnderlay {
    record: UnderlayRecord,
    flavour: String,
    contents: String,
}

impl StoredUnderlay {
    fn parse(self) -> Result<UnderlayRecord, Error> {
        let Self { record, flavour, contents } = self;
        let unreadable = |source| Error::Record { what: format!("underlay {}", record.name), source };
        let flavour = serde_json::from_str(&flavour).map_err(unreadable)?;
        let contents = serde_json::from_str(&contents).map_err(unreadable)?;
        Ok(UnderlayRecord { flavour, contents, ..record })
    }
}

fn read_row(row: &Row<'_>) -> rusqlite::Result<StoredUnderlay> {
    let record = UnderlayRecord {
        name: row.get(0)?,
        number: row.get(1)?,
        image: row.get(2)?,
        published: row.get::<_, i64>(3)? as Millis,
        owner: row.get(4)?,
        source: row.get(5)?,
        flavour: Flavour::default(),
        contents: Value::Null,
    };
    Ok(StoredUnderlay { record, flavour: row.get(6)?, contents: row.get(7)? })
}

#[cfg(test)]
mod tests {
    use package::inventory::Inventory;

    use super::*;
    use crate::{Plan, RevisionRecord};

    fn underlay(name: &str, owner: Option<&str>) -> UnderlayRecord {
        UnderlayRecord {
            name: name.to_owned(),
            number: 0,
            image: "sha256:1".to_owned(),
            published: 1,
            owner: owner.map(str::to_owned),
            source: "~/lab_ws".to_owned(),
            flavour: Flavour::default(),
            contents: serde_json::json!({"base": "bookworm-ros1"}),
        }
    }

    fn revision(service: &str, on: &[(&str, u64)]) -> RevisionRecord {
        let underlays = on.iter().map(|(name, number)| ((*name).to_owned(), *number)).collect();
        RevisionRecord {
            service: service.to_owned(),
            number: 0,
            image: "sha256:2".to_owned(),
            published: 1,
            package: "p".to_owned(),
            owner: None,
            source: String::new(),
            flavour: Flavour::default(),
            plan: Plan { underlays, ..Plan::default() },
            interface: Default::default(),
        }
    }

    #[test]
    fn an_underlay_replaces_its_earlier_revision_and_keeps_its_owner() {
        let place = tempfile::tempdir().expect("a directory");
        let state = State::open(&place.path().join("cloudroid.db")).expect("a database");
        assert_eq!(state.publish_underlay(&underlay("maps", Some("ada"))).expect("published"), 1);
        let changed = UnderlayRecord { image: "sha256:3".to_owned(), ..underlay("maps", Some("bob")) };
        assert_eq!(state.publish_underlay(&changed).expect("published"), 2);
        let expected = UnderlayRecord { number: 2, owner: Some("ada".to_owned()), ..changed };
        assert_eq!(state.underlay("maps").expect("read"), Some(expected.clone()));
        assert_eq!(state.underlays().expect("read"), [expected]);
        assert!(state.remove_underlay("maps").expect("removed") && !state.remove_underlay("maps").expect("gone"));
        assert_eq!(state.publish_underlay(&underlay("maps", None)).expect("published"), 3, "numbers go on");
    }

    #[test]
    fn current_revisions_say_what_they_stand_on() {
        let place = tempfile::tempdir().expect("a directory");
        let state = State::open(&place.path().join("cloudroid.db")).expect("a database");
        for (service, on) in [
            ("nav", &[("maps", 1), ("arms", 4)][..]),
            ("plain", &[]),
            ("slam", &[("arms", 4)]),
            ("slam", &[("maps", 2)]),
        ] {
            state.publish(&revision(service, on), &Inventory::default()).expect("published");
        }
        let standing = state.services_on_underlays().expect("read");
        let on = |service: &str, on| StandingService { service: service.to_owned(), on };
        assert_eq!(standing["maps"], [on("nav", 1), on("slam", 2)]);
        assert_eq!(standing["arms"], [on("nav", 4)]);
        let read = state.current_revision("nav").expect("read").expect("there");
        assert_eq!(read.plan.underlays.len(), 2);
    }
}
