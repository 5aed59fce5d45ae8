//! `trust`: accepts the certificate of a server.

use anyhow::{Context, bail};
use clap::Args;
use tls::{Fingerprint, KnownIdentity, KnownServers};

use crate::client::ServerAddress;

/// Accept a server's self-signed certificate by its fingerprint.
///
/// The daemon prints the fingerprint when it starts, and so does cloudroidctl status on the server. It is stored in
/// ~/.config/cloudroid/known_servers, in place of an earlier one of this server.
#[derive(Debug, Args)]
pub struct TrustArgs {
    /// Address of the server, as for --server: https://HOST:PORT.
    #[arg(value_name = "URL")]
    address: String,
    /// Fingerprint of the certificate, such as SHA256:5d21...
    fingerprint: Fingerprint,
}

impl TrustArgs {
    /// Stores the fingerprint.
    pub fn run(&self) -> anyhow::Result<()> {
        let ServerAddress::Tls(server) = ServerAddress::parse(&self.address)? else {
            bail!("{} does not use TLS, so it has no certificate; write https://HOST:PORT", self.address);
        };
        let known = KnownServers::for_user().context("neither XDG_CONFIG_HOME nor HOME is set; set one of them")?;
        known
            .remember(&server, KnownIdentity::Certificate(self.fingerprint))
            .context("cannot store the certificate")?;
        println!("{server} is now trusted with the certificate {}", self.fingerprint);
        Ok(())
    }
}
