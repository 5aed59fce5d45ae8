//! A content-addressed store of container images in the OCI image layout (version 1.1), which skopeo, umoci and
//! podman read and which is served read-only under `/v2/`.
//!
//! ```text
//!   tree ──layer_from_tree──▶ blobs/sha256/<digest> ──extracted──▶ layers/<diff-id>/  (shared, read-only)
//!   tar.gz ──import_layer───▶        ▲
//!                          put_image ┴ tag ──▶ index.json      gc: what no tag and no caller keeps, goes
//!   upload ──unpack──▶ directory     (refuses whatever could leave it)
//! ```
//!
//! Blobs come and go whole: they are written without a name (or under a temporary one that is locked while it is
//! written), flushed, and then linked to their digest. A crash leaves nothing that looks complete, and
//! [`Store::open`] sweeps what it does leave. All calls block; several threads may make the same one.

#![forbid(unsafe_code)]

mod digest;
mod error;
mod layer;
pub mod oci;
mod store;
mod unpack;

pub use digest::Digest;
pub use error::Error;
pub use layer::{LayerInfo, Mtime, TreeOptions};
pub use store::{Blob, Damage, Hold, Image, ImageSpec, Manifest, Store, Swept};
pub use unpack::{Limits, Refusal, Unpacked, unpack};
