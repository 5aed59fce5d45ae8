//! The event journal.

use api::{Event, Level, Millis};
use rusqlite::{Connection, params};

use super::backlog::Write;
use super::{Error, State, now};

/// Maximum number of events; older ones are deleted first.
const MAX_EVENTS: i64 = 10_000;

/// Objects that a new event is about.
#[derive(Debug, Clone, Default)]
pub struct NewEvent<'a> {
    /// Service concerned.
    pub service: Option<&'a str>,
    /// Servant concerned.
    pub servant: Option<&'a str>,
    /// Robot concerned.
    pub robot: Option<&'a str>,
}

/// Selection of events; absent criteria match all.
#[derive(Debug, Clone, Copy, Default)]
pub struct EventFilter<'a> {
    /// Kind of event.
    pub kind: Option<&'a str>,
    /// Service concerned.
    pub service: Option<&'a str>,
    /// Servant concerned.
    pub servant: Option<&'a str>,
    /// Robot concerned.
    pub robot: Option<&'a str>,
    /// Restriction to the events that a principal without full access may see.
    pub told: Option<EventVisibility<'a>>,
}

/// Events that a principal without full access may see: those of some services, and of no robot other than its own.
#[derive(Debug, Clone, Copy)]
pub struct EventVisibility<'a> {
    /// Visible services.
    pub services: &'a [String],
    /// Name of the robot, if the reader is one. Events of a service that concern no robot are visible to all.
    pub own_robot: Option<&'a str>,
}

impl EventVisibility<'_> {
    fn matches(&self, event: &Event) -> bool {
        let of_service = event.service.as_ref();
        of_service.is_some_and(|service| self.services.contains(service))
            && self.own_robot.is_none_or(|own| event.robot.as_deref().is_none_or(|robot| robot == own))
    }
}

impl EventFilter<'_> {
    fn matches(&self, event: &Event) -> bool {
        let is = |wanted: Option<&str>, has: Option<&str>| wanted.is_none() || wanted == has;
        is(self.kind, Some(&event.kind))
            && is(self.service, event.service.as_deref())
            && is(self.servant, event.servant.as_deref())
            && is(self.robot, event.robot.as_deref())
            && self.told.is_none_or(|told| told.matches(event))
    }
}

/// Returns the number of the latest event ever written; 0 before the first.
pub(super) fn last_event_number(connection: &Connection) -> rusqlite::Result<i64> {
    connection
        .query_row("SELECT COALESCE((SELECT seq FROM sqlite_sequence WHERE name = 'events'), 0)", [], |row| row.get(0))
}

/// Writes an event that already has its number.
pub(super) fn insert(connection: &Connection, event: &Event) -> rusqlite::Result<()> {
    connection
        .prepare_cached(
            "INSERT INTO events (id, time, level, kind, service, servant, robot, message)
             VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8)",
        )?
        .execute(params![
            event.id,
            event.time as i64,
            level_name(event.level),
            event.kind,
            event.service,
            event.servant,
            event.robot,
            event.message
        ])?;
    if event.id % 100 == 0 {
        connection.execute("DELETE FROM events WHERE id <= ?1", [event.id - MAX_EVENTS])?;
    }
    Ok(())
}

impl State {
    /// Appends an event to the journal, or queues it if the database cannot be written now.
    pub fn add_event(&self, level: Level, kind: &str, message: &str, about: &NewEvent<'_>) {
        let owned = |text: Option<&str>| text.map(str::to_owned);
        self.write_or_queue(Write::Event(Event {
            id: 0,
            time: now(),
            level,
            kind: kind.to_owned(),
            service: owned(about.service),
            servant: owned(about.servant),
            robot: owned(about.robot),
            message: message.to_owned(),
        }));
    }

    /// Returns the latest `limit` events after number `since`, oldest first.
    pub fn events(&self, since: i64, limit: u32) -> Result<Vec<Event>, Error> {
        self.filtered_events(EventFilter::default(), since, limit)
    }

    /// Returns the latest `limit` matching events after number `since`, oldest first.
    pub fn filtered_events(&self, filter: EventFilter<'_>, since: i64, limit: u32) -> Result<Vec<Event>, Error> {
        // Read before the written events, so that none is missed that is written in between.
        let mut kept = self.backlog.unwritten_events(since);
        kept.retain(|event| filter.matches(event));
        let mut events = self.written_events(filter, since, limit)?;
        let last = events.last().map_or(since, |event| event.id);
        events.extend(kept.into_iter().filter(|event| event.id > last));
        let beyond = events.len().saturating_sub(limit as usize);
        Ok(events.split_off(beyond))
    }

    /// Returns the services with events, sorted by name.
    pub fn services_with_events(&self) -> Result<Vec<String>, Error> {
        let mut services: Vec<String> = self.read_at_length(|connection| {
            connection
                .prepare_cached("SELECT DISTINCT service FROM events WHERE service IS NOT NULL")?
                .query_map([], |row| row.get(0))?
                .collect()
        })?;
        let kept = self.backlog.unwritten_events(0).into_iter();
        services.extend(kept.filter_map(|event| event.service));
        services.sort();
        services.dedup();
        Ok(services)
    }

    fn written_events(&self, filter: EventFilter<'_>, since: i64, limit: u32) -> Result<Vec<Event>, Error> {
        let EventFilter { kind, service, servant, robot, told } = filter;
        let services = told.map(|told| serde_json::Value::from(told.services).to_string());
        let own_robot = told.and_then(|told| told.own_robot);
        self.read_at_length(|connection| {
            connection
                .prepare_cached(
                    "SELECT id, time, level, kind, service, servant, robot, message FROM
                     (SELECT * FROM events WHERE id > ?1
                      AND (?3 IS NULL OR kind = ?3) AND (?4 IS NULL OR service = ?4)
                      AND (?5 IS NULL OR servant = ?5) AND (?6 IS NULL OR robot = ?6)
                      AND (?7 IS NULL OR service IN (SELECT value FROM json_each(?7)))
                      AND (?8 IS NULL OR robot IS NULL OR robot = ?8)
                      ORDER BY id DESC LIMIT ?2) ORDER BY id",
                )?
                .query_map(params![since, limit, kind, service, servant, robot, services, own_robot], |row| {
                    Ok(Event {
                        id: row.get(0)?,
                        time: row.get::<_, i64>(1)? as Millis,
                        level: parse_level(&row.get::<_, String>(2)?),
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

fn parse_level(name: &str) -> Level {
    match name {
        "info" => Level::Info,
        "warning" => Level::Warning,
        _ => Level::Error,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn event_about<'a>(service: Option<&'a str>, robot: Option<&'a str>) -> NewEvent<'a> {
        NewEvent { service, servant: None, robot }
    }

    #[test]
    fn whoever_sees_little_is_told_the_newest_of_that_however_much_else_there_is() {
        let home = tempfile::tempdir().expect("a directory");
        let state = State::open(&home.path().join("cloudroid.db")).expect("a database");
        state.add_event(Level::Info, "k", "mine", &event_about(Some("mine"), Some("r1")));
        state.add_event(Level::Info, "k", "of mine", &event_about(Some("mine"), None));
        state.add_event(Level::Info, "k", "a friend's", &event_about(Some("mine"), Some("r2")));
        for _ in 0..200 {
            state.add_event(Level::Info, "k", "theirs", &event_about(Some("theirs"), Some("r1")));
            state.add_event(Level::Info, "k", "the machine's", &event_about(None, None));
        }
        assert_eq!(state.services_with_events().expect("readable"), ["mine", "theirs"]);
        let told = |services: &[String], own_robot, limit| -> Vec<String> {
            let filter = EventFilter { told: Some(EventVisibility { services, own_robot }), ..EventFilter::default() };
            let events = state.filtered_events(filter, 0, limit).expect("readable");
            events.into_iter().map(|event| event.message).collect()
        };
        let mine = ["mine".to_owned()];
        assert_eq!(told(&mine, None, 9), ["mine", "of mine", "a friend's"]);
        assert_eq!(told(&mine, None, 1), ["a friend's"]);
        assert_eq!(told(&mine, Some("r1"), 9), ["mine", "of mine"]);
        assert!(told(&[], None, 9).is_empty());
        // The same holds for events that have not been written yet.
        let locker = Connection::open(home.path().join("cloudroid.db")).expect("another connection");
        locker.execute_batch("BEGIN IMMEDIATE").expect("the lock");
        state.add_event(Level::Info, "k", "kept", &event_about(Some("mine"), Some("r1")));
        state.add_event(Level::Info, "k", "kept of others", &event_about(Some("other"), None));
        assert_eq!(told(&mine, Some("r1"), 9), ["mine", "of mine", "kept"]);
        assert_eq!(state.services_with_events().expect("readable"), ["mine", "other", "theirs"]);
    }
}
