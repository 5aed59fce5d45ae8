//! HTTP requests to the provider, made by `openidconnect` and for userinfo.

use std::future::Future;
use std::path::PathBuf;
use std::pin::Pin;

use bytes::Bytes;
use http_body_util::Full;
use openidconnect::http::header::{ACCEPT, AUTHORIZATION, HeaderValue};
use openidconnect::http::{Request, StatusCode};
use openidconnect::url::Url;
use openidconnect::{AsyncHttpClient, HttpRequest, HttpResponse};

use crate::claims::Claims;
use crate::{BYTES, TIME, is_confidential};

const ADVICE: &str = "add the authority of the provider's certificate to authorities in [oidc] of the configuration";

/// Reason why a request failed.
#[derive(Debug, thiserror::Error)]
pub enum ProviderRequestError {
    /// The provider named a URL that is not https.
    #[error("it names an address that is not https: {0}")]
    PlainText(String),
    /// The request failed.
    #[error(transparent)]
    Outbound(#[from] outbound::Error),
}

/// Reason why a person's claims cannot be fetched from the userinfo endpoint.
#[derive(Debug, thiserror::Error)]
pub enum UserinfoError {
    /// The access token cannot be part of a header.
    #[error("its access token cannot be sent")]
    UnsendableToken,
    /// The request cannot be made.
    #[error(transparent)]
    Invalid(#[from] openidconnect::http::Error),
    /// The request failed.
    #[error(transparent)]
    Request(#[from] ProviderRequestError),
    /// The endpoint refused.
    #[error("its userinfo endpoint answered {0}")]
    Status(StatusCode),
    /// The response cannot be read.
    #[error("its userinfo is not a JSON object with a sub ({0}); signed userinfo is not supported")]
    Unreadable(serde_json::Error),
}

/// HTTP client for the provider.
pub struct Http {
    client: outbound::OutboundClient,
    /// True if the issuer uses https; then every request must.
    secure: bool,
}

impl Http {
    pub fn new(authorities: Option<PathBuf>, secure: bool) -> Http {
        Http { client: outbound::OutboundClient::new(authorities, ADVICE).with_limits(TIME, BYTES), secure }
    }

    /// Returns true if a URL named by the provider is as secure as its issuer.
    pub fn is_allowed(&self, url: &Url) -> bool {
        url.scheme() == "https" || (!self.secure && is_confidential(url))
    }

    async fn send(&self, request: HttpRequest) -> Result<HttpResponse, ProviderRequestError> {
        if self.secure && request.uri().scheme_str() != Some("https") {
            let host = request.uri().host().unwrap_or_default();
            return Err(ProviderRequestError::PlainText(host.to_owned()));
        }
        let request = request.map(|body| Full::new(Bytes::from(body)));
        let answer = self.client.send(request).await?;
        Ok(answer.map(|body| body.to_vec()))
    }

    /// Fetches the claims of the access token's owner (section 5.3.1).
    pub async fn fetch_userinfo(&self, url: &Url, access_token: &str) -> Result<Claims, UserinfoError> {
        let shown =
            HeaderValue::from_str(&format!("Bearer {access_token}")).map_err(|_| UserinfoError::UnsendableToken)?;
        let request = Request::get(url.as_str())
            .header(AUTHORIZATION, shown)
            .header(ACCEPT, "application/json")
            .body(Vec::new())?;
        let answer = self.send(request).await?;
        if answer.status() != StatusCode::OK {
            return Err(UserinfoError::Status(answer.status()));
        }
        Claims::from_slice(answer.body()).map_err(UserinfoError::Unreadable)
    }
}

impl<'c> AsyncHttpClient<'c> for Http {
    type Error = ProviderRequestError;
    type Future = Pin<Box<dyn Future<Output = Result<HttpResponse, ProviderRequestError>> + Send + 'c>>;

    fn call(&'c self, request: HttpRequest) -> Self::Future {
        Box::pin(self.send(request))
    }
}
