//! The trained weights of the detector: fetched once, stored in the user's cache directory under their digest, and
//! copied from there into each checkout's package sources.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use sha2::{Digest, Sha256};

use crate::deadline;

/// Path in the package's directory.
const FILE: &str = "models/centernet.onnx";
/// Text of the script before the SHA-256 that the file must have.
const EXPECTED: &str = "MODEL_SHA256 = \"";

/// Maximum time to fetch some tens of megabytes.
const LONGEST: Duration = Duration::from_secs(600);

/// Installs the weights in `package`, unless they are there.
pub fn install(package: &Path) -> Result<()> {
    install_from(package, &cache_directory()?)
}

fn install_from(package: &Path, cache: &Path) -> Result<()> {
    let (script, file) = (package.join("fetch_weights"), package.join(FILE));
    let text = std::fs::read_to_string(&script).with_context(|| script.display().to_string())?;
    let expected = text.split_once(EXPECTED).and_then(|(_, rest)| rest.get(..64));
    let expected = expected.with_context(|| format!("{} names no SHA-256", script.display()))?;
    let kept = cache.join(format!("{expected}.onnx"));
    if !has_digest(&file, expected) {
        if has_digest(&kept, expected) {
            copy(&kept, &file)?;
            return Ok(());
        }
        let status =
            deadline::wait_for_exit(&mut Command::new(&script).spawn()?, &script.display().to_string(), LONGEST)?;
        ensure!(
            status.success() && has_digest(&file, expected),
            "the detector's weights could not be fetched ({status}): run {}, which takes them from the registry of npm",
            script.display()
        );
    }
    if !kept.exists() {
        copy(&file, &kept)?;
    }
    Ok(())
}

fn has_digest(file: &Path, expected: &str) -> bool {
    std::fs::read(file).is_ok_and(|bytes| format!("{:x}", Sha256::digest(bytes)) == expected)
}

/// Copies a file atomically, by renaming a complete copy.
fn copy(from: &Path, to: &Path) -> Result<()> {
    let directory = to.parent().context("a directory")?;
    std::fs::create_dir_all(directory)?;
    let half = tempfile::NamedTempFile::new_in(directory)?;
    std::fs::copy(from, half.path())?;
    half.persist(to)?;
    Ok(())
}

fn cache_directory() -> Result<PathBuf> {
    let variable = |name| std::env::var_os(name).filter(|value| !value.is_empty());
    let caches = variable("XDG_CACHE_HOME").map(PathBuf::from);
    let caches = caches.or_else(|| Some(PathBuf::from(variable("HOME")?).join(".cache")));
    Ok(caches.context("neither XDG_CACHE_HOME nor HOME is set")?.join("cloudroid/weights"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    /// Creates a package whose script writes "learned" and records that it ran.
    fn package(place: &Path) -> PathBuf {
        let package = place.join("package");
        std::fs::create_dir_all(package.join("models")).expect("a directory");
        let sum = format!("{:x}", Sha256::digest(b"learned"));
        let script = format!(
            "#!/bin/sh\n# {EXPECTED}{sum}\"\ncd \"$(dirname \"$0\")\"\necho run >> runs\nprintf learned > {FILE}\n"
        );
        let path = package.join("fetch_weights");
        std::fs::write(&path, script).expect("a script");
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).expect("ours");
        package
    }

    #[test]
    fn another_checkout_fetches_nothing() {
        let place = tempfile::tempdir().expect("a directory");
        let (package, cache) = (package(place.path()), place.path().join("cache"));
        install_from(&package, &cache).expect("it is fetched");
        // As in another checkout.
        std::fs::remove_file(package.join(FILE)).expect("it is there");
        install_from(&package, &cache).expect("it is kept");
        // A damaged file is not used.
        std::fs::write(package.join(FILE), "lear").expect("ours");
        install_from(&package, &cache).expect("it is kept");
        let read = |name: &str| std::fs::read_to_string(package.join(name)).expect("a file");
        assert_eq!((read(FILE), read("runs")), ("learned".into(), "run\n".into()));
    }
}
