//! People authenticated by the identity provider: their names here, and their sessions.

use access::principal::oidc_principal_name;
use catalogue::names;
use oidc::{GrantedRole, Person, Roles};
use store::NewSession;

use super::Principals;
use super::changing::SECRET;
use super::people::{StartedSession, encode_scope};
use super::stored::{KnownSession, milliseconds};
use crate::errors::Error;
use crate::tokens;

impl Principals {
    /// Enables sessions of this provider's people, given its issuer identifier; without one, none of them has a
    /// session. Ends sessions that would start differently today, judged by the groups that their people had: those
    /// of another provider or with other permissions.
    pub fn with_provider(self, provider: Option<(&str, &Roles)>) -> Result<Principals, store::Error> {
        let people = self.state.federated_people()?;
        for session in self.state.sessions()? {
            let Some(id) = session.person else {
                continue;
            };
            let person = people.iter().find(|person| person.id == id);
            let groups: Vec<String> =
                session.groups.as_deref().and_then(|groups| serde_json::from_str(groups).ok()).unwrap_or_default();
            let today = provider
                .filter(|(issuer, _)| person.is_some_and(|person| person.issuer == *issuer))
                .and_then(|(_, roles)| roles.grant_for_groups(&groups));
            let same = match &today {
                Some(granted) => {
                    granted.role.name() == session.role
                        && encode_scope(&granted.services, &session.name)? == session.scope
                }
                None => false,
            };
            if !same {
                tracing::info!(
                    "the session of {} was ended: its rights in the configuration have changed",
                    session.name
                );
                self.state.end_session(session.id)?;
            }
        }
        self.stored.write().names_provider = provider.is_some();
        self.reload()?;
        Ok(self)
    }

    /// Starts a session of a person authenticated by the provider.
    pub fn begin_provider_session(
        &self,
        issuer: &str,
        person: &Person,
        granted: &GrantedRole,
        peer: &str,
    ) -> Result<StartedSession, Error> {
        let wanted = oidc_principal_name(&person.name);
        let known = self.state.sign_in_federated_person(issuer, &person.subject, &wanted)?;
        let secret = names::random(SECRET);
        let made = self.state.add_session(
            &NewSession {
                hash: &tokens::hash(&secret),
                account: None,
                name: &known.name,
                role: granted.role.name(),
                scope: &encode_scope(&granted.services, &known.name)?,
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
        Ok(StartedSession { secret, identity, expires })
    }
}

#[cfg(test)]
mod tests;
