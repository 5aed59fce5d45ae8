//! `cloudroidctl trust`: accepts the certificate of a server.

use anyhow::{Context, bail};
use clap::Args;
use tls::{Fingerprint, Known, KnownServers};

use crate::client::Server;

/// Accept a server's certificate, which no authority has signed, by its fingerprint.
///
/// The daemon says it at its start, and so does cloudroidctl status on the server. It is remembered in
/// ~/.config/cloudroid/known_servers, in place of what the server showed before.
#[derive(Debug, Args)]
pub struct TrustServer {
    /// The server, as --server names it: https://HOST:PORT.
    #[arg(value_name = "URL")]
    address: String,
    /// Such as SHA256:5d21...
    fingerprint: Fingerprint,
}

impl TrustServer {
    /// Remembers it.
    pub fn run(&self) -> anyhow::Result<()> {
        let Server::Tls(server) = Server::parse(&self.address)? else {
            bail!(
                "{} is reached without TLS and shows no certificate; write https://HOST:PORT",
                self.address
            );
        };
        let known = KnownServers::of_user()
            .context("neither XDG_CONFIG_HOME nor HOME is set; set one of them")?;
        known
            .remember(&server, Known::Certificate(self.fingerprint))
            .context("cannot remember the certificate")?;
        println!("{server} is trusted with {}", self.fingerprint);
        Ok(())
    }
}
