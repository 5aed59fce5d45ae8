//! The archive of an OCI image layout, written while its files arrive.

use std::io;

use anyhow::Context;
use bytes::Bytes;

use super::digest::Digest;
use crate::push::archive::Chunks;

/// Size of a block of a tar archive in bytes.
const BLOCK: u64 = 512;

/// Writes the archive to the body of a request.
pub struct LayoutWriter {
    chunks: Chunks,
    /// Size of the file that is being written.
    size: u64,
}

impl LayoutWriter {
    /// Begins an archive.
    pub fn new(chunks: Chunks) -> LayoutWriter {
        LayoutWriter { chunks, size: 0 }
    }

    /// Adds a whole file.
    pub async fn add_file(&mut self, name: &str, text: &str) -> anyhow::Result<()> {
        self.begin_file(name, text.len() as u64).await?;
        self.add_bytes(Bytes::copy_from_slice(text.as_bytes())).await?;
        self.end_file().await
    }

    /// Begins a blob of `size` bytes.
    pub async fn begin_blob(&mut self, digest: &Digest, size: u64) -> anyhow::Result<()> {
        self.begin_file(&format!("blobs/sha256/{}", digest.hex()), size).await
    }

    async fn begin_file(&mut self, name: &str, size: u64) -> anyhow::Result<()> {
        let mut header = tar::Header::new_gnu();
        header.set_path(name)?;
        header.set_size(size);
        header.set_mode(0o644);
        header.set_mtime(0);
        header.set_uid(0);
        header.set_gid(0);
        header.set_cksum();
        self.size = size;
        self.add_bytes(Bytes::copy_from_slice(header.as_bytes())).await
    }

    /// Adds bytes of the file that was begun.
    pub async fn add_bytes(&mut self, bytes: Bytes) -> anyhow::Result<()> {
        if bytes.is_empty() {
            return Ok(());
        }
        let sent = self.chunks.send(Ok(bytes)).await;
        sent.map_err(|_| io::Error::from(io::ErrorKind::BrokenPipe)).context("the daemon stopped reading")
    }

    /// Ends a file, whose bytes are all added.
    pub async fn end_file(&mut self) -> anyhow::Result<()> {
        let padding = (BLOCK - self.size % BLOCK) % BLOCK;
        self.add_bytes(vec![0_u8; padding as usize].into()).await
    }

    /// Ends the archive.
    pub async fn finish(&mut self) -> anyhow::Result<()> {
        self.add_bytes(vec![0_u8; 2 * BLOCK as usize].into()).await
    }

    /// Returns whether nobody reads the archive any more.
    pub fn is_closed(&self) -> bool {
        self.chunks.is_closed()
    }

    /// Ends the archive with an error.
    pub async fn abort(self, error: io::Error) {
        let _ = self.chunks.send(Err(error)).await;
    }
}
