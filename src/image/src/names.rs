//! Paths of archive entries, made safe to walk.

use crate::Refusal;
use crate::entry::shown;

/// Directories within directories that a tree may have. Each level costs an open file while a tree is walked.
pub(crate) const MAX_DEPTH: usize = foreign::MAX_DEPTH;

/// The longest path that the kernel takes, less its final NUL.
pub(crate) const MAX_PATH: usize = 4095;

/// The longest name of one file.
const MAX_NAME: usize = 255;

/// `a/b` of `./a//b/`: no `.`, no `..`, no empty part; empty for the root itself. A leading `/` is dropped:
/// who minds checks before.
pub(crate) fn normal(name: &[u8], longest: usize) -> Result<Vec<u8>, Refusal> {
    let bad = |problem: String| Refusal::BadName {
        entry: shown(name),
        problem,
    };
    if name.contains(&0) {
        return Err(bad("it contains a NUL byte".to_owned()));
    }
    if name.len() > longest {
        return Err(bad(format!(
            "it is {} bytes long, and {longest} are accepted",
            name.len()
        )));
    }
    let mut path = Vec::with_capacity(name.len());
    let mut depth = 0;
    for part in name.split(|&byte| byte == b'/') {
        match part {
            b"" | b"." => continue,
            b".." => return Err(Refusal::ParentDirectory { entry: shown(name) }),
            long if long.len() > MAX_NAME => {
                return Err(bad(format!(
                    "one part is {} bytes long, and {MAX_NAME} are possible",
                    long.len()
                )));
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
        return Err(bad(format!(
            "it is {depth} directories deep, and {MAX_DEPTH} are accepted"
        )));
    }
    Ok(path)
}

/// The directory (empty for the root) and the last part.
pub(crate) fn split(path: &[u8]) -> (&[u8], &[u8]) {
    match path.iter().rposition(|&byte| byte == b'/') {
        Some(slash) => (&path[..slash], &path[slash + 1..]),
        None => (b"", path),
    }
}

/// `directory/name`, or `name` in the root.
pub(crate) fn join(directory: &[u8], name: &[u8]) -> Vec<u8> {
    if directory.is_empty() {
        return name.to_vec();
    }
    [directory, b"/", name].concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(name: &[u8]) -> String {
        normal(name, 4000).unwrap_err().to_string()
    }

    #[test]
    fn drops_what_means_nothing() {
        assert_eq!(normal(b"./a//b/./c/", 100).unwrap(), b"a/b/c");
        assert_eq!(normal(b"./", 100).unwrap(), b"");
        assert_eq!(split(b"a/b/c"), (&b"a/b"[..], &b"c"[..]));
        assert_eq!(split(b"c"), (&b""[..], &b"c"[..]));
    }

    #[test]
    fn refuses_what_leaves_or_cannot_be() {
        assert!(refused(b"a/../b").contains("goes up with '..'"));
        assert!(refused(b"a\0b").contains("NUL"));
        assert!(refused(&[b'x'; 256]).contains("one part is 256 bytes long"));
        assert!(refused(&[b'x'; 4001]).contains("4001 bytes long"));
        assert!(refused(&b"d/".repeat(257)).contains("257 directories deep"));
    }
}
