//! List of all files in a stub's archive. `install.sh` creates the same list of the files it finds, with `find` and
//! `sha256sum`, and compares them byte by byte.

use sha2::{Digest, Sha256};

use super::{Content, Files};

/// Name of the list in the archive.
pub const MANIFEST: &str = "MANIFEST";
/// Name of the list's signature.
pub const SIGNATURE: &str = "MANIFEST.sig";
/// Public key of the server in OpenSSH's allowed-signers format.
pub const SIGNER: &str = "server.pub";

/// Returns the list: one line for each file (`x` if executable) and link, sorted bytewise.
pub fn manifest(files: &Files) -> String {
    let mut lines: Vec<String> = files
        .iter()
        .map(|(path, content)| match content {
            Content::File { bytes, executable } => {
                let kind = if *executable { 'x' } else { '-' };
                let hash = hex::encode(Sha256::digest(bytes));
                // The escaping that sha256sum uses for such names.
                if path.contains('\\') {
                    format!("{kind} \\{hash}  ./{}\n", path.replace('\\', "\\\\"))
                } else {
                    format!("{kind} {hash}  ./{path}\n")
                }
            }
            Content::Link(target) => format!("l ./{path} -> {target}\n"),
        })
        .collect();
    lines.sort_unstable();
    lines.concat()
}
