//! Orders one certificate: proves its names by answering challenges at port 443 (tls-alpn-01, RFC 8737) and fetches it.

use std::net::SocketAddr;
use std::time::Duration;

use anyhow::{Context, bail};
use instant_acme::{
    Account, AuthorizationStatus, ChallengeType, Identifier, NewOrder, Order, OrderStatus, RetryPolicy,
};
use portal::{Challenge, Tls, TlsError};
use rcgen::{CertificateParams, CustomExtension, DistinguishedName, KeyPair};
use tokio_rustls::rustls::pki_types::{PrivateKeyDer, PrivatePkcs8KeyDer};

/// Time allowed for the authority to validate, and again to sign.
const PATIENCE: Duration = Duration::from_secs(120);

/// A certificate that the authority has issued.
pub struct IssuedCertificate {
    /// PEM of the certificate, followed by the rest of its chain.
    pub chain: String,
    /// PEM of its key.
    pub key: String,
}

/// Has a certificate signed for names that resolve to this machine, where the portal answers challenges at `looked_at`.
pub async fn order_certificate(
    account: &Account,
    names: &[String],
    tls: &Tls,
    looked_at: SocketAddr,
) -> anyhow::Result<IssuedCertificate> {
    let identifiers: Vec<Identifier> = names.iter().cloned().map(Identifier::Dns).collect();
    let mut order = account.new_order(&NewOrder::new(&identifiers)).await.context("the authority refused the order")?;
    let patience = RetryPolicy::new().timeout(PATIENCE);
    if order.state().status == OrderStatus::Pending {
        prove_names(&mut order, tls).await?;
        let status = order.poll_ready(&patience).await;
        if !matches!(status, Ok(OrderStatus::Ready)) {
            let reasons = failure_reasons(&mut order).await.join("; ");
            let port = looked_at.port();
            let failed = match status {
                Err(error) => format!("{error}; {reasons}"),
                Ok(_) => reasons,
            };
            bail!(
                "the authority could not verify the names: {failed}. Forward their port 443 to port {port} of this \
                    machine, without a proxy that terminates TLS"
            );
        }
    }
    let key = KeyPair::generate().context("cannot create a key")?;
    let mut params = CertificateParams::new(names)?;
    params.distinguished_name = DistinguishedName::new();
    let request = params.serialize_request(&key)?;
    order.finalize_csr(request.der()).await.context("the authority refused to sign")?;
    let chain = order.poll_certificate(&patience).await.context("cannot fetch the certificate")?;
    Ok(IssuedCertificate { chain, key: key.serialize_pem() })
}

/// Presents the challenge of each name and tells the authority that it may validate.
async fn prove_names(order: &mut Order, tls: &Tls) -> anyhow::Result<()> {
    let mut shown = Vec::new();
    let mut names = order.authorizations();
    while let Some(name) = names.next().await {
        let mut name = name.context("cannot fetch the order")?;
        if name.status != AuthorizationStatus::Pending {
            continue;
        }
        let Some(challenge) = name.challenge(ChallengeType::TlsAlpn01) else {
            bail!(
                "the authority does not offer the challenge tls-alpn-01 (port 443), the only one that this daemon \
                    supports; use another ACME client with certificate and key of [tls]"
            );
        };
        let of = challenge.identifier().to_string();
        let digest = challenge.key_authorization().digest();
        shown.push(challenge_certificate(of, digest.as_ref())?);
    }
    tls.set_challenges(shown).map_err(to_anyhow)?;
    let mut names = order.authorizations();
    while let Some(name) = names.next().await {
        let mut name = name.context("cannot fetch the order")?;
        if name.status != AuthorizationStatus::Pending {
            continue;
        }
        if let Some(mut challenge) = name.challenge(ChallengeType::TlsAlpn01) {
            challenge.set_ready().await.context("cannot start the authority's challenge")?;
        }
    }
    Ok(())
}

/// Returns the certificate that answers the challenge for a name (RFC 8737, section 3).
fn challenge_certificate(name: String, digest: &[u8]) -> anyhow::Result<Challenge> {
    let mut params = CertificateParams::new([name.clone()])?;
    params.custom_extensions = vec![CustomExtension::new_acme_identifier(digest)];
    let key = KeyPair::generate().context("cannot create a key")?;
    let certificate = params.self_signed(&key)?;
    Ok(Challenge {
        name,
        certificate: certificate.der().clone(),
        key: PrivateKeyDer::Pkcs8(PrivatePkcs8KeyDer::from(key.serialize_der())),
    })
}

/// Returns the authority's errors about each name.
async fn failure_reasons(order: &mut Order) -> Vec<String> {
    let mut reasons = Vec::new();
    let mut names = order.authorizations();
    while let Some(Ok(mut name)) = names.next().await {
        let Ok(state) = name.refresh().await else {
            continue;
        };
        let of = state.identifier().to_string();
        let failed = state.challenges.iter().filter_map(|challenge| challenge.error.as_ref());
        reasons.extend(failed.map(|problem| format!("{of}: {problem}")));
    }
    reasons
}

/// Converts the error without its source, whose text it contains already.
pub(super) fn to_anyhow(error: TlsError) -> anyhow::Error {
    anyhow::Error::msg(error.to_string())
}
