//! Servers whose certificates were seen, as `known_hosts` of ssh(1): a line each, `HOST:PORT SHA256:…`, or
//! `HOST:PORT authority` where an authority speaks for the certificate.

use std::fmt;
use std::fs::{DirBuilder, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use nix::fcntl::{Flock, FlockArg};

use crate::{Fingerprint, NoFingerprint};

/// What is remembered of a server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Known {
    /// Its certificate.
    Certificate(Fingerprint),
    /// An authority that the client trusts has signed its certificate, which may change, but not to one that nobody has
    /// signed.
    ByAuthority,
}

/// The word of [`Known::ByAuthority`].
const AUTHORITY: &str = "authority";

impl fmt::Display for Known {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Known::Certificate(fingerprint) => fingerprint.fmt(out),
            Known::ByAuthority => out.write_str(AUTHORITY),
        }
    }
}

impl FromStr for Known {
    type Err = NoFingerprint;

    fn from_str(written: &str) -> Result<Known, NoFingerprint> {
        if written == AUTHORITY {
            return Ok(Known::ByAuthority);
        }
        written.parse().map(Known::Certificate)
    }
}

/// The file of one user.
#[derive(Debug, Clone)]
pub struct KnownServers(PathBuf);

impl KnownServers {
    /// A file.
    pub fn at(path: PathBuf) -> Self {
        Self(path)
    }

    /// This user's: `cloudroid/known_servers` below `$XDG_CONFIG_HOME`, or below `~/.config`.
    pub fn of_user() -> Option<Self> {
        let variable = |name| {
            std::env::var_os(name)
                .filter(|value| !value.is_empty())
                .map(PathBuf::from)
        };
        let config = variable("XDG_CONFIG_HOME")
            .or_else(|| variable("HOME").map(|home| home.join(".config")))?;
        Some(Self(config.join("cloudroid/known_servers")))
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// What is remembered of a server, by its host and port.
    pub fn find(&self, server: &str) -> io::Result<Option<Known>> {
        let known = self.read()?;
        Ok(known
            .into_iter()
            .find(|(name, _)| name == server)
            .map(|(_, known)| known))
    }

    /// Remembers this of a server, in place of what was remembered.
    pub fn remember(&self, server: &str, new: Known) -> io::Result<()> {
        self.change(server, |_| Some(new)).map(|_| ())
    }

    /// The same where nothing is remembered of the server; gives what is remembered then.
    pub fn remember_first(&self, server: &str, new: Known) -> io::Result<Known> {
        let known = self.change(server, |known| match known {
            Some(_) => None,
            None => Some(new),
        })?;
        Ok(known.unwrap_or(new))
    }

    /// Writes what `decide` makes of what is known of a server; gives what was known.
    fn change(
        &self,
        server: &str,
        decide: impl FnOnce(Option<Known>) -> Option<Known>,
    ) -> io::Result<Option<Known>> {
        let named = |error| about(&self.0, error);
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

    /// Two programs that remember something at once do it one after the other.
    fn lock(&self) -> io::Result<Flock<std::fs::File>> {
        let file = private(&self.beside("lock"))?;
        Flock::lock(file, FlockArg::LockExclusive).map_err(|(_, errno)| errno.into())
    }

    fn beside(&self, extension: &str) -> PathBuf {
        self.0.with_extension(extension)
    }

    fn read(&self) -> io::Result<Vec<(String, Known)>> {
        let text = match std::fs::read_to_string(&self.0) {
            Ok(text) => text,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(error) => return Err(about(&self.0, error)),
        };
        let mut known = Vec::new();
        for (at, line) in text.lines().enumerate() {
            let line = line.trim();
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            let read = line
                .split_once(' ')
                .and_then(|(server, shown)| Some((server.to_owned(), shown.trim().parse().ok()?)));
            let Some(read) = read else {
                let words = format!(
                    "line {} is no HOST:PORT with a fingerprint or the word \"{AUTHORITY}\"; correct or remove it",
                    at + 1
                );
                return Err(about(&self.0, io::Error::other(words)));
            };
            known.push(read);
        }
        Ok(known)
    }

    fn write(&self, known: &[(String, Known)]) -> io::Result<()> {
        let begun = self.beside("begun");
        let mut file = private(&begun)?;
        file.set_len(0)?;
        for (server, known) in known {
            writeln!(file, "{server} {known}")?;
        }
        file.sync_all()?;
        std::fs::rename(&begun, &self.0)
    }
}

/// A file that nobody else reads.
fn private(path: &Path) -> io::Result<std::fs::File> {
    OpenOptions::new()
        .write(true)
        .create(true)
        .truncate(false)
        .mode(0o600)
        .open(path)
}

fn about(path: &Path, error: io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("{}: {error}", path.display()))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    fn shown(digit: char) -> Known {
        let digits = digit.to_string().repeat(64);
        format!("SHA256:{digits}").parse().unwrap()
    }

    #[test]
    fn the_first_is_remembered_until_another_is_accepted() {
        let place = tempfile::tempdir().unwrap();
        let known = KnownServers::at(place.path().join("new/cloudroid/known_servers"));
        let (one, other) = (shown('1'), shown('2'));
        assert_eq!(known.find("a:1").unwrap(), None);
        assert_eq!(known.remember_first("a:1", one).unwrap(), one);
        assert_eq!(known.remember_first("b:1", other).unwrap(), other);
        assert_eq!(known.remember_first("a:1", other).unwrap(), one, "kept");
        assert_eq!(known.find("a:1").unwrap(), Some(one));
        known.remember("a:1", other).unwrap();
        assert_eq!(known.find("a:1").unwrap(), Some(other));
        assert_eq!(known.find("b:1").unwrap(), Some(other));
        assert_eq!(known.find("a:11").unwrap(), None);
        known.remember("b:1", Known::ByAuthority).unwrap();
        assert_eq!(known.find("b:1").unwrap(), Some(Known::ByAuthority));
        assert_eq!(known.find("a:1").unwrap(), Some(other));
        let mode = known.path().metadata().unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
    }

    #[test]
    fn programs_that_remember_at_once_lose_nothing() {
        let place = tempfile::tempdir().unwrap();
        let known = KnownServers::at(place.path().join("known_servers"));
        std::thread::scope(|scope| {
            for at in 0..16 {
                let known = &known;
                scope.spawn(move || known.remember(&format!("s:{at}"), shown('a')));
            }
        });
        for at in 0..16 {
            let found = known.find(&format!("s:{at}")).unwrap();
            assert_eq!(found, Some(shown('a')), "{at}");
        }
    }

    #[test]
    fn a_damaged_file_is_no_reason_to_trust_anybody() {
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("known_servers");
        let known = KnownServers::at(path.clone());
        for text in [
            "a:1",
            "a:1 SHA256:00",
            "a:1 Authority",
            "# fine\n\na:1\tx",
            "\u{fffd} ",
        ] {
            std::fs::write(&path, text).unwrap();
            for refused in [
                known.find("b:1").map(|_| ()),
                known.remember_first("b:1", shown('1')).map(|_| ()),
            ] {
                let words = refused.expect_err(text).to_string();
                assert!(words.contains("known_servers: line"), "{words}");
            }
        }
        std::fs::write(&path, [0xff, 0xfe]).unwrap();
        known.find("b:1").expect_err("no text");
    }
}
