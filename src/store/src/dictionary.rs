//! Dictionary rows of services.

use api::Measure;
use api::dictionary::{NewRows, Row};
use rusqlite::params;

use super::{Error, State, now, to_json};

impl State {
    /// Returns all rows of a service, in the order in which they were first written.
    pub fn dictionary(&self, service: &str) -> Result<Vec<Row>, Error> {
        type Texts = (String, String, String, Option<String>);
        let found: Vec<(i64, f64, Option<u64>, i64, Texts)> = self.read(|connection| {
            connection
                .prepare_cached(
                    "SELECT id, value, revision, written, measure, aux, limits, spread
                     FROM dictionary WHERE service = ?1 ORDER BY id",
                )?
                .query_map([service], |row| {
                    let texts = (row.get(4)?, row.get(5)?, row.get(6)?, row.get(7)?);
                    Ok((row.get(0)?, row.get(1)?, row.get(2)?, row.get(3)?, texts))
                })?
                .collect()
        })?;
        let rows = found.into_iter();
        rows.map(|(id, value, revision, written, texts)| {
            let (measure, aux, limits, spread) = texts;
            let unreadable =
                |source| Error::Record { what: format!("entry {id} of the SLA table of {service}"), source };
            Ok(Row {
                id,
                measure: read_measure(&measure).map_err(unreadable)?,
                value,
                aux: serde_json::from_str(&aux).map_err(unreadable)?,
                limits: serde_json::from_str(&limits).map_err(unreadable)?,
                spread: spread.map(|spread| serde_json::from_str(&spread)).transpose().map_err(unreadable)?,
                revision,
                written: written as api::Millis,
            })
        })
        .collect()
    }

    /// Writes rows of a service durably, all or none. A row replaces an earlier one with the same measure, value and
    /// auxiliary parameters and takes over its number. `revision` is the revision that they were measured with.
    pub fn write_dictionary(&self, service: &str, revision: u64, new: &NewRows) -> Result<(), Error> {
        let mut texts = Vec::new();
        for row in &new.rows {
            let spread = row.spread.as_ref();
            let spread = spread.map(|spread| to_json(spread, service)).transpose()?;
            let (aux, limits) = (to_json(&row.aux, service)?, to_json(&row.limits, service)?);
            texts.push((aux, limits, spread));
        }
        self.write_durably(|transaction| {
            if new.replace {
                transaction.execute("DELETE FROM dictionary WHERE service = ?1", [service])?;
            }
            for (row, (aux, limits, spread)) in new.rows.iter().zip(&texts) {
                transaction.execute(
                    "INSERT INTO dictionary (service, measure, value, aux, limits, spread, revision, written)
                     VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8)
                     ON CONFLICT (service, measure, value, aux) DO UPDATE
                     SET limits = ?5, spread = ?6, revision = ?7, written = ?8",
                    params![service, row.measure.name(), row.value, aux, limits, spread, revision, now() as i64],
                )?;
            }
            Ok(())
        })
    }

    /// Deletes a row of a service; returns false if it does not exist.
    pub fn remove_from_dictionary(&self, service: &str, id: i64) -> Result<bool, Error> {
        self.write_durably(|connection| {
            connection.execute("DELETE FROM dictionary WHERE service = ?1 AND id = ?2", params![service, id])
        })
        .map(|removed| removed == 1)
    }
}

fn read_measure(name: &str) -> serde_json::Result<Measure> {
    serde_json::from_value(serde_json::Value::String(name.to_owned()))
}
