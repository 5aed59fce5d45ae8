//! One certificate: ordered, its names proved by answering at port 443 (tls-alpn-01, RFC 8737), fetched.

use std::net::SocketAddr;
use std::time::Duration;

use anyhow::{Context, bail};
use instant_acme::{
    Account, AuthorizationStatus, ChallengeType, Identifier, NewOrder, Order, OrderStatus,
    RetryPolicy,
};
use portal::{Challenge, Tls};
use rcgen::{CertificateParams, CustomExtension, DistinguishedName, KeyPair};
use tokio_rustls::rustls::pki_types::{PrivateKeyDer, PrivatePkcs8KeyDer};

/// How long the authority may take to look, and to sign.
const PATIENCE: Duration = Duration::from_secs(120);

/// What was signed.
pub struct Made {
    /// PEM of the certificate, followed by those that lead to the authority.
    pub chain: String,
    /// PEM of its key.
    pub key: String,
}

/// Has a certificate signed for names that lead to this machine, where the portal answers at `looked_at`.
pub async fn certificate(
    account: &Account,
    names: &[String],
    tls: &Tls,
    looked_at: SocketAddr,
) -> anyhow::Result<Made> {
    let identifiers: Vec<Identifier> = names.iter().cloned().map(Identifier::Dns).collect();
    let mut order = account
        .new_order(&NewOrder::new(&identifiers))
        .await
        .context("the order is refused")?;
    let patience = RetryPolicy::new().timeout(PATIENCE);
    if order.state().status == OrderStatus::Pending {
        prove(&mut order, tls).await?;
        let status = order.poll_ready(&patience).await;
        if !matches!(status, Ok(OrderStatus::Ready)) {
            let reasons = reasons(&mut order).await.join("; ");
            let port = looked_at.port();
            let failed = match status {
                Err(error) => format!("{error}; {reasons}"),
                Ok(_) => reasons,
            };
            bail!(
                "the authority could not see that the names lead here: {failed}. Their port 443 has to be led to port {port} of this \
                 machine, without a proxy that ends TLS"
            );
        }
    }
    let key = KeyPair::generate().context("cannot make a key")?;
    let mut params = CertificateParams::new(names)?;
    params.distinguished_name = DistinguishedName::new();
    let request = params.serialize_request(&key)?;
    order
        .finalize_csr(request.der())
        .await
        .context("the authority does not sign")?;
    let chain = order
        .poll_certificate(&patience)
        .await
        .context("the certificate cannot be fetched")?;
    Ok(Made {
        chain,
        key: key.serialize_pem(),
    })
}

/// Shows what the authority is to see for each name, and says that it may look.
async fn prove(order: &mut Order, tls: &Tls) -> anyhow::Result<()> {
    let mut shown = Vec::new();
    let mut names = order.authorizations();
    while let Some(name) = names.next().await {
        let mut name = name.context("the order cannot be read")?;
        if name.status != AuthorizationStatus::Pending {
            continue;
        }
        let Some(challenge) = name.challenge(ChallengeType::TlsAlpn01) else {
            bail!(
                "the authority does not look at port 443 (tls-alpn-01), which is the only way of this daemon; use another client of \
                 ACME with certificate and key of [tls]"
            );
        };
        let of = challenge.identifier().to_string();
        let digest = challenge.key_authorization().digest();
        shown.push(answer(of, digest.as_ref())?);
    }
    tls.answer(shown).map_err(super::said)?;
    let mut names = order.authorizations();
    while let Some(name) = names.next().await {
        let mut name = name.context("the order cannot be read")?;
        if name.status != AuthorizationStatus::Pending {
            continue;
        }
        if let Some(mut challenge) = name.challenge(ChallengeType::TlsAlpn01) {
            challenge
                .set_ready()
                .await
                .context("the authority cannot be told to look")?;
        }
    }
    Ok(())
}

/// The certificate that proves a name (RFC 8737, section 3).
fn answer(name: String, digest: &[u8]) -> anyhow::Result<Challenge> {
    let mut params = CertificateParams::new([name.clone()])?;
    params.custom_extensions = vec![CustomExtension::new_acme_identifier(digest)];
    let key = KeyPair::generate().context("cannot make a key")?;
    let certificate = params.self_signed(&key)?;
    Ok(Challenge {
        name,
        certificate: certificate.der().clone(),
        key: PrivateKeyDer::Pkcs8(PrivatePkcs8KeyDer::from(key.serialize_der())),
    })
}

/// What the authority has seen instead.
async fn reasons(order: &mut Order) -> Vec<String> {
    let mut reasons = Vec::new();
    let mut names = order.authorizations();
    while let Some(Ok(mut name)) = names.next().await {
        let Ok(state) = name.refresh().await else {
            continue;
        };
        let of = state.identifier().to_string();
        let failed = state
            .challenges
            .iter()
            .filter_map(|challenge| challenge.error.as_ref());
        reasons.extend(failed.map(|problem| format!("{of}: {problem}")));
    }
    reasons
}
