//! The certificate authority for robots: its key and certificate, created once, and issuing certificates.

use std::fmt;
use std::fs::OpenOptions;
use std::io::{ErrorKind, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::time::Duration;

use rcgen::{
    BasicConstraints, CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair, KeyUsagePurpose,
    SanType, date_time_ymd,
};
use tokio_rustls::rustls::pki_types::CertificateDer;
use tokio_rustls::rustls::pki_types::pem::{self, PemObject};

use crate::{
    CertificateRequest, Error, Millis, SCHEME, UnreadableCertificate, VerifiedCertificate, client_certificate,
};

/// Time by which a certificate's validity starts earlier, because clocks of other machines may be behind.
const CLOCK_TOLERANCE: Duration = Duration::from_secs(300);

/// Reason why a text (PEM) is no authority.
#[derive(Debug, thiserror::Error)]
pub enum AuthorityPemError {
    /// The certificate is missing or malformed.
    #[error("{0}")]
    Certificate(pem::Error),
    /// The private key is missing.
    #[error("it has no BEGIN PRIVATE KEY")]
    NoKey,
    /// The private key is unusable, or the certificate is not that of an authority.
    #[error(transparent)]
    Issuer(#[from] rcgen::Error),
    /// The certificate cannot be read.
    #[error(transparent)]
    Unreadable(#[from] UnreadableCertificate),
}

/// Certificate authority that signs robots' certificates.
pub struct Authority {
    certificate: CertificateDer<'static>,
    issuer: Issuer<'static, KeyPair>,
    /// Name of the authority (DER), as in the issuer field of its certificates.
    name: Vec<u8>,
}

/// A certificate that was issued.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IssuedRobotCertificate {
    /// The certificate (PEM).
    pub certificate: String,
    /// Time of issue.
    pub issued: Millis,
    /// End of validity, in whole seconds.
    pub expires: Millis,
}

impl fmt::Debug for Authority {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("Authority")
    }
}

impl Authority {
    /// Loads the authority from a file, or creates the file, readable by its owner only.
    pub fn load_or_create(path: &Path) -> Result<Authority, Error> {
        let io = |action| {
            let path = path.to_owned();
            move |source| Error::Io { action, path, source }
        };
        let text = match std::fs::read_to_string(path) {
            Ok(text) => text,
            Err(error) if error.kind() == ErrorKind::NotFound => {
                let text =
                    generate().map_err(|source| Error::Unmade { what: "robots' authority".to_owned(), source })?;
                // The file is written atomically.
                let half = path.with_extension("half");
                let _ = std::fs::remove_file(&half);
                let mut file =
                    OpenOptions::new().write(true).create_new(true).mode(0o600).open(&half).map_err(io("make"))?;
                file.write_all(text.as_bytes())
                    .and_then(|()| file.sync_all())
                    .and_then(|()| std::fs::rename(&half, path))
                    .map_err(io("write"))?;
                text
            }
            Err(error) => return Err(io("read")(error)),
        };
        Self::from_pem(&text).map_err(|reason| Error::NoAuthority { path: path.to_owned(), reason })
    }

    /// Parses a certificate and its key.
    fn from_pem(text: &str) -> Result<Authority, AuthorityPemError> {
        let certificate = CertificateDer::from_pem_slice(text.as_bytes()).map_err(AuthorityPemError::Certificate)?;
        let key = KeyPair::from_pem(find_private_key(text)?)?;
        let name = client_certificate::subject_der(&certificate)?;
        let issuer = Issuer::from_ca_cert_der(&certificate, key)?;
        Ok(Authority { certificate, issuer, name })
    }

    /// Returns the authority's own certificate, the trust anchor for those it issues.
    pub fn certificate(&self) -> &CertificateDer<'static> {
        &self.certificate
    }

    /// Returns true if this authority issued the verified certificate.
    pub fn has_issued(&self, shown: &VerifiedCertificate) -> bool {
        shown.issuer == self.name
    }

    /// Issues a certificate to a robot, valid for `lifetime` from `now`.
    pub fn issue(
        &self,
        request: &CertificateRequest,
        robot: &str,
        now: Millis,
        lifetime: Duration,
    ) -> Result<IssuedRobotCertificate, Error> {
        let unmade = |source| Error::Unmade { what: format!("{SCHEME}{robot}"), source };
        // Certificates count in whole seconds (RFC 5280, section 4.1.2.5).
        let now_seconds = now / 1000;
        let end_seconds = now_seconds.saturating_add(lifetime.as_secs().max(1));
        let at = |seconds: u64| date_time_ymd(1970, 1, 1) + Duration::from_secs(seconds);
        let mut params = CertificateParams::default();
        let name = format!("{SCHEME}{robot}");
        params.distinguished_name = rcgen::DistinguishedName::new();
        params.distinguished_name.push(DnType::CommonName, name.as_str());
        params.subject_alt_names = vec![SanType::URI(name.try_into().map_err(unmade)?)];
        params.not_before = at(now_seconds.saturating_sub(CLOCK_TOLERANCE.as_secs()));
        // notAfter is inclusive.
        params.not_after = at(end_seconds - 1);
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ClientAuth];
        params.use_authority_key_identifier_extension = true;
        let certificate = params.signed_by(request.public_key(), &self.issuer).map_err(unmade)?;
        Ok(IssuedRobotCertificate {
            certificate: certificate.pem(),
            issued: now_seconds * 1000,
            expires: end_seconds * 1000,
        })
    }
}

/// Returns a PEM file from its private key on.
fn find_private_key(text: &str) -> Result<&str, AuthorityPemError> {
    const BEGIN: &str = "-----BEGIN PRIVATE KEY-----";
    let at = text.find(BEGIN).ok_or(AuthorityPemError::NoKey)?;
    Ok(&text[at..])
}

/// Generates a self-signed authority. It does not expire, like the daemon's own certificate, because robots know it
/// by nothing else.
fn generate() -> Result<String, rcgen::Error> {
    let mut params = CertificateParams::default();
    let key = KeyPair::generate()?;
    // A unique name, so that certificates of another daemon are recognised before their signature is verified.
    let id = hex::encode(&crate::client_certificate::hash_key(rcgen::PublicKeyData::der_bytes(&key))[..8]);
    params.distinguished_name = rcgen::DistinguishedName::new();
    params.distinguished_name.push(DnType::CommonName, format!("cloudroid robots {id}"));
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    params.not_before = date_time_ymd(2000, 1, 1);
    params.not_after = date_time_ymd(9999, 12, 31);
    let certificate = params.self_signed(&key)?;
    Ok(certificate.pem() + &key.serialize_pem())
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    fn request(robot: &str) -> (KeyPair, CertificateRequest) {
        let key = KeyPair::generate().expect("a key");
        let mut params = CertificateParams::default();
        params.distinguished_name = rcgen::DistinguishedName::new();
        params.distinguished_name.push(DnType::CommonName, format!("{SCHEME}{robot}"));
        let text = params.serialize_request(&key).expect("made").pem().expect("PEM");
        let request = CertificateRequest::parse(&text, robot).expect("good");
        (key, request)
    }

    #[test]
    fn an_authority_is_made_once_and_is_its_owners_alone() {
        let place = tempfile::tempdir().expect("a directory");
        let path = place.path().join("authority.pem");
        let made = Authority::load_or_create(&path).expect("made").certificate;
        assert_eq!(Authority::load_or_create(&path).expect("read").certificate, made);
        let mode = path.metadata().expect("there").permissions().mode() & 0o7777;
        assert_eq!(mode, 0o600);
        assert_eq!(std::fs::read_dir(place.path()).expect("there").count(), 1);
        let text = std::fs::read_to_string(&path).expect("there");
        let (certificate, _) = text.split_at(text.find("-----BEGIN PRIVATE").expect("a key"));
        for damaged in ["rubbish", certificate, &text[certificate.len()..]] {
            std::fs::write(&path, damaged).expect("written");
            let refused = Authority::load_or_create(&path).expect_err("none").to_string();
            assert!(
                refused.contains("authority.pem holds no certificate with its key")
                    && refused.contains("pair all robots again"),
                "{refused}"
            );
        }
    }

    #[test]
    fn a_certificate_names_its_robot_its_key_and_its_end() {
        let place = tempfile::tempdir().expect("a directory");
        let authority = Authority::load_or_create(&place.path().join("a.pem")).expect("made");
        let other = Authority::load_or_create(&place.path().join("b.pem")).expect("made");
        let (_, request) = request("rover1");
        let week = Duration::from_secs(7 * 86_400);
        let now = 1_800_000_000_123;
        let issued = authority.issue(&request, "rover1", now, week).expect("made");
        assert_eq!((issued.issued, issued.expires), (1_800_000_000_000, 1_800_604_800_000));
        let der = CertificateDer::from_pem_slice(issued.certificate.as_bytes()).expect("PEM");
        let shown = client_certificate::read_robot_certificate(&der).expect("readable");
        assert_eq!((&*shown.robot, &*shown.key, shown.until), ("rover1", request.key_hash(), issued.expires));
        assert!(authority.has_issued(&shown) && !other.has_issued(&shown));
        // The authority's own certificate names no robot.
        let refused = client_certificate::read_robot_certificate(authority.certificate()).expect_err("an authority");
        assert!(refused.to_string().contains("robot:NAME"), "{refused}");
    }
}
