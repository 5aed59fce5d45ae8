//! Reading small untrusted files.

use std::path::Path;

use crate::Error;

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

/// A file operation that failed.
pub(crate) fn failed(action: &'static str, path: &Path, error: impl Into<std::io::Error>) -> Error {
    Error::File {
        action,
        path: path.to_owned(),
        source: error.into(),
    }
}
