//! Names of robots and their owners.

use rusqlite::{OptionalExtension, params};

use super::backlog::Write;
use super::{Error, State, now};

/// SHA-256 of a bearer token, in lower-case hexadecimal.
pub type TokenHash = String;
/// Owner of a robot's name: the hash of a configured token, or a principal as encoded by the portal.
pub type Owner = String;

impl State {
    /// Binds `robot` to `owner` if it is new, or with `claim` also if it has no owner yet; returns the owner that it is
    /// bound to.
    pub fn claim_robot(&self, robot: &str, owner: Option<&Owner>, claim: bool) -> Result<Option<Owner>, Error> {
        // Known robots can connect even while the database cannot be written.
        let known = self.find_robot(robot)?;
        if let Some(known) = known
            && (known.is_some() || !claim)
        {
            self.record_robot_seen(robot);
            return Ok(known);
        }
        self.write(|connection| {
            connection
                .prepare_cached(
                    "INSERT INTO robots (name, owner, first_seen, last_seen) VALUES (?1, ?2, ?3, ?3)
                     ON CONFLICT (name) DO UPDATE SET last_seen = ?3,
                     owner = CASE WHEN ?4 THEN COALESCE(owner, ?2) ELSE owner END RETURNING owner",
                )?
                .query_row(params![robot, owner, now() as i64, claim], |row| row.get(0))
        })
    }

    /// Binds a robot's name to `owner`, regardless of its previous owner.
    pub fn bind_robot(&self, robot: &str, owner: &Owner) -> Result<(), Error> {
        self.write_durably(|connection| {
            connection.execute(
                "INSERT INTO robots (name, owner, first_seen, last_seen) VALUES (?1, ?2, ?3, ?3)
                 ON CONFLICT (name) DO UPDATE SET owner = ?2",
                params![robot, owner, now() as i64],
            )
        })
        .map(|_| ())
    }

    /// Deletes robots bound to owners that are not in `owners`, so that their names can be used again. Returns their
    /// number.
    pub fn release_robots(&self, owners: &[Owner]) -> Result<usize, Error> {
        let kept = serde_json::Value::from(owners).to_string();
        self.write(|connection| {
            connection.execute(
                "DELETE FROM robots WHERE owner IS NOT NULL AND owner NOT IN (SELECT value FROM json_each(?1))",
                [kept],
            )
        })
    }

    /// Returns the owner of a robot's name, if any. Writes nothing.
    pub fn find_robot_owner(&self, robot: &str) -> Result<Option<Owner>, Error> {
        Ok(self.find_robot(robot)?.flatten())
    }

    /// Returns the row of a robot, if it exists: its owner, if it has one.
    fn find_robot(&self, robot: &str) -> Result<Option<Option<Owner>>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached("SELECT owner FROM robots WHERE name = ?1")?
                .query_row([robot], |row| row.get(0))
                .optional()
        })
    }

    /// Records that a robot has connected.
    fn record_robot_seen(&self, robot: &str) {
        self.write_or_queue(Write::RobotSeen(robot.to_owned(), now()));
    }
}
