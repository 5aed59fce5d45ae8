//! Stubs: `GET /stubs/NAME.tar.gz?arch=ARCHITECTURE&ros=1` returns the archive for robots of that architecture and ROS
//! version (default: those of the server and of the service), `NAME.tar.gz.sig` its signature, and `GET /stubs` the
//! list, [`Stubs`].

use serde::{Deserialize, Serialize};

/// Architectures that the robot's program is built for, in the terms of `uname -m` (`armv7` for `armv7l`).
pub const ARCHITECTURES: [&str; 3] = ["x86_64", "aarch64", "armv7"];

/// Response header with the architecture of an archive.
pub const ARCHITECTURE: &str = "cloudroid-architecture";

/// Response header with the ROS version of the robots that an archive is for, 1 or 2.
pub const ROS: &str = "cloudroid-ros";

/// Response header with the signature of an archive: the lines of the detached signature without its begin and end
/// markers.
pub const SIGNATURE: &str = "cloudroid-signature";
/// Signature namespace of archives, for `ssh-keygen -Y verify -n`.
pub const ARCHIVE: &str = "cloudroid-archive";
/// Signature namespace of the file list of an archive.
pub const CONTENTS: &str = "cloudroid-stub";
/// Principal name of the server in the robots' allowed-signers files.
pub const SIGNER: &str = "cloudroid";

/// Stubs available from this server.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stubs {
    /// Services; the archive of each is at `/stubs/NAME.tar.gz`.
    pub services: Vec<String>,
    /// Architectures for which the robot's program is installed.
    pub architectures: Vec<String>,
    /// Supported architectures for which the robot's program is not installed.
    pub lacking: Vec<String>,
    /// Public key of the archive signatures in OpenSSH format; empty from earlier versions, which do not sign.
    #[serde(default)]
    pub key: String,
}

/// Returns the canonical architecture for a common name of it.
pub fn parse_architecture(name: &str) -> Option<&'static str> {
    match name {
        "x86_64" | "amd64" => Some("x86_64"),
        "aarch64" | "arm64" => Some("aarch64"),
        "armv7" | "armv7l" | "armv8l" | "armhf" | "arm" => Some("armv7"),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn architectures_have_several_names() {
        for name in ARCHITECTURES {
            assert_eq!(parse_architecture(name), Some(name));
        }
        assert_eq!(parse_architecture("armv7l"), Some("armv7"));
        assert_eq!(parse_architecture("arm64"), Some("aarch64"));
        assert_eq!(parse_architecture("sparc"), None);
    }
}
