//! Policy rules, as encoded by the portal.

use rusqlite::{OptionalExtension, Row, params};

use super::{Error, State};

/// A policy rule.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RuleRecord {
    /// Rule number; never reused.
    pub id: i64,
    /// Principals that the rule applies to, as text.
    pub who: String,
    /// Service name pattern that the rule applies to, as text.
    pub services: String,
    /// Permissions granted, as JSON.
    pub allow: String,
}

fn read_rule(row: &Row<'_>) -> rusqlite::Result<RuleRecord> {
    Ok(RuleRecord { id: row.get(0)?, who: row.get(1)?, services: row.get(2)?, allow: row.get(3)? })
}

impl State {
    /// Returns all rules, oldest first.
    pub fn rules(&self) -> Result<Vec<RuleRecord>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached("SELECT id, who, services, allow FROM rules ORDER BY id")?
                .query_map([], read_rule)?
                .collect()
        })
    }

    /// Adds a rule durably.
    pub fn add_rule(&self, who: &str, services: &str, allow: &str) -> Result<RuleRecord, Error> {
        self.write_durably(|connection| {
            connection
                .prepare_cached(
                    "INSERT INTO rules (who, services, allow) VALUES (?1, ?2, ?3) RETURNING id, who, services, allow",
                )?
                .query_row([who, services, allow], read_rule)
        })
    }

    /// Deletes a rule; returns `None` if it does not exist.
    pub fn remove_rule(&self, id: i64) -> Result<Option<RuleRecord>, Error> {
        self.write_durably(|connection| {
            connection
                .prepare_cached("DELETE FROM rules WHERE id = ?1 RETURNING id, who, services, allow")?
                .query_row(params![id], read_rule)
                .optional()
        })
    }
}
