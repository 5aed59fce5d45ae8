//! The robot's key and the certificates that servers have issued to it (docs/adr/086).
//!
//! ```text
//!  ~/.config/cloudroid/robot.key               made at the first pairing; it never leaves the robot
//!  ~/.config/cloudroid/paired/HOST:PORT.toml   the certificate for a server: shown to it, and renewed in time
//!  ~/.config/cloudroid/servers.pub             the keys that these servers sign stubs by, for install.sh
//! ```
//!
//! All stubs of a robot share them.

mod files;
mod key;
mod own;
mod renewal;
mod request;

use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use serde_json::json;
use tls::{ClientIdentity, KnownIdentity, KnownServers, PairingLine, Trust};

use crate::address::Address;
use crate::arguments;
use crate::config::{self, Config};
use crate::http;
use crate::resolver;

use key::RobotKey;
use own::{IdentityDirectory, PairedCertificate};
pub use renewal::run_renewal;

/// Returns the directory of this robot's key and certificates.
fn identity_directory(named: Option<&Path>) -> Option<IdentityDirectory> {
    let usual = || Some(KnownServers::for_user()?.path().parent()?.to_owned());
    let path = named.map(config::expand_home).or_else(usual);
    path.map(IdentityDirectory)
}

/// Returns the identity directory and the address of the configured server, if it is reached over TLS.
fn locate_identity(config: &Config) -> Option<(IdentityDirectory, Address)> {
    let address = config.address().ok().filter(|address| address.secure)?;
    Some((identity_directory(config.identity.as_deref())?, address))
}

/// Returns the name under which this robot is paired with the configured server.
pub fn paired_robot(config: &Config) -> Option<String> {
    let (own, address) = locate_identity(config)?;
    Some(own.load_certificate(&address).ok()??.robot)
}

/// Returns the key and the certificate that this robot presents to the configured server, if it is paired with it.
pub fn load_identity(config: &Config) -> anyhow::Result<Option<Arc<ClientIdentity>>> {
    let Some((own, address)) = locate_identity(config) else {
        return Ok(None);
    };
    let Some(certificate) = own.load_certificate(&address)? else {
        return Ok(None);
    };
    let key = RobotKey::read(&own.key_path())?;
    Ok(Some(Arc::new(ClientIdentity { chain: certificate.chain()?, key: key.private_key() })))
}

/// Pairs this robot.
pub fn pair(asked: &arguments::PairRobotArgs) -> anyhow::Result<ExitCode> {
    let line: PairingLine = asked.line.parse()?;
    let own = identity_directory(asked.identity.as_deref())
        .context("neither XDG_CONFIG_HOME nor HOME is set; set one of them, or name a directory with --identity")?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let lifetime = runtime.block_on(request_pairing(&line, &own))?;
    println!(
        "This robot is paired with {} as {}. Its key is {}; its certificate is valid for {}, and the stubs renew it.",
        line.server,
        line.robot,
        own.key_path().display(),
        duration_in_words(lifetime)
    );
    Ok(ExitCode::SUCCESS)
}

async fn request_pairing(line: &PairingLine, own: &IdentityDirectory) -> anyhow::Result<Duration> {
    let address = Address::parse(&format!("wss://{}", line.server))?;
    let key = own.load_or_create_key()?;
    let trust = Trust {
        authorities: None,
        fingerprint: Some(line.fingerprint),
        known: None,
        accept: "a new line of cloudroidctl pair with".to_owned(),
        advice: "",
        identity: None,
    };
    let ip = resolver::resolve(&address.host).await.with_context(|| format!("cannot find {}", address.host))?;
    let server = http::HttpServer {
        address,
        ip,
        trust,
        // A certificate authority is not sufficient: the line names the exact certificate.
        only: Some(line.fingerprint),
    };
    let asks = json!({ "robot": line.robot, "code": line.code, "request": key.certificate_request(&line.robot)? });
    let answer = http::post(&server, "/api/v1/pair", &asks)
        .await
        .with_context(|| format!("cannot pair with {}", line.server))?;
    if answer.status != 200 {
        bail!("{} answers {}: {}", line.server, answer.status, answer.problem_text());
    }
    let certificate = PairedCertificate::read(&answer.body)
        .with_context(|| format!("the response of {} is not a certificate", line.server))?;
    own.store_certificate(&server.address, &certificate)?;
    own.trust_signer(&line.key)?;
    own.known_servers()
        .remember(&server.address.known_server_name(), KnownIdentity::Certificate(line.fingerprint))
        .context("cannot store the server's certificate")?;
    Ok(certificate.lifetime())
}

/// Formats a duration for a message.
fn duration_in_words(length: Duration) -> String {
    match length.as_secs() {
        seconds if seconds >= 2 * 86_400 => format!("{} days", seconds / 86_400),
        seconds if seconds >= 2 * 3600 => format!("{} hours", seconds / 3600),
        seconds if seconds >= 120 => format!("{} minutes", seconds / 60),
        seconds => format!("{seconds} s"),
    }
}

#[cfg(test)]
mod tests;
