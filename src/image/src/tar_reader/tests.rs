use tar::EntryType;

use super::*;

/// Returns an arbitrary header with its content.
pub(crate) fn member(kind: EntryType, name: &str, content: &[u8]) -> Vec<u8> {
    let mut header = Header::new_ustar();
    header.set_entry_type(kind);
    header.set_path(name).expect("a short name");
    header.set_mode(0o644);
    header.set_size(content.len() as u64);
    header.set_cksum();
    let mut bytes = header.as_bytes().to_vec();
    bytes.extend_from_slice(content);
    bytes.resize(bytes.len().next_multiple_of(BLOCK), 0);
    bytes
}

/// Returns pax records of attributes without values: the most memory for their length.
fn attributes(count: usize) -> Vec<u8> {
    b"19 SCHILY.xattr.a=\n".repeat(count)
}

/// Returns an archive of a file preceded by `extensions`, with an end mark.
pub(crate) fn archive(extensions: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = extensions.concat();
    bytes.extend(member(EntryType::Regular, "f", b"content"));
    bytes.extend([0; 2 * BLOCK]);
    bytes
}

/// Returns a pax header with `count` attributes.
pub(crate) fn extension(count: usize) -> Vec<u8> {
    member(EntryType::XHeader, "pax", &attributes(count))
}

fn refusal(archive: &[u8]) -> String {
    match TarReader::new(archive).next_entry() {
        Err(ReadStop::Refused(problem)) => problem.to_string(),
        Err(ReadStop::Source(error)) => panic!("{error}"),
        Ok(entry) => panic!("it is read: {}", entry.map_or(0, |entry| entry.xattrs.len())),
    }
}

#[test]
fn what_a_file_can_have_is_read() {
    let largest = MAX_EXTENSION as usize / attributes(1).len();
    let name = member(EntryType::GNULongName, "long", b"name\0");
    let archive = archive(&[name, extension(largest - 1)]);
    let mut reader = TarReader::new(&archive[..]);
    let Ok(Some(entry)) = reader.next_entry() else { panic!("it is a good entry") };
    assert_eq!(entry.name, b"name");
    assert_eq!(entry.xattrs.len(), largest - 1);
    assert_eq!(reader.headers(), 3);
}

#[test]
fn extended_headers_of_one_entry_are_few() {
    for kind in [EntryType::XHeader, EntryType::XGlobalHeader, EntryType::GNULongName, EntryType::GNULongLink] {
        let one = member(kind, "extended", b"");
        let many = archive(&vec![one.clone(); 9]);
        let said = refusal(&many);
        assert!(said.contains("more than 8 extended headers"), "{said}");
        let few = archive(&vec![one; 8]);
        assert!(matches!(TarReader::new(&few[..]).next_entry(), Ok(Some(_))));
    }
}

#[test]
fn extended_headers_of_one_entry_are_small_in_all() {
    let half = MAX_EXTENSION as usize / attributes(1).len() / 2;
    let said = refusal(&archive(&[extension(half), extension(half + 100)]));
    assert!(said.contains("extended headers of"), "{said}");
    let name = member(EntryType::GNULongName, "long", &vec![b'n'; 600 << 10]);
    let link = member(EntryType::GNULongLink, "long", &vec![b'l'; 600 << 10]);
    let said = refusal(&archive(&[name, link]));
    assert!(said.contains("extended headers of"), "{said}");
}
