//! Asking the provider by HTTP: as `openidconnect` asks, and for userinfo.

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
use crate::{BYTES, TIME, is_private};

const ADVICE: &str = "name the authorities of the provider's certificate: authorities in [oidc] of the configuration";

/// Why a request has no answer.
#[derive(Debug, thiserror::Error)]
pub enum Unanswered {
    /// The provider would have this server ask in plain text.
    #[error("it names an address that is not https: {0}")]
    PlainText(String),
    /// No answer.
    #[error(transparent)]
    Outbound(#[from] outbound::Error),
}

/// Asks the provider.
pub struct Http {
    client: outbound::Client,
    /// Whether its issuer is at https: then all of it is.
    secure: bool,
}

impl Http {
    pub fn new(authorities: Option<PathBuf>, secure: bool) -> Http {
        Http {
            client: outbound::Client::new(authorities, ADVICE).bounded(TIME, BYTES),
            secure,
        }
    }

    /// Whether an address that the provider names is as its issuer is.
    pub fn may_ask(&self, url: &Url) -> bool {
        url.scheme() == "https" || (!self.secure && is_private(url))
    }

    async fn send(&self, request: HttpRequest) -> Result<HttpResponse, Unanswered> {
        if self.secure && request.uri().scheme_str() != Some("https") {
            let host = request.uri().host().unwrap_or_default();
            return Err(Unanswered::PlainText(host.to_owned()));
        }
        let request = request.map(|body| Full::new(Bytes::from(body)));
        let answer = self.client.send(request).await?;
        Ok(answer.map(|body| body.to_vec()))
    }

    /// What it says of whoever an access token is of (section 5.3.1).
    pub async fn userinfo(&self, url: &Url, access_token: &str) -> Result<Claims, String> {
        let shown = HeaderValue::from_str(&format!("Bearer {access_token}"))
            .map_err(|_| "its access token cannot be sent".to_owned())?;
        let request = Request::get(url.as_str())
            .header(AUTHORIZATION, shown)
            .header(ACCEPT, "application/json")
            .body(Vec::new())
            .map_err(|error| error.to_string())?;
        let answer = self
            .send(request)
            .await
            .map_err(|error| error.to_string())?;
        if answer.status() != StatusCode::OK {
            return Err(format!("its userinfo is answered by {}", answer.status()));
        }
        Claims::read(answer.body()).map_err(|error| {
            format!("its userinfo is no JSON object with a sub ({error}); signed ones are not read")
        })
    }
}

impl<'c> AsyncHttpClient<'c> for Http {
    type Error = Unanswered;
    type Future = Pin<Box<dyn Future<Output = Result<HttpResponse, Unanswered>> + Send + 'c>>;

    fn call(&'c self, request: HttpRequest) -> Self::Future {
        Box::pin(self.send(request))
    }
}
