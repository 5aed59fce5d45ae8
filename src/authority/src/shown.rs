//! What a certificate says that a connection has shown and rustls has verified.

use sha2::{Digest, Sha256};
use tokio_rustls::rustls::pki_types::CertificateDer;
use x509_parser::certificate::X509Certificate;
use x509_parser::extensions::GeneralName;
use x509_parser::prelude::FromDer;

use crate::{Error, Millis, SCHEME};

/// Of whom a certificate is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Shown {
    /// The robot.
    pub robot: String,
    /// SHA-256 of its key, in hexadecimal digits.
    pub key: String,
    /// The certificate's end.
    pub until: Millis,
    /// Who signed it, by name (DER).
    pub(crate) issuer: Vec<u8>,
}

pub(crate) fn hash(key: &[u8]) -> [u8; 32] {
    Sha256::digest(key).into()
}

fn parsed<'a>(certificate: &'a CertificateDer<'_>) -> Result<X509Certificate<'a>, String> {
    match X509Certificate::from_der(certificate) {
        Ok((_, parsed)) => Ok(parsed),
        Err(error) => Err(error.to_string()),
    }
}

/// The name of whom a certificate is (DER).
pub(crate) fn subject(certificate: &CertificateDer<'_>) -> Result<Vec<u8>, String> {
    Ok(parsed(certificate)?.subject().as_raw().to_vec())
}

/// From when to when a certificate is good.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Period {
    /// Its beginning.
    pub from: Millis,
    /// Its end: that of the last second in which it is good (RFC 5280, section 4.1.2.5, counts that in).
    pub until: Millis,
}

/// Reads from when to when any certificate is good. Times before 1970 are 1970.
pub fn period(certificate: &CertificateDer<'_>) -> Result<Period, String> {
    Ok(period_of(&parsed(certificate)?))
}

fn period_of(parsed: &X509Certificate<'_>) -> Period {
    let validity = parsed.validity();
    let millis = |seconds: i64| Millis::try_from(seconds).unwrap_or(0).saturating_mul(1000);
    Period {
        from: millis(validity.not_before.timestamp()),
        until: millis(validity.not_after.timestamp().saturating_add(1)),
    }
}

/// Reads a robot's certificate: its name is `robot:NAME` as URI among the subject alternative names or, where there is none, as
/// the subject's common name.
pub fn read(certificate: &CertificateDer<'_>) -> Result<Shown, Error> {
    let parsed = parsed(certificate).map_err(Error::Nameless)?;
    let mut names: Vec<&str> = Vec::new();
    let alternative = parsed
        .subject_alternative_name()
        .map_err(|error| Error::Nameless(error.to_string()))?;
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
    Ok(Shown {
        robot: (*robot).to_owned(),
        key: hex::encode(hash(&parsed.public_key().subject_public_key.data)),
        until: period_of(&parsed).until,
        issuer: parsed.issuer().as_raw().to_vec(),
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use rcgen::{CertificateParams, DistinguishedName, DnType, KeyPair, SanType};

    use super::*;

    fn named(common: Option<&str>, uris: &[&str]) -> Result<String, String> {
        let key = KeyPair::generate().expect("a key");
        let mut params = CertificateParams::default();
        params.distinguished_name = DistinguishedName::new();
        if let Some(common) = common {
            params.distinguished_name.push(DnType::CommonName, common);
        }
        let uri = |uri: &&str| SanType::URI((*uri).try_into().expect("ASCII"));
        params.subject_alt_names = uris.iter().map(uri).collect();
        let made = params.self_signed(&key).expect("made");
        let read = read(made.der());
        read.map(|shown| shown.robot)
            .map_err(|error| error.to_string())
    }

    /// A lab's own authority writes the name where its tools do.
    #[test]
    fn the_name_stands_among_the_alternative_ones_or_in_the_subject() {
        assert_eq!(named(None, &["robot:r1"]), Ok("r1".into()));
        assert_eq!(named(Some("robot:r1"), &[]), Ok("r1".into()));
        assert_eq!(
            named(Some("robot:r2"), &["https://x", "robot:r1"]),
            Ok("r1".into())
        );
        for (common, uris) in [
            (None, &[][..]),
            (Some("r1"), &[]),
            (Some("alice"), &["https://robot:r1"]),
            (None, &["robot:r1", "robot:r2"]),
        ] {
            let refused = named(common, uris).expect_err("no robot");
            assert!(refused.contains("names no robot"), "{refused}");
        }
    }

    proptest! {
        #[test]
        fn bytes_that_are_no_certificate_name_nobody(der in prop::collection::vec(any::<u8>(), 0..300)) {
            prop_assert!(read(&CertificateDer::from(der)).is_err());
        }
    }
}
