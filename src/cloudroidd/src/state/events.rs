//! The journal.

use api::{Event, Level, Millis};
use rusqlite::params;

use super::{State, StateError, now};

/// Events beyond are forgotten, oldest first.
const EVENTS_KEPT: i64 = 10_000;

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

impl State {
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
