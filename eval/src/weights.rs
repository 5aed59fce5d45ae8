//! What the detector has learned: fetched once, kept in the user's cache directory under the name of what was fetched, and put beside the
//! package's sources of each checkout from there.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use sha2::{Digest, Sha256};

use crate::deadline;

/// Of a package's directory.
const FILE: &str = "models/centernet.onnx";
/// In the script, before the SHA-256 that the file must have.
const EXPECTED: &str = "MODEL_SHA256 = \"";

/// For fetching some tens of megabytes.
const LONGEST: Duration = Duration::from_secs(600);

/// Puts it into `package`, where it is not there yet.
pub fn put_into(package: &Path) -> Result<()> {
    put(package, &cache()?)
}

fn put(package: &Path, cache: &Path) -> Result<()> {
    let (script, file) = (package.join("fetch_weights"), package.join(FILE));
    let text = std::fs::read_to_string(&script).with_context(|| script.display().to_string())?;
    let expected = text
        .split_once(EXPECTED)
        .and_then(|(_, rest)| rest.get(..64));
    let expected = expected.with_context(|| format!("{} names no SHA-256", script.display()))?;
    let kept = cache.join(format!("{expected}.onnx"));
    if !is(&file, expected) {
        if is(&kept, expected) {
            copy(&kept, &file)?;
            return Ok(());
        }
        let status = deadline::ends(
            &mut Command::new(&script).spawn()?,
            &script.display().to_string(),
            LONGEST,
        )?;
        ensure!(
            status.success() && is(&file, expected),
            "the detector's weights could not be fetched ({status}): run {}, which takes them from the registry of npm",
            script.display()
        );
    }
    if !kept.exists() {
        copy(&file, &kept)?;
    }
    Ok(())
}

fn is(file: &Path, expected: &str) -> bool {
    std::fs::read(file).is_ok_and(|bytes| format!("{:x}", Sha256::digest(bytes)) == expected)
}

/// Under its name when it is whole.
fn copy(from: &Path, to: &Path) -> Result<()> {
    let directory = to.parent().context("a directory")?;
    std::fs::create_dir_all(directory)?;
    let half = tempfile::NamedTempFile::new_in(directory)?;
    std::fs::copy(from, half.path())?;
    half.persist(to)?;
    Ok(())
}

fn cache() -> Result<PathBuf> {
    let variable = |name| std::env::var_os(name).filter(|value| !value.is_empty());
    let caches = variable("XDG_CACHE_HOME").map(PathBuf::from);
    let caches = caches.or_else(|| Some(PathBuf::from(variable("HOME")?).join(".cache")));
    Ok(caches
        .context("neither XDG_CACHE_HOME nor HOME is set")?
        .join("cloudroid/weights"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::PermissionsExt;

    /// A package whose script writes "learned" and notes that it was run.
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
        put(&package, &cache).expect("it is fetched");
        // As in another checkout.
        std::fs::remove_file(package.join(FILE)).expect("it is there");
        put(&package, &cache).expect("it is kept");
        // What is damaged is not taken.
        std::fs::write(package.join(FILE), "lear").expect("ours");
        put(&package, &cache).expect("it is kept");
        let read = |name: &str| std::fs::read_to_string(package.join(name)).expect("a file");
        assert_eq!(
            (read(FILE), read("runs")),
            ("learned".into(), "run\n".into())
        );
    }
}
