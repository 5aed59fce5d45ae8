//! Files of the last seconds of servants.

use api::Millis;
use rusqlite::{Row, params};

use super::{Error, State, to_json};

/// A file, as it is remembered.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordingRecord {
    /// Its number, which names the file; 0 in one that is yet to be.
    pub id: u64,
    /// The service.
    pub service: String,
    /// The robot.
    pub robot: String,
    /// The servant's id.
    pub servant: String,
    /// When it was written.
    pub time: Millis,
    /// Why it was written.
    pub why: String,
    /// From its first message to its last, in milliseconds.
    pub span: Millis,
    /// Messages.
    pub messages: u64,
    /// Bytes of the file.
    pub bytes: u64,
    /// The topics that it has messages of; none: nobody knows.
    pub topics: Option<Vec<String>>,
}

impl State {
    /// Remembers a file; its number.
    pub fn add_recording(&self, new: &RecordingRecord) -> Result<u64, Error> {
        let topics = new.topics.as_ref();
        let topics = topics
            .map(|topics| to_json(topics, "a recording"))
            .transpose()?;
        self.write(|connection| {
            connection
                .prepare_cached(
                    "INSERT INTO recordings (service, robot, servant, time, why, span, messages, bytes, topics)
                     VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9) RETURNING id",
                )?
                .query_row(
                    params![
                        new.service,
                        new.robot,
                        new.servant,
                        new.time as i64,
                        new.why,
                        new.span as i64,
                        new.messages as i64,
                        new.bytes as i64,
                        topics
                    ],
                    |row| row.get::<_, i64>(0),
                )
        })
        .map(|id| id as u64)
    }

    /// All files, the newest first.
    pub fn recordings(&self) -> Result<Vec<RecordingRecord>, Error> {
        self.read_at_length(|connection| {
            connection
                .prepare_cached(
                    "SELECT id, service, robot, servant, time, why, span, messages, bytes, topics
                     FROM recordings ORDER BY id DESC",
                )?
                .query_map([], record)?
                .collect()
        })
    }

    /// Forgets a file; whether it was known.
    pub fn forget_recording(&self, id: u64) -> Result<bool, Error> {
        self.write(|connection| {
            connection.execute("DELETE FROM recordings WHERE id = ?1", [id as i64])
        })
        .map(|forgotten| forgotten > 0)
    }
}

fn record(row: &Row<'_>) -> rusqlite::Result<RecordingRecord> {
    let number = |at: usize| row.get::<_, i64>(at).map(|number| number as u64);
    Ok(RecordingRecord {
        id: number(0)?,
        service: row.get(1)?,
        robot: row.get(2)?,
        servant: row.get(3)?,
        time: number(4)?,
        why: row.get(5)?,
        span: number(6)?,
        messages: number(7)?,
        bytes: number(8)?,
        // What cannot be read is not known.
        topics: row
            .get::<_, Option<String>>(9)?
            .and_then(|topics| serde_json::from_str(&topics).ok()),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_remembered_with_their_topics() {
        let directory = tempfile::tempdir().expect("a directory");
        let state = State::open(&directory.path().join("cloudroid.db")).expect("a database");
        let mut record = RecordingRecord {
            id: 0,
            service: "sights".into(),
            robot: "rover".into(),
            servant: "sights-1".into(),
            time: 1,
            why: "a test".into(),
            span: 2,
            messages: 3,
            bytes: 4,
            topics: Some(vec!["/map".into(), "/it's".into()]),
        };
        record.id = state.add_recording(&record).expect("written");
        assert_eq!(state.recordings().expect("read"), [record.clone()]);
        // Of files of before nobody knows what they hold.
        let of_before = "UPDATE recordings SET topics = NULL";
        let changed = state.write(|connection| connection.execute(of_before, []));
        assert_eq!(changed.expect("written"), 1);
        record.topics = None;
        assert_eq!(state.recordings().expect("read"), [record.clone()]);
        assert!(state.forget_recording(record.id).expect("forgotten"));
        assert_eq!(state.recordings().expect("read"), []);
    }
}
