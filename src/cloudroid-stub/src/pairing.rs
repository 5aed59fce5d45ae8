//! The robot's own key, and the certificates that servers have given it (docs/adr/086).
//!
//! ```text
//!  ~/.config/cloudroid/robot.key               made at the first pairing; it never leaves the robot
//!  ~/.config/cloudroid/paired/HOST:PORT.toml   the certificate for a server: shown to it, and renewed in time
//!  ~/.config/cloudroid/servers.pub             the keys that these servers sign stubs by, for install.sh
//! ```
//! All stubs of a robot share them.

mod key;
mod own;
mod renewal;
mod request;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use serde_json::json;
use tls::{Identity, Known, KnownServers, PairingLine, Trust};

use crate::address::Address;
use crate::arguments;
use crate::config::{self, Config};
use crate::http;
use crate::resolver;

use key::Key;
use own::{Certificate, Own};
pub use renewal::keep_renewed;

/// Where this robot's key and certificates are.
fn directory(named: Option<&Path>) -> Option<Own> {
    let usual = || Some(KnownServers::of_user()?.path().parent()?.to_owned());
    let path = named.map(config::at_home).or_else(usual);
    path.map(Own)
}

/// The server that a configuration names, where it may ask for a certificate, and what is kept for it.
fn of(config: &Config) -> Option<(Own, Address)> {
    let address = config.address().ok().filter(|address| address.secure)?;
    Some((directory(config.identity.as_deref())?, address))
}

/// As whom this robot is paired with the server of a configuration.
pub fn robot(config: &Config) -> Option<String> {
    let (own, address) = of(config)?;
    Some(own.certificate(&address).ok()??.robot)
}

/// What this robot shows to the server of a configuration, where it is paired with it.
pub fn identity(config: &Config) -> anyhow::Result<Option<Arc<Identity>>> {
    let Some((own, address)) = of(config) else {
        return Ok(None);
    };
    let Some(certificate) = own.certificate(&address)? else {
        return Ok(None);
    };
    let key = Key::read(&own.key())?;
    Ok(Some(Arc::new(Identity {
        chain: certificate.chain()?,
        key: key.to_show(),
    })))
}

/// Pairs this robot.
pub fn pair(asked: &arguments::Pair) -> anyhow::Result<ExitCode> {
    let line: PairingLine = asked.line.parse()?;
    let own = directory(asked.identity.as_deref())
        .context("neither XDG_CONFIG_HOME nor HOME is set; set one of them, or name a directory with --identity")?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let lifetime = runtime.block_on(paired(&line, &own))?;
    println!(
        "This robot is paired with {} as {}. Its key is {}; its certificate is good for {}, and the stubs renew it.",
        line.server,
        line.robot,
        own.key().display(),
        in_words(lifetime)
    );
    Ok(ExitCode::SUCCESS)
}

async fn paired(line: &PairingLine, own: &Own) -> anyhow::Result<Duration> {
    let address = Address::parse(&format!("wss://{}", line.server)).map_err(anyhow::Error::msg)?;
    let key = own.make_key()?;
    let trust = Trust {
        authorities: None,
        fingerprint: Some(line.fingerprint),
        known: None,
        accept: "a new line of cloudroidctl pair, which says".to_owned(),
        advice: "",
        identity: None,
    };
    let ip = resolver::resolve(&address.host)
        .await
        .with_context(|| format!("cannot find {}", address.host))?;
    let server = http::Server {
        address,
        ip,
        trust,
        // An authority's word is not enough: the line names the one certificate.
        only: Some(line.fingerprint),
    };
    let asks =
        json!({ "robot": line.robot, "code": line.code, "request": key.request(&line.robot)? });
    let answer = http::post(&server, "/api/v1/pair", &asks)
        .await
        .with_context(|| format!("cannot pair with {}", line.server))?;
    if answer.status != 200 {
        bail!(
            "{} answers {}: {}",
            line.server,
            answer.status,
            answer.words()
        );
    }
    let certificate = Certificate::read(&answer.body)
        .with_context(|| format!("what {} answers is no certificate", line.server))?;
    own.keep(&server.address, &certificate)?;
    own.trust_signer(&line.key)?;
    own.known_servers()
        .remember(
            &server.address.known_as(),
            Known::Certificate(line.fingerprint),
        )
        .context("cannot remember the server's certificate")?;
    Ok(certificate.lifetime())
}

/// A length of time for people.
fn in_words(length: Duration) -> String {
    match length.as_secs() {
        seconds if seconds >= 2 * 86_400 => format!("{} days", seconds / 86_400),
        seconds if seconds >= 2 * 3600 => format!("{} hours", seconds / 3600),
        seconds if seconds >= 120 => format!("{} minutes", seconds / 60),
        seconds => format!("{seconds} s"),
    }
}

/// A file that is about this robot's key or its certificates, and what is wrong with it.
fn about(path: &Path, what: impl std::fmt::Display) -> anyhow::Error {
    anyhow::anyhow!("{}: {what}", path.display())
}

/// Writes a file of this user's alone, whole or not at all.
fn write_whole(path: &Path, text: &str) -> anyhow::Result<()> {
    use std::io::Write;
    use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
    let directory = path.parent().unwrap_or(Path::new("."));
    let mut making = std::fs::DirBuilder::new();
    making.recursive(true).mode(0o700);
    making
        .create(directory)
        .map_err(|error| about(directory, error))?;
    let half = half(path);
    let _ = std::fs::remove_file(&half);
    let written = || -> std::io::Result<()> {
        let mut file = std::fs::OpenOptions::new()
            .write(true)
            .create_new(true)
            .mode(0o600)
            .open(&half)?;
        file.write_all(text.as_bytes())?;
        file.sync_all()?;
        std::fs::rename(&half, path)
    };
    written().map_err(|error| about(path, error))
}

fn half(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(format!(".{}", std::process::id()));
    name.into()
}

#[cfg(test)]
mod tests;
