//! A robot's TLS connection to a daemon, and its token.

use std::net::TcpStream;
use std::sync::Arc;

use anyhow::Result;
use bench_report::BenchDaemon;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::CertificateDer;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::{ClientConfig, ClientConnection, RootCertStore, StreamOwned};

use crate::node::PATIENCE;

/// Client side of a TLS connection.
pub(crate) type BenchTlsStream = StreamOwned<ClientConnection, TcpStream>;

/// Returns the robot's token if the daemon requires one.
pub(crate) fn robot_token(daemon: &BenchDaemon) -> Result<Option<String>> {
    match std::fs::read_to_string(daemon.directory().join("token")) {
        Ok(token) => Ok(Some(token.trim().to_owned())),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error.into()),
    }
}

/// Connects by TLS to a daemon, trusting the certificate in its home.
pub(crate) fn connect(daemon: &BenchDaemon) -> Result<BenchTlsStream> {
    let stream = TcpStream::connect(&daemon.address)?;
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    let mut roots = RootCertStore::empty();
    let own = daemon.home.join("tls/own.pem");
    roots.add(CertificateDer::from_pem_file(own)?)?;
    let builder = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()));
    let config = builder.with_safe_default_protocol_versions()?.with_root_certificates(roots).with_no_client_auth();
    let connection = ClientConnection::new(Arc::new(config), "localhost".try_into()?)?;
    Ok(StreamOwned::new(connection, stream))
}
