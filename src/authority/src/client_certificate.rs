//! Contents of a client certificate that rustls has verified.

use sha2::{Digest, Sha256};
use tokio_rustls::rustls::pki_types::CertificateDer;
use x509_parser::certificate::X509Certificate;
use x509_parser::error::X509Error;
use x509_parser::extensions::GeneralName;
use x509_parser::nom;
use x509_parser::prelude::FromDer;

use crate::{Error, Millis, SCHEME};

/// A robot's certificate.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct VerifiedCertificate {
    /// Name of the robot.
    pub robot: String,
    /// SHA-256 hash of the robot's key in hexadecimal.
    pub key: String,
    /// End of the certificate's validity.
    pub until: Millis,
    /// Name of the issuer (DER).
    pub(crate) issuer: Vec<u8>,
}

pub(crate) fn hash_key(key: &[u8]) -> [u8; 32] {
    Sha256::digest(key).into()
}

/// The error of bytes that are no certificate.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct UnreadableCertificate(nom::Err<X509Error>);

fn parse_certificate<'a>(certificate: &'a CertificateDer<'_>) -> Result<X509Certificate<'a>, UnreadableCertificate> {
    let (_, parsed) = X509Certificate::from_der(certificate).map_err(UnreadableCertificate)?;
    Ok(parsed)
}

/// Returns the subject of a certificate (DER).
pub(crate) fn subject_der(certificate: &CertificateDer<'_>) -> Result<Vec<u8>, UnreadableCertificate> {
    Ok(parse_certificate(certificate)?.subject().as_raw().to_vec())
}

/// Validity period of a certificate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ValidityPeriod {
    /// Start of the period.
    pub from: Millis,
    /// End of the period, exclusive: `notAfter` is inclusive (RFC 5280, section 4.1.2.5), so this is one second
    /// later.
    pub until: Millis,
}

/// Reads the validity period of any certificate. Times before 1970 count as 1970.
pub fn read_validity(certificate: &CertificateDer<'_>) -> Result<ValidityPeriod, UnreadableCertificate> {
    Ok(validity_period(&parse_certificate(certificate)?))
}

fn validity_period(parsed: &X509Certificate<'_>) -> ValidityPeriod {
    let validity = parsed.validity();
    let millis = |seconds: i64| Millis::try_from(seconds).unwrap_or(0).saturating_mul(1000);
    ValidityPeriod {
        from: millis(validity.not_before.timestamp()),
        until: millis(validity.not_after.timestamp().saturating_add(1)),
    }
}

/// Reads a robot's certificate. Its name is `robot:NAME`, as a URI among the subject alternative names or, if there
/// is none, as the subject's common name.
pub fn read_robot_certificate(certificate: &CertificateDer<'_>) -> Result<VerifiedCertificate, Error> {
    let parsed = parse_certificate(certificate).map_err(|error| Error::Nameless(error.to_string()))?;
    let mut names: Vec<&str> = Vec::new();
    let alternative = parsed.subject_alternative_name().map_err(|error| Error::Nameless(error.to_string()))?;
    for name in alternative.iter().flat_map(|all| &all.value.general_names) {
        if let GeneralName::URI(uri) = name {
            names.extend(uri.strip_prefix(SCHEME));
        }
    }
    if names.is_empty() {
        let common = parsed.subject().iter_common_name();
        let common = common.filter_map(|name| name.as_str().ok());
        names.extend(common.filter_map(|name| name.strip_prefix(SCHEME)));
    }
    names.dedup();
    let [robot] = names.as_slice() else {
        return Err(Error::Nameless(match names.len() {
            0 => format!("its subject is {:?}", parsed.subject().to_string()),
            _ => "it names several".to_owned(),
        }));
    };
    Ok(VerifiedCertificate {
        robot: (*robot).to_owned(),
        key: hex::encode(hash_key(&parsed.public_key().subject_public_key.data)),
        until: validity_period(&parsed).until,
        issuer: parsed.issuer().as_raw().to_vec(),
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rcgen::{CertificateParams, DistinguishedName, DnType, KeyPair, SanType};

    use super::*;

    fn read_name(common: Option<&str>, uris: &[&str]) -> Result<String, String> {
        let key = KeyPair::generate().expect("a key");
        let mut params = CertificateParams::default();
        params.distinguished_name = DistinguishedName::new();
        if let Some(common) = common {
            params.distinguished_name.push(DnType::CommonName, common);
        }
        let uri = |uri: &&str| SanType::URI((*uri).try_into().expect("ASCII"));
        params.subject_alt_names = uris.iter().map(uri).collect();
        let made = params.self_signed(&key).expect("made");
        let read = read_robot_certificate(made.der());
        read.map(|shown| shown.robot).map_err(|error| error.to_string())
    }

    /// A third-party authority puts the name where its tools do.
    #[test]
    fn the_name_stands_among_the_alternative_ones_or_in_the_subject() {
        assert_eq!(read_name(None, &["robot:r1"]), Ok("r1".into()));
        assert_eq!(read_name(Some("robot:r1"), &[]), Ok("r1".into()));
        assert_eq!(read_name(Some("robot:r2"), &["https://x", "robot:r1"]), Ok("r1".into()));
        for (common, uris) in [
            (None, &[][..]),
            (Some("r1"), &[]),
            (Some("alice"), &["https://robot:r1"]),
            (None, &["robot:r1", "robot:r2"]),
        ] {
            let refused = read_name(common, uris).expect_err("no robot");
            assert!(refused.contains("names no robot"), "{refused}");
        }
    }

    proptest! {
        #[test]
        fn bytes_that_are_no_certificate_name_nobody(der in prop::collection::vec(any::<u8>(), 0..300)) {
            prop_assert!(read_robot_certificate(&CertificateDer::from(der)).is_err());
        }
    }
}
