//! Dependencies of compiled files: reads the dynamic section of ELF files (System V gABI, chapter 5).

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

use foreign::Visit;
use rustix::fs::FileType;

use crate::error::{Error, IoContext};

/// Names in the dynamic section.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Dynamic {
    /// Required libraries (`DT_NEEDED`).
    pub(crate) needed: BTreeSet<String>,
}

const PT_LOAD: u32 = 1;
const PT_DYNAMIC: u32 = 2;
const DT_NULL: u64 = 0;
const DT_NEEDED: u64 = 1;
const DT_STRTAB: u64 = 5;
const DT_STRSZ: u64 = 10;
/// Maximum size of a header table or dynamic section; a damaged header may state more.
const LARGEST: u64 = 1 << 20;
/// Maximum number of names that are read of a file, and of all files. Entries may all name parts of one long text, so
/// that a small file has any number of long names.
const MOST_OF_FILE: usize = 1024;
const MOST_OF_ALL: usize = 20_000;
/// Maximum length of a file's name.
const LONGEST_NAME: u64 = 255;

struct Segment {
    kind: u32,
    offset: u64,
    address: u64,
    size: u64,
}

/// Reads a file; `None` if it is not a dynamically linked, little-endian ELF file.
fn read_dynamic(mut file: File, path: &Path) -> Result<Option<Dynamic>, Error> {
    let mut magic = Vec::new();
    (&mut file).take(64).read_to_end(&mut magic).io_context("reading", path)?;
    if magic.len() < 52 || !magic.starts_with(b"\x7fELF") || magic[5] != 1 {
        return Ok(None);
    }
    // A damaged file is not reported here: loading it will fail.
    Ok(parse_dynamic(&mut file, &magic))
}

fn parse_dynamic(file: &mut File, header: &[u8]) -> Option<Dynamic> {
    let wide = header[4] == 2;
    let (table, size, count) = if wide {
        (u64_at(header, 32)?, u16_at(header, 54)?, u16_at(header, 56)?)
    } else {
        (u32_at(header, 28)?.into(), u16_at(header, 42)?, u16_at(header, 44)?)
    };
    let headers = read_range(file, table, u64::from(size) * u64::from(count))?;
    let segments: Vec<Segment> =
        headers.chunks_exact(usize::from(size).max(1)).filter_map(|raw| parse_segment(raw, wide)).collect();
    let place = segments.iter().find(|s| s.kind == PT_DYNAMIC)?;
    let entries = read_range(file, place.offset, place.size)?;
    let mut names = Vec::new();
    let (mut strings, mut length) = (None, 0);
    for entry in entries.chunks_exact(if wide { 16 } else { 8 }) {
        let (tag, value) = if wide {
            (u64_at(entry, 0)?, u64_at(entry, 8)?)
        } else {
            (u32_at(entry, 0)?.into(), u32_at(entry, 4)?.into())
        };
        match tag {
            DT_NULL => break,
            DT_NEEDED => names.push(value),
            DT_STRTAB => strings = Some(value),
            DT_STRSZ => length = value,
            _ => {}
        }
    }
    // The table's address is a memory address; the segment that contains it gives its offset in the file.
    let address = strings?;
    let mut loaded = segments.iter().filter(|s| s.kind == PT_LOAD);
    let place = loaded.find_map(|segment| {
        let inside = address.checked_sub(segment.address)?;
        (inside < segment.size).then(|| segment.offset.checked_add(inside))
    })??;
    let mut needed = BTreeSet::new();
    for at in names.into_iter().filter(|at| *at < length).take(MOST_OF_FILE) {
        needed.extend(read_name(file, place.checked_add(at)?, length - at));
    }
    Some(Dynamic { needed })
}

/// Reads the name at `offset`, which ends with a zero within `most` bytes; `None` if no file can have it.
fn read_name(file: &mut File, offset: u64, most: u64) -> Option<String> {
    file.seek(SeekFrom::Start(offset)).ok()?;
    let mut bytes = Vec::new();
    (&mut *file).take(most.min(LONGEST_NAME + 1)).read_to_end(&mut bytes).ok()?;
    bytes.truncate(bytes.iter().position(|byte| *byte == 0)?);
    String::from_utf8(bytes).ok().filter(|name| !name.is_empty())
}

fn parse_segment(raw: &[u8], wide: bool) -> Option<Segment> {
    let kind = u32_at(raw, 0)?;
    Some(if wide {
        Segment { kind, offset: u64_at(raw, 8)?, address: u64_at(raw, 16)?, size: u64_at(raw, 32)? }
    } else {
        let field = |at| u32_at(raw, at).map(u64::from);
        Segment { kind, offset: field(4)?, address: field(8)?, size: field(16)? }
    })
}

fn read_range(file: &mut File, offset: u64, size: u64) -> Option<Vec<u8>> {
    if size > LARGEST {
        return None;
    }
    let mut bytes = vec![0; usize::try_from(size).ok()?];
    file.seek(SeekFrom::Start(offset)).ok()?;
    file.read_exact(&mut bytes).ok()?;
    Some(bytes)
}

fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    Some(u16::from_le_bytes(bytes.get(at..at + 2)?.try_into().ok()?))
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?))
}

fn u64_at(bytes: &[u8], at: usize) -> Option<u64> {
    Some(u64::from_le_bytes(bytes.get(at..at + 8)?.try_into().ok()?))
}

/// Returns the libraries that ELF files below `root` need and that are not below it themselves.
pub(crate) fn needed_libraries(root: &Path) -> Result<BTreeSet<String>, Error> {
    let (mut needed, mut present) = (BTreeSet::new(), BTreeSet::new());
    foreign::walk(root, |entry| {
        if entry.kind() != FileType::Directory {
            present.insert(entry.name().to_string_lossy().into_owned());
        }
        if entry.kind() == FileType::RegularFile
            && needed.len() < MOST_OF_ALL
            && let Some(dynamic) = read_dynamic(entry.open()?, &entry.display_path())?
        {
            needed.extend(dynamic.needed);
        }
        Ok::<_, Error>(Visit::Into)
    })?;
    // A name with a slash is a path, which cannot be looked up in packages.
    needed.retain(|name| !name.contains('/') && !present.contains(name));
    Ok(needed)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(path: &Path) -> Result<Option<Dynamic>, Error> {
        read_dynamic(File::open(path).io_context("reading", path)?, path)
    }

    #[test]
    fn a_program_tells_what_it_needs() {
        let own = std::env::current_exe().expect("known");
        let dynamic = read(&own).expect("read").expect("an ELF file");
        assert!(dynamic.needed.iter().any(|name| name.starts_with("libc.so.")), "{dynamic:?}");
    }

    #[test]
    fn anything_else_needs_nothing() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("x");
        let own = std::fs::read(std::env::current_exe().expect("known")).expect("read");
        let cases: [&[u8]; 4] = [b"", b"#!/bin/sh\n", &own[..40], &own[..100]];
        for bytes in cases {
            std::fs::write(&path, bytes).expect("written");
            assert_eq!(read(&path).expect("read"), None);
        }
    }

    /// Creates a 64-bit file with one loaded segment, a dynamic section and a string table behind it.
    fn elf_file(segment: Segment, entries: &[(u64, u64)], strings: &[u8]) -> Vec<u8> {
        let dynamic = Segment { kind: PT_DYNAMIC, offset: 64 + 2 * 56, address: 0, size: 16 * entries.len() as u64 };
        let mut bytes = b"\x7fELF\x02\x01".to_vec();
        bytes.resize(64, 0);
        bytes[32..40].copy_from_slice(&64_u64.to_le_bytes());
        bytes[54..58].copy_from_slice(&[56, 0, 2, 0]);
        for segment in [segment, dynamic] {
            let fields = [segment.kind.into(), segment.offset, segment.address, 0, segment.size, 0, 0];
            bytes.extend(fields.iter().flat_map(|field: &u64| field.to_le_bytes()));
        }
        for (tag, value) in entries {
            bytes.extend([tag, value].iter().flat_map(|word| word.to_le_bytes()));
        }
        bytes.extend(strings);
        bytes
    }

    #[test]
    fn a_file_whose_numbers_mean_nothing_needs_nothing() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("x");
        let needs = |offset, address, size, table| {
            let kind = PT_LOAD;
            let segment = Segment { kind, offset, address, size };
            let entries = [(DT_NEEDED, 1), (DT_STRTAB, table), (DT_STRSZ, 9), (DT_NULL, 0)];
            std::fs::write(&path, elf_file(segment, &entries, b"\0libx.so\0")).expect("written");
            let dynamic = read(&path).expect("read")?;
            dynamic.needed.into_iter().next()
        };
        let strings = 64 + 2 * 56 + 4 * 16;
        assert_eq!(needs(0, 0x1000, 1 << 20, 0x1000 + strings).as_deref(), Some("libx.so"));
        for (offset, address, size, table) in [
            (0, u64::MAX - 8, 100, u64::MAX - 1),
            (u64::MAX - 8, 0, u64::MAX, 100),
            (u64::MAX, u64::MAX, u64::MAX, u64::MAX),
            (0, 0x1000, 100, 0),
        ] {
            assert_eq!(needs(offset, address, size, table), None, "{offset} {address}");
        }
    }

    #[test]
    fn many_names_in_one_long_text_take_little() {
        const LENGTH: u64 = 1 << 20;
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("x");
        let mut strings = vec![b'a'; LENGTH as usize];
        strings.extend(b"\0");
        // The last ones are short enough for names of files; there are more than are read.
        let mut entries: Vec<(u64, u64)> = (0..40_000).map(|number| (DT_NEEDED, LENGTH - 1 - number)).collect();
        let table = 64 + 2 * 56 + 16 * (entries.len() as u64 + 3);
        entries.extend([(DT_STRTAB, table), (DT_STRSZ, LENGTH + 1), (DT_NULL, 0)]);
        let segment = Segment { kind: PT_LOAD, offset: 0, address: 0, size: u64::MAX };
        std::fs::write(&path, elf_file(segment, &entries, &strings)).expect("written");
        let needed = read(&path).expect("read").expect("an ELF file").needed;
        assert_eq!(needed.len(), 255);
        assert!(needed.iter().all(|name| name.len() <= 255));
    }

    #[test]
    fn what_is_beside_it_is_not_needed_from_elsewhere() {
        let directory = tempfile::tempdir().expect("a directory");
        std::fs::copy(std::env::current_exe().expect("known"), directory.path().join("x")).expect("copied");
        let before = needed_libraries(directory.path()).expect("read");
        let libc = before.iter().find(|name| name.starts_with("libc.so.")).expect("needed").clone();
        std::fs::write(directory.path().join(&libc), "").expect("written");
        assert!(!needed_libraries(directory.path()).expect("read").contains(&libc));
    }
}
