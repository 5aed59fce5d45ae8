//! A separate cache for this benchmark, filled from the user's.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};

/// Fills `place/cache` with the user's cached layers, notes and lists; returns its path for `XDG_CACHE_HOME`.
pub(crate) fn copy_user_cache(place: &Path) -> Result<PathBuf> {
    let variable = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    let users = variable("XDG_CACHE_HOME").or_else(|| variable("HOME").map(|home| home.join(".cache")));
    let users = users.context("neither XDG_CACHE_HOME nor HOME is set")?.join("cloudroid");
    let cache = place.join("cache");
    for part in ["layers", "chains", "notes", "apt"] {
        copy_tree(&users.join(part), &cache.join("cloudroid").join(part))?;
    }
    Ok(cache)
}

/// Copies the base layer, with this digest, and the downloads from one cache to another.
pub(crate) fn copy_base_and_downloads(from: &Path, to: &Path, base: &str) -> Result<()> {
    let (from, to) = (from.join("cloudroid"), to.join("cloudroid"));
    copy_tree(&from.join("apt"), &to.join("apt"))?;
    let (layers, kept) = (from.join("layers"), to.join("layers"));
    fs::create_dir_all(&kept)?;
    for entry in fs::read_dir(&layers)? {
        let record = entry?.path();
        let archive = record.with_extension("tar.gz");
        if crate::packages::is_record_of_layer(&record, base) && archive.exists() {
            for path in [&record, &archive] {
                let name = path.file_name().unwrap_or_default();
                fs::copy(path, kept.join(name))?;
            }
        }
    }
    Ok(())
}

/// Copies the tree below `from`, if it exists; files that are never modified are hard-linked. Copies keep their times,
/// which decide whether lists are up to date.
fn copy_tree(from: &Path, to: &Path) -> Result<()> {
    let Ok(entries) = fs::read_dir(from) else {
        return Ok(());
    };
    fs::create_dir_all(to)?;
    for entry in entries {
        let entry = entry?;
        let (source, target) = (entry.path(), to.join(entry.file_name()));
        let kind = entry.file_type()?;
        if kind.is_dir() {
            copy_tree(&source, &target)?;
            continue;
        }
        let name = entry.file_name().to_string_lossy().into_owned();
        let whole = [".gz", ".deb"].iter().any(|ending| name.ends_with(ending));
        // Linking fails across file systems; copying may fail because another daemon has cleaned up meanwhile.
        let linked = whole && fs::hard_link(&source, &target).is_ok();
        if kind.is_file() && !linked && source.exists() {
            let copying = || format!("copying {}", source.display());
            fs::copy(&source, &target).with_context(copying)?;
            let time = source.metadata().and_then(|about| about.modified());
            let file = File::options().write(true).open(&target);
            file.and_then(|file| file.set_modified(time?)).with_context(copying)?;
        }
    }
    Ok(())
}
