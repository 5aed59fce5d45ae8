//! Certificates of robots, and requests for them.

use base64_simd::STANDARD;
use tokio_rustls::rustls::pki_types::CertificateDer;

/// The robot for which certificates are asked here.
const ROBOT: &str = "r1";

/// A request for a certificate (PKCS #10), DER.
pub fn request(data: &[u8]) {
    let text = format!(
        "-----BEGIN CERTIFICATE REQUEST-----\n{}\n-----END CERTIFICATE REQUEST-----\n",
        STANDARD.encode_to_string(data)
    );
    if ::authority::Request::read(&text, ROBOT).is_ok() {
        assert!(
            ::authority::Request::read(&text, "another").is_err()
                || !data.windows(8).any(|bytes| bytes == b"robot:r1"),
            "a request that names a robot is one for another"
        );
    }
}

/// A certificate that a connection has shown, DER.
pub fn certificate(data: &[u8]) {
    let certificate = CertificateDer::from(data);
    if let Ok(shown) = ::authority::read(&certificate) {
        let named = format!("robot:{}", shown.robot);
        assert!(
            data.windows(named.len())
                .any(|bytes| bytes == named.as_bytes()),
            "a name that is not in it: {named}"
        );
        let period = ::authority::period(&certificate).expect("it was read");
        assert_eq!(period.until, shown.until);
    }
    // What clients and portal ask of any certificate.
    let _ = tls::signs_itself(&certificate);
    let _ = tls::speaks_for(&certificate, "robots.lab.example:9090");
}
