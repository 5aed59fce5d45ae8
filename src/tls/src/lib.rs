//! What the daemon, the command line and robots' programs share of TLS: how a certificate is named, and whom a client trusts
//! (docs/adr/080).

#![deny(unsafe_code)]

mod client;
mod fingerprint;
mod known;

pub use client::{Connected, Trust, signs_itself, speaks_for};
pub use fingerprint::{Fingerprint, NoFingerprint};
pub use known::{Known, KnownServers};
