//! Kinds of archives, which their first entry tells apart, so that each is taken in while it arrives.

use std::io::Read;

use crate::entry::Kind;
use crate::gzip;
use crate::tar_reader::TarReader;

/// Number of bytes from the beginning of an archive that tell its kind.
pub const BEGINNING: usize = 64 << 10;

/// Content of an archive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ArchiveKind {
    /// An image: documents, and layers in files of their own.
    Image,
    /// Files of a system, from its root.
    Root,
}

/// Returns the kind of the archive that begins with these bytes. What cannot be read counts as an image, whose reader
/// reports the error.
pub fn detect_archive(beginning: &[u8]) -> ArchiveKind {
    let Ok(content) = gzip::decoder(beginning) else {
        return ArchiveKind::Image;
    };
    // Of a compressed archive the beginning may be much longer than what was sent.
    let mut reader = TarReader::new(content.take(4 * BEGINNING as u64));
    loop {
        match reader.next_entry() {
            Ok(Some(entry)) => {
                let mut parts = entry.name.split(|&byte| byte == b'/').filter(|part| !matches!(*part, b"" | b"."));
                match parts.next() {
                    Some(first) if is_part_of_image(first) => return ArchiveKind::Image,
                    Some(_) => return ArchiveKind::Root,
                    None if entry.kind == Kind::Directory => {}
                    None => return ArchiveKind::Root,
                }
            }
            Ok(None) | Err(_) => return ArchiveKind::Image,
        }
    }
}

/// Returns whether a name at the root of an archive is one that writers of images use: of the OCI image layout 1.1, or
/// of docker's archives, where layers and configurations are named by digests.
fn is_part_of_image(name: &[u8]) -> bool {
    let known: [&[u8]; 6] = [b"blobs", b"oci-layout", b"index.json", b"manifest.json", b"repositories", b"VERSION"];
    let stem = name.strip_suffix(b".tar").or(name.strip_suffix(b".json")).unwrap_or(name);
    known.contains(&name) || stem.len() == 64 && stem.iter().all(u8::is_ascii_hexdigit)
}

#[cfg(test)]
mod tests {
    use tar::EntryType;

    use super::*;
    use crate::tar_reader::tests::member;

    fn beginning(names: &[(&str, EntryType)]) -> Vec<u8> {
        names.iter().flat_map(|(name, kind)| member(*kind, name, b"")).collect()
    }

    #[test]
    fn the_first_name_tells_an_image_from_a_system() {
        let (file, directory) = (EntryType::Regular, EntryType::Directory);
        let hex = "0123456789abcdef".repeat(4);
        let (layer, config) = (format!("{hex}/layer.tar"), format!("{hex}.json"));
        for (names, expected) in [
            (&[("blobs/", directory)][..], ArchiveKind::Image),
            (&[("./", directory), ("./oci-layout", file)], ArchiveKind::Image),
            (&[("manifest.json", file)], ArchiveKind::Image),
            (&[(layer.as_str(), file)], ArchiveKind::Image),
            (&[(config.as_str(), file)], ArchiveKind::Image),
            (&[("./", directory), ("./bin", EntryType::Symlink)], ArchiveKind::Root),
            (&[("etc/hostname", file)], ArchiveKind::Root),
            (&[("usr/share/blobs/x", file)], ArchiveKind::Root),
        ] {
            let plain = beginning(names);
            assert_eq!(detect_archive(&plain), expected, "{names:?}");
            let packed = zstd::stream::encode_all(&plain[..], 1).expect("packed");
            assert_eq!(detect_archive(&packed), expected, "{names:?}");
        }
        for unreadable in [&b""[..], b"#!/bin/sh\n", &[0x1f, 0x8b, 0, 0]] {
            assert_eq!(detect_archive(unreadable), ArchiveKind::Image);
        }
    }
}
