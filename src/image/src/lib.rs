//! A content-addressed store of container images in the OCI image layout (version 1.1), which skopeo, umoci and
//! podman read and which is served read-only under `/v2/`.
//!
//! ```text
//!   tree ──layer_from_tree──▶ blobs/sha256/<digest> ──extracted──▶ layers/<diff-id>/  (shared, read-only)
//!     │  ╰───────────stage_tree──────────────────────────────────▲   (the tree at once, the blob later)
//!   tar.gz ──import_layer───▶        ▲   (a whole image of another store: receive)
//!                          put_image ┴ tag ──▶ index.json      gc: what no tag and no caller keeps, goes
//!   upload ──unpack──▶ directory     (refuses whatever could leave it)
//! ```
//!
//! Blobs come and go whole: they are written without a name (or under a temporary one that is locked while it is
//! written), flushed, and then linked to their digest. A crash leaves nothing that looks complete, and
//! [`Store::open`] sweeps what it does leave. All calls block; several threads may make the same one.

#![forbid(unsafe_code)]

mod beneath;
mod capability;
mod digest;
mod entry;
mod error;
mod extract;
mod files;
mod gc;
mod glob;
mod gzip;
mod images;
mod layer;
mod layer_writer;
mod names;
pub mod oci;
mod pipe;
mod received;
mod refusal;
mod store;
mod tar_reader;
mod tar_writer;
mod tree;
mod unpack;

pub use digest::Digest;
pub use error::Error;
pub use files::write_whole;
pub use gc::{Damage, Swept};
pub use images::{Image, ImageSpec, Manifest};
pub use layer::{LayerInfo, Mtime, TreeOptions};
pub use received::{Received, document, is_layout};
pub use refusal::Refusal;
pub use store::{Blob, Hold, Store};
pub use unpack::{Limits, Unpacked, unpack};

/// Does `work` on a thread of the engine, as the daemon does; for tests, of which all share one engine.
#[cfg(test)]
fn by_engine<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    static ENGINE: std::sync::OnceLock<privilege::Engine> = std::sync::OnceLock::new();
    ENGINE.get_or_init(|| {
        let engine = privilege::Engine::start(privilege::Account::default());
        engine.expect("threads; run this test as root")
    });
    privilege::now(work)
}
