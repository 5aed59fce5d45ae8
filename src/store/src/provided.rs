//! Federated people: users authenticated by an identity provider, each with a unique name.

use rusqlite::{OptionalExtension, Row, params};

use super::{Error, State, now};

/// A user authenticated by an identity provider.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FederatedPersonRecord {
    /// Row number; never reused.
    pub id: i64,
    /// Issuer identifier of the provider.
    pub issuer: String,
    /// Subject identifier at the provider.
    pub subject: String,
    /// Unique name, used in rules and audit records.
    pub name: String,
    /// First sign-in.
    pub created: u64,
    /// Last sign-in.
    pub last_login: u64,
}

const PERSON: &str = "id, issuer, subject, name, created, last_login";

fn read_person(row: &Row<'_>) -> rusqlite::Result<FederatedPersonRecord> {
    Ok(FederatedPersonRecord {
        id: row.get(0)?,
        issuer: row.get(1)?,
        subject: row.get(2)?,
        name: row.get(3)?,
        created: row.get(4)?,
        last_login: row.get(5)?,
    })
}

impl State {
    /// Returns all federated people who have signed in here.
    pub fn federated_people(&self) -> Result<Vec<FederatedPersonRecord>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached(&format!("SELECT {PERSON} FROM provided_people ORDER BY id"))?
                .query_map([], read_person)?
                .collect()
        })
    }

    /// Records a sign-in and returns the person. At the first sign-in the person is given the name `wanted` or, if that
    /// is taken, `wanted~2` and so on, and keeps it even if the provider changes the name later.
    pub fn sign_in_federated_person(
        &self,
        issuer: &str,
        subject: &str,
        wanted: &str,
    ) -> Result<FederatedPersonRecord, Error> {
        let at = now() as i64;
        self.write_durably(|transaction| {
            let known = transaction
                .prepare_cached(&format!(
                    "UPDATE provided_people SET last_login = ?3 WHERE issuer = ?1 AND subject = ?2 RETURNING {PERSON}"
                ))?
                .query_row(params![issuer, subject, at], read_person)
                .optional()?;
            let mut number = 1;
            let person = loop {
                if let Some(person) = &known {
                    break person.clone();
                }
                let name = match number {
                    1 => wanted.to_owned(),
                    number => format!("{wanted}~{number}"),
                };
                let made = transaction
                    .prepare_cached(&format!(
                        "INSERT INTO provided_people (issuer, subject, name, created, last_login) VALUES (?1, \
                         ?2, ?3, ?4, ?4)
                         ON CONFLICT (name) DO NOTHING RETURNING {PERSON}"
                    ))?
                    .query_row(params![issuer, subject, name, at], read_person)
                    .optional()?;
                if let Some(person) = made {
                    break person;
                }
                number += 1;
            };
            Ok(person)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_one_persons_for_ever() {
        let home = tempfile::tempdir().expect("a directory");
        let state = State::open(&home.path().join("cloudroid.db")).expect("a database");
        let name = |issuer: &str, subject: &str, wanted: &str| {
            let person = state.sign_in_federated_person(issuer, subject, wanted);
            person.expect("written").name
        };
        assert_eq!(name("a", "1", "oidc:alice"), "oidc:alice");
        // Another person of the same name, and one of another provider.
        assert_eq!(name("a", "2", "oidc:alice"), "oidc:alice~2");
        assert_eq!(name("b", "1", "oidc:alice"), "oidc:alice~3");
        // Changing the name does not change the identity.
        assert_eq!(name("a", "2", "oidc:bob"), "oidc:alice~2");
        assert_eq!(name("a", "1", "oidc:carol"), "oidc:alice");
        assert_eq!(state.federated_people().expect("readable").len(), 3);
    }
}
