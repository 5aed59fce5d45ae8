//! Pushes of late, what they printed, and how long their steps took.

use api::{Millis, PushState};
use rusqlite::{OptionalExtension, Row, params};

use super::{Error, State, now};

/// Number of steps whose duration is kept.
const STEPS: i64 = 2000;

/// A push.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PushRecord {
    /// Number of the push; 0 before it is stored.
    pub id: u64,
    /// Name of the service, if known.
    pub service: Option<String>,
    /// Description of what was pushed.
    pub source: String,
    /// Name of the principal that pushes.
    pub who: String,
    /// Time when it began.
    pub began: Millis,
    /// Time when it ended; absent while it runs.
    pub ended: Option<Millis>,
    /// State of the push.
    pub state: PushState,
    /// Title of its last step.
    pub step: String,
    /// Reason why it failed, if it did.
    pub message: Option<String>,
}

impl State {
    /// Adds a push that begins and returns its number.
    pub fn add_push(&self, new: &PushRecord) -> Result<u64, Error> {
        self.write(|connection| {
            connection
                .prepare_cached(
                    "INSERT INTO pushes (service, source, who, began, state) VALUES (?1, ?2, ?3, ?4, ?5) RETURNING id",
                )?
                .query_row(params![new.service, new.source, new.who, new.began as i64, new.state.name()], |row| {
                    row.get::<_, i64>(0)
                })
        })
        .map(|id| id as u64)
    }

    /// Records the end of a push with its output. Of those that have ended, forgets the ones that began before `since`
    /// and, beyond `most` in all, the oldest of whoever has most: nobody drives out the pushes of others by many of
    /// their own. Those that have not ended stay until `since`, so that they can be found while they run.
    pub fn end_push(&self, ended: &PushRecord, output: &str, most: u32, since: Millis) -> Result<(), Error> {
        self.write(|connection| {
            connection
                .prepare_cached(
                    "UPDATE pushes SET service = ?2, ended = ?3, state = ?4, step = ?5, message = ?6, output = ?7
                     WHERE id = ?1",
                )?
                .execute(params![
                    ended.id as i64,
                    ended.service,
                    ended.ended.map(|at| at as i64),
                    ended.state.name(),
                    ended.step,
                    ended.message,
                    output
                ])?;
            connection
                .prepare_cached(
                    "DELETE FROM pushes WHERE id <> ?1 AND (began < ?2 OR ended IS NOT NULL AND id NOT IN
                     (SELECT id FROM (SELECT id, row_number() OVER (PARTITION BY who ORDER BY id DESC) AS place
                                      FROM pushes) ORDER BY place, id DESC LIMIT ?3))",
                )?
                .execute(params![ended.id as i64, since as i64, most])?;
            Ok(())
        })
    }

    /// Returns the pushes, newest first.
    pub fn pushes(&self) -> Result<Vec<PushRecord>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached(
                    "SELECT id, service, source, who, began, ended, state, step, message FROM pushes ORDER BY id DESC",
                )?
                .query_map([], read_push)?
                .collect()
        })
    }

    /// Returns what a push printed until its end, as JSON lines; `None` if there is no such push.
    pub fn push_output(&self, id: u64) -> Result<Option<String>, Error> {
        self.read_at_length(|connection| {
            connection
                .prepare_cached("SELECT output FROM pushes WHERE id = ?1")?
                .query_row([id as i64], |row| row.get(0))
                .optional()
        })
    }

    /// Records how long a step took, in milliseconds. `subject` is the service, or what was pushed.
    pub fn record_push_step(&self, subject: &str, title: &str, took: u64) -> Result<(), Error> {
        self.write(|connection| {
            connection
                .prepare_cached("INSERT OR REPLACE INTO push_steps (subject, title, took, at) VALUES (?1, ?2, ?3, ?4)")?
                .execute(params![subject, title, took as i64, now() as i64])?;
            connection
                .prepare_cached(
                    "DELETE FROM push_steps WHERE at <
                     (SELECT at FROM push_steps ORDER BY at DESC LIMIT 1 OFFSET ?1)",
                )?
                .execute([STEPS])?;
            Ok(())
        })
    }

    /// Returns how long a step took when it was completed last, in milliseconds: for this subject, otherwise for any.
    pub fn last_push_step(&self, subject: &str, title: &str) -> Result<Option<u64>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached(
                    "SELECT took FROM push_steps WHERE title = ?2 ORDER BY subject = ?1 DESC, at DESC LIMIT 1",
                )?
                .query_row(params![subject, title], |row| row.get::<_, i64>(0))
                .optional()
        })
        .map(|took| took.map(|took| took as u64))
    }
}

fn read_push(row: &Row<'_>) -> rusqlite::Result<PushRecord> {
    let number = |at: usize| row.get::<_, i64>(at).map(|number| number as u64);
    let state: String = row.get(6)?;
    let states = [PushState::Running, PushState::Published, PushState::Cancelled];
    Ok(PushRecord {
        id: number(0)?,
        service: row.get(1)?,
        source: row.get(2)?,
        who: row.get(3)?,
        began: number(4)?,
        ended: row.get::<_, Option<i64>>(5)?.map(|at| at as u64),
        // A value that cannot be decoded counts as a failure.
        state: states.into_iter().find(|one| one.name() == state).unwrap_or(PushState::Failed),
        step: row.get(7)?,
        message: row.get(8)?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state() -> (tempfile::TempDir, State) {
        let directory = tempfile::tempdir().expect("a directory");
        let state = State::open(&directory.path().join("cloudroid.db")).expect("a database");
        (directory, state)
    }

    fn push(source: &str, began: Millis) -> PushRecord {
        PushRecord {
            id: 0,
            service: None,
            source: source.into(),
            who: "ada".into(),
            began,
            ended: None,
            state: PushState::Running,
            step: String::new(),
            message: None,
        }
    }

    #[test]
    fn pushes_are_kept_up_to_a_number_and_an_age() {
        let (_directory, state) = state();
        let mut all: Vec<PushRecord> = (0..4).map(|number| push("./here", 100 * number)).collect();
        for one in &mut all {
            one.id = state.add_push(one).expect("written");
        }
        let last = all.last_mut().expect("four");
        last.service = Some("maps".into());
        last.ended = Some(500);
        last.state = PushState::Published;
        last.step = "publishing".into();
        state.end_push(last, "{}\n", 3, 150).expect("written");
        let last = last.clone();
        assert_eq!(state.pushes().expect("read"), [last.clone(), all[2].clone()], "two were too old");
        assert_eq!(state.push_output(last.id).expect("read").as_deref(), Some("{}\n"));
        assert_eq!(state.push_output(all[0].id).expect("read"), None);
        let earlier = PushRecord { ended: Some(600), state: PushState::Failed, ..all[2].clone() };
        state.end_push(&earlier, "", 3, 0).expect("written");
        assert_eq!(state.pushes().expect("read"), [last.clone(), earlier]);
        state.end_push(&last, "", 1, 0).expect("written");
        assert_eq!(state.pushes().expect("read"), std::slice::from_ref(&last));
        // Numbers are not used again.
        assert!(state.add_push(&push("./there", 600)).expect("written") > last.id);
    }

    #[test]
    fn nobody_drives_out_the_pushes_of_others_or_one_that_runs() {
        let (_directory, state) = state();
        let add = |who: &str, ends: bool| {
            let mut one = PushRecord { who: who.into(), ..push("./here", 100) };
            one.id = state.add_push(&one).expect("written");
            if ends {
                let ended = PushRecord { ended: Some(200), state: PushState::Failed, ..one.clone() };
                state.end_push(&ended, "{}\n", 3, 0).expect("written");
            }
            one.id
        };
        let running = add("bob", false);
        let quiet = add("ada", true);
        let busy: Vec<u64> = (0..5).map(|_| add("eve", true)).collect();
        let kept: Vec<u64> = state.pushes().expect("read").into_iter().map(|one| one.id).collect();
        assert_eq!(kept, [busy[4], quiet, running]);
        // One that a killed daemon left goes with its age.
        let last = PushRecord { id: busy[4], ended: Some(300), ..push("./here", 300) };
        state.end_push(&last, "", 3, 150).expect("written");
        assert_eq!(state.pushes().expect("read").len(), 1);
    }

    #[test]
    fn a_step_takes_what_it_took_the_same_subject_or_else_another() {
        let (_directory, state) = state();
        let last = |subject: &str| state.last_push_step(subject, "packing").expect("read");
        assert_eq!(last("maps"), None);
        state.record_push_step("maps", "packing", 10).expect("written");
        state.record_push_step("people", "packing", 20).expect("written");
        assert_eq!((last("maps"), last("people")), (Some(10), Some(20)));
        state.record_push_step("maps", "packing", 30).expect("written");
        assert_eq!(last("maps"), Some(30));
        assert!(last("another").is_some());
    }
}
