//! The daemon's account with the authority (RFC 8555, section 7.3): created at first use, its key kept in the home.

use std::future::Future;
use std::path::Path;
use std::pin::Pin;

use anyhow::{Context, anyhow};
use bytes::Bytes;
use http_body_util::{BodyExt, Full};
use hyper::Request;
use instant_acme::{Account, AccountCredentials, BodyWrapper, BytesResponse, Error, HttpClient, NewAccount};
use serde::{Deserialize, Serialize};
use store::private;

use crate::config;

/// File of the account.
const FILE: &str = "acme-account.json";
/// Advice when no authorities are known by which the server's certificate could be checked.
const ADVICE: &str = "no certificate authorities are installed to verify it: install ca-certificates, or set \
    authorities in [tls.acme] to a PEM file";

/// HTTP client for requests to the authority's server.
struct AcmeClient(outbound::OutboundClient);

impl HttpClient for AcmeClient {
    fn request(
        &self,
        request: Request<BodyWrapper<Bytes>>,
    ) -> Pin<Box<dyn Future<Output = Result<BytesResponse, Error>> + Send>> {
        let client = self.0.clone();
        Box::pin(async move {
            let (parts, body) = request.into_parts();
            let body = body.collect().await.unwrap_or_else(|never| match never {});
            let request = Request::from_parts(parts, Full::new(body.to_bytes()));
            let answer = client.send(request).await;
            let answer = answer.map_err(|error| Error::Other(Box::new(error)))?;
            Ok(BytesResponse::from(answer.map(Full::new)))
        })
    }
}

/// The account as written to its file.
#[derive(Serialize, Deserialize)]
struct StoredAccount {
    /// Directory URL of the authority.
    directory: String,
    credentials: AccountCredentials,
}

/// Loads the account, or creates one if the home has none with this authority.
pub async fn load_or_create(acme: &config::AcmeConfig, home: &Path) -> anyhow::Result<Account> {
    let client = outbound::OutboundClient::new(acme.authorities.clone(), ADVICE);
    let builder = Account::builder_with_http(Box::new(AcmeClient(client)));
    let path = home.join(FILE);
    let file = path.clone();
    let kept = privilege::run(async move {
        match std::fs::read(&file) {
            Ok(bytes) => Ok(Some(bytes)),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error),
        }
    })
    .await
    .with_context(|| format!("cannot read {}", path.display()))?;
    let kept = kept.map(|bytes| serde_json::from_slice::<StoredAccount>(&bytes));
    let kept = kept
        .transpose()
        .with_context(|| format!("{} contains no account; remove it, and a new account is created", path.display()))?;
    if let Some(kept) = kept.filter(|kept| kept.directory == acme.directory) {
        return Ok(builder.from_credentials(kept.credentials).await?);
    }
    let contact: Vec<&str> = acme.contact.iter().map(String::as_str).collect();
    let new = NewAccount { contact: &contact, terms_of_service_agreed: acme.accept_terms, only_return_existing: false };
    let (account, credentials) = builder
        .create(&new, acme.directory.clone(), None)
        .await
        .map_err(|error| anyhow!("cannot create an account: {error}"))?;
    let text = serde_json::to_vec(&StoredAccount { directory: acme.directory.clone(), credentials })?;
    let file = path.clone();
    privilege::run(async move { private::write_atomically(&file, &text) })
        .await
        .with_context(|| format!("cannot write the account to {}", path.display()))?;
    Ok(account)
}

/// Returns whether something failed because the authority does not know the account (RFC 8555, section 6.7).
pub fn is_unknown_account(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| match cause.downcast_ref() {
        Some(Error::Api(problem)) => {
            problem.r#type.as_deref() == Some("urn:ietf:params:acme:error:accountDoesNotExist")
        }
        _ => false,
    })
}

/// Removes the account's file, so that another account is created.
pub async fn forget(home: &Path) -> anyhow::Result<()> {
    let path = home.join(FILE);
    let file = path.clone();
    privilege::run(async move { std::fs::remove_file(file) })
        .await
        .with_context(|| format!("cannot remove {}", path.display()))
}
