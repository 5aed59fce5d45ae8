//! People whom an identity provider knows, each by a name that is nobody else's.

use rusqlite::{OptionalExtension, Row, params};

use super::{Error, State, now};

/// Somebody whom an identity provider knows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProvidedRecord {
    /// Its number, never given twice.
    pub id: i64,
    /// The provider's issuer identifier.
    pub issuer: String,
    /// By which the provider tells people apart.
    pub subject: String,
    /// By which rules and records know the person.
    pub name: String,
    /// When it signed in first.
    pub created: u64,
    /// When it signed in last.
    pub last_login: u64,
}

const PERSON: &str = "id, issuer, subject, name, created, last_login";

fn read(row: &Row<'_>) -> rusqlite::Result<ProvidedRecord> {
    Ok(ProvidedRecord {
        id: row.get(0)?,
        issuer: row.get(1)?,
        subject: row.get(2)?,
        name: row.get(3)?,
        created: row.get(4)?,
        last_login: row.get(5)?,
    })
}

impl State {
    /// Everybody whom a provider knew when they signed in here.
    pub fn provided_people(&self) -> Result<Vec<ProvidedRecord>, Error> {
        self.read(|connection| {
            connection
                .prepare_cached(&format!("SELECT {PERSON} FROM provided_people ORDER BY id"))?
                .query_map([], read)?
                .collect()
        })
    }

    /// Who signs in. At the first time it is given the name `wanted` or, where that is another's, `wanted~2` and so on; it keeps
    /// that, whatever the provider calls it later.
    pub fn provided_person(
        &self,
        issuer: &str,
        subject: &str,
        wanted: &str,
    ) -> Result<ProvidedRecord, Error> {
        let at = now() as i64;
        self.write_durably(|transaction| {
            let known = transaction
                .prepare_cached(&format!(
                    "UPDATE provided_people SET last_login = ?3 WHERE issuer = ?1 AND subject = ?2 RETURNING {PERSON}"
                ))?
                .query_row(params![issuer, subject, at], read)
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
                        "INSERT INTO provided_people (issuer, subject, name, created, last_login) VALUES (?1, ?2, ?3, ?4, ?4)
                         ON CONFLICT (name) DO NOTHING RETURNING {PERSON}"
                    ))?
                    .query_row(params![issuer, subject, name, at], read)
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
            let person = state.provided_person(issuer, subject, wanted);
            person.expect("written").name
        };
        assert_eq!(name("a", "1", "oidc:alice"), "oidc:alice");
        // Another who is called so, and one of another provider.
        assert_eq!(name("a", "2", "oidc:alice"), "oidc:alice~2");
        assert_eq!(name("b", "1", "oidc:alice"), "oidc:alice~3");
        // Whoever changes its name does not become another.
        assert_eq!(name("a", "2", "oidc:bob"), "oidc:alice~2");
        assert_eq!(name("a", "1", "oidc:carol"), "oidc:alice");
        assert_eq!(state.provided_people().expect("readable").len(), 3);
    }
}
