//! `[oidc]`: an identity provider for people, and the roles of its groups.

use std::collections::BTreeMap;
use std::io::Read;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use access::{Glob, Role};
use anyhow::{Context, bail, ensure};
use portal::{CALLBACK, IdentityProvider};
use serde::Deserialize;

/// Longest secret, in bytes.
const LONGEST: u64 = 4096;

/// An identity provider.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OidcConfig {
    /// Issuer identifier of the provider.
    pub issuer: String,
    /// Display name for the link on the sign-in page (default: the issuer's host).
    pub name: Option<String>,
    /// Client id of this server at the provider.
    pub client_id: String,
    /// File of the client secret (default: none, a public client).
    pub client_secret_file: Option<PathBuf>,
    /// Public address of the portal in people's browsers: `https://HOST[:PORT]`.
    pub redirect: String,
    /// Scopes that are requested besides `openid` (default: `profile`).
    #[serde(default = "profile")]
    pub scopes: Vec<String>,
    /// Claim that contains a person's groups (default: `groups`).
    #[serde(default = "groups")]
    pub groups_claim: String,
    /// Claim that contains a person's name (default: `preferred_username`).
    #[serde(default = "preferred_username")]
    pub name_claim: String,
    /// PEM file of the authorities by which the provider's certificate is checked; must be world-readable (default: the
    /// system's).
    pub authorities: Option<PathBuf>,
    /// Roles of the provider's groups.
    pub roles: BTreeMap<String, RoleGrant>,
}

fn profile() -> Vec<String> {
    vec!["profile".to_owned()]
}

fn groups() -> String {
    "groups".to_owned()
}

fn preferred_username() -> String {
    "preferred_username".to_owned()
}

/// A role, either for all services or limited to some.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(untagged)]
pub enum RoleGrant {
    /// A role for all services.
    Whole(Role),
    /// A role for some services.
    Scoped(ScopedRole),
}

/// A role that is limited to some services.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScopedRole {
    role: Role,
    #[serde(default)]
    services: Vec<Glob>,
}

impl RoleGrant {
    fn parts(&self) -> (Role, &[Glob]) {
        match self {
            RoleGrant::Whole(role) => (*role, &[]),
            RoleGrant::Scoped(scoped) => (scoped.role, &scoped.services),
        }
    }

    fn check(&self, group: &str) -> anyhow::Result<()> {
        let (role, services) = self.parts();
        if role == Role::Robot {
            bail!("{group:?} cannot have the role robot: robots are paired, or have tokens");
        }
        match (role.is_scoped(), services.is_empty()) {
            (true, true) => bail!(
                "the role {role} needs a list of services: write {group:?} = {{ role = \"{role}\", services = \
                    [\"lab_*\"] }}, or \"*\" for all"
            ),
            (false, false) => {
                bail!("the role {role} is for all services: write {group:?} = \"{role}\", or choose another role")
            }
            _ => Ok(()),
        }
    }
}

fn read_secret(path: &Path) -> anyhow::Result<String> {
    let file =
        std::fs::File::open(path).with_context(|| format!("cannot read client_secret_file {}", path.display()))?;
    let mode = file.metadata()?.permissions().mode();
    ensure!(
        mode & 0o007 == 0,
        "client_secret_file {} can be read by every user of this machine; restrict it with: chmod 600 {}",
        path.display(),
        path.display()
    );
    let mut text = String::new();
    file.take(LONGEST + 1)
        .read_to_string(&mut text)
        .with_context(|| format!("cannot read client_secret_file {}", path.display()))?;
    let secret = text.trim();
    ensure!(
        !secret.is_empty() && text.len() as u64 <= LONGEST,
        "client_secret_file {} must contain only this client's secret from the provider",
        path.display()
    );
    Ok(secret.to_owned())
}

impl OidcConfig {
    fn origin(&self) -> &str {
        self.redirect.trim_end_matches('/')
    }

    fn roles(&self) -> oidc::Roles {
        let groups = self.roles.iter().map(|(name, given)| {
            let (role, services) = given.parts();
            oidc::RoleGroup { name: name.clone(), role, services: services.to_vec() }
        });
        oidc::Roles(groups.collect())
    }

    fn settings(&self) -> oidc::Settings {
        oidc::Settings {
            issuer: self.issuer.clone(),
            client_id: self.client_id.clone(),
            client_secret: None,
            redirect: format!("{}{CALLBACK}", self.origin()),
            scopes: self.scopes.clone(),
            groups_claim: self.groups_claim.clone(),
            name_claim: self.name_claim.clone(),
            authorities: self.authorities.clone(),
        }
    }

    pub(super) fn check(&self) -> anyhow::Result<()> {
        oidc::Provider::new(self.settings())?;
        let host = self.origin().split_once("://").map_or("", |(_, host)| host);
        ensure!(
            !host.is_empty() && !host.contains(['/', '?', '#', '@']),
            "redirect = {:?} must be only the portal's address as used in browsers: \"https://HOST:PORT\"",
            self.redirect
        );
        ensure!(!self.client_id.is_empty(), "client_id is empty; write the client ID of this server at the provider");
        ensure!(
            !self.roles.is_empty(),
            "roles is empty, so nobody could sign in; name a group: roles = {{ \"robot-admins\" = \"admin\" }}"
        );
        for (group, given) in &self.roles {
            given.check(group).context("roles")?;
        }
        match &self.client_secret_file {
            Some(path) => read_secret(path).map(|_| ()),
            None => Ok(()),
        }
    }

    /// Returns the provider with its secret, as the portal takes it.
    pub fn identity_provider(&self) -> anyhow::Result<IdentityProvider> {
        let mut settings = self.settings();
        settings.client_secret = self.client_secret_file.as_deref().map(read_secret).transpose()?;
        let host = self.issuer.split("://").nth(1).unwrap_or(&self.issuer);
        let host = host.split('/').next().unwrap_or(host);
        Ok(IdentityProvider {
            provider: oidc::Provider::new(settings)?,
            name: self.name.clone().unwrap_or_else(|| host.to_owned()),
            roles: self.roles(),
            origin: self.origin().to_owned(),
            groups_claim: self.groups_claim.clone(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str = "issuer = \"https://id.lab.example/realms/lab\"\nclient_id = \"cloudroid\"\n\
                        redirect = \"https://robots.lab.example:9090/\"\n";

    fn read(more: &str) -> OidcConfig {
        toml::from_str(&format!("{GOOD}{more}")).expect("well-formed")
    }

    #[test]
    fn groups_have_roles_and_services() {
        let read =
            read("roles = { admins = \"admin\", students = { role = \"viewer\", services = [\"lab_*\", \"demo\"] } }");
        read.check().expect("good");
        let made = read.identity_provider().expect("good");
        assert_eq!(made.name, "id.lab.example");
        assert_eq!(made.origin, "https://robots.lab.example:9090");
        let of = |group: &str| made.roles.grant_for_groups(&[group.to_owned()]);
        assert_eq!(of("admins").expect("a role").role, Role::Admin);
        assert_eq!(of("students").expect("a role").services.len(), 2);
        assert!(of("others").is_none());
    }

    #[test]
    fn with_a_provider_the_network_is_let_in_by_nobody_else() {
        let text = format!("listen = \"0.0.0.0:9090\"\n[oidc]\n{GOOD}roles = {{ admins = \"admin\" }}\n");
        let config = super::super::Config::parse(&text).expect("well-formed");
        config.check().expect("people sign in");
        let without = super::super::Config { oidc: None, ..config };
        without.check().expect_err("nobody is asked");
    }

    #[test]
    fn what_cannot_work_is_refused() {
        let admins = "roles = { a = \"admin\" }\n";
        for (text, words) in [
            ("roles = {}", "nobody could sign in"),
            ("roles = { a = \"viewer\" }", "services = "),
            ("roles = { a = { role = \"deployer\" } }", "services = "),
            ("roles = { a = \"robot\" }", "cannot have the role robot"),
            ("roles = { a = { role = \"admin\", services = [\"x\"] } }", "for all services"),
        ] {
            let refused = format!("{:#}", read(text).check().expect_err(text));
            assert!(refused.contains(words), "{text}: {refused}");
        }
        for (from, to, words) in [
            ("https://id.lab", "http://id.lab", "only for this machine"),
            ("https://id.lab", "ldap://id.lab", "https://"),
            ("realms/lab", "realms/lab?x=1", "without a query"),
            ("https://robots", "http://robots", "only for this machine"),
            (":9090/", ":9090/portal", "only the portal's address"),
            ("\"cloudroid\"", "\"\"", "client_id"),
        ] {
            let text = format!("{GOOD}{admins}").replace(from, to);
            let read: OidcConfig = toml::from_str(&text).expect("well-formed");
            let refused = format!("{:#}", read.check().expect_err(to));
            assert!(refused.contains(words), "{to}: {refused}");
        }
        for text in ["", "roles = { a = \"king\" }", "roles = { a = { role = \"admin\", x = 1 } }"] {
            toml::from_str::<OidcConfig>(&format!("{GOOD}{text}")).expect_err(text);
        }
    }

    #[test]
    fn a_secret_that_everybody_can_read_is_none() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("secret");
        let written = |text: &str, mode: u32| {
            std::fs::write(&path, text).expect("written");
            let mode = std::fs::Permissions::from_mode(mode);
            std::fs::set_permissions(&path, mode).expect("set");
            read_secret(&path).map_err(|error| format!("{error:#}"))
        };
        assert_eq!(written("geheim\n", 0o600), Ok("geheim".into()));
        assert_eq!(written("geheim", 0o640), Ok("geheim".into()));
        let open = written("geheim", 0o644).expect_err("open");
        assert!(open.contains("chmod 600"), "{open}");
        assert!(!open.contains("geheim"), "{open}");
        for text in ["", " \n", &"x".repeat(5000)] {
            let refused = written(text, 0o600).expect_err("none");
            assert!(refused.contains("only this client's secret"), "{refused}");
        }
        std::fs::remove_file(&path).expect("removed");
        let gone = read_secret(&path).expect_err("gone").to_string();
        assert!(gone.contains("client_secret_file"), "{gone}");
    }
}
