//! The ID token, and what is checked of it (OpenID Connect Core 1.0, section 3.1.3.7).

use std::collections::BTreeMap;

use chrono::{DateTime, TimeDelta, Utc};
use openidconnect::core::{
    CoreAuthDisplay, CoreAuthPrompt, CoreErrorResponseType, CoreGenderClaim, CoreJsonWebKey,
    CoreJweContentEncryptionAlgorithm, CoreJwsSigningAlgorithm, CoreRevocableToken,
    CoreRevocationErrorResponse, CoreTokenIntrospectionResponse, CoreTokenType,
};
use openidconnect::{
    AccessToken, AccessTokenHash, AdditionalClaims, ClaimsVerificationError, ClientId,
    EmptyExtraTokenFields, EndpointMaybeSet, EndpointNotSet, EndpointSet, IdTokenFields,
    IdTokenVerifier, IssuerUrl, Nonce, SignatureVerificationError, StandardErrorResponse,
    StandardTokenResponse,
};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::claims::Claims;
use crate::error::with_causes;
use crate::metadata::Known;

/// How far the provider's clock may be from this machine's.
const SKEW: TimeDelta = TimeDelta::seconds(60);
/// Signatures that count: those of key pairs. By a secret that both know this server could sign, too, and by none anybody.
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

/// Claims beyond those that the standard names, groups among them.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Others(BTreeMap<String, Value>);

impl AdditionalClaims for Others {}

type IdToken = openidconnect::IdToken<
    Others,
    CoreGenderClaim,
    CoreJweContentEncryptionAlgorithm,
    CoreJwsSigningAlgorithm,
>;

/// What the token endpoint answers.
pub type Response = StandardTokenResponse<
    IdTokenFields<
        Others,
        EmptyExtraTokenFields,
        CoreGenderClaim,
        CoreJweContentEncryptionAlgorithm,
        CoreJwsSigningAlgorithm,
    >,
    CoreTokenType,
>;

/// This server as the provider knows it.
pub type Client = openidconnect::Client<
    Others,
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

/// Why an ID token is not good.
#[derive(Debug, thiserror::Error)]
pub enum Refused {
    /// Its claims, or its signature.
    #[error("{}", with_causes(.0))]
    Claims(ClaimsVerificationError),
    /// It was made for another server that the provider knows.
    #[error("it was made for the client {0}")]
    Party(String),
    /// It has several audiences, and does not say for which of them it was made.
    #[error("it has several audiences, and no azp")]
    NoParty,
    /// The access token beside it is another's.
    #[error("its at_hash is of another access token")]
    AccessToken,
    /// Its claims cannot be written as JSON.
    #[error(transparent)]
    Unwritable(#[from] serde_json::Error),
}

impl Refused {
    /// Whether it is signed by a key that the provider did not have when it was asked.
    pub fn is_of_unknown_key(&self) -> bool {
        let unknown = ClaimsVerificationError::SignatureVerification(
            SignatureVerificationError::NoMatchingKey,
        );
        matches!(self, Refused::Claims(error) if *error == unknown)
    }
}

/// What an ID token must fit.
pub struct Checks<'a> {
    pub client_id: &'a str,
    pub issuer: &'a IssuerUrl,
    /// What was sent when the sign-in began.
    pub nonce: &'a Nonce,
    /// What came beside it.
    pub access: &'a AccessToken,
}

impl Checks<'_> {
    /// Its claims, when all is as it should be.
    pub fn verify(&self, token: &IdToken, known: &Known) -> Result<Claims, Refused> {
        let keys = known.metadata.jwks().clone();
        let client = ClientId::new(self.client_id.to_owned());
        let verifier = IdTokenVerifier::new_public_client(client, self.issuer.clone(), keys)
            .set_allowed_algs(ALGORITHMS)
            .set_time_fn(|| Utc::now() - SKEW)
            .set_issue_time_verifier_fn(not_from_later)
            // Which of several it was made for says azp.
            .set_other_audience_verifier_fn(|_| true);
        let claims = token
            .claims(&verifier, self.nonce)
            .map_err(Refused::Claims)?;
        match claims.authorized_party() {
            Some(party) if party.as_str() != self.client_id => {
                return Err(Refused::Party(party.as_str().to_owned()));
            }
            None if claims.audiences().len() > 1 => return Err(Refused::NoParty),
            _ => {}
        }
        if let Some(expected) = claims.access_token_hash() {
            let signature =
                |error| Refused::Claims(ClaimsVerificationError::SignatureVerification(error));
            let algorithm = token.signing_alg().map_err(signature)?;
            let key = token.signing_key(&verifier).map_err(signature)?;
            let found = AccessTokenHash::from_token(self.access, algorithm, key)
                .map_err(|_| Refused::AccessToken)?;
            if found != *expected {
                return Err(Refused::AccessToken);
            }
        }
        Ok(Claims::of(serde_json::to_value(claims)?)?)
    }
}

fn not_from_later(issued: DateTime<Utc>) -> Result<(), String> {
    match issued <= Utc::now() + SKEW {
        true => Ok(()),
        false => Err(format!("issued at {issued}, which is yet to come")),
    }
}
