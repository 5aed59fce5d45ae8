//! File capabilities in their on-disk format (`struct vfs_ns_cap_data`, linux/capability.h).
//!
//! A file that got its capabilities inside a user namespace has them in version 3, bound to the host id of the
//! namespace's root. In a layer they are in version 2, bound to root wherever the layer is used.

/// Name of the extended attribute.
pub(crate) const NAME: &[u8] = b"security.capability";

const REVISION_MASK: u32 = 0xFF00_0000;
const REVISION_2: u32 = 0x0200_0000;
const REVISION_3: u32 = 0x0300_0000;
const SIZE_2: usize = 20;
const SIZE_3: usize = 24;

/// Converts a value to version 2; `None` if it is of another version, or bound to another root id than `root`.
pub(crate) fn as_version_2(value: &[u8], root: u32) -> Option<Vec<u8>> {
    let word = |at: usize| value.get(at..at + 4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
    let magic = word(0)?;
    match (magic & REVISION_MASK, value.len()) {
        (REVISION_2, SIZE_2) => Some(value.to_vec()),
        (REVISION_3, SIZE_3) if word(20)? == root => {
            let mut version_2 = value[..SIZE_2].to_vec();
            version_2[..4].copy_from_slice(&(magic & !REVISION_MASK | REVISION_2).to_le_bytes());
            Some(version_2)
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// CAP_NET_RAW, effective; version 3 with a root id.
    fn version_3(root: u32) -> Vec<u8> {
        let mut value = 0x0300_0001_u32.to_le_bytes().to_vec();
        value.extend(0x2000_u32.to_le_bytes());
        value.extend([0; 12]);
        value.extend(root.to_le_bytes());
        value
    }

    #[test]
    fn version_3_of_the_own_namespace_becomes_version_2() {
        let value = as_version_2(&version_3(100_000), 100_000).unwrap();
        assert_eq!(value.len(), 20);
        assert_eq!(value[..4], 0x0200_0001_u32.to_le_bytes());
        assert_eq!(value[4..8], 0x2000_u32.to_le_bytes());
        assert_eq!(as_version_2(&value, 100_000).unwrap(), value);
    }

    #[test]
    fn other_namespaces_and_nonsense_are_dropped() {
        assert_eq!(as_version_2(&version_3(5), 100_000), None);
        assert_eq!(as_version_2(b"", 0), None);
        assert_eq!(as_version_2(&[0; 20], 0), None);
        assert_eq!(as_version_2(&version_3(0)[..20], 0), None);
    }
}
