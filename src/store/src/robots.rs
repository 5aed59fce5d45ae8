//! Names of robots and whose they are.

use rusqlite::{OptionalExtension, params};

use super::backlog::Write;
use super::{Error, State, now};

/// SHA-256 of a bearer token, lower-case hex.
pub type TokenHash = String;
/// To whom a robot's name belongs: a token of the configuration, by its hash, or a principal, in the words of whoever tells
/// them apart.
pub type Owner = String;

impl State {
    /// Binds `robot` to `owner` when it is new, and with `claim` also when nobody owns it yet; then says to whom it
    /// is bound.
    pub fn robot_owner(
        &self,
        robot: &str,
        owner: Option<&Owner>,
        claim: bool,
    ) -> Result<Option<Owner>, Error> {
        // Who is known comes in even while nothing can be written.
        let known = self.known_robot(robot)?;
        if let Some(known) = known
            && (known.is_some() || !claim)
        {
            self.robot_seen(robot);
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

    /// Binds a robot's name to `owner`, whoever had it before.
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

    /// Forgets robots bound to owners that are not in `owners` any more, so that their names can be used again.
    pub fn release_robots(&self, owners: &[Owner]) -> Result<usize, Error> {
        let kept = serde_json::Value::from(owners).to_string();
        self.write(|connection| {
            connection.execute(
                "DELETE FROM robots WHERE owner IS NOT NULL AND owner NOT IN (SELECT value FROM json_each(?1))",
                [kept],
            )
        })
    }

    /// To whom a robot's name is bound, if to anybody. Nothing is written.
    pub fn owner_of_robot(&self, robot: &str) -> Result<Option<Owner>, Error> {
        Ok(self.known_robot(robot)?.flatten())
    }

    /// The row of a robot, if there is one: its owner, if it has one.
    fn known_robot(&self, robot: &str) -> Result<Option<Option<Owner>>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached("SELECT owner FROM robots WHERE name = ?1")?
                .query_row([robot], |row| row.get(0))
                .optional()
        })
    }

    /// Remembers that a robot came.
    fn robot_seen(&self, robot: &str) {
        self.write_or_keep(Write::RobotSeen(robot.to_owned(), now()));
    }
}
