//! User names and passwords for registries: given on the command line, or where podman, skopeo and docker keep them
//! (containers-auth.json(5)). Their credential helpers are not run.

use std::collections::BTreeMap;
use std::fmt;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use hyper::header::HeaderValue;
use serde::Deserialize;

use super::reference::ImageReference;

/// Maximum size of an authentication file in bytes.
const LARGEST_FILE: u64 = 1 << 20;

/// User name and password.
#[derive(Clone, PartialEq, Eq)]
pub struct Credentials {
    user: String,
    password: String,
}

impl fmt::Debug for Credentials {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.debug_struct("Credentials").field("user", &self.user).finish_non_exhaustive()
    }
}

/// File of podman, skopeo, buildah and docker.
#[derive(Deserialize)]
struct AuthFile {
    #[serde(default)]
    auths: BTreeMap<String, AuthEntry>,
}

#[derive(Deserialize)]
struct AuthEntry {
    auth: Option<String>,
}

impl Credentials {
    /// Creates credentials of a user.
    pub fn new(user: String, password: String) -> anyhow::Result<Credentials> {
        // RFC 7617, section 2: the first colon separates them.
        ensure!(!user.is_empty() && !user.contains(':'), "{user:?} is not a user name");
        Ok(Credentials { user, password })
    }

    /// Returns the value of `Authorization` (RFC 7617).
    pub fn authorization(&self) -> anyhow::Result<HeaderValue> {
        let pair = format!("{}:{}", self.user, self.password);
        let mut value = HeaderValue::from_str(&format!("Basic {}", base64_simd::STANDARD.encode_to_string(pair)))?;
        value.set_sensitive(true);
        Ok(value)
    }

    /// Finds the credentials for an image in this user's authentication files; `None` if there are none.
    pub fn find(image: &ImageReference) -> anyhow::Result<Option<Credentials>> {
        for path in auth_files() {
            if let Some(found) = read_auth_file(&path)?.and_then(|file| file.find(image)) {
                return Ok(Some(found));
            }
        }
        Ok(None)
    }

    fn decode(auth: &str) -> Option<Credentials> {
        let pair = String::from_utf8(base64_simd::STANDARD.decode_to_vec(auth.trim()).ok()?).ok()?;
        let (user, password) = pair.split_once(':')?;
        // docker pads the password.
        Credentials::new(user.to_owned(), password.trim_end_matches('\0').to_owned()).ok()
    }
}

impl AuthFile {
    /// Finds the entry of the repository, of a part of its path, or of its registry.
    fn find(&self, image: &ImageReference) -> Option<Credentials> {
        let whole = format!("{}/{}", image.registry, image.repository);
        let places = std::iter::successors(Some(whole.as_str()), |place| Some(place.rsplit_once('/')?.0));
        let mut found = places.filter_map(|place| {
            let entry = self.auths.iter().find(|(key, _)| normalize_key(key) == place);
            Credentials::decode(entry?.1.auth.as_deref()?)
        });
        found.next()
    }
}

/// Returns the place that a key of a file stands for: docker writes `https://HOST/v1/` for a host.
fn normalize_key(key: &str) -> &str {
    match key.split_once("://") {
        Some((_, rest)) => rest.split_once('/').map_or(rest, |(host, _)| host),
        None => key.trim_end_matches('/'),
    }
}

/// Returns the authentication files in the order of podman and skopeo.
fn auth_files() -> Vec<PathBuf> {
    let variable = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    if let Some(named) = variable("REGISTRY_AUTH_FILE") {
        return vec![named];
    }
    let home = variable("HOME");
    let below_home = |part: &str| home.as_ref().map(|home| home.join(part));
    let own = format!("/run/containers/{}", nix::unistd::getuid());
    let running = variable("XDG_RUNTIME_DIR").map_or_else(|| own.into(), |directory| directory.join("containers"));
    let config = variable("XDG_CONFIG_HOME").or_else(|| below_home(".config"));
    let docker = variable("DOCKER_CONFIG").or_else(|| below_home(".docker"));
    let files = [
        Some(running.join("auth.json")),
        config.map(|config| config.join("containers/auth.json")),
        docker.map(|docker| docker.join("config.json")),
    ];
    files.into_iter().flatten().collect()
}

fn read_auth_file(path: &Path) -> anyhow::Result<Option<AuthFile>> {
    let unread = || format!("cannot read the registries' passwords in {}", path.display());
    let file = match File::open(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        file => file.with_context(unread)?,
    };
    let mut text = Vec::new();
    file.take(LARGEST_FILE).read_to_end(&mut text).with_context(unread)?;
    serde_json::from_slice(&text).map(Some).with_context(unread)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn passwords_are_found_where_other_tools_keep_them() {
        let entry = |pair: &str| format!("{{\"auth\": {:?}}}", base64_simd::STANDARD.encode_to_string(pair));
        let text = format!(
            "{{\"auths\": {{\"registry.example.org\": {}, \"registry.example.org/lab\": {}, \
             \"https://docker.example.org/v1/\": {}, \"helped.example.org\": {{}}}}, \"credsStore\": \"x\"}}",
            entry("all:a:b"),
            entry("lab:c"),
            entry("old:d\0\0"),
        );
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("auth.json");
        assert!(read_auth_file(&path).expect("none").is_none());
        std::fs::write(&path, text).expect("written");
        let file = read_auth_file(&path).expect("read").expect("there");
        for (image, expected) in [
            ("registry.example.org/ros", Some("all:a:b")),
            ("registry.example.org/lab/ros", Some("lab:c")),
            ("registry.example.org/laboratory/ros", Some("all:a:b")),
            ("docker.example.org/ros", Some("old:d")),
            ("helped.example.org/ros", None),
            ("registry.example.org:5000/ros", None),
        ] {
            let found = file.find(&image.parse().expect("a reference"));
            let found = found.map(|found| format!("{}:{}", found.user, found.password));
            assert_eq!(found.as_deref(), expected, "{image}");
        }
        std::fs::write(&path, "{").expect("written");
        let damaged = read_auth_file(&path).map(drop).expect_err("no JSON").to_string();
        assert!(damaged.contains("auth.json"), "{damaged}");
    }

    #[test]
    fn passwords_are_not_printed() {
        let made = Credentials::new("lab".to_owned(), "secret".to_owned()).expect("a user");
        assert!(!format!("{made:?}").contains("secret"));
        assert_eq!(made.authorization().expect("a header"), "Basic bGFiOnNlY3JldA==");
        Credentials::new("a:b".to_owned(), String::new()).expect_err("two names");
    }
}
