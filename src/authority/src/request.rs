//! Certificate signing requests of robots: PKCS #10 (RFC 2986), sent by whoever presented a pairing code or a
//! certificate.

use rcgen::{
    CertificateSigningRequestParams, DnType, DnValue, PKCS_ECDSA_P256_SHA256, PKCS_ED25519, PublicKey, PublicKeyData,
    SanType,
};
use tokio_rustls::rustls::pki_types::CertificateSigningRequestDer;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use x509_parser::certification_request::X509CertificationRequest;
use x509_parser::oid_registry::{OID_EC_P256, OID_KEY_TYPE_EC_PUBLIC_KEY, OID_SIG_ED25519};
use x509_parser::prelude::FromDer;

use crate::{Error, SCHEME, client_certificate};

/// Maximum size of a request in bytes; one with a P-256 key has about 500.
pub const LONGEST: usize = 4096;

/// A signing request whose signature was verified, which proves that the sender holds the key.
#[derive(Debug, Clone)]
pub struct CertificateRequest {
    key: PublicKey,
    hash: String,
}

impl CertificateRequest {
    /// Parses a request (PEM) for a robot's certificate. It may name this robot only, or nobody.
    pub fn parse(text: &str, robot: &str) -> Result<CertificateRequest, Error> {
        if text.len() > LONGEST {
            return Err(Error::TooLong(text.len()));
        }
        let der = CertificateSigningRequestDer::from_pem_slice(text.as_bytes())
            .map_err(|error| Error::NoRequest(error.to_string()))?;
        // Signatures of unsupported key types are not verified.
        if !has_supported_key(&der)? {
            return Err(Error::Kind);
        }
        let read = CertificateSigningRequestParams::from_der(&der).map_err(|error| match error {
            rcgen::Error::UnsupportedSignatureAlgorithm => Error::Kind,
            error => Error::NoRequest(error.to_string()),
        })?;
        let wanted = format!("{SCHEME}{robot}");
        let other = |found: String| Error::OtherName { found, robot: robot.to_owned() };
        for (kind, value) in read.params.distinguished_name.iter() {
            let text = name_text(value);
            if *kind != DnType::CommonName || text != wanted {
                return Err(other(text));
            }
        }
        for name in &read.params.subject_alt_names {
            match name {
                SanType::URI(uri) if uri.as_str() == wanted => {}
                SanType::URI(uri) => return Err(other(uri.as_str().to_owned())),
                SanType::DnsName(name) => return Err(other(name.as_str().to_owned())),
                _ => return Err(other("another kind of name".to_owned())),
            }
        }
        let key = read.public_key;
        let bytes = PublicKeyData::der_bytes(&key);
        // The algorithm is that of the signature; the key itself may be on another curve.
        let known = match PublicKeyData::algorithm(&key) {
            algorithm if *algorithm == PKCS_ECDSA_P256_SHA256 => bytes.len() == 65 && bytes[0] == 4,
            algorithm if *algorithm == PKCS_ED25519 => bytes.len() == 32,
            _ => false,
        };
        if !known {
            return Err(Error::Kind);
        }
        Ok(CertificateRequest { hash: hex::encode(client_certificate::hash_key(bytes)), key })
    }

    /// Returns the SHA-256 hash of the key in hexadecimal.
    pub fn key_hash(&self) -> &str {
        &self.hash
    }

    pub(crate) fn public_key(&self) -> &PublicKey {
        &self.key
    }
}

/// Returns true if the key is P-256 (RFC 5480, section 2.1.1) or Ed25519 (RFC 8410, section 3).
fn has_supported_key(der: &CertificateSigningRequestDer<'_>) -> Result<bool, Error> {
    let (_, read) = X509CertificationRequest::from_der(der).map_err(|error| Error::NoRequest(error.to_string()))?;
    let kind = &read.certification_request_info.subject_pki.algorithm;
    let curve = kind.parameters.as_ref();
    let curve = curve.and_then(|parameters| parameters.as_oid().ok());
    Ok(match &kind.algorithm {
        algorithm if *algorithm == OID_KEY_TYPE_EC_PUBLIC_KEY => curve == Some(OID_EC_P256),
        algorithm => *algorithm == OID_SIG_ED25519,
    })
}

fn name_text(value: &DnValue) -> String {
    match value {
        DnValue::Utf8String(text) => text.clone(),
        DnValue::PrintableString(text) => text.as_str().to_owned(),
        DnValue::Ia5String(text) => text.as_str().to_owned(),
        _ => "a name in an unsupported encoding".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rcgen::{CertificateParams, DistinguishedName, KeyPair, PKCS_ECDSA_P384_SHA384};

    use super::*;

    fn request_pem(key: &KeyPair, names: &[(DnType, &str)], alternative: Vec<SanType>) -> String {
        let mut params = CertificateParams::default();
        params.distinguished_name = DistinguishedName::new();
        for (kind, name) in names {
            params.distinguished_name.push(kind.clone(), *name);
        }
        params.subject_alt_names = alternative;
        params.serialize_request(key).expect("made").pem().expect("PEM")
    }

    fn uri(text: &str) -> SanType {
        SanType::URI(text.try_into().expect("ASCII"))
    }

    #[test]
    fn a_robot_asks_for_itself_or_says_no_name() {
        let key = KeyPair::generate().expect("a key");
        let ed25519 = KeyPair::generate_for(&PKCS_ED25519).expect("a key");
        let own = (DnType::CommonName, "robot:r1");
        let first = CertificateRequest::parse(&request_pem(&key, &[], Vec::new()), "r1").expect("nameless");
        for text in
            [request_pem(&key, std::slice::from_ref(&own), Vec::new()), request_pem(&key, &[], vec![uri("robot:r1")])]
        {
            assert_eq!(CertificateRequest::parse(&text, "r1").expect("its own").hash, first.hash);
        }
        CertificateRequest::parse(&request_pem(&ed25519, &[own], Vec::new()), "r1").expect("Ed25519");
    }

    #[test]
    fn what_asks_for_another_name_is_refused_with_both() {
        let key = KeyPair::generate().expect("a key");
        for text in [
            request_pem(&key, &[(DnType::CommonName, "robot:r2")], Vec::new()),
            request_pem(&key, &[(DnType::CommonName, "r1")], Vec::new()),
            request_pem(&key, &[(DnType::OrganizationName, "robot:r1")], Vec::new()),
            request_pem(&key, &[], vec![uri("robot:r1"), uri("robot:r2")]),
            request_pem(&key, &[], vec![SanType::DnsName("server".try_into().expect("a name"))]),
            request_pem(&key, &[], vec![SanType::IpAddress([10, 0, 0, 1].into())]),
        ] {
            let refused = CertificateRequest::parse(&text, "r1").expect_err(&text).to_string();
            assert!(refused.contains("is for robot:r1"), "{refused}");
        }
    }

    #[test]
    fn other_kinds_of_keys_are_refused_with_those_that_are_taken() {
        let key = KeyPair::generate_for(&PKCS_ECDSA_P384_SHA384).expect("a key");
        // Made by openssl: req -new -newkey rsa:1024 -nodes -subj /CN=robot:r1
        let weak = include_str!("../tests/rsa1024.csr");
        for text in [&*request_pem(&key, &[], Vec::new()), weak] {
            let refused = CertificateRequest::parse(text, "r1").expect_err(text).to_string();
            assert!(refused.contains("P-256 or Ed25519"), "{refused}");
        }
    }

    #[test]
    fn what_is_no_request_is_refused() {
        let key = KeyPair::generate().expect("a key");
        let good = request_pem(&key, &[], Vec::new());
        let certificate = CertificateParams::default().self_signed(&key).expect("made").pem();
        // Flips a bit of the key or of the signature.
        let turned = |at: usize| {
            let mut der = CertificateSigningRequestDer::from_pem_slice(good.as_bytes()).expect("PEM").to_vec();
            let at = if at == 0 { der.len() - 1 } else { at };
            der[at] ^= 1;
            let encoded = encode_base64(&der);
            format!("-----BEGIN CERTIFICATE REQUEST-----\n{encoded}\n-----END CERTIFICATE REQUEST-----\n")
        };
        for text in ["", "rubbish", &certificate, &good[..good.len() / 2], &turned(0)] {
            let refused = CertificateRequest::parse(text, "r1").expect_err(text).to_string();
            assert!(refused.contains("not a certificate request"), "{refused}");
        }
        let long = good + &" ".repeat(LONGEST);
        let refused = CertificateRequest::parse(&long, "r1").expect_err("long").to_string();
        assert!(refused.contains("at most 4096 bytes"), "{refused}");
    }

    fn encode_base64(der: &[u8]) -> String {
        const ALPHABET: &[u8] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
        let mut text = String::new();
        for three in der.chunks(3) {
            let bits = (0..3).fold(0u32, |bits, at| bits << 8 | u32::from(*three.get(at).unwrap_or(&0)));
            for at in 0..4 {
                if at <= three.len() {
                    text.push(char::from(ALPHABET[(bits >> (18 - 6 * at) & 63) as usize]))
                } else {
                    text.push('=')
                }
            }
        }
        text
    }

    proptest! {
        /// Arbitrary bytes are refused without a panic.
        #[test]
        fn bytes_that_are_no_request_are_refused(der in prop::collection::vec(any::<u8>(), 0..300)) {
            let text = format!(
                "-----BEGIN CERTIFICATE REQUEST-----\n{}\n-----END CERTIFICATE REQUEST-----\n",
                encode_base64(&der)
            );
            prop_assert!(CertificateRequest::parse(&text, "r1").is_err());
        }
    }
}
