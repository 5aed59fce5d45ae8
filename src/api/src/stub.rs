//! Stubs: `GET /stubs/NAME.tar.gz?arch=ARCHITECTURE` answers with an archive, `NAME.tar.gz.sig` with its signature, `GET /stubs`
//! with [`Stubs`].

use serde::{Deserialize, Serialize};

/// Architectures that a robot's program is made for, as `uname -m` says them (`armv7` for `armv7l`).
pub const ARCHITECTURES: [&str; 3] = ["x86_64", "aarch64", "armv7"];

/// The header of an archive that names the architecture it is for.
pub const ARCHITECTURE: &str = "cloudroid-architecture";

/// The header of an archive with its signature: the lines of the detached one, without those that begin and end it.
pub const SIGNATURE: &str = "cloudroid-signature";
/// What archives are signed as: the namespace of `ssh-keygen -Y verify -n`.
pub const ARCHIVE: &str = "cloudroid-archive";
/// What the list of an archive's files is signed as.
pub const CONTENTS: &str = "cloudroid-stub";
/// As whom robots' lists of signers name a server.
pub const SIGNER: &str = "cloudroid";

/// What stubs this server has.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stubs {
    /// Services, each with its archive at `/stubs/NAME.tar.gz`.
    pub services: Vec<String>,
    /// Architectures whose program this server holds.
    pub architectures: Vec<String>,
    /// Those it could hold and does not.
    pub lacking: Vec<String>,
    /// The key that archives are signed by, as OpenSSH writes it; empty: an earlier version's, which signs none.
    #[serde(default)]
    pub key: String,
}

/// The architecture that is meant by a name in use for it.
pub fn architecture(name: &str) -> Option<&'static str> {
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
            assert_eq!(architecture(name), Some(name));
        }
        assert_eq!(architecture("armv7l"), Some("armv7"));
        assert_eq!(architecture("arm64"), Some("aarch64"));
        assert_eq!(architecture("sparc"), None);
    }
}
