//! `[oidc]`: an identity provider that knows people, and what its groups may do.

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
pub struct Oidc {
    /// Its issuer identifier.
    pub issuer: String,
    /// As people know it: on the page's link.
    pub name: Option<String>,
    /// As whom it knows this server.
    pub client_id: String,
    /// The file of the secret by which this server proves that; none: a public client.
    pub client_secret_file: Option<PathBuf>,
    /// The portal's address, as people's browsers have it: `https://HOST[:PORT]`.
    pub redirect: String,
    /// What is asked for besides `openid`.
    #[serde(default = "profile")]
    pub scopes: Vec<String>,
    /// The claim that has a person's groups.
    #[serde(default = "groups")]
    pub groups_claim: String,
    /// The claim that has a person's name.
    #[serde(default = "preferred_username")]
    pub name_claim: String,
    /// PEM file of the authorities that the provider's certificate is checked by, which everybody may read; the system's by default.
    pub authorities: Option<PathBuf>,
    /// What people of a group may do.
    pub roles: BTreeMap<String, Given>,
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

/// A role, and for which services where it is for some.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(untagged)]
pub enum Given {
    /// For all services.
    Whole(Role),
    /// For some.
    Scoped(Scoped),
}

/// A role that is for some services.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scoped {
    role: Role,
    #[serde(default)]
    services: Vec<Glob>,
}

impl Given {
    fn parts(&self) -> (Role, &[Glob]) {
        match self {
            Given::Whole(role) => (*role, &[]),
            Given::Scoped(scoped) => (scoped.role, &scoped.services),
        }
    }

    fn check(&self, group: &str) -> anyhow::Result<()> {
        let (role, services) = self.parts();
        if role == Role::Robot {
            bail!(
                "{group:?} cannot be robot: people are no robots; robots are paired, or have tokens"
            );
        }
        match (role.is_scoped(), services.is_empty()) {
            (true, true) => bail!(
                "a {role} is for services that are named: write {group:?} = {{ role = \"{role}\", services = [\"lab_*\"] }}, or \"*\" for all"
            ),
            (false, false) => bail!(
                "an {role} is for all services: write {group:?} = \"{role}\", or choose another role"
            ),
            _ => Ok(()),
        }
    }
}

fn secret(path: &Path) -> anyhow::Result<String> {
    let file = std::fs::File::open(path)
        .with_context(|| format!("cannot read client_secret_file {}", path.display()))?;
    let mode = file.metadata()?.permissions().mode();
    ensure!(
        mode & 0o007 == 0,
        "client_secret_file {} can be read by every user of this machine; close it with: chmod 600 {}",
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
        "client_secret_file {} should have the secret alone, which the provider shows for this client",
        path.display()
    );
    Ok(secret.to_owned())
}

impl Oidc {
    fn origin(&self) -> &str {
        self.redirect.trim_end_matches('/')
    }

    fn roles(&self) -> oidc::Roles {
        let groups = self.roles.iter().map(|(name, given)| {
            let (role, services) = given.parts();
            oidc::Group {
                name: name.clone(),
                role,
                services: services.to_vec(),
            }
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
            "redirect = {:?} should be the portal's address alone, as browsers have it: \"https://HOST:PORT\"",
            self.redirect
        );
        ensure!(
            !self.client_id.is_empty(),
            "client_id is empty; write the one by which the provider knows this server"
        );
        ensure!(
            !self.roles.is_empty(),
            "roles is empty, and nobody could sign in; name a group: roles = {{ \"robot-admins\" = \"admin\" }}"
        );
        for (group, given) in &self.roles {
            given.check(group).context("roles")?;
        }
        match &self.client_secret_file {
            Some(path) => secret(path).map(|_| ()),
            None => Ok(()),
        }
    }

    /// As the portal has it, with its secret.
    pub fn provider(&self) -> anyhow::Result<IdentityProvider> {
        let mut settings = self.settings();
        settings.client_secret = self.client_secret_file.as_deref().map(secret).transpose()?;
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

    fn read(more: &str) -> Oidc {
        toml::from_str(&format!("{GOOD}{more}")).expect("well-formed")
    }

    #[test]
    fn groups_have_roles_and_services() {
        let read = read(
            "roles = { admins = \"admin\", students = { role = \"viewer\", services = [\"lab_*\", \"demo\"] } }",
        );
        read.check().expect("good");
        let made = read.provider().expect("good");
        assert_eq!(made.name, "id.lab.example");
        assert_eq!(made.origin, "https://robots.lab.example:9090");
        let of = |group: &str| made.roles.of(&[group.to_owned()]);
        assert_eq!(of("admins").expect("a role").role, Role::Admin);
        assert_eq!(of("students").expect("a role").services.len(), 2);
        assert!(of("others").is_none());
    }

    #[test]
    fn with_a_provider_the_network_is_let_in_by_nobody_else() {
        let text =
            format!("listen = \"0.0.0.0:9090\"\n[oidc]\n{GOOD}roles = {{ admins = \"admin\" }}\n");
        let config = super::super::Config::parse(&text).expect("well-formed");
        config.check().expect("people sign in");
        let without = super::super::Config {
            oidc: None,
            ..config
        };
        without.check().expect_err("nobody is asked");
    }

    #[test]
    fn what_cannot_work_is_refused() {
        let admins = "roles = { a = \"admin\" }\n";
        for (text, words) in [
            ("roles = {}", "nobody could sign in"),
            ("roles = { a = \"viewer\" }", "services = "),
            ("roles = { a = { role = \"deployer\" } }", "services = "),
            ("roles = { a = \"robot\" }", "no robots"),
            (
                "roles = { a = { role = \"admin\", services = [\"x\"] } }",
                "for all services",
            ),
        ] {
            let refused = format!("{:#}", read(text).check().expect_err(text));
            assert!(refused.contains(words), "{text}: {refused}");
        }
        for (from, to, words) in [
            ("https://id.lab", "http://id.lab", "this machine alone"),
            ("https://id.lab", "ldap://id.lab", "https://"),
            ("realms/lab", "realms/lab?x=1", "without query"),
            ("https://robots", "http://robots", "this machine alone"),
            (":9090/", ":9090/portal", "address alone"),
            ("\"cloudroid\"", "\"\"", "client_id"),
        ] {
            let text = format!("{GOOD}{admins}").replace(from, to);
            let read: Oidc = toml::from_str(&text).expect("well-formed");
            let refused = format!("{:#}", read.check().expect_err(to));
            assert!(refused.contains(words), "{to}: {refused}");
        }
        for text in [
            "",
            "roles = { a = \"king\" }",
            "roles = { a = { role = \"admin\", x = 1 } }",
        ] {
            toml::from_str::<Oidc>(&format!("{GOOD}{text}")).expect_err(text);
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
            secret(&path).map_err(|error| format!("{error:#}"))
        };
        assert_eq!(written("geheim\n", 0o600), Ok("geheim".into()));
        assert_eq!(written("geheim", 0o640), Ok("geheim".into()));
        let open = written("geheim", 0o644).expect_err("open");
        assert!(open.contains("chmod 600"), "{open}");
        assert!(!open.contains("geheim"), "{open}");
        for text in ["", " \n", &"x".repeat(5000)] {
            let refused = written(text, 0o600).expect_err("none");
            assert!(refused.contains("the secret alone"), "{refused}");
        }
        std::fs::remove_file(&path).expect("removed");
        let gone = secret(&path).expect_err("gone").to_string();
        assert!(gone.contains("client_secret_file"), "{gone}");
    }
}
