//! Content-addressed store of container images in the OCI image layout (version 1.1), which skopeo, umoci and podman
//! can read and which is served read-only under `/v2/`.
//!
//! ```text
//!   tree ──layer_from_tree──▶ blobs/sha256/<digest> ──ensure_extracted──▶ layers/<diff-id>/  (shared, read-only)
//!     │  ╰───────────stage_tree───────────────────────────────────────────▲   (the tree at once, the blob later)
//!   tar.gz ──import_layer───▶        ▲   (a whole image of another store: receive; of other tools: receive_saved)
//!                          put_image ┴ tag ──▶ index.json      gc: removes what no tag and no caller uses
//!   upload ──unpack──▶ directory     (rejects entries that would escape from it)
//! ```
//!
//! Blobs appear and disappear atomically: they are written without a name (or with a temporary one that is locked while
//! it is written), flushed, and then linked to their digest. A crash leaves nothing that looks complete, and
//! [`Store::open`] removes what it does leave. All calls block; several threads may make the same call concurrently.

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
mod layout;
mod names;
pub mod oci;
mod pipe;
mod received;
mod refusal;
mod saved;
mod store;
mod tar_reader;
mod tar_writer;
mod tree;
mod unpack;

pub use digest::Digest;
pub use error::Error;
pub use files::write_atomically;
pub use gc::{Damage, GcReport};
pub use images::{Image, ImageSpec, Manifest};
pub use layer::{LayerInfo, Mtime, TreeOptions};
pub use received::{ReceivedImage, is_layout, read_layout_document};
pub use refusal::Refusal;
pub use saved::{ArchiveKind, BEGINNING, SavedImage, detect_archive};
pub use store::{Blob, GcHold, Store};
pub use unpack::{Limits, UnpackStats, unpack};

/// Runs `work` on a thread of the engine, as the daemon does; for tests, which all share one engine.
#[cfg(test)]
fn run_as_engine<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    static ENGINE: std::sync::OnceLock<privilege::Engine> = std::sync::OnceLock::new();
    ENGINE.get_or_init(|| {
        let engine = privilege::Engine::start(privilege::Account::default());
        engine.expect("threads; run this test as root")
    });
    privilege::run_sync(work)
}
