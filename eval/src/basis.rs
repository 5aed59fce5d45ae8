//! Inputs that all runs depend on besides their own plans: with other packages, programs or networks, earlier results
//! are no longer valid.

use std::fs::File;
use std::path::PathBuf;

use anyhow::{Context, Result};
use sha2::{Digest, Sha256};
use support::binaries;

use crate::examples;
use crate::place::NetworkProfile;

/// The programs under measurement: the daemon, the init of each servant, and the robot's stub.
const PROGRAMS: [&str; 3] = ["cloudroidd", "cloudroid-init", "stubs/x86_64/cloudroid-stub"];

/// Returns the SHA-256 of all these inputs.
///
/// # Errors
/// If a program has not been built, or if a package cannot be read.
pub fn basis() -> Result<String> {
    hash_inputs(
        &examples::fingerprint()?,
        &PROGRAMS.map(binaries::path),
        &NetworkProfile::ALL.map(|network| format!("{:?}", network.rules())),
    )
}

fn hash_inputs(packages: &str, programs: &[PathBuf], networks: &[String]) -> Result<String> {
    let mut whole = Sha256::new();
    whole.update(packages);
    for program in programs {
        let named = || format!("{}, which make eval builds", program.display());
        let mut file = File::open(program).with_context(named)?;
        let mut one = Sha256::new();
        std::io::copy(&mut file, &mut one).with_context(named)?;
        whole.update(one.finalize());
    }
    for network in networks {
        whole.update(network);
    }
    Ok(format!("{:x}", whole.finalize()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_program_or_network_is_another_basis() {
        let place = tempfile::tempdir().expect("a directory");
        let program = place.path().join("cloudroidd");
        let programs = [program.clone()];
        let now = |network: &str| hash_inputs("packages", &programs, &[network.to_owned()]);
        let error = now("1 ms").expect_err("there is no program");
        assert!(format!("{error:#}").contains("cloudroidd"), "{error:#}");
        std::fs::write(&program, "one").expect("ours");
        let first = now("1 ms").expect("a basis");
        assert_eq!(now("1 ms").expect("a basis"), first);
        assert_ne!(now("2 ms").expect("a basis"), first);
        std::fs::write(&program, "two").expect("ours");
        assert_ne!(now("1 ms").expect("a basis"), first);
    }
}
