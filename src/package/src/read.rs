//! Reading of small untrusted files.

use std::path::Path;

use crate::Error;

/// Reads the text of a file in an untrusted tree, of at most `limit` bytes, following links that stay inside.
pub(crate) fn read_text(root: &Path, path: &Path, limit: u64) -> Result<String, Error> {
    let below = path.strip_prefix(root).unwrap_or(path);
    let file = foreign::Tree::open(root)?.read_file_following(below, limit)?;
    let file = file.ok_or_else(|| file_error("open", path, std::io::ErrorKind::NotFound))?;
    decode_utf8(file.bytes, path)
}

fn decode_utf8(bytes: Vec<u8>, path: &Path) -> Result<String, Error> {
    String::from_utf8(bytes).map_err(|error| {
        let problem = format!("it is not UTF-8: {}", error.utf8_error());
        file_error("read", path, std::io::Error::new(std::io::ErrorKind::InvalidData, problem))
    })
}

/// Creates the error of a failed file operation.
pub(crate) fn file_error(action: &'static str, path: &Path, error: impl Into<std::io::Error>) -> Error {
    Error::File { action, path: path.to_owned(), source: error.into() }
}
