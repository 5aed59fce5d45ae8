//! Verification of the ID token (OpenID Connect Core 1.0, section 3.1.3.7).

use std::collections::BTreeMap;

use chrono::{DateTime, TimeDelta, Utc};
use openidconnect::core::{
    CoreAuthDisplay, CoreAuthPrompt, CoreErrorResponseType, CoreGenderClaim, CoreJsonWebKey,
    CoreJweContentEncryptionAlgorithm, CoreJwsSigningAlgorithm, CoreRevocableToken, CoreRevocationErrorResponse,
    CoreTokenIntrospectionResponse, CoreTokenType,
};
use openidconnect::{
    AccessToken, AccessTokenHash, AdditionalClaims, ClaimsVerificationError, ClientId, EmptyExtraTokenFields,
    EndpointMaybeSet, EndpointNotSet, EndpointSet, IdTokenFields, IdTokenVerifier, IssuerUrl, Nonce,
    SignatureVerificationError, StandardErrorResponse, StandardTokenResponse,
};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::claims::Claims;
use crate::error::with_causes;
use crate::metadata::DiscoveredProvider;

/// Tolerated clock skew between the provider and this machine.
const SKEW: TimeDelta = TimeDelta::seconds(60);
/// Accepted signature algorithms: asymmetric ones only. With a shared secret this server could sign as well, and with
/// `none` anybody could.
const ALGORITHMS: [CoreJwsSigningAlgorithm; 9] = [
    CoreJwsSigningAlgorithm::RsaSsaPkcs1V15Sha256,
    CoreJwsSigningAlgorithm::RsaSsaPkcs1V15Sha384,
    CoreJwsSigningAlgorithm::RsaSsaPkcs1V15Sha512,
    CoreJwsSigningAlgorithm::RsaSsaPssSha256,
    CoreJwsSigningAlgorithm::RsaSsaPssSha384,
    CoreJwsSigningAlgorithm::RsaSsaPssSha512,
    CoreJwsSigningAlgorithm::EcdsaP256Sha256,
    CoreJwsSigningAlgorithm::EcdsaP384Sha384,
    CoreJwsSigningAlgorithm::EdDsa,
];

/// Claims beyond the standard ones, such as groups.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ExtraClaims(BTreeMap<String, Value>);

impl AdditionalClaims for ExtraClaims {}

type IdToken =
    openidconnect::IdToken<ExtraClaims, CoreGenderClaim, CoreJweContentEncryptionAlgorithm, CoreJwsSigningAlgorithm>;

/// Response of the token endpoint.
pub type Response = StandardTokenResponse<
    IdTokenFields<
        ExtraClaims,
        EmptyExtraTokenFields,
        CoreGenderClaim,
        CoreJweContentEncryptionAlgorithm,
        CoreJwsSigningAlgorithm,
    >,
    CoreTokenType,
>;

/// OAuth client that represents this server.
pub type OidcClient = openidconnect::Client<
    ExtraClaims,
    CoreAuthDisplay,
    CoreGenderClaim,
    CoreJweContentEncryptionAlgorithm,
    CoreJsonWebKey,
    CoreAuthPrompt,
    StandardErrorResponse<CoreErrorResponseType>,
    Response,
    CoreTokenIntrospectionResponse,
    CoreRevocableToken,
    CoreRevocationErrorResponse,
    EndpointSet,
    EndpointNotSet,
    EndpointNotSet,
    EndpointNotSet,
    EndpointMaybeSet,
    EndpointMaybeSet,
>;

/// Reason why an ID token is refused.
#[derive(Debug, thiserror::Error)]
pub enum IdTokenError {
    /// The claims or the signature are invalid.
    #[error("{}", with_causes(.0))]
    Claims(ClaimsVerificationError),
    /// It was issued for another client of the provider.
    #[error("it was issued for the client {0}")]
    Party(String),
    /// It has several audiences and no authorized party (azp).
    #[error("it has several audiences, and no azp")]
    NoParty,
    /// The token's hash does not match the access token.
    #[error("its at_hash is of another access token")]
    AccessToken,
    /// The claims cannot be serialized as JSON.
    #[error(transparent)]
    Unwritable(#[from] serde_json::Error),
}

impl IdTokenError {
    /// Returns true if it is signed by a key that is missing from the fetched key set.
    pub fn is_unknown_key(&self) -> bool {
        let unknown = ClaimsVerificationError::SignatureVerification(SignatureVerificationError::NoMatchingKey);
        matches!(self, IdTokenError::Claims(error) if *error == unknown)
    }
}

/// Expected values of an ID token.
pub struct IdTokenChecks<'a> {
    pub client_id: &'a str,
    pub issuer: &'a IssuerUrl,
    /// Nonce sent when the sign-in started.
    pub nonce: &'a Nonce,
    /// Access token received with the ID token.
    pub access: &'a AccessToken,
}

impl IdTokenChecks<'_> {
    /// Verifies the token and returns its claims.
    pub fn verify(&self, token: &IdToken, known: &DiscoveredProvider) -> Result<Claims, IdTokenError> {
        let keys = known.metadata.jwks().clone();
        let client = ClientId::new(self.client_id.to_owned());
        let verifier = IdTokenVerifier::new_public_client(client, self.issuer.clone(), keys)
            .set_allowed_algs(ALGORITHMS)
            .set_time_fn(|| Utc::now() - SKEW)
            .set_issue_time_verifier_fn(|issued| check_issue_time(issued).map_err(|error| error.to_string()))
            // With several audiences, azp decides.
            .set_other_audience_verifier_fn(|_| true);
        let claims = token.claims(&verifier, self.nonce).map_err(IdTokenError::Claims)?;
        match claims.authorized_party() {
            Some(party) if party.as_str() != self.client_id => {
                return Err(IdTokenError::Party(party.as_str().to_owned()));
            }
            None if claims.audiences().len() > 1 => return Err(IdTokenError::NoParty),
            _ => {}
        }
        if let Some(expected) = claims.access_token_hash() {
            let signature = |error| IdTokenError::Claims(ClaimsVerificationError::SignatureVerification(error));
            let algorithm = token.signing_alg().map_err(signature)?;
            let key = token.signing_key(&verifier).map_err(signature)?;
            let found =
                AccessTokenHash::from_token(self.access, algorithm, key).map_err(|_| IdTokenError::AccessToken)?;
            if found != *expected {
                return Err(IdTokenError::AccessToken);
            }
        }
        Ok(Claims::from_value(serde_json::to_value(claims)?)?)
    }
}

/// An ID token whose time of issue is in the future.
#[derive(Debug, thiserror::Error)]
#[error("issued at {0}, which is in the future")]
struct FutureIssueTime(DateTime<Utc>);

fn check_issue_time(issued: DateTime<Utc>) -> Result<(), FutureIssueTime> {
    if issued <= Utc::now() + SKEW { Ok(()) } else { Err(FutureIssueTime(issued)) }
}
