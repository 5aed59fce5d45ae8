//! Sign-in through an identity provider with OpenID Connect Core 1.0: the authorization code flow (section 3.1) with
//! PKCE (RFC 7636), state and nonce.
//!
//! ```text
//!  begin: redirect URL and cookie ─▶ (the provider authenticates the person) ─▶ resume: the pending sign-in, once
//!                                                    ─▶ finish: code ─▶ ID token, verified ─▶ [`Person`]
//! ```
//!
//! [`Roles`] determines what a person may do. The provider is contacted only when somebody signs in; its metadata is
//! cached for an hour.

#![forbid(unsafe_code)]

mod claims;
mod error;
mod http;
mod metadata;
mod pending;
mod roles;
mod token;

use std::net::IpAddr;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use openidconnect::core::CoreAuthenticationFlow;
use openidconnect::url::Url;
use openidconnect::{
    AuthType, AuthorizationCode, ClientId, ClientSecret, CsrfToken, IssuerUrl, Nonce, OAuth2TokenResponse,
    PkceCodeChallenge, PkceCodeVerifier, RedirectUrl, RequestTokenError, Scope, TokenResponse,
};
use parking_lot::Mutex;
use tokio::sync::{Semaphore, SemaphorePermit};

pub use error::Error;
pub use pending::ReturnedSignIn;
pub use roles::{GrantedRole, RoleGroup, Roles};

use http::Http;
use metadata::{DiscoveredProvider, MetadataCache};
use pending::{PendingSignIn, PendingSignIns};
use token::OidcClient;

/// Timeout of a response from the provider, and its maximum size in bytes.
const TIME: Duration = Duration::from_secs(10);
const BYTES: usize = 256 << 10;
/// Limit on concurrent requests to the provider; further ones are told to try again.
const AT_ONCE: usize = 16;
/// Length of the random values that identify a browser or a sign-in, in bytes.
const SECRET: u32 = 32;
/// Maximum length of an authorization code in bytes.
const LONGEST_CODE: usize = 8192;

/// Configuration of the provider.
#[derive(Clone)]
pub struct Settings {
    /// Issuer identifier; its metadata is at `ISSUER/.well-known/openid-configuration`.
    pub issuer: String,
    /// Client identifier of this server.
    pub client_id: String,
    /// Client secret; `None` for a public client.
    pub client_secret: Option<String>,
    /// Redirect URI, to which the provider sends browsers back.
    pub redirect: String,
    /// Scopes requested besides `openid`.
    pub scopes: Vec<String>,
    /// Claim that holds a person's groups.
    pub groups_claim: String,
    /// Claim that holds a person's name.
    pub name_claim: String,
    /// PEM file with the authorities that sign the provider's certificate (default: the system's).
    pub authorities: Option<PathBuf>,
}

/// A person authenticated by the provider.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Person {
    /// Subject identifier (`sub`), unique and permanent at the provider.
    pub subject: String,
    /// Display name, neither unique nor permanent (section 5.7).
    pub name: String,
    /// Groups of the person.
    pub groups: Vec<String>,
}

/// A sign-in that has been started.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SignInRedirect {
    /// URL to which the browser is redirected.
    pub url: String,
    /// Value that identifies the browser when it returns.
    pub browser: String,
}

/// An identity provider.
pub struct Provider {
    settings: Settings,
    issuer: IssuerUrl,
    redirect: RedirectUrl,
    http: Http,
    metadata: MetadataCache,
    pending: Mutex<PendingSignIns>,
    turns: Semaphore,
}

/// Returns true if requests to the URL are encrypted or stay on this machine.
fn is_confidential(url: &Url) -> bool {
    match url.scheme() {
        "https" => true,
        "http" => url.host_str().is_some_and(|host| {
            // IPv6 addresses are in brackets.
            outbound::is_loopback_host(host.trim_matches(['[', ']']))
        }),
        _ => false,
    }
}

impl Provider {
    /// Creates a provider; it is contacted later.
    pub fn new(settings: Settings) -> Result<Provider, Error> {
        let address = |text: &str| {
            let url = Url::parse(text).ok().filter(is_confidential);
            url.filter(|url| url.query().is_none() && url.fragment().is_none())
                .ok_or_else(|| Error::NoAddress(text.to_owned()))
        };
        let issuer = address(&settings.issuer)?;
        address(&settings.redirect)?;
        let wrong = |text: &str| {
            let text = text.to_owned();
            move |_| Error::NoAddress(text)
        };
        let http = Http::new(settings.authorities.clone(), issuer.scheme() == "https");
        Ok(Provider {
            issuer: IssuerUrl::new(settings.issuer.clone()).map_err(wrong(&settings.issuer))?,
            redirect: RedirectUrl::new(settings.redirect.clone()).map_err(wrong(&settings.redirect))?,
            http,
            metadata: MetadataCache::default(),
            pending: Mutex::default(),
            turns: Semaphore::new(AT_ONCE),
            settings,
        })
    }

    /// Returns the issuer identifier.
    pub fn issuer(&self) -> &str {
        &self.settings.issuer
    }

    fn acquire_permit(&self) -> Result<SemaphorePermit<'_>, Error> {
        self.turns.try_acquire().map_err(|_| Error::Busy)
    }

    fn unreachable(&self, reason: String) -> Error {
        Error::Unreachable { issuer: self.settings.issuer.clone(), reason: error::sanitize(&reason) }
    }

    fn client(&self, known: &DiscoveredProvider) -> OidcClient {
        let secret = self.settings.client_secret.clone().map(ClientSecret::new);
        let client = OidcClient::from_provider_metadata(
            known.metadata.clone(),
            ClientId::new(self.settings.client_id.clone()),
            secret,
        );
        let how = if known.supports_basic_auth() { AuthType::BasicAuth } else { AuthType::RequestBody };
        client.set_redirect_uri(self.redirect.clone()).set_auth_type(how)
    }

    /// Starts a sign-in. `browser` identifies the browser if it was here before; `earlier` is returned as
    /// [`ReturnedSignIn::earlier`].
    pub async fn begin(
        &self,
        browser: Option<&str>,
        from: IpAddr,
        earlier: Option<String>,
    ) -> Result<SignInRedirect, Error> {
        let _turn = self.acquire_permit()?;
        let known = self.metadata.get(&self.issuer, &self.http).await;
        let known = known.map_err(|error| self.unreachable(error.to_string()))?;
        let (challenge, verifier) = PkceCodeChallenge::new_random_sha256();
        let flow = CoreAuthenticationFlow::AuthorizationCode;
        let state = || CsrfToken::new_random_len(SECRET);
        let client = self.client(&known);
        let scopes = self.settings.scopes.iter().cloned().map(Scope::new);
        let asked = client
            .authorize_url(flow, state, || Nonce::new_random_len(SECRET))
            .add_scopes(scopes)
            .set_pkce_challenge(challenge);
        let (url, state, nonce) = asked.url();
        if !self.http.is_allowed(&url) {
            return Err(self.unreachable(format!(
                "it sends browsers to {}, which is not https",
                url.origin().ascii_serialization()
            )));
        }
        let browser = match browser {
            // Sign-ins in two windows of one browser may both be finished.
            Some(browser) => browser.to_owned(),
            None => CsrfToken::new_random_len(SECRET).into_secret(),
        };
        let waiting = PendingSignIn { browser: browser.clone(), from, nonce, verifier, earlier };
        let mut pending = self.pending.lock();
        pending.insert(state.into_secret(), waiting, Instant::now());
        Ok(SignInRedirect { url: url.into(), browser })
    }

    /// Takes the sign-in that was started with this state in this browser. Works once.
    pub fn resume(&self, state: &str, browser: Option<&str>) -> Result<ReturnedSignIn, Error> {
        self.pending.lock().take(state, browser, Instant::now())
    }

    /// Refuses a response from another issuer (RFC 9207).
    pub fn check_issuer(&self, issuer: Option<&str>) -> Result<(), Error> {
        match issuer {
            Some(other) if other != self.settings.issuer => Err(Error::Token {
                issuer: self.settings.issuer.clone(),
                reason: format!("the answer comes from another issuer, {}", error::sanitize(other)),
            }),
            _ => Ok(()),
        }
    }

    /// Exchanges the authorization code for the person who signed in.
    pub async fn finish(&self, started: ReturnedSignIn, code: String) -> Result<Person, Error> {
        if code.is_empty() || code.len() > LONGEST_CODE {
            return Err(Error::Code { reason: "it is empty, or too long".into() });
        }
        let _turn = self.acquire_permit()?;
        let known = self.metadata.get(&self.issuer, &self.http).await;
        let known = known.map_err(|error| self.unreachable(error.to_string()))?;
        let response = self.exchange(&known, code, started.verifier).await?;
        let Some(id_token) = response.id_token() else {
            return Err(self.token_error("it is missing".into()));
        };
        let checks = token::IdTokenChecks {
            client_id: &self.settings.client_id,
            issuer: &self.issuer,
            nonce: &started.nonce,
            access: response.access_token(),
        };
        let claims = match checks.verify(id_token, &known) {
            // The provider may have rotated its keys since they were fetched.
            Err(refused) if refused.is_unknown_key() => {
                let fresh = self.metadata.refresh_keys(&known, &self.http).await;
                match fresh.map_err(|error| self.unreachable(error.to_string()))? {
                    Some(fresh) => checks.verify(id_token, &fresh),
                    None => Err(refused),
                }
            }
            verified => verified,
        };
        let claims = claims.map_err(|refused| self.token_error(refused.to_string()))?;
        self.resolve_person(&known, claims, response.access_token().secret()).await
    }

    fn token_error(&self, reason: String) -> Error {
        Error::Token { issuer: self.settings.issuer.clone(), reason: error::sanitize(&reason) }
    }

    async fn exchange(
        &self,
        known: &DiscoveredProvider,
        code: String,
        verifier: PkceCodeVerifier,
    ) -> Result<token::Response, Error> {
        let client = self.client(known);
        let request = client
            .exchange_code(AuthorizationCode::new(code))
            .map_err(|_| self.unreachable("it names no token endpoint".into()))?;
        let asked = request.set_pkce_verifier(verifier);
        asked.request_async(&self.http).await.map_err(|error| match error {
            RequestTokenError::ServerResponse(refusal) => {
                // The error concerns the client, not the code (RFC 6749, section 5.2): nobody can sign in.
                let reason = error::sanitize(&refusal.to_string());
                match refusal.error().as_ref() {
                    "invalid_grant" => Error::Code { reason },
                    _ => Error::Client { issuer: self.settings.issuer.clone(), reason },
                }
            }
            RequestTokenError::Request(error) => self.unreachable(error.to_string()),
            // The response may contain a secret.
            RequestTokenError::Parse(..) => self
                .token_error("the answer of the token endpoint has no ID token with iss, sub, aud, exp and iat".into()),
            other => self.token_error(error::with_causes(&other)),
        })
    }

    /// Builds the person from verified claims. Missing groups are fetched from the userinfo endpoint (section 5.3).
    async fn resolve_person(
        &self,
        known: &DiscoveredProvider,
        claims: claims::Claims,
        access_token: &str,
    ) -> Result<Person, Error> {
        let subject = claims.subject().to_owned();
        let (name, groups) = (&self.settings.name_claim, &self.settings.groups_claim);
        let lacks = claims.find(groups).is_none() || claims.find(name).is_none();
        let more = match known.userinfo_endpoint().filter(|_| lacks) {
            Some(url) => {
                let told = self.http.fetch_userinfo(url, access_token).await;
                let told = told.map_err(|error| self.unreachable(error.to_string()))?;
                if told.subject() != subject {
                    return Err(self.token_error("its userinfo is of another person".into()));
                }
                Some(told)
            }
            None => None,
        };
        let told = |claim: &str| {
            let of_userinfo = || more.as_ref().and_then(|more| more.find_groups(claim));
            claims.find_groups(claim).or_else(of_userinfo)
        };
        let named = claims.find_text(name).or_else(|| more.as_ref().and_then(|more| more.find_text(name)));
        Ok(Person { name: named.unwrap_or_else(|| subject.clone()), groups: told(groups).unwrap_or_default(), subject })
    }
}

#[cfg(test)]
mod tests;
