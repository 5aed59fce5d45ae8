//! Tests of a client's trust decisions, by TLS handshakes with servers that present the certificate of each case.

use std::path::Path;
use std::sync::Arc;

use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, IsCa, KeyPair};
use tls::{Fingerprint, KnownIdentity, KnownServers, Trust};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::ServerConfig;
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivatePkcs8KeyDer};

struct Server {
    certificate: CertificateDer<'static>,
    config: Arc<ServerConfig>,
}

impl Server {
    fn with_certificate(certificate: CertificateDer<'static>, key: &KeyPair) -> Self {
        let builder = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()));
        let key = PrivatePkcs8KeyDer::from(key.serialize_der());
        let config = builder
            .with_safe_default_protocol_versions()
            .unwrap()
            .with_no_client_auth()
            .with_single_cert(vec![certificate.clone()], key.into())
            .unwrap();
        Self { certificate, config: Arc::new(config) }
    }

    /// Creates a server with a self-signed certificate, as the daemon makes them or, with `is_ca`, as openssl does.
    fn self_signed(name: &str, is_ca: bool) -> Self {
        let key = KeyPair::generate().unwrap();
        let mut params = CertificateParams::new([name.to_owned()]).unwrap();
        if is_ca {
            params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        }
        let certificate = params.self_signed(&key).unwrap();
        Self::with_certificate(certificate.der().clone(), &key)
    }

    /// Creates a server whose certificate is signed by a new authority, whose own certificate is written to a file.
    fn signed_by_authority(name: &str, authority: &Path) -> Self {
        let mut params = CertificateParams::new([]).unwrap();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let common = rcgen::DnType::CommonName;
        params.distinguished_name.push(common, "authority");
        let issuer = CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap();
        std::fs::write(authority, issuer.pem()).unwrap();
        let key = KeyPair::generate().unwrap();
        let params = CertificateParams::new([name.to_owned()]).unwrap();
        let certificate = params.signed_by(&key, &issuer).unwrap();
        Self::with_certificate(certificate.der().clone(), &key)
    }

    fn fingerprint(&self) -> Fingerprint {
        Fingerprint::from_certificate(&self.certificate)
    }

    /// Performs a handshake as a client; returns the fingerprint if the certificate was seen for the first time.
    async fn handshake(&self, trust: &Trust) -> Result<Option<Fingerprint>, String> {
        let (here, there) = tokio::io::duplex(1 << 16);
        let acceptor = TlsAcceptor::from(Arc::clone(&self.config));
        let serving = tokio::spawn(async move { acceptor.accept(there).await.map(|_| ()) });
        let connected = trust.connect(here, "localhost", "localhost:1").await;
        let _ = serving.await;
        match connected {
            Ok(connected) => Ok(connected.first),
            Err(error) => Err(error.to_string()),
        }
    }
}

fn trust(known: Option<&Path>) -> Trust {
    Trust {
        authorities: None,
        fingerprint: None,
        known: known.map(|path| KnownServers::new(path.to_owned())),
        accept: "accept it".to_owned(),
        advice: "nobody is trusted",
        identity: None,
    }
}

#[tokio::test]
async fn what_signs_itself_is_remembered_and_no_other_is_taken_for_it() {
    for is_ca in [false, true] {
        let place = tempfile::tempdir().unwrap();
        let file = place.path().join("known_servers");
        let (server, other) = (Server::self_signed("localhost", is_ca), Server::self_signed("localhost", is_ca));
        let client = trust(Some(&file));
        let shown = server.fingerprint();
        assert_eq!(server.handshake(&client).await, Ok(Some(shown)), "first seen");
        assert_eq!(server.handshake(&client).await, Ok(None), "known");
        let refused = other.handshake(&client).await.expect_err("another");
        for words in [shown.to_string(), other.fingerprint().to_string(), format!("accept it {}", other.fingerprint())]
        {
            assert!(refused.contains(&words), "{words}: {refused}");
        }
        assert_eq!(server.handshake(&client).await, Ok(None), "still known");
        let known = KnownServers::new(file);
        let other_one = KnownIdentity::Certificate(other.fingerprint());
        known.remember("localhost:1", other_one).unwrap();
        assert_eq!(other.handshake(&client).await, Ok(None), "accepted");
        server.handshake(&client).await.expect_err("the one before");
    }
}

#[tokio::test]
async fn a_fingerprint_that_was_named_is_needed() {
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("known_servers");
    // The name does not matter: the fingerprint identifies the holder of the key.
    let server = Server::self_signed("elsewhere", false);
    let named = |fingerprint| Trust { fingerprint: Some(fingerprint), ..trust(Some(&file)) };
    let right = named(server.fingerprint());
    assert_eq!(server.handshake(&right).await, Ok(None));
    let other = Server::self_signed("elsewhere", false);
    other.handshake(&right).await.expect_err("another server");
    assert!(!file.exists(), "nothing was to be remembered");
}

#[tokio::test]
async fn what_an_authority_has_signed_may_change_but_not_to_what_signs_itself() {
    let place = tempfile::tempdir().unwrap();
    let (file, pem) = (place.path().join("known_servers"), place.path().join("ca.pem"));
    let server = Server::signed_by_authority("localhost", &pem);
    let alone = Server::self_signed("localhost", false);
    let by_chance = trust(Some(&file));
    server.handshake(&by_chance).await.expect_err("whose?");
    let client = Trust { authorities: Some(pem.clone()), ..by_chance.clone() };
    // With the authority's signature it may change, whatever was known before; a self-signed certificate accepted
    // earlier is refused.
    let known = KnownServers::new(file.clone());
    let accepted = KnownIdentity::Certificate(alone.fingerprint());
    known.remember("localhost:1", accepted).unwrap();
    alone.handshake(&client).await.expect_err("signs itself");
    assert_eq!(known.find("localhost:1").unwrap(), Some(accepted));
    assert_eq!(server.handshake(&client).await, Ok(None));
    assert_eq!(known.find("localhost:1").unwrap(), Some(KnownIdentity::ByAuthority));
    // A self-signed certificate shown later, possibly by a man in the middle, is not a first use.
    let refused = alone.handshake(&by_chance).await.expect_err("stands between");
    assert!(refused.contains("signed by an authority"), "{refused}");
    assert_eq!(known.find("localhost:1").unwrap(), Some(KnownIdentity::ByAuthority));
    known.remember("localhost:1", accepted).unwrap();
    assert_eq!(alone.handshake(&by_chance).await, Ok(None), "accepted");
    let elsewhere = Server::signed_by_authority("elsewhere", &pem);
    let refused = elsewhere.handshake(&client).await.expect_err("another name");
    assert!(refused.contains("not valid for name"), "{refused}");
    // An unwritable home directory is no reason to refuse the server.
    let unwritable = Trust { known: Some(KnownServers::new("/proc/nowhere/known_servers".into())), ..client };
    assert_eq!(Server::signed_by_authority("localhost", &pem).handshake(&unwritable).await, Ok(None));
}

#[tokio::test]
async fn what_cannot_be_remembered_is_not_trusted() {
    let place = tempfile::tempdir().unwrap();
    let blocked = place.path().join("file");
    std::fs::write(&blocked, "").unwrap();
    let server = Server::self_signed("localhost", false);
    let client = trust(Some(&blocked.join("known_servers")));
    server.handshake(&client).await.expect_err("no directory");
    server.handshake(&trust(None)).await.expect_err("no file");
    let damaged = place.path().join("damaged");
    std::fs::write(&damaged, "localhost:1\n").unwrap();
    let refused = server.handshake(&trust(Some(&damaged))).await;
    let refused = refused.expect_err("damaged");
    assert!(refused.contains("line 1"), "{refused}");
}

#[test]
fn a_certificate_speaks_for_its_names_alone() {
    let params = CertificateParams::new(["cloud.lab", "192.0.2.7", "2001:db8::7"].map(str::to_owned));
    let key = KeyPair::generate().unwrap();
    let certificate = params.unwrap().self_signed(&key).unwrap();
    for (authority, is_spoken_for) in [
        ("cloud.lab", true),
        ("cloud.lab:9090", true),
        ("CLOUD.lab:9090", true),
        ("192.0.2.7:9090", true),
        ("[2001:db8::7]:9090", true),
        ("[2001:db8::7]", true),
        ("192.0.2.8:9090", false),
        ("other.lab:9090", false),
        ("cloud.lab.other", false),
        ("cloud.lab:x", false),
        ("", false),
        (":9090", false),
    ] {
        let spoken = tls::is_valid_for_host(certificate.der(), authority);
        assert_eq!(spoken, is_spoken_for, "{authority}");
    }
}
