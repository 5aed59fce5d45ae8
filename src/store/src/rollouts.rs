//! Services on their way from one revision to another: one each, the last, in the words of whoever decides about it.

use rusqlite::params;

use super::{Error, State};

impl State {
    /// Remembers a service's rollout in place of an earlier one.
    pub fn set_rollout(&self, service: &str, rollout: &str) -> Result<(), Error> {
        self.write(|connection| {
            // A service that was removed meanwhile has none.
            connection.execute(
                "INSERT OR REPLACE INTO rollouts (service, rollout)
                 SELECT name, ?2 FROM services WHERE name = ?1",
                params![service, rollout],
            )
        })
        .map(|_| ())
    }

    /// The rollouts of all services that had one.
    pub fn rollouts(&self) -> Result<Vec<(String, String)>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached("SELECT service, rollout FROM rollouts ORDER BY service")?
                .query_map([], |row| Ok((row.get(0)?, row.get(1)?)))?
                .collect()
        })
    }
}
