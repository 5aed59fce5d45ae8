//! People whom an identity provider knows, by OpenID Connect Core 1.0: the authorization code flow (section 3.1) with PKCE
//! (RFC 7636), state and nonce.
//!
//! ```text
//!  begin: where the browser goes, and what it keeps ─▶ (the provider asks who it is) ─▶ take: what was begun, once
//!                                                             ─▶ finish: code ─▶ ID token, verified ─▶ [`Person`]
//! ```
//!
//! What a person may do is for [`Roles`]. The provider is asked when somebody signs in, and not before: what it says of itself is
//! kept for an hour.

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
    AuthType, AuthorizationCode, ClientId, ClientSecret, CsrfToken, IssuerUrl, Nonce,
    OAuth2TokenResponse, PkceCodeChallenge, PkceCodeVerifier, RedirectUrl, RequestTokenError,
    Scope, TokenResponse,
};
use parking_lot::Mutex;
use tokio::sync::{Semaphore, SemaphorePermit};

pub use error::Error;
pub use pending::Started;
pub use roles::{Granted, Group, Roles};

use http::Http;
use metadata::{Known, Metadata};
use pending::{Pending, Waiting};
use token::Client;

/// How long the provider may take for one answer, and how many bytes that may have.
const TIME: Duration = Duration::from_secs(10);
const BYTES: usize = 256 << 10;
/// Requests to the provider at once; who comes beyond is told to try again.
const AT_ONCE: usize = 16;
/// Bytes of what makes a browser, or a sign-in, known again.
const SECRET: u32 = 32;
/// Longest code that is looked at, in bytes.
const LONGEST_CODE: usize = 8192;

/// What the operator says of the provider.
#[derive(Clone)]
pub struct Settings {
    /// Its issuer identifier: what it says of itself is at `ISSUER/.well-known/openid-configuration`.
    pub issuer: String,
    /// As whom it knows this server.
    pub client_id: String,
    /// By what this server proves that; none: a public client.
    pub client_secret: Option<String>,
    /// Where it sends browsers back to.
    pub redirect: String,
    /// What is asked for besides `openid`.
    pub scopes: Vec<String>,
    /// The claim that has a person's groups.
    pub groups_claim: String,
    /// The claim that has its name.
    pub name_claim: String,
    /// PEM file of the authorities that its certificate is checked by; none: the system's.
    pub authorities: Option<PathBuf>,
}

/// Somebody whom the provider knows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Person {
    /// By which the provider tells people apart, for ever (`sub`).
    pub subject: String,
    /// As it calls the person now: not unique, and another tomorrow perhaps (section 5.7).
    pub name: String,
    /// Its groups.
    pub groups: Vec<String>,
}

/// A sign-in that has begun.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Begun {
    /// Where the browser goes.
    pub url: String,
    /// By what it is known when it comes back.
    pub browser: String,
}

/// An identity provider.
pub struct Provider {
    settings: Settings,
    issuer: IssuerUrl,
    redirect: RedirectUrl,
    http: Http,
    metadata: Metadata,
    pending: Mutex<Pending>,
    turns: Semaphore,
}

/// Whether nobody can read what is sent to an address, or only this machine's own.
fn is_private(url: &Url) -> bool {
    match url.scheme() {
        "https" => true,
        "http" => url.host_str().is_some_and(|host| {
            // Those of IPv6 stand in brackets.
            outbound::is_this_machine(host.trim_matches(['[', ']']))
        }),
        _ => false,
    }
}

impl Provider {
    /// One that is asked later.
    pub fn new(settings: Settings) -> Result<Provider, Error> {
        let address = |text: &str| {
            let url = Url::parse(text).ok().filter(is_private);
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
            redirect: RedirectUrl::new(settings.redirect.clone())
                .map_err(wrong(&settings.redirect))?,
            http,
            metadata: Metadata::default(),
            pending: Mutex::default(),
            turns: Semaphore::new(AT_ONCE),
            settings,
        })
    }

    /// Its issuer identifier.
    pub fn issuer(&self) -> &str {
        &self.settings.issuer
    }

    fn turn(&self) -> Result<SemaphorePermit<'_>, Error> {
        self.turns.try_acquire().map_err(|_| Error::Busy)
    }

    fn unreachable(&self, reason: String) -> Error {
        Error::Unreachable {
            issuer: self.settings.issuer.clone(),
            reason: error::cut(&reason),
        }
    }

    fn client(&self, known: &Known) -> Client {
        let secret = self.settings.client_secret.clone().map(ClientSecret::new);
        let client = Client::from_provider_metadata(
            known.metadata.clone(),
            ClientId::new(self.settings.client_id.clone()),
            secret,
        );
        let how = match known.takes_basic() {
            true => AuthType::BasicAuth,
            false => AuthType::RequestBody,
        };
        client
            .set_redirect_uri(self.redirect.clone())
            .set_auth_type(how)
    }

    /// Begins to sign somebody in, in the browser that is known by `browser` if it was here before. `earlier`: what
    /// [`Started::earlier`] says later.
    pub async fn begin(
        &self,
        browser: Option<&str>,
        from: IpAddr,
        earlier: Option<String>,
    ) -> Result<Begun, Error> {
        let _turn = self.turn()?;
        let known = self.metadata.get(&self.issuer, &self.http).await;
        let known = known.map_err(|reason| self.unreachable(reason))?;
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
        if !self.http.may_ask(&url) {
            return Err(self.unreachable(format!(
                "it sends browsers to {}, which is not https",
                url.origin().ascii_serialization()
            )));
        }
        let browser = match browser {
            // Whoever signs in in two windows of one browser goes on in both.
            Some(browser) => browser.to_owned(),
            None => CsrfToken::new_random_len(SECRET).into_secret(),
        };
        let waiting = Waiting {
            browser: browser.clone(),
            from,
            nonce,
            verifier,
            earlier,
        };
        let mut pending = self.pending.lock();
        pending.keep(state.into_secret(), waiting, Instant::now());
        Ok(Begun {
            url: url.into(),
            browser,
        })
    }

    /// What was begun by this state, in the browser that is known by `browser`: once.
    pub fn take(&self, state: &str, browser: Option<&str>) -> Result<Started, Error> {
        self.pending.lock().take(state, browser, Instant::now())
    }

    /// Refuses an answer of another provider (RFC 9207).
    pub fn check_issuer(&self, issuer: Option<&str>) -> Result<(), Error> {
        match issuer {
            Some(other) if other != self.settings.issuer => Err(Error::Token {
                issuer: self.settings.issuer.clone(),
                reason: format!("the answer is one of {}", error::cut(other)),
            }),
            _ => Ok(()),
        }
    }

    /// Who has signed in, by the code that the provider gave its browser.
    pub async fn finish(&self, started: Started, code: String) -> Result<Person, Error> {
        if code.is_empty() || code.len() > LONGEST_CODE {
            return Err(Error::Code {
                reason: "it is empty, or too long".into(),
            });
        }
        let _turn = self.turn()?;
        let known = self.metadata.get(&self.issuer, &self.http).await;
        let known = known.map_err(|reason| self.unreachable(reason))?;
        let response = self.exchange(&known, code, started.verifier).await?;
        let Some(id_token) = response.id_token() else {
            return Err(self.bad("there is none".into()));
        };
        let checks = token::Checks {
            client_id: &self.settings.client_id,
            issuer: &self.issuer,
            nonce: &started.nonce,
            access: response.access_token(),
        };
        let claims = match checks.verify(id_token, &known) {
            // It may sign by another key since it was asked for its keys.
            Err(refused) if refused.is_of_unknown_key() => {
                let fresh = self.metadata.renewed(&known, &self.http).await;
                match fresh.map_err(|reason| self.unreachable(reason))? {
                    Some(fresh) => checks.verify(id_token, &fresh),
                    None => Err(refused),
                }
            }
            verified => verified,
        };
        let claims = claims.map_err(|refused| self.bad(refused.to_string()))?;
        self.person(&known, claims, response.access_token().secret())
            .await
    }

    fn bad(&self, reason: String) -> Error {
        Error::Token {
            issuer: self.settings.issuer.clone(),
            reason: error::cut(&reason),
        }
    }

    async fn exchange(
        &self,
        known: &Known,
        code: String,
        verifier: PkceCodeVerifier,
    ) -> Result<token::Response, Error> {
        let client = self.client(known);
        let request = client
            .exchange_code(AuthorizationCode::new(code))
            .map_err(|_| self.unreachable("it names no token endpoint".into()))?;
        let asked = request.set_pkce_verifier(verifier);
        asked
            .request_async(&self.http)
            .await
            .map_err(|error| match error {
                RequestTokenError::ServerResponse(refusal) => {
                    // Of the client, not of the code (RFC 6749, section 5.2): nobody can sign in.
                    let reason = error::cut(&refusal.to_string());
                    match refusal.error().as_ref() {
                        "invalid_grant" => Error::Code { reason },
                        _ => Error::Client {
                            issuer: self.settings.issuer.clone(),
                            reason,
                        },
                    }
                }
                RequestTokenError::Request(error) => self.unreachable(error.to_string()),
                // What stands there may be a secret.
                RequestTokenError::Parse(..) => self.bad(
                    "the answer of the token endpoint is not one with an ID token that has iss, sub, aud, exp and iat"
                        .into(),
                ),
                other => self.bad(error::with_causes(&other)),
            })
    }

    /// The person that verified claims are of. Groups that are not in them are asked for (userinfo, section 5.3).
    async fn person(
        &self,
        known: &Known,
        claims: claims::Claims,
        access_token: &str,
    ) -> Result<Person, Error> {
        let subject = claims.subject().to_owned();
        let (name, groups) = (&self.settings.name_claim, &self.settings.groups_claim);
        let lacks = claims.find(groups).is_none() || claims.find(name).is_none();
        let more = match known.userinfo().filter(|_| lacks) {
            Some(url) => {
                let told = self.http.userinfo(url, access_token).await;
                let told = told.map_err(|reason| self.unreachable(reason))?;
                if told.subject() != subject {
                    return Err(self.bad("its userinfo is of another person".into()));
                }
                Some(told)
            }
            None => None,
        };
        let told = |claim: &str| {
            let of_userinfo = || more.as_ref().and_then(|more| more.groups(claim));
            claims.groups(claim).or_else(of_userinfo)
        };
        let named = claims
            .text(name)
            .or_else(|| more.as_ref().and_then(|more| more.text(name)));
        Ok(Person {
            name: named.unwrap_or_else(|| subject.clone()),
            groups: told(groups).unwrap_or_default(),
            subject,
        })
    }
}

#[cfg(test)]
mod tests;
