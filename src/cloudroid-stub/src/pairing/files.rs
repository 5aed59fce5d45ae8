//! Files of this robot's key and certificates.

use std::path::{Path, PathBuf};

/// Returns an error about a file of this robot's key or certificates.
pub(super) fn file_error(path: &Path, what: impl std::fmt::Display) -> anyhow::Error {
    anyhow::anyhow!("{}: {what}", path.display())
}

/// Writes a file atomically, accessible only to this user.
pub(super) fn write_atomically(path: &Path, text: &str) -> anyhow::Result<()> {
    use std::io::Write;
    use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
    let directory = path.parent().unwrap_or(Path::new("."));
    let mut making = std::fs::DirBuilder::new();
    making.recursive(true).mode(0o700);
    making.create(directory).map_err(|error| file_error(directory, error))?;
    let half = temporary_path(path);
    let _ = std::fs::remove_file(&half);
    let written = || -> std::io::Result<()> {
        let mut file = std::fs::OpenOptions::new().write(true).create_new(true).mode(0o600).open(&half)?;
        file.write_all(text.as_bytes())?;
        file.sync_all()?;
        std::fs::rename(&half, path)
    };
    written().map_err(|error| file_error(path, error))
}

fn temporary_path(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(format!(".{}", std::process::id()));
    name.into()
}
