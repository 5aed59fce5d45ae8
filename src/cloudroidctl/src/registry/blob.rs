//! The transfer of one blob. If its connection breaks, the rest is requested, and not everything again: a layer may be
//! large.

use std::time::Duration;

use anyhow::ensure;
use sha2::{Digest as _, Sha256};
use tokio::time::sleep;

use super::client::RegistryClient;
use super::digest::Digest;
use super::documents::BlobDescriptor;
use super::layout::LayoutWriter;

/// Maximum number of requests for one blob.
const MOST_REQUESTS: u32 = 5;
/// Pause after the first broken transfer; the second one is twice as long, and so on.
const PAUSE: Duration = if cfg!(test) { Duration::ZERO } else { Duration::from_secs(1) };

/// Copies a blob, which must have the size and the digest of its descriptor. `on_bytes` is called with the number of
/// bytes of each part that arrives.
pub async fn copy_blob(
    client: &mut RegistryClient,
    blob: &BlobDescriptor,
    layout: &mut LayoutWriter,
    on_bytes: &(impl Fn(u64) + Send + Sync),
) -> anyhow::Result<()> {
    layout.begin_blob(&blob.digest, blob.size).await?;
    let mut copied = CopiedPart { blob, length: 0, hasher: Sha256::new() };
    let mut requests = 1;
    while let Err(error) = copied.copy_rest(client, layout, on_bytes).await {
        if requests == MOST_REQUESTS || !is_transfer_error(&error) {
            return Err(error);
        }
        if copied.length == blob.size {
            break;
        }
        sleep(PAUSE * requests).await;
        requests += 1;
    }
    copied.check()?;
    layout.end_file().await
}

/// The part of a blob that is in the layout.
struct CopiedPart<'a> {
    blob: &'a BlobDescriptor,
    length: u64,
    hasher: Sha256,
}

impl CopiedPart<'_> {
    /// Requests the rest, and copies it as it arrives.
    async fn copy_rest(
        &mut self,
        client: &mut RegistryClient,
        layout: &mut LayoutWriter,
        on_bytes: &(impl Fn(u64) + Send + Sync),
    ) -> anyhow::Result<()> {
        let BlobDescriptor { digest, size } = self.blob;
        let (mut body, begin) = client.open_blob(digest, self.length).await?;
        let mut known = self.length - begin;
        while let Some(mut chunk) = body.next_chunk().await? {
            let skipped = known.min(chunk.len() as u64);
            known -= skipped;
            drop(chunk.split_to(skipped as usize));
            let length = chunk.len() as u64;
            ensure!(length <= size - self.length, "{digest} is longer than the {size} bytes that the manifest names");
            self.length += length;
            self.hasher.update(&chunk);
            on_bytes(length);
            layout.add_bytes(chunk).await?;
        }
        let left = size - self.length;
        ensure!(left == 0, "{digest} is {left} bytes shorter than the manifest names");
        Ok(())
    }

    fn check(self) -> anyhow::Result<()> {
        let (wanted, found) = (&self.blob.digest, Digest::from_hasher(self.hasher));
        ensure!(found == *wanted, "{wanted} has the content of {found}");
        Ok(())
    }
}

/// Returns whether another attempt may succeed: the connection broke, or none was possible.
fn is_transfer_error(error: &anyhow::Error) -> bool {
    use outbound::Error::{Late, NoAnswer, Stalled, Unreachable, Unreadable};
    let error = error.downcast_ref::<outbound::Error>();
    matches!(error, Some(Unreachable { .. } | NoAnswer { .. } | Unreadable { .. } | Late { .. } | Stalled { .. }))
}
