//! Rollouts: the latest of each service, in the encoding of the choreographer.

use rusqlite::params;

use super::{Error, State};

impl State {
    /// Stores a service's rollout, replacing an earlier one.
    pub fn set_rollout(&self, service: &str, rollout: &str) -> Result<(), Error> {
        self.write(|connection| {
            // Nothing is stored for a service that has been removed meanwhile.
            connection.execute(
                "INSERT OR REPLACE INTO rollouts (service, rollout)
                 SELECT name, ?2 FROM services WHERE name = ?1",
                params![service, rollout],
            )
        })
        .map(|_| ())
    }

    /// Returns the latest rollouts of all services.
    pub fn rollouts(&self) -> Result<Vec<(String, String)>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached("SELECT service, rollout FROM rollouts ORDER BY service")?
                .query_map([], |row| Ok((row.get(0)?, row.get(1)?)))?
                .collect()
        })
    }
}
