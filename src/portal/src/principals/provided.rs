//! People whom an identity provider knows: their names here, and their sessions.

use access::principal::provided_name;
use catalogue::names;
use oidc::{Granted, Person, Roles};
use store::NewSession;

use super::Principals;
use super::changing::SECRET;
use super::people::{Begun, KnownSession, milliseconds, scope};
use crate::errors::Error;
use crate::tokens;

impl Principals {
    /// With people whom this provider knows, by its issuer identifier; without one, none of them has a session any more. Ended are
    /// sessions that would not begin so today, by the groups that their people had: of another provider, or of other rights.
    pub fn provided(self, provider: Option<(&str, &Roles)>) -> Result<Principals, store::Error> {
        let people = self.state.provided_people()?;
        for session in self.state.sessions()? {
            let Some(id) = session.person else {
                continue;
            };
            let person = people.iter().find(|person| person.id == id);
            let groups: Vec<String> = session
                .groups
                .as_deref()
                .and_then(|groups| serde_json::from_str(groups).ok())
                .unwrap_or_default();
            let today = provider
                .filter(|(issuer, _)| person.is_some_and(|person| person.issuer == *issuer))
                .and_then(|(_, roles)| roles.of(&groups));
            let same = match &today {
                Some(granted) => {
                    granted.role.name() == session.role
                        && scope(&granted.services, &session.name)? == session.scope
                }
                None => false,
            };
            if !same {
                tracing::info!(
                    "the session of {} is ended: by the configuration its rights are others now",
                    session.name
                );
                self.state.end_session(session.id)?;
            }
        }
        self.stored.write().names_provider = provider.is_some();
        self.reload()?;
        Ok(self)
    }

    /// Begins a session of somebody whom the provider knows.
    pub fn begin_provided(
        &self,
        issuer: &str,
        person: &Person,
        granted: &Granted,
        peer: &str,
    ) -> Result<Begun, Error> {
        let wanted = provided_name(&person.name);
        let known = self
            .state
            .provided_person(issuer, &person.subject, &wanted)?;
        let secret = names::random(SECRET);
        let made = self.state.add_session(
            &NewSession {
                hash: &tokens::hash(&secret),
                account: None,
                name: &known.name,
                role: granted.role.name(),
                scope: &scope(&granted.services, &known.name)?,
                peer,
                expires: store::now().saturating_add(milliseconds(self.lasting.most)),
                person: Some((known.id, &serde_json::json!(granted.groups).to_string())),
            },
            None,
        )?;
        let made = made.ok_or(Error::Internal("beginning a session"))?;
        self.reload()?;
        let expires = made.expires;
        let identity = KnownSession::read(made)?.recognise(store::now(), self.lasting)?;
        Ok(Begun {
            secret,
            identity,
            expires,
        })
    }
}

#[cfg(test)]
mod tests;
