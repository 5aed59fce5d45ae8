//! Stubs: `GET /stubs/NAME.tar.gz?arch=ARCHITECTURE` answers with an archive, `GET /stubs` with [`Stubs`].

use serde::{Deserialize, Serialize};

/// Architectures that a robot's program is made for, as `uname -m` says them (`armv7` for `armv7l`).
pub const ARCHITECTURES: [&str; 3] = ["x86_64", "aarch64", "armv7"];

/// The header of an archive that names the architecture it is for.
pub const ARCHITECTURE: &str = "cloudroid-architecture";

/// What stubs this server has.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stubs {
    /// Services, each with its archive at `/stubs/NAME.tar.gz`.
    pub services: Vec<String>,
    /// Architectures whose program this server holds.
    pub architectures: Vec<String>,
    /// Those it could hold and does not.
    pub lacking: Vec<String>,
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
