//! An identity provider, as the page and the sign-in need it.

use api::people::ProviderLink;
use oidc::Roles;

/// Path at which a sign-in starts.
pub const LOGIN: &str = "/api/v1/oidc/login";

/// An identity provider and the roles of its groups.
pub struct IdentityProvider {
    /// Client of the provider.
    pub provider: oidc::Provider,
    /// Display name of the provider.
    pub name: String,
    /// Roles of its groups.
    pub roles: Roles,
    /// The portal's own origin as browsers write it (RFC 6454): `https://HOST[:PORT]`.
    pub origin: String,
    /// Claim that holds the groups, named in the message for people without any.
    pub groups_claim: String,
}

impl IdentityProvider {
    /// Returns what the page needs for a link to the sign-in.
    pub fn link(&self) -> ProviderLink {
        ProviderLink { name: self.name.clone(), path: LOGIN.to_owned() }
    }
}
