//! Cache of the provider's metadata (OpenID Connect Discovery 1.0) and keys, fetched when somebody signs in.

use std::sync::Arc;
use std::time::{Duration, Instant};

use openidconnect::core::{CoreClientAuthMethod, CoreJsonWebKeySet, CoreProviderMetadata};
use openidconnect::url::Url;
use openidconnect::{DiscoveryError, IssuerUrl};
use tokio::sync::Mutex;

use crate::error::with_causes;
use crate::http::{Http, ProviderRequestError};

/// Time for which the metadata is cached.
const AGE: Duration = Duration::from_secs(3600);
/// Minimum interval between refreshes of the keys, whatever tokens demand.
const KEYS_AGAIN: Duration = Duration::from_secs(60);
/// Time for which a failure is cached, so that those who waited for it need not wait again.
const FAILURE_EXPIRY: Duration = Duration::from_secs(1);

/// Metadata of the provider.
pub struct DiscoveredProvider {
    /// The provider's metadata, including its keys.
    pub metadata: CoreProviderMetadata,
    at: Instant,
}

impl DiscoveredProvider {
    /// Returns true if the client secret may be sent in a header, which is the default (Core, section 9).
    pub fn supports_basic_auth(&self) -> bool {
        let methods = self.metadata.token_endpoint_auth_methods_supported();
        methods.is_none_or(|methods| methods.contains(&CoreClientAuthMethod::ClientSecretBasic))
    }

    /// Returns the URL of the userinfo endpoint.
    pub fn userinfo_endpoint(&self) -> Option<&Url> {
        self.metadata.userinfo_endpoint().map(|url| url.url())
    }
}

/// Reason why the metadata or the keys of the provider cannot be fetched.
#[derive(Debug, Clone, thiserror::Error)]
#[error("{}", with_causes(.0))]
pub struct MetadataError(Arc<DiscoveryError<ProviderRequestError>>);

impl MetadataError {
    fn new(error: DiscoveryError<ProviderRequestError>) -> MetadataError {
        MetadataError(Arc::new(error))
    }
}

#[derive(Default)]
struct State {
    known: Option<Arc<DiscoveredProvider>>,
    failed: Option<(Instant, MetadataError)>,
    /// Time when the keys were last refreshed.
    keys: Option<Instant>,
}

/// Cached metadata of a provider.
#[derive(Default)]
pub struct MetadataCache(Mutex<State>);

impl MetadataCache {
    /// Returns the cached metadata, or fetches it.
    pub async fn get(&self, issuer: &IssuerUrl, http: &Http) -> Result<Arc<DiscoveredProvider>, MetadataError> {
        // Concurrent callers wait for the same response.
        let asked = Instant::now();
        let mut state = self.0.lock().await;
        if let Some(known) = state.known.as_ref().filter(|known| known.at.elapsed() < AGE) {
            return Ok(Arc::clone(known));
        }
        if let Some((at, error)) = &state.failed
            && (*at >= asked || at.elapsed() < FAILURE_EXPIRY)
        {
            return Err(error.clone());
        }
        match CoreProviderMetadata::discover_async(issuer.clone(), http).await {
            Ok(metadata) => {
                let at = Instant::now();
                let known = Arc::new(DiscoveredProvider { metadata, at });
                state.known = Some(Arc::clone(&known));
                state.failed = None;
                Ok(known)
            }
            Err(error) => {
                let error = MetadataError::new(error);
                state.failed = Some((Instant::now(), error.clone()));
                Err(error)
            }
        }
    }

    /// Returns the metadata with refreshed keys; `None` if they were refreshed a moment ago.
    pub async fn refresh_keys(
        &self,
        before: &DiscoveredProvider,
        http: &Http,
    ) -> Result<Option<Arc<DiscoveredProvider>>, MetadataError> {
        let mut state = self.0.lock().await;
        // Another caller has refreshed them while this one waited.
        if let Some(known) = state.known.as_ref().filter(|known| known.at > before.at) {
            return Ok(Some(Arc::clone(known)));
        }
        if state.keys.is_some_and(|at| at.elapsed() < KEYS_AGAIN) {
            return Ok(None);
        }
        state.keys = Some(Instant::now());
        let asked = CoreJsonWebKeySet::fetch_async(before.metadata.jwks_uri(), http).await;
        let keys = asked.map_err(MetadataError::new)?;
        let known =
            Arc::new(DiscoveredProvider { metadata: before.metadata.clone().set_jwks(keys), at: Instant::now() });
        state.known = Some(Arc::clone(&known));
        Ok(Some(known))
    }
}
