//! The list of all that a stub's archive holds. `install.sh` makes the same list of what it finds, with `find` and
//! `sha256sum`, and compares them byte by byte.

use sha2::{Digest, Sha256};

use super::{Content, Files};

/// The list's name in the archive.
pub const MANIFEST: &str = "MANIFEST";
/// Its signature's name.
pub const SIGNATURE: &str = "MANIFEST.sig";
/// The server's key, as OpenSSH lists signers.
pub const SIGNER: &str = "server.pub";

/// One line for each file (`x` where it may be executed) and link, sorted by bytes.
pub fn manifest(files: &Files) -> String {
    let mut lines: Vec<String> = files
        .iter()
        .map(|(path, content)| match content {
            Content::File { bytes, executable } => {
                let kind = if *executable { 'x' } else { '-' };
                let hash = hex::encode(Sha256::digest(bytes));
                // As sha256sum writes such names.
                match path.contains('\\') {
                    false => format!("{kind} {hash}  ./{path}\n"),
                    true => format!("{kind} \\{hash}  ./{}\n", path.replace('\\', "\\\\")),
                }
            }
            Content::Link(target) => format!("l ./{path} -> {target}\n"),
        })
        .collect();
    lines.sort_unstable();
    lines.concat()
}
