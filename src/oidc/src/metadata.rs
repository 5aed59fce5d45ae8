//! What a provider says of itself (OpenID Connect Discovery 1.0) and its keys: asked for when somebody signs in, and kept.

use std::sync::Arc;
use std::time::{Duration, Instant};

use openidconnect::IssuerUrl;
use openidconnect::core::{CoreClientAuthMethod, CoreJsonWebKeySet, CoreProviderMetadata};
use openidconnect::url::Url;
use tokio::sync::Mutex;

use crate::error::with_causes;
use crate::http::Http;

/// How long it is kept.
const AGE: Duration = Duration::from_secs(3600);
/// Keys are asked for anew no more often, whatever tokens name.
const KEYS_AGAIN: Duration = Duration::from_secs(60);
/// Those who waited while the provider gave no answer are not made to wait again.
const FAILED: Duration = Duration::from_secs(1);

/// What is known of a provider.
pub struct Known {
    /// Its own words, keys included.
    pub metadata: CoreProviderMetadata,
    at: Instant,
}

impl Known {
    /// Whether it takes the client's secret in a header, which it does if it says nothing (Core, section 9).
    pub fn takes_basic(&self) -> bool {
        let methods = self.metadata.token_endpoint_auth_methods_supported();
        methods.is_none_or(|methods| methods.contains(&CoreClientAuthMethod::ClientSecretBasic))
    }

    /// Where it tells more of a person.
    pub fn userinfo(&self) -> Option<&Url> {
        self.metadata.userinfo_endpoint().map(|url| url.url())
    }
}

#[derive(Default)]
struct State {
    known: Option<Arc<Known>>,
    failed: Option<(Instant, String)>,
    /// When keys were asked for anew.
    keys: Option<Instant>,
}

/// What a provider says of itself.
#[derive(Default)]
pub struct Metadata(Mutex<State>);

impl Metadata {
    /// What is known, or what it says now; else why it says nothing.
    pub async fn get(&self, issuer: &IssuerUrl, http: &Http) -> Result<Arc<Known>, String> {
        // Who comes meanwhile waits for the same answer.
        let asked = Instant::now();
        let mut state = self.0.lock().await;
        if let Some(known) = state
            .known
            .as_ref()
            .filter(|known| known.at.elapsed() < AGE)
        {
            return Ok(Arc::clone(known));
        }
        if let Some((at, reason)) = &state.failed
            && (*at >= asked || at.elapsed() < FAILED)
        {
            return Err(reason.clone());
        }
        match CoreProviderMetadata::discover_async(issuer.clone(), http).await {
            Ok(metadata) => {
                let at = Instant::now();
                let known = Arc::new(Known { metadata, at });
                state.known = Some(Arc::clone(&known));
                state.failed = None;
                Ok(known)
            }
            Err(error) => {
                let reason = with_causes(&error);
                state.failed = Some((Instant::now(), reason.clone()));
                Err(reason)
            }
        }
    }

    /// The same with keys of now; none where it was asked for them a moment ago.
    pub async fn renewed(&self, before: &Known, http: &Http) -> Result<Option<Arc<Known>>, String> {
        let mut state = self.0.lock().await;
        // Another has asked while this one waited.
        if let Some(known) = state.known.as_ref().filter(|known| known.at > before.at) {
            return Ok(Some(Arc::clone(known)));
        }
        if state.keys.is_some_and(|at| at.elapsed() < KEYS_AGAIN) {
            return Ok(None);
        }
        state.keys = Some(Instant::now());
        let asked = CoreJsonWebKeySet::fetch_async(before.metadata.jwks_uri(), http).await;
        let keys = asked.map_err(|error| with_causes(&error))?;
        let known = Arc::new(Known {
            metadata: before.metadata.clone().set_jwks(keys),
            at: Instant::now(),
        });
        state.known = Some(Arc::clone(&known));
        Ok(Some(known))
    }
}
