//! Resources that others provide to the local engine: images and hosts.

use std::error::Error as StdError;
use std::net::IpAddr;
use std::path::PathBuf;

use async_trait::async_trait;

/// Resources that the local engine needs from others.
#[async_trait]
pub trait Resources: Send + Sync + 'static {
    /// Returns the extracted layers of an image, lowest first.
    async fn layers(&self, image: &str) -> Result<Vec<PathBuf>, Box<dyn StdError + Send + Sync>>;
    /// Resolves the hosts of `HOST:PORT`s to their names, each with the loopback address in the container that stands
    /// for it; fails with the one that is not allowed.
    fn hosts(&self, egress: &[String]) -> Result<Vec<(IpAddr, String)>, Box<dyn StdError + Send + Sync>>;
}

/// Provides no image and no host: for engines that only start containers from layers.
pub(super) struct NoResources;

#[async_trait]
impl Resources for NoResources {
    async fn layers(&self, _image: &str) -> Result<Vec<PathBuf>, Box<dyn StdError + Send + Sync>> {
        Err("this engine was given no images".into())
    }

    fn hosts(&self, egress: &[String]) -> Result<Vec<(IpAddr, String)>, Box<dyn StdError + Send + Sync>> {
        match egress.first() {
            Some(name) => Err(format!("this engine allows no connections to {name}").into()),
            None => Ok(Vec::new()),
        }
    }
}
