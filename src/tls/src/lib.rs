//! What the daemon, the command line and robots' programs share of TLS: how a certificate is named, whom a client trusts
//! (docs/adr/080), and by which line a robot is paired (docs/adr/086).

#![deny(unsafe_code)]

mod client;
mod fingerprint;
mod known;
mod line;

pub use client::{Connected, Identity, Trust, signs_itself, speaks_for};
pub use fingerprint::{Fingerprint, NoFingerprint};
pub use known::{Known, KnownServers};
pub use line::{CODE, NoLine, PairingLine, is_code};
