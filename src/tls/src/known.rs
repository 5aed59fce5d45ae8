//! Known servers, like `known_hosts` of ssh(1): one line each, `HOST:PORT SHA256:…`, or `HOST:PORT authority` if an
//! authority vouches for the certificate.

use std::fmt;
use std::fs::{DirBuilder, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use nix::fcntl::{Flock, FlockArg};

use crate::{Fingerprint, ParseFingerprintError};

/// Identity remembered for a server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum KnownIdentity {
    /// The server's certificate.
    Certificate(Fingerprint),
    /// A trusted authority has signed the certificate. It may change, but not to a self-signed one.
    ByAuthority,
}

/// Text form of [`KnownIdentity::ByAuthority`].
const AUTHORITY: &str = "authority";

impl fmt::Display for KnownIdentity {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            KnownIdentity::Certificate(fingerprint) => fingerprint.fmt(out),
            KnownIdentity::ByAuthority => out.write_str(AUTHORITY),
        }
    }
}

impl FromStr for KnownIdentity {
    type Err = ParseFingerprintError;

    fn from_str(written: &str) -> Result<KnownIdentity, ParseFingerprintError> {
        if written == AUTHORITY {
            return Ok(KnownIdentity::ByAuthority);
        }
        written.parse().map(KnownIdentity::Certificate)
    }
}

/// File of the servers known to a user.
#[derive(Debug, Clone)]
pub struct KnownServers(PathBuf);

impl KnownServers {
    /// Uses the file at `path`.
    pub fn new(path: PathBuf) -> Self {
        Self(path)
    }

    /// Returns the current user's file: `cloudroid/known_servers` below `$XDG_CONFIG_HOME`, or below `~/.config`.
    pub fn for_user() -> Option<Self> {
        let variable = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
        let config = variable("XDG_CONFIG_HOME").or_else(|| variable("HOME").map(|home| home.join(".config")))?;
        Some(Self(config.join("cloudroid/known_servers")))
    }

    /// Returns the path of the file.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Returns the identity remembered for a server, given its host and port.
    pub fn find(&self, server: &str) -> io::Result<Option<KnownIdentity>> {
        let known = self.read()?;
        Ok(known.into_iter().find(|(name, _)| name == server).map(|(_, known)| known))
    }

    /// Remembers the identity of a server, replacing the previous one.
    pub fn remember(&self, server: &str, new: KnownIdentity) -> io::Result<()> {
        self.update(server, |_| Some(new)).map(|_| ())
    }

    /// Remembers the identity of a server unless one is known; returns the one that is then remembered.
    pub fn remember_first(&self, server: &str, new: KnownIdentity) -> io::Result<KnownIdentity> {
        let known = self.update(server, |known| match known {
            Some(_) => None,
            None => Some(new),
        })?;
        Ok(known.unwrap_or(new))
    }

    /// Applies `decide` to the known identity of a server and writes its result; returns the previous identity.
    fn update(
        &self,
        server: &str,
        decide: impl FnOnce(Option<KnownIdentity>) -> Option<KnownIdentity>,
    ) -> io::Result<Option<KnownIdentity>> {
        let named = |error| with_path(&self.0, error);
        if let Some(directory) = self.0.parent() {
            let mut making = DirBuilder::new();
            making.recursive(true).mode(0o700);
            making.create(directory).map_err(named)?;
        }
        let _alone = self.lock().map_err(named)?;
        let mut all = self.read()?;
        let known = all.iter().position(|(name, _)| name == server);
        let before = known.map(|at| all[at].1);
        let Some(new) = decide(before) else {
            return Ok(before);
        };
        match known {
            Some(at) => all[at].1 = new,
            None => all.push((server.to_owned(), new)),
        }
        self.write(&all).map_err(named)?;
        Ok(before)
    }

    /// Serializes concurrent changes by several processes.
    fn lock(&self) -> io::Result<Flock<std::fs::File>> {
        let file = open_private(&self.sibling_path("lock"))?;
        Flock::lock(file, FlockArg::LockExclusive).map_err(|(_, errno)| errno.into())
    }

    fn sibling_path(&self, extension: &str) -> PathBuf {
        self.0.with_extension(extension)
    }

    fn read(&self) -> io::Result<Vec<(String, KnownIdentity)>> {
        let text = match std::fs::read_to_string(&self.0) {
            Ok(text) => text,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(error) => return Err(with_path(&self.0, error)),
        };
        let mut known = Vec::new();
        for (at, line) in text.lines().enumerate() {
            let line = line.trim();
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            let read =
                line.split_once(' ').and_then(|(server, shown)| Some((server.to_owned(), shown.trim().parse().ok()?)));
            let Some(read) = read else {
                let words = format!(
                    "line {} is not HOST:PORT with a fingerprint or the word \"{AUTHORITY}\"; correct or remove it",
                    at + 1
                );
                return Err(with_path(&self.0, io::Error::other(words)));
            };
            known.push(read);
        }
        Ok(known)
    }

    fn write(&self, known: &[(String, KnownIdentity)]) -> io::Result<()> {
        let begun = self.sibling_path("begun");
        let mut file = open_private(&begun)?;
        file.set_len(0)?;
        for (server, known) in known {
            writeln!(file, "{server} {known}")?;
        }
        file.sync_all()?;
        std::fs::rename(&begun, &self.0)
    }
}

/// Opens a file that only its owner may read, creating it if necessary.
fn open_private(path: &Path) -> io::Result<std::fs::File> {
    OpenOptions::new().write(true).create(true).truncate(false).mode(0o600).open(path)
}

fn with_path(path: &Path, error: io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("{}: {error}", path.display()))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    fn known_certificate(digit: char) -> KnownIdentity {
        let digits = digit.to_string().repeat(64);
        format!("SHA256:{digits}").parse().unwrap()
    }

    #[test]
    fn the_first_is_remembered_until_another_is_accepted() {
        let place = tempfile::tempdir().unwrap();
        let known = KnownServers::new(place.path().join("new/cloudroid/known_servers"));
        let (one, other) = (known_certificate('1'), known_certificate('2'));
        assert_eq!(known.find("a:1").unwrap(), None);
        assert_eq!(known.remember_first("a:1", one).unwrap(), one);
        assert_eq!(known.remember_first("b:1", other).unwrap(), other);
        assert_eq!(known.remember_first("a:1", other).unwrap(), one, "kept");
        assert_eq!(known.find("a:1").unwrap(), Some(one));
        known.remember("a:1", other).unwrap();
        assert_eq!(known.find("a:1").unwrap(), Some(other));
        assert_eq!(known.find("b:1").unwrap(), Some(other));
        assert_eq!(known.find("a:11").unwrap(), None);
        known.remember("b:1", KnownIdentity::ByAuthority).unwrap();
        assert_eq!(known.find("b:1").unwrap(), Some(KnownIdentity::ByAuthority));
        assert_eq!(known.find("a:1").unwrap(), Some(other));
        let mode = known.path().metadata().unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
    }

    #[test]
    fn programs_that_remember_at_once_lose_nothing() {
        let place = tempfile::tempdir().unwrap();
        let known = KnownServers::new(place.path().join("known_servers"));
        std::thread::scope(|scope| {
            for at in 0..16 {
                let known = &known;
                scope.spawn(move || known.remember(&format!("s:{at}"), known_certificate('a')));
            }
        });
        for at in 0..16 {
            let found = known.find(&format!("s:{at}")).unwrap();
            assert_eq!(found, Some(known_certificate('a')), "{at}");
        }
    }

    #[test]
    fn a_damaged_file_is_no_reason_to_trust_anybody() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("known_servers");
        let known = KnownServers::new(path.clone());
        for text in ["a:1", "a:1 SHA256:00", "a:1 Authority", "# fine\n\na:1\tx", "\u{fffd} "] {
            std::fs::write(&path, text).unwrap();
            for refused in
                [known.find("b:1").map(|_| ()), known.remember_first("b:1", known_certificate('1')).map(|_| ())]
            {
                let words = refused.expect_err(text).to_string();
                assert!(words.contains("known_servers: line"), "{words}");
            }
        }
        std::fs::write(&path, [0xff, 0xfe]).unwrap();
        known.find("b:1").expect_err("no text");
    }
}
