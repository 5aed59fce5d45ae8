use rcgen::{
    BasicConstraints, CertificateParams, CertificateRevocationListParams, CertifiedIssuer, DnType, IsCa, KeyIdMethod,
    KeyPair, KeyUsagePurpose, RevokedCertParams, SerialNumber,
};
use tokio::net::TcpListener;
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::ClientConfig;

use super::*;

type Lab = CertifiedIssuer<'static, KeyPair>;

fn lab(name: &str) -> Lab {
    let mut params = CertificateParams::default();
    params.distinguished_name.push(DnType::CommonName, name);
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    CertifiedIssuer::self_signed(params, KeyPair::generate().expect("a key")).expect("signed")
}

/// Creates a robot's certificate with this serial number, and its key.
fn robot(lab: &Lab, number: u64) -> (CertificateDer<'static>, PrivateKeyDer<'static>) {
    let key = KeyPair::generate().expect("a key");
    let mut params = CertificateParams::new(vec!["localhost".to_owned()]).expect("names");
    params.serial_number = Some(SerialNumber::from(number));
    let signed = params.signed_by(&key, lab).expect("signed");
    let der = key.serialize_der();
    (signed.der().clone(), PrivateKeyDer::Pkcs8(der.into()))
}

/// Creates an expired revocation list of the authority that names this serial number.
fn list(lab: &Lab, number: u64) -> CertificateRevocationListDer<'static> {
    let then = rcgen::date_time_ymd(2020, 1, 1);
    let named = RevokedCertParams {
        serial_number: SerialNumber::from(number),
        revocation_time: then,
        reason_code: None,
        invalidity_date: None,
    };
    let params = CertificateRevocationListParams {
        this_update: then,
        next_update: rcgen::date_time_ymd(2020, 1, 2),
        crl_number: SerialNumber::from(1),
        issuing_distribution_point: None,
        revoked_certs: vec![named],
        key_identifier_method: KeyIdMethod::Sha256,
    };
    let signed = params.signed_by(lab).expect("signed");
    CertificateRevocationListDer::from(signed.der().to_vec())
}

/// Returns why a client with this certificate is refused, if it is.
async fn refusal(
    tls: &Tls,
    server: &CertificateDer<'static>,
    (certificate, key): (CertificateDer<'static>, PrivateKeyDer<'static>),
) -> Option<String> {
    let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("bound");
    let mut roots = RootCertStore::empty();
    roots.add(server.clone()).expect("a certificate");
    let provider = Arc::new(ring::default_provider());
    let config = ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .expect("versions")
        .with_root_certificates(roots)
        .with_client_auth_cert(vec![certificate], key)
        .expect("a certificate and its key");
    let asking = async {
        let stream = TcpStream::connect(address).await.expect("listening");
        let name = "localhost".try_into().expect("a name");
        let connector = TlsConnector::from(Arc::new(config));
        let mut stream = connector.connect(name, stream).await?;
        stream.write_all(b"GET / HTTP/1.1\r\n\r\n").await
    };
    let accepting = async {
        let (stream, _) = listener.accept().await.expect("a client");
        tls.accept(stream).await
    };
    let (accepted, _) = tokio::join!(accepting, asking);
    accepted.err().and_then(|error| refused_certificate(&error))
}

#[tokio::test]
async fn what_a_list_names_is_refused_until_another_list_does_not() {
    let (own, lab) = (lab("own"), lab("lab"));
    let (certificate, key) = robot(&own, 1);
    let server = own.der().clone();
    let tls = Tls::new(vec![certificate], key, own.der(), vec![lab.der().clone()]).expect("usable");
    assert_eq!(refusal(&tls, &server, robot(&lab, 7)).await, None);
    tls.set_revocation_lists(vec![list(&lab, 7)]).expect("a list");
    let refused = refusal(&tls, &server, robot(&lab, 7)).await.expect("refused");
    assert!(refused.to_lowercase().contains("revoked"), "{refused}");
    assert_eq!(refusal(&tls, &server, robot(&lab, 8)).await, None);
    assert_eq!(refusal(&tls, &server, robot(&own, 7)).await, None, "of another authority");
    tls.set_revocation_lists(vec![CertificateRevocationListDer::from(vec![1, 2])]).expect_err("no list");
    refusal(&tls, &server, robot(&lab, 7)).await.expect("the one before holds");
    tls.set_revocation_lists(vec![list(&lab, 9)]).expect("a list");
    assert_eq!(refusal(&tls, &server, robot(&lab, 7)).await, None);
}
