//! Normalization of the paths of archive entries.

use crate::Refusal;
use crate::entry::display_name;

/// Maximum depth of a tree. Each level costs an open file while a tree is walked.
pub(crate) const MAX_DEPTH: usize = foreign::MAX_DEPTH;

/// Maximum length of a path accepted by the kernel, without the final NUL.
pub(crate) const MAX_PATH: usize = 4095;

/// Maximum length of a file name.
const MAX_NAME: usize = 255;

/// Normalizes a path: `./a//b/` becomes `a/b`, without `.`, `..` and empty components; empty for the root itself. A
/// leading `/` is dropped; callers that reject absolute paths check before.
pub(crate) fn normalize(name: &[u8], longest: usize) -> Result<Vec<u8>, Refusal> {
    let bad = |problem: String| Refusal::BadName { entry: display_name(name), problem };
    if name.contains(&0) {
        return Err(bad("it contains a NUL byte".to_owned()));
    }
    if name.len() > longest {
        return Err(bad(format!("it is {} bytes long; the limit is {longest}", name.len())));
    }
    let mut path = Vec::with_capacity(name.len());
    let mut depth = 0;
    for part in name.split(|&byte| byte == b'/') {
        match part {
            b"" | b"." => continue,
            b".." => {
                return Err(Refusal::ParentDirectory { entry: display_name(name) });
            }
            long if long.len() > MAX_NAME => {
                return Err(bad(format!("one part is {} bytes long; the limit is {MAX_NAME}", long.len())));
            }
            part => {
                if !path.is_empty() {
                    path.push(b'/');
                }
                path.extend_from_slice(part);
                depth += 1;
            }
        }
    }
    if depth > MAX_DEPTH {
        return Err(bad(format!("it is {depth} directories deep; the limit is {MAX_DEPTH}")));
    }
    Ok(path)
}

/// Splits a path into its directory (empty for the root) and its last component.
pub(crate) fn split(path: &[u8]) -> (&[u8], &[u8]) {
    match path.iter().rposition(|&byte| byte == b'/') {
        Some(slash) => (&path[..slash], &path[slash + 1..]),
        None => (b"", path),
    }
}

/// Joins `directory` and `name`; the directory may be empty for the root.
pub(crate) fn join(directory: &[u8], name: &[u8]) -> Vec<u8> {
    if directory.is_empty() {
        return name.to_vec();
    }
    [directory, b"/", name].concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refusal(name: &[u8]) -> String {
        normalize(name, 4000).unwrap_err().to_string()
    }

    #[test]
    fn drops_what_means_nothing() {
        assert_eq!(normalize(b"./a//b/./c/", 100).unwrap(), b"a/b/c");
        assert_eq!(normalize(b"./", 100).unwrap(), b"");
        assert_eq!(split(b"a/b/c"), (&b"a/b"[..], &b"c"[..]));
        assert_eq!(split(b"c"), (&b""[..], &b"c"[..]));
    }

    #[test]
    fn refuses_what_leaves_or_cannot_be() {
        assert!(refusal(b"a/../b").contains("goes up with '..'"));
        assert!(refusal(b"a\0b").contains("NUL"));
        assert!(refusal(&[b'x'; 256]).contains("one part is 256 bytes long"));
        assert!(refusal(&[b'x'; 4001]).contains("4001 bytes long"));
        assert!(refusal(&b"d/".repeat(257)).contains("257 directories deep"));
    }
}
