//! Index of the recordings of servants' last seconds.

use api::Millis;
use rusqlite::{Row, params};

use super::{Error, State, to_json};

/// A recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordingRecord {
    /// Recording number, which names the file; 0 before it is stored.
    pub id: u64,
    /// Name of the service.
    pub service: String,
    /// Name of the robot.
    pub robot: String,
    /// Id of the servant.
    pub servant: String,
    /// Time when the file was written.
    pub time: Millis,
    /// Reason for the recording.
    pub why: String,
    /// Duration from the first to the last message, in milliseconds.
    pub span: Millis,
    /// Number of messages.
    pub messages: u64,
    /// Size of the file in bytes.
    pub bytes: u64,
    /// Topics that the file has messages of; absent if unknown.
    pub topics: Option<Vec<String>>,
}

impl State {
    /// Adds a recording and returns its number.
    pub fn add_recording(&self, new: &RecordingRecord) -> Result<u64, Error> {
        let topics = new.topics.as_ref();
        let topics = topics.map(|topics| to_json(topics, "a recording")).transpose()?;
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

    /// Returns all recordings, newest first.
    pub fn recordings(&self) -> Result<Vec<RecordingRecord>, Error> {
        self.read_at_length(|connection| {
            connection
                .prepare_cached(
                    "SELECT id, service, robot, servant, time, why, span, messages, bytes, topics
                     FROM recordings ORDER BY id DESC",
                )?
                .query_map([], read_recording)?
                .collect()
        })
    }

    /// Deletes a recording; returns whether it existed.
    pub fn forget_recording(&self, id: u64) -> Result<bool, Error> {
        self.write(|connection| connection.execute("DELETE FROM recordings WHERE id = ?1", [id as i64]))
            .map(|forgotten| forgotten > 0)
    }
}

fn read_recording(row: &Row<'_>) -> rusqlite::Result<RecordingRecord> {
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
        // A value that cannot be decoded counts as unknown.
        topics: row.get::<_, Option<String>>(9)?.and_then(|topics| serde_json::from_str(&topics).ok()),
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
        // The topics of earlier recordings are unknown.
        let of_before = "UPDATE recordings SET topics = NULL";
        let changed = state.write(|connection| connection.execute(of_before, []));
        assert_eq!(changed.expect("written"), 1);
        record.topics = None;
        assert_eq!(state.recordings().expect("read"), [record.clone()]);
        assert!(state.forget_recording(record.id).expect("forgotten"));
        assert_eq!(state.recordings().expect("read"), []);
    }
}
