//! Writer of tar streams: ustar, with a pax header only where ustar is not sufficient, so that the same entries always
//! give the same bytes.

use std::io::{self, Read, Write};

use tar::Header;

use crate::entry::{Entry, Kind};

const BLOCK: usize = 512;
/// Maximum values of the octal fields of ustar.
const MAX_SIZE: u64 = 0o77_777_777_777;
const MAX_ID: u64 = 0o7_777_777;

pub(crate) struct TarWriter<W> {
    output: W,
}

impl<W: Write> TarWriter<W> {
    pub(crate) fn new(output: W) -> Self {
        Self { output }
    }

    /// Writes the header of an entry, whose content, if any, follows.
    pub(crate) fn write_header(&mut self, entry: &Entry) -> io::Result<()> {
        let records = pax_records(entry);
        if !records.is_empty() {
            let mut extended = Entry::new(*b"././@PaxHeader", Kind::Other(b'x'), 0o644);
            extended.size = records.len() as u64;
            self.output.write_all(ustar(&extended).as_bytes())?;
            self.output.write_all(&records)?;
            self.pad(records.len() as u64)?;
        }
        self.output.write_all(ustar(entry).as_bytes())
    }

    /// Writes a file with exactly `entry.size` bytes of `content`; `UnexpectedEof` if there are fewer.
    pub(crate) fn write_file(&mut self, entry: &Entry, content: impl Read, buffer: &mut [u8]) -> io::Result<()> {
        self.write_header(entry)?;
        let mut content = content.take(entry.size);
        let mut copied = 0;
        while copied < entry.size {
            let read = content.read(buffer)?;
            if read == 0 {
                return Err(io::ErrorKind::UnexpectedEof.into());
            }
            self.output.write_all(&buffer[..read])?;
            copied += read as u64;
        }
        self.pad(entry.size)
    }

    /// Writes the end mark.
    pub(crate) fn finish(mut self) -> io::Result<W> {
        self.output.write_all(&[0; 2 * BLOCK])?;
        Ok(self.output)
    }

    fn pad(&mut self, size: u64) -> io::Result<()> {
        let padding = (BLOCK as u64 - size % BLOCK as u64) % BLOCK as u64;
        self.output.write_all(&[0; BLOCK][..padding as usize])
    }
}

fn pax_records(entry: &Entry) -> Vec<u8> {
    let mut records = Vec::new();
    if entry.name.len() > 100 {
        pax_record(&mut records, b"path", &entry.name);
    }
    if entry.link.len() > 100 {
        pax_record(&mut records, b"linkpath", &entry.link);
    }
    for (key, value, most) in [("size", entry.size, MAX_SIZE), ("uid", entry.uid, MAX_ID), ("gid", entry.gid, MAX_ID)] {
        if value > most {
            pax_record(&mut records, key.as_bytes(), value.to_string().as_bytes());
        }
    }
    for (name, value) in &entry.xattrs {
        pax_record(&mut records, &[b"SCHILY.xattr.", &name[..]].concat(), value);
    }
    records
}

/// Appends a record `LENGTH KEY=VALUE `, where LENGTH includes itself.
fn pax_record(records: &mut Vec<u8>, key: &[u8], value: &[u8]) {
    let rest = key.len() + value.len() + 3;
    let mut length = rest + 1;
    while length != rest + length.to_string().len() {
        length = rest + length.to_string().len();
    }
    records.extend_from_slice(length.to_string().as_bytes());
    records.push(b' ');
    records.extend_from_slice(key);
    records.push(b'=');
    records.extend_from_slice(value);
    records.push(b'\n');
}

fn ustar(entry: &Entry) -> Header {
    let mut header = Header::new_ustar();
    header.set_entry_type(tar::EntryType::new(entry.kind.typeflag()));
    header.set_mode(entry.mode);
    header.set_uid(entry.uid.min(MAX_ID));
    header.set_gid(entry.gid.min(MAX_ID));
    header.set_mtime(entry.mtime.min(MAX_SIZE));
    header.set_size(entry.size.min(MAX_SIZE));
    if let Some(fields) = header.as_ustar_mut() {
        let length = entry.name.len().min(100);
        fields.name[..length].copy_from_slice(&entry.name[..length]);
        let length = entry.link.len().min(100);
        fields.linkname[..length].copy_from_slice(&entry.link[..length]);
        if matches!(entry.kind, Kind::Character | Kind::Block) {
            fields.set_device_major(entry.device.0);
            fields.set_device_minor(entry.device.1);
        }
    }
    header.set_cksum();
    header
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tar_reader::TarReader;

    fn round_trip(entry: &Entry, content: &[u8]) -> Entry {
        let mut writer = TarWriter::new(Vec::new());
        writer.write_file(entry, content, &mut [0; 64]).unwrap();
        let bytes = writer.finish().unwrap();
        assert_eq!(bytes.len() % BLOCK, 0);
        let mut reader = TarReader::new(&bytes[..]);
        let read = reader.next_entry().unwrap().unwrap();
        let mut found = Vec::new();
        reader.read_to_end(&mut found).unwrap();
        assert_eq!(found, content);
        assert!(reader.next_entry().unwrap().is_none());
        read
    }

    #[test]
    fn what_is_written_is_read() {
        let mut entry = Entry::new(*b"bin/sudo", Kind::File, 0o4755);
        (entry.uid, entry.gid, entry.mtime, entry.size) = (0, 42, 1_700_000_000, 5);
        assert_eq!(round_trip(&entry, b"hello"), entry);
    }

    #[test]
    fn what_ustar_has_no_room_for_is_read_too() {
        for length in [100, 101, 980, 990, 1000, 4000] {
            let mut entry = Entry::new(vec![b'n'; length], Kind::File, 0o644);
            (entry.uid, entry.gid) = (3_000_000, 4_000_000_000);
            entry.xattrs = vec![(b"user.x".to_vec(), b"\0\n=\xff".to_vec())];
            assert_eq!(round_trip(&entry, b""), entry);
        }
        let mut link = Entry::new(*b"l", Kind::Symlink, 0o777);
        link.link = vec![b't'; 300];
        assert_eq!(round_trip(&link, b""), link);
    }
}
