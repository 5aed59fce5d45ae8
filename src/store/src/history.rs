//! Metrics of servants and of the machine in steps of seconds, and periods in which robots were served by their local
//! originals. They only record the past: a write that fails leaves a gap.

use api::Millis;
use api::history::LocalPeriod;
use rusqlite::{Connection, params};

use super::{Error, EventVisibility, State};

/// Maximum number of servants with samples; those seen least recently are deleted first.
const MAX_SERVANTS: i64 = 20_000;
/// Maximum number of local periods; older ones are deleted first.
const PERIODS: i64 = 10_000;

/// A sample of one servant or of the machine.
#[derive(Debug, Clone, Copy)]
pub struct NewSample<'a> {
    /// Id of the servant; empty for the machine.
    pub servant: &'a str,
    /// Service of the servant.
    pub service: &'a str,
    /// Robot of the servant.
    pub robot: &'a str,
    /// Time when the servant was requested.
    pub began: Millis,
    /// Values; NaN means unknown.
    pub figures: &'a [f32],
}

/// A servant, or the machine, that has samples.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RecordedSeries {
    /// Row number.
    pub id: i64,
    /// Id of the servant; empty for the machine.
    pub servant: String,
    /// Service of the servant.
    pub service: String,
    /// Robot of the servant.
    pub robot: String,
    /// Time when the servant was requested.
    pub began: Millis,
    /// Time of the latest sample.
    pub seen: Millis,
}

/// Selection of servants with samples; absent criteria match all servants.
#[derive(Debug, Clone, Copy, Default)]
pub struct SeriesFilter<'a> {
    /// Id of the servant.
    pub servant: Option<&'a str>,
    /// Service of the servant.
    pub service: Option<&'a str>,
    /// Robot of the servant.
    pub robot: Option<&'a str>,
    /// Restriction to what a principal without full access may see.
    pub told: Option<EventVisibility<'a>>,
}

impl State {
    /// Writes samples of one time and one step (in seconds), all or none.
    pub fn add_samples(&self, step: u32, time: Millis, samples: &[NewSample<'_>]) -> Result<(), Error> {
        self.write(|transaction| {
            for sample in samples {
                let id: i64 = transaction
                    .prepare_cached(
                        "INSERT INTO recorded (servant, service, robot, began, seen) VALUES (?1, ?2, ?3, ?4, ?5)
                         ON CONFLICT (servant) DO UPDATE SET seen = ?5 RETURNING id",
                    )?
                    .query_row(
                        params![sample.servant, sample.service, sample.robot, sample.began as i64, time as i64],
                        |row| row.get(0),
                    )?;
                let figures: Vec<u8> = sample.figures.iter().flat_map(|one| one.to_le_bytes()).collect();
                transaction
                    .prepare_cached(
                        "INSERT OR REPLACE INTO samples (recorded, step, time, figures) VALUES (?1, ?2, ?3, ?4)",
                    )?
                    .execute(params![id, step, time as i64, figures])?;
            }
            Ok(())
        })
    }

    /// Deletes the samples of each step (in seconds) before its time, series not seen since the earliest of these
    /// times, and local periods that ended before it.
    pub fn forget_history(&self, before: &[(u32, Millis)]) -> Result<(), Error> {
        let oldest = before.iter().map(|(_, time)| *time).min().unwrap_or(0) as i64;
        self.write(|transaction| {
            for (step, time) in before {
                // Deletes by the key of each servant, since there is no index by time alone.
                transaction
                    .prepare_cached(
                        "DELETE FROM samples WHERE recorded IN (SELECT id FROM recorded) AND step = ?1 AND time < ?2",
                    )?
                    .execute(params![step, *time as i64])?;
            }
            transaction.execute("DELETE FROM recorded WHERE seen < ?1", [oldest])?;
            transaction.execute(
                "DELETE FROM recorded WHERE id IN (SELECT id FROM recorded ORDER BY seen DESC LIMIT -1 OFFSET ?1)",
                [MAX_SERVANTS],
            )?;
            transaction.execute("DELETE FROM local_periods WHERE ended < ?1", [oldest])?;
            transaction
                .execute("DELETE FROM local_periods WHERE id <= (SELECT MAX(id) FROM local_periods) - ?1", [PERIODS])?;
            Ok(())
        })
    }

    /// Returns the servants with samples since `from`, most recently requested first.
    pub fn recorded_series(
        &self,
        filter: SeriesFilter<'_>,
        from: Millis,
        limit: u32,
    ) -> Result<Vec<RecordedSeries>, Error> {
        let SeriesFilter { servant, service, robot, told } = filter;
        let services = told.map(|told| serde_json::Value::from(told.services).to_string());
        let own_robot = told.and_then(|told| told.own_robot);
        self.read_at_length(|connection| {
            connection
                .prepare_cached(
                    "SELECT id, servant, service, robot, began, seen FROM recorded
                     WHERE seen >= ?1 AND servant = COALESCE(?2, servant) AND (?2 = '' OR servant <> '')
                     AND service = COALESCE(?3, service) AND robot = COALESCE(?4, robot)
                     AND (?6 IS NULL OR service IN (SELECT value FROM json_each(?6))) AND robot = COALESCE(?7, robot)
                     ORDER BY began DESC, id DESC LIMIT ?5",
                )?
                .query_map(params![from as i64, servant, service, robot, limit, services, own_robot], |row| {
                    Ok(RecordedSeries {
                        id: row.get(0)?,
                        servant: row.get(1)?,
                        service: row.get(2)?,
                        robot: row.get(3)?,
                        began: row.get::<_, i64>(4)? as Millis,
                        seen: row.get::<_, i64>(5)? as Millis,
                    })
                })?
                .collect()
        })
    }

    /// Returns the services with samples, sorted by name.
    pub fn services_with_samples(&self) -> Result<Vec<String>, Error> {
        self.read_at_length(|connection| {
            connection
                .prepare_cached("SELECT DISTINCT service FROM recorded WHERE servant <> '' ORDER BY service")?
                .query_map([], |row| row.get(0))?
                .collect()
        })
    }

    /// Returns the samples of one step (in seconds) from `from` to `to`, oldest first; if there are more than `limit`,
    /// the latest ones.
    pub fn samples(
        &self,
        recorded: i64,
        step: u32,
        (from, to): (Millis, Millis),
        limit: usize,
    ) -> Result<Vec<(Millis, Vec<f32>)>, Error> {
        self.read_at_length(|connection| {
            let mut found: Vec<_> = connection
                .prepare_cached(
                    "SELECT time, figures FROM samples WHERE recorded = ?1 AND step = ?2 AND time BETWEEN ?3 AND ?4
                     ORDER BY time DESC LIMIT ?5",
                )?
                .query_map(params![recorded, step, from as i64, to as i64, limit as i64], |row| {
                    let figures: Vec<u8> = row.get(1)?;
                    let figures = figures.chunks_exact(4).map(|bytes| {
                        let bytes = bytes.try_into().expect("four bytes");
                        f32::from_le_bytes(bytes)
                    });
                    Ok((row.get::<_, i64>(0)? as Millis, figures.collect()))
                })?
                .collect::<Result<_, _>>()?;
            found.reverse();
            Ok(found)
        })
    }

    /// Records that a robot's node is served by its local original from `began` on. A period that is already open is
    /// left unchanged.
    pub fn begin_local_period(
        &self,
        (service, robot, node): (&str, &str, &str),
        began: Millis,
        why: &str,
    ) -> Result<(), Error> {
        self.write(|connection| {
            connection
                .prepare_cached(
                    "INSERT INTO local_periods (service, robot, node, began, why) SELECT ?1, ?2, ?3, ?4, ?5
                     WHERE NOT EXISTS (SELECT 1 FROM local_periods
                     WHERE service = ?1 AND robot = ?2 AND node = ?3 AND ended IS NULL)",
                )?
                .execute(params![service, robot, node, began as i64, why])
                .map(drop)
        })
    }

    /// Records that a robot's node is served by the cloud again from `ended` on.
    pub fn end_local_period(&self, (service, robot, node): (&str, &str, &str), ended: Millis) -> Result<(), Error> {
        self.write(|connection| {
            connection
                .prepare_cached(
                    "UPDATE local_periods SET ended = MAX(?4, began)
                     WHERE service = ?1 AND robot = ?2 AND node = ?3 AND ended IS NULL",
                )?
                .execute(params![service, robot, node, ended as i64])
                .map(drop)
        })
    }

    /// Returns the periods between `from` and `to` in which a robot was served by its local originals instead of a
    /// service, oldest first.
    pub fn local_periods(
        &self,
        service: &str,
        robot: &str,
        (from, to): (Millis, Millis),
    ) -> Result<Vec<LocalPeriod>, Error> {
        self.read(|connection| read_local_periods(connection, service, robot, (from, to)))
    }
}

fn read_local_periods(
    connection: &Connection,
    service: &str,
    robot: &str,
    (from, to): (Millis, Millis),
) -> rusqlite::Result<Vec<LocalPeriod>> {
    connection
        .prepare_cached(
            "SELECT node, began, ended, why FROM local_periods WHERE service = ?1 AND robot = ?2
             AND began <= ?4 AND (ended IS NULL OR ended >= ?3) ORDER BY id",
        )?
        .query_map(params![service, robot, from as i64, to as i64], |row| {
            Ok(LocalPeriod {
                node: row.get(0)?,
                began: row.get::<_, i64>(1)? as Millis,
                ended: row.get::<_, Option<i64>>(2)?.map(|ended| ended as Millis),
                why: row.get(3)?,
            })
        })?
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn database() -> (tempfile::TempDir, State) {
        let home = tempfile::tempdir().expect("a directory");
        let state = State::open(&home.path().join("cloudroid.db")).expect("a database");
        (home, state)
    }

    fn sample<'a>(servant: &'a str, figures: &'a [f32]) -> NewSample<'a> {
        NewSample { servant, service: "adder", robot: "r1", began: 5, figures }
    }

    #[test]
    fn samples_are_read_as_they_were_written() {
        let (_home, state) = database();
        let samples = [sample("s1", &[1.5, f32::NAN]), sample("s2", &[3.0])];
        state.add_samples(10, 1_000, &samples).expect("written");
        state.add_samples(10, 11_000, &samples[..1]).expect("written");
        state.add_samples(60, 60_000, &samples[..1]).expect("written");
        let found = state.recorded_series(SeriesFilter::default(), 0, 10).expect("read");
        let seen: Vec<_> = found.iter().map(|one| (&*one.servant, one.seen)).collect();
        assert_eq!(seen, [("s2", 1_000), ("s1", 60_000)]);
        let of = |from, to| state.samples(found[1].id, 10, (from, to), 9).expect("read");
        let times =
            |samples: Vec<(Millis, Vec<f32>)>| -> Vec<Millis> { samples.into_iter().map(|(time, _)| time).collect() };
        assert_eq!(times(of(0, 11_000)), [1_000, 11_000]);
        assert_eq!(times(of(1_001, 99_000)), [11_000]);
        let (_, figures) = &of(0, 1_000)[0];
        assert!(figures[0] == 1.5 && figures[1].is_nan(), "{figures:?}");
        // Only the latest ones if there are too many.
        let newest = state.samples(found[1].id, 10, (0, 99_000), 1).expect("read");
        assert_eq!(times(newest), [11_000]);
    }

    #[test]
    fn what_is_old_is_forgotten_step_by_step() {
        let (_home, state) = database();
        state.add_samples(60, 1_000, &[sample("old", &[1.0])]).expect("written");
        for time in [1_000, 50_000, 90_000] {
            let samples = [sample("s1", &[1.0]), sample("", &[2.0])];
            state.add_samples(10, time, &samples).expect("written");
            state.add_samples(60, time, &samples).expect("written");
        }
        state.forget_history(&[(10, 60_000), (60, 20_000)]).expect("forgotten");
        let servants = state.recorded_series(SeriesFilter::default(), 0, 10).expect("read");
        assert_eq!(servants.len(), 1, "the machine is no servant: {servants:?}");
        let machine = SeriesFilter { servant: Some(""), ..SeriesFilter::default() };
        let machine = state.recorded_series(machine, 0, 10).expect("read");
        for id in [servants[0].id, machine[0].id] {
            let count = |step| state.samples(id, step, (0, 99_000), 99).expect("read").len();
            assert_eq!((count(10), count(60)), (1, 2));
        }
    }

    #[test]
    fn a_local_period_begins_and_ends_once() {
        let (_home, state) = database();
        let of = ("adder", "r1", "/adder");
        state.begin_local_period(of, 10, "the link is down").expect("written");
        state.begin_local_period(of, 20, "Q has fallen").expect("written");
        state.end_local_period(of, 30).expect("written");
        state.end_local_period(of, 40).expect("written");
        state.begin_local_period(of, 50, "Q has fallen").expect("written");
        let periods = |from, to| state.local_periods("adder", "r1", (from, to)).expect("read");
        let told: Vec<_> = periods(0, 99).iter().map(|one| (one.began, one.ended)).collect();
        assert_eq!(told, [(10, Some(30)), (50, None)]);
        assert_eq!(periods(0, 99)[0].why, "the link is down");
        assert_eq!(periods(31, 49), []);
        assert_eq!(periods(70, 99).len(), 1, "it still is");
        state.forget_history(&[(60, 31)]).expect("forgotten");
        assert_eq!(periods(0, 99).len(), 1);
    }
}
