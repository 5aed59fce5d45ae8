//! Reading small files of strangers.

use std::fs::File;
use std::io::Read;
use std::os::fd::OwnedFd;
use std::path::Path;

use rustix::fs::{FileType, Mode, OFlags};

use crate::Error;

/// The text of a file of at most `limit` bytes.
pub(crate) fn text(path: &Path, limit: u64) -> Result<String, Error> {
    // Not blocking: a fifo of this name must not stop us.
    let flags = OFlags::RDONLY | OFlags::CLOEXEC | OFlags::NONBLOCK;
    let file = rustix::fs::open(path, flags, Mode::empty())
        .map_err(|error| failed("open", path, error))?;
    utf8(bytes(file, path, limit)?, path)
}

/// The text of a file in a foreign tree, of at most `limit` bytes, through links that stay in it.
pub(crate) fn text_inside(root: &Path, path: &Path, limit: u64) -> Result<String, Error> {
    let below = path.strip_prefix(root).unwrap_or(path);
    let file = foreign::Tree::open(root)?.file_following(below, limit)?;
    let file = file.ok_or_else(|| failed("open", path, std::io::ErrorKind::NotFound))?;
    utf8(file.bytes, path)
}

fn utf8(bytes: Vec<u8>, path: &Path) -> Result<String, Error> {
    String::from_utf8(bytes).map_err(|error| {
        let problem = format!("it is not UTF-8: {}", error.utf8_error());
        failed(
            "read",
            path,
            std::io::Error::new(std::io::ErrorKind::InvalidData, problem),
        )
    })
}

/// The bytes of an open regular file, at most `limit`.
fn bytes(file: OwnedFd, path: &Path, limit: u64) -> Result<Vec<u8>, Error> {
    let stat = rustix::fs::fstat(&file).map_err(|error| failed("look at", path, error))?;
    if FileType::from_raw_mode(stat.st_mode) != FileType::RegularFile {
        let error = std::io::Error::new(std::io::ErrorKind::InvalidInput, "it is not a file");
        return Err(failed("read", path, error));
    }
    let mut bytes = Vec::new();
    File::from(file)
        .take(limit + 1)
        .read_to_end(&mut bytes)
        .map_err(|error| failed("read", path, error))?;
    if bytes.len() as u64 > limit {
        return Err(Error::TooLarge {
            path: path.to_owned(),
            limit,
        });
    }
    Ok(bytes)
}

/// A file operation that failed.
pub(crate) fn failed(action: &'static str, path: &Path, error: impl Into<std::io::Error>) -> Error {
    Error::File {
        action,
        path: path.to_owned(),
        source: error.into(),
    }
}
