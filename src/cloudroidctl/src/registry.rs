//! Images of registries, pulled into an OCI image layout that is sent while it arrives: nothing is stored here.
//!
//! ```text
//!   registry ─▶ index ─▶ manifest ─▶ PulledImage ─▶ config and layers ─▶ tar archive of a layout ─▶ daemon
//! ```
//!
//! Sizes and digests are those of the manifest, and the first that differs ends the archive with an error. The daemon,
//! which trusts no archive, checks them again.

mod blob;
mod challenge;
mod client;
mod credentials;
mod digest;
mod documents;
mod layout;
mod reference;

use std::time::Duration;

use anyhow::{Context, bail, ensure};
use hyper::Response;
use outbound::{OutboundBody, OutboundClient};
use serde_json::json;

use crate::client::RequestBody;
use crate::push::archive::{self, Packing};
use client::RegistryClient;
use digest::Digest;
use documents::{ImageDocument, ImageManifest, LARGEST_DOCUMENT};
use layout::LayoutWriter;

pub use credentials::Credentials;
pub use reference::{ImageReference, SCHEME};

/// Time within which a registry answers, and the longest pause while a layer arrives.
const PAUSE: Duration = Duration::from_secs(60);
/// Maximum size of what a token server answers, in bytes.
const LARGEST_TOKEN: usize = 1 << 20;
/// Maximum number of indexes in indexes.
const MAX_NESTED_INDEXES: usize = 3;

/// An image in a registry whose manifest has been read.
#[derive(Debug)]
pub struct PulledImage {
    client: RegistryClient,
    image: ImageReference,
    manifest: ImageManifest,
    /// The manifest as the registry has it.
    document: Vec<u8>,
}

/// Amount that is to be pulled.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PullSize {
    /// Number of layers.
    pub layers: usize,
    /// Size in bytes, of each blob once.
    pub bytes: u64,
}

/// Finds an image for a server of this architecture (in the terms of Go). Without `credentials`, those of podman's and
/// docker's log-ins are used.
pub async fn find_image(
    image: &ImageReference,
    credentials: Option<Credentials>,
    architecture: &str,
) -> anyhow::Result<PulledImage> {
    let credentials = match credentials {
        Some(credentials) => Some(credentials),
        None => Credentials::find(image)?,
    };
    read_manifest(image, credentials, architecture).await
}

async fn read_manifest(
    image: &ImageReference,
    credentials: Option<Credentials>,
    architecture: &str,
) -> anyhow::Result<PulledImage> {
    let http = OutboundClient::new(None, client::NOBODY_TRUSTED).with_limits(PAUSE, LARGEST_TOKEN);
    let mut client = RegistryClient::connect(image, credentials, http).await?;
    let mut wanted = image.digest().cloned();
    for _ in 0..MAX_NESTED_INDEXES {
        let version = wanted.as_ref().map_or_else(|| image.version(), Digest::to_string);
        let answer = client.open_manifest(&version).await?;
        let document = read_document(answer, wanted.as_ref()).await.with_context(|| image.to_string())?;
        match ImageDocument::parse(&document, architecture).with_context(|| image.to_string())? {
            ImageDocument::Index(entry) => wanted = Some(entry.digest),
            ImageDocument::Manifest(manifest) => {
                return Ok(PulledImage { client, image: image.clone(), manifest, document });
            }
        }
    }
    bail!("{image} is a list of lists; name one image by its digest")
}

/// Reads a document, which must have the digest `wanted`.
async fn read_document(answer: Response<OutboundBody>, wanted: Option<&Digest>) -> anyhow::Result<Vec<u8>> {
    let mut body = answer.into_body();
    let mut document = Vec::new();
    while let Some(chunk) = body.next_chunk().await? {
        document.extend_from_slice(&chunk);
        ensure!(document.len() as u64 <= LARGEST_DOCUMENT, "its manifest is larger than {LARGEST_DOCUMENT} bytes");
    }
    let found = Digest::compute(&document);
    match wanted {
        Some(wanted) if *wanted != found => bail!("the registry gives {found} for {wanted}"),
        _ => Ok(document),
    }
}

impl PulledImage {
    /// Returns how much is to be pulled.
    pub fn size(&self) -> PullSize {
        let bytes = self.manifest.blobs().iter().fold(0_u64, |sum, blob| sum.saturating_add(blob.size));
        PullSize { layers: self.manifest.layers.len(), bytes }
    }

    /// Returns the image as the body of a request: a tar archive of an image layout. `on_bytes` is called with the
    /// number of bytes of each part that arrives.
    pub fn into_body(mut self, on_bytes: impl Fn(u64) + Send + Sync + 'static) -> (RequestBody, Packing) {
        let (body, chunks) = archive::new_body();
        let (failed, packing) = Packing::channel();
        tokio::spawn(async move {
            let image = self.image.to_string();
            let mut layout = LayoutWriter::new(chunks);
            let outcome = self.pull(&mut layout, &on_bytes).await;
            // Why the daemon stopped reading is said by the daemon.
            if let Err(error) = outcome
                && !layout.is_closed()
            {
                let error = error.context(format!("cannot pull {image}"));
                let torn = std::io::Error::other(format!("{error:#}"));
                let _ = failed.try_send(error);
                // The body ends with an error, so that the daemon does not accept a truncated archive.
                layout.abort(torn).await;
            }
        });
        (body, packing)
    }

    async fn pull(&mut self, layout: &mut LayoutWriter, on_bytes: &(impl Fn(u64) + Send + Sync)) -> anyhow::Result<()> {
        layout.add_file("oci-layout", &json!({ "imageLayoutVersion": "1.0.0" }).to_string()).await?;
        layout.add_file("index.json", &self.index()).await?;
        layout.begin_blob(&Digest::compute(&self.document), self.document.len() as u64).await?;
        layout.add_bytes(self.document.clone().into()).await?;
        layout.end_file().await?;
        for blob in self.manifest.blobs() {
            blob::copy_blob(&mut self.client, blob, layout, on_bytes).await?;
        }
        layout.finish().await
    }

    /// Returns the index of the layout, with the image under its name.
    fn index(&self) -> String {
        let entry = json!({
            "mediaType": self.manifest.media_type,
            "digest": Digest::compute(&self.document).to_string(),
            "size": self.document.len(),
            "annotations": { "io.containerd.image.name": self.image.to_string() },
        });
        json!({ "schemaVersion": 2, "manifests": [entry] }).to_string()
    }
}

#[cfg(test)]
mod tests;
