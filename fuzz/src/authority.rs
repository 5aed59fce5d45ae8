//! Certificates of robots, and requests for them.

use base64_simd::STANDARD;
use tokio_rustls::rustls::pki_types::CertificateDer;

/// Robot for which certificates are requested.
const ROBOT: &str = "r1";

/// A certificate request (PKCS #10), DER.
pub fn request(data: &[u8]) {
    let text = format!(
        "-----BEGIN CERTIFICATE REQUEST-----\n{}\n-----END CERTIFICATE REQUEST-----\n",
        STANDARD.encode_to_string(data)
    );
    if ::authority::CertificateRequest::parse(&text, ROBOT).is_ok() {
        assert!(
            ::authority::CertificateRequest::parse(&text, "another").is_err()
                || !data.windows(8).any(|bytes| bytes == b"robot:r1"),
            "a request that names a robot is one for another"
        );
    }
}

/// A client certificate of a connection, DER.
pub fn certificate(data: &[u8]) {
    let certificate = CertificateDer::from(data);
    if let Ok(shown) = ::authority::read_robot_certificate(&certificate) {
        let named = format!("robot:{}", shown.robot);
        assert!(data.windows(named.len()).any(|bytes| bytes == named.as_bytes()), "a name that is not in it: {named}");
        let period = ::authority::read_validity(&certificate).expect("it was read");
        assert_eq!(period.until, shown.until);
    }
    // The checks that clients and portal apply to any certificate.
    let _ = tls::is_self_signed(&certificate);
    let _ = tls::is_valid_for_host(&certificate, "robots.lab.example:9090");
}
