//! The daemon's account with the authority (RFC 8555, section 7.3): made at the first time, its key kept in the home.

use std::future::Future;
use std::path::Path;
use std::pin::Pin;

use anyhow::{Context, anyhow};
use bytes::Bytes;
use http_body_util::{BodyExt, Full};
use hyper::Request;
use instant_acme::{
    Account, AccountCredentials, BodyWrapper, BytesResponse, Error, HttpClient, NewAccount,
};
use serde::{Deserialize, Serialize};
use store::private;

use crate::config;

/// Its file.
const FILE: &str = "acme-account.json";
/// Where no authority is known by whom the server could be.
const ADVICE: &str = "no authorities are known by whom it could be: install ca-certificates, or name a PEM file of theirs as authorities \
                      in [tls.acme]";

/// Asks the authority's server.
struct Client(outbound::Client);

impl HttpClient for Client {
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

/// As it is in the file.
#[derive(Serialize, Deserialize)]
struct Kept {
    /// Of which authority.
    directory: String,
    credentials: AccountCredentials,
}

/// The account; made where the home has none with this authority.
pub async fn of_home(acme: &config::Acme, home: &Path) -> anyhow::Result<Account> {
    let client = outbound::Client::new(acme.authorities.clone(), ADVICE);
    let builder = Account::builder_with_http(Box::new(Client(client)));
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
    let kept = kept.map(|bytes| serde_json::from_slice::<Kept>(&bytes));
    let kept = kept.transpose().with_context(|| {
        format!(
            "{} holds no account; remove it, and another is made",
            path.display()
        )
    })?;
    if let Some(kept) = kept.filter(|kept| kept.directory == acme.directory) {
        return Ok(builder.from_credentials(kept.credentials).await?);
    }
    let contact: Vec<&str> = acme.contact.iter().map(String::as_str).collect();
    let new = NewAccount {
        contact: &contact,
        terms_of_service_agreed: acme.accept_terms,
        only_return_existing: false,
    };
    let (account, credentials) = builder
        .create(&new, acme.directory.clone(), None)
        .await
        .map_err(|error| anyhow!("no account is to be had: {error}"))?;
    let text = serde_json::to_vec(&Kept {
        directory: acme.directory.clone(),
        credentials,
    })?;
    let file = path.clone();
    privilege::run(async move { private::replace(&file, &text) })
        .await
        .with_context(|| format!("cannot keep the account in {}", path.display()))?;
    Ok(account)
}

/// Whether something failed because the authority knows no such account (RFC 8555, section 6.7).
pub fn is_unknown(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| match cause.downcast_ref() {
        Some(Error::Api(problem)) => {
            problem.r#type.as_deref() == Some("urn:ietf:params:acme:error:accountDoesNotExist")
        }
        _ => false,
    })
}

/// Forgets the account, so that another is made.
pub async fn forget(home: &Path) -> anyhow::Result<()> {
    let path = home.join(FILE);
    let file = path.clone();
    privilege::run(async move { std::fs::remove_file(file) })
        .await
        .with_context(|| format!("cannot remove {}", path.display()))
}
