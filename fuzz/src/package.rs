//! Files of packages that are pushed.

use std::path::Path;

use ::package::condition::Variables;
use ::package::interface::Interface;
use ::package::manifest::Manifest;

/// A `package.xml`.
pub fn manifest(data: &[u8]) {
    let text = String::from_utf8_lossy(data);
    for (version, distribution) in [(1, "noetic"), (2, "jazzy")] {
        let variables = Variables::for_distribution(version, distribution);
        if let Ok(manifest) = Manifest::parse(&text, Path::new("package.xml"), &variables) {
            assert!(!manifest.name.is_empty(), "a package has a name");
        }
    }
}

/// An interface as a deployer or a stub states it.
pub fn interface(data: &[u8]) {
    let text = String::from_utf8_lossy(data);
    if let Ok(interface) = Interface::from_toml(&text, Path::new("interface.toml")) {
        let _ = Interface::from_toml(&interface.to_toml(), Path::new("written.toml"));
    }
}
