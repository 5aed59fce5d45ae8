//! A service that the bridge answers itself.

use std::sync::Arc;

use access::Grants;
use async_trait::async_trait;
use budget::Budget;
use ros::schema::{SchemaError, ServiceDef};

use crate::lacking::DefinitionError;
use crate::rosapi::ParamRequestError;
use crate::shared::BridgeShared;
use crate::tf::TransformRequestError;

/// Reasons why one of the bridge's own services does not answer a request.
#[derive(Debug, thiserror::Error)]
pub(crate) enum OwnServiceError {
    /// The arguments are not those of the service.
    #[error("args: {0}")]
    Args(#[source] serde_json::Error),
    /// The requested definition is not available.
    #[error(transparent)]
    Definition(#[from] DefinitionError),
    /// A definition that the service needs itself is not available.
    #[error(transparent)]
    Schema(#[from] SchemaError),
    #[error(transparent)]
    Param(#[from] ParamRequestError),
    #[error(transparent)]
    Transforms(#[from] TransformRequestError),
    #[error("rosapi has no service {0}")]
    Unknown(&'static str),
}

/// The client that calls one of the bridge's own services.
pub(crate) struct Caller<'a> {
    /// Grants that filter the answer.
    pub grants: &'a Grants,
    /// Budget for the parsed arguments.
    pub budget: &'a Budget,
}

/// A service answered by the bridge itself.
#[async_trait]
pub(crate) trait OwnService: Send + Sync {
    /// Returns whether every client may call it: the answer only contains names and types, filtered by the caller's
    /// grants.
    fn is_filtered(&self) -> bool {
        false
    }

    /// Returns whether its answer depends on what nodes have registered.
    fn reads_graph(&self) -> bool {
        false
    }

    /// Returns its definition, in the servant's ROS.
    fn definition(&self, shared: &BridgeShared) -> Result<Arc<ServiceDef>, SchemaError>;

    /// Answers a request in JSON with a response in JSON.
    async fn answer(
        &self,
        shared: &Arc<BridgeShared>,
        args: &[u8],
        caller: &Caller<'_>,
    ) -> Result<Vec<u8>, OwnServiceError>;
}
