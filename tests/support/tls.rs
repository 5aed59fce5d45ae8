//! A TLS proxy in front of a portal, with a certificate authority of its own, as a robot's owner might have.

use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use anyhow::ensure;

use crate::deployer::run;
use crate::machine::free_port;
use crate::world::{Directory, world};

/// Proxy and authority, implemented with socat and openssl.
pub struct TlsProxy {
    /// Listening port.
    pub port: u16,
    place: Directory,
    serving: Child,
}

const CERTIFICATES: &str = r#"
new="-newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes"
openssl req -x509 $new -keyout ca.key -out ca.pem -days 2 -subj /CN=authority -addext keyUsage=keyCertSign
openssl req $new -keyout server.key -out server.csr -subj /CN=server
echo 'subjectAltName=DNS:localhost,IP:127.0.0.1' > names
openssl x509 -req -in server.csr -CA ca.pem -CAkey ca.key -CAcreateserial -days 2 -extfile names -out server.pem
"#;

/// Creates an authority (`ca.pem`, `ca.key`) and a certificate for this machine (`server.pem`, `server.key`) in a
/// directory.
pub(crate) fn make_certificates(place: &Path) -> anyhow::Result<()> {
    let made = run(Command::new("sh").args(["-euc", CERTIFICATES]).current_dir(place))?;
    ensure!(made.status == 0, "{}", made.output());
    Ok(())
}

impl TlsProxy {
    /// Starts a proxy in front of the portal at `address`, for the names `localhost` and 127.0.0.1.
    pub fn start(address: &str) -> anyhow::Result<Self> {
        Self::with_certificate("server", address)
    }

    /// Starts a proxy that uses the authority's own certificate.
    pub fn with_ca_certificate(address: &str) -> anyhow::Result<Self> {
        Self::with_certificate("ca", address)
    }

    fn with_certificate(certificate: &str, address: &str) -> anyhow::Result<Self> {
        let place = world().directory("tls")?;
        make_certificates(place.path())?;
        let port = free_port()?;
        let listen = format!(
            "OPENSSL-LISTEN:{port},bind=0.0.0.0,reuseaddr,fork,cert={certificate}.pem,key={certificate}.key,verify=0"
        );
        let serving = Command::new("socat")
            .args([&listen, &format!("TCP:{address}")])
            .current_dir(place.path())
            .stdin(Stdio::null())
            .stderr(Stdio::null())
            .spawn()?;
        let mut proxy = Self { port, place, serving };
        // It listens as soon as a connection succeeds.
        crate::wait_until("a proxy that listens", || {
            let reached = TcpStream::connect(("127.0.0.1", port));
            let ended = proxy.serving.try_wait()?;
            ensure!(ended.is_none(), "socat ended: {ended:?}");
            Ok(reached.map(drop).map_err(|error| error.to_string()))
        })?;
        Ok(proxy)
    }

    /// Returns the authority's certificate.
    pub fn authority(&self) -> PathBuf {
        self.place.path().join("ca.pem")
    }
}

impl Drop for TlsProxy {
    fn drop(&mut self) {
        let _ = self.serving.kill();
        let _ = self.serving.wait();
    }
}
