//! Rules of the policy, in the words of whoever decides by them.

use rusqlite::{OptionalExtension, Row, params};

use super::{Error, State};

/// A rule.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RuleRecord {
    /// Its number, never given twice.
    pub id: i64,
    /// The principals that it is for, as text.
    pub who: String,
    /// The services that it is for, as text.
    pub services: String,
    /// What is granted, as JSON.
    pub allow: String,
}

fn read(row: &Row<'_>) -> rusqlite::Result<RuleRecord> {
    Ok(RuleRecord {
        id: row.get(0)?,
        who: row.get(1)?,
        services: row.get(2)?,
        allow: row.get(3)?,
    })
}

impl State {
    /// All rules, oldest first.
    pub fn rules(&self) -> Result<Vec<RuleRecord>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached("SELECT id, who, services, allow FROM rules ORDER BY id")?
                .query_map([], read)?
                .collect()
        })
    }

    /// Records a rule, on disk when this returns.
    pub fn add_rule(&self, who: &str, services: &str, allow: &str) -> Result<RuleRecord, Error> {
        self.write_durably(|connection| {
            connection
                .prepare_cached(
                    "INSERT INTO rules (who, services, allow) VALUES (?1, ?2, ?3) RETURNING id, who, services, allow",
                )?
                .query_row([who, services, allow], read)
        })
    }

    /// Forgets a rule; none where there is none of that number.
    pub fn remove_rule(&self, id: i64) -> Result<Option<RuleRecord>, Error> {
        self.write_durably(|connection| {
            connection
                .prepare_cached(
                    "DELETE FROM rules WHERE id = ?1 RETURNING id, who, services, allow",
                )?
                .query_row(params![id], read)
                .optional()
        })
    }
}
