//! TLS parts shared by the daemon, the command line and the robots' programs: certificate fingerprints, the client's
//! trust decisions (docs/adr/080), and the pairing line (docs/adr/086).

#![deny(unsafe_code)]

mod client;
mod fingerprint;
mod known;
mod line;

pub use client::{ClientIdentity, Trust, TrustedConnection, is_self_signed, is_valid_for_host};
pub use fingerprint::{Fingerprint, ParseFingerprintError};
pub use known::{KnownIdentity, KnownServers};
pub use line::{CODE, PairingLine, ParsePairingLineError, is_code};
