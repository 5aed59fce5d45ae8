//! Reader of untrusted tar streams (ustar, GNU and pax).
//!
//! The reader of the `tar` crate is not used: as of version 0.4.46 it reads an extended header into memory regardless
//! of its size, and accepts a stream without an end mark as complete. Neither can be fixed from outside, since it reads
//! extended headers before it returns an entry; in raw mode, which returns them one by one, it ignores sizes in pax
//! headers. Only its header fields are used here.

use std::io::{self, Read};

use tar::Header;

use crate::Refusal;
use crate::entry::{Entry, Kind, display_name};

const BLOCK: usize = 512;

/// Maximum total size of the extended headers of one entry: far more than a path and all attributes of a file (64 KiB
/// for each name).
const MAX_EXTENSION: u64 = 1 << 20;

/// Maximum number of extended headers of one entry. Writers need three: a pax header, and GNU headers for a name and
/// for a link.
const MAX_EXTENSIONS: u64 = 8;

/// Reason why reading stopped.
#[derive(Debug)]
pub(crate) enum ReadStop {
    /// The source failed.
    Source(io::Error),
    /// The archive is invalid.
    Refused(Refusal),
}

impl From<Refusal> for ReadStop {
    fn from(refusal: Refusal) -> Self {
        Self::Refused(refusal)
    }
}

/// Reader of the entries of a stream; as a [`Read`] it returns the content of the entry last returned by `next_entry`.
pub(crate) struct TarReader<R> {
    input: R,
    /// Unread bytes of the current entry's content.
    remaining: u64,
    /// Padding bytes of the current entry's last block.
    padding: u64,
    /// Number of headers read, including extended ones.
    headers: u64,
    /// Name of the current entry, for messages.
    last: Vec<u8>,
}

/// Extended headers of the following entry.
#[derive(Default)]
struct ExtendedHeaders {
    /// Number of headers.
    headers: u64,
    /// Total size in bytes.
    bytes: u64,
    name: Option<Vec<u8>>,
    link: Option<Vec<u8>>,
    size: Option<u64>,
    uid: Option<u64>,
    gid: Option<u64>,
    mtime: Option<u64>,
    xattrs: Vec<(Vec<u8>, Vec<u8>)>,
}

impl<R: Read> TarReader<R> {
    pub(crate) fn new(input: R) -> Self {
        Self { input, remaining: 0, padding: 0, headers: 0, last: Vec::new() }
    }

    /// Returns the number of headers read, including extended ones, each of which costs as much work as an entry.
    pub(crate) fn headers(&self) -> u64 {
        self.headers
    }

    /// Returns the next entry; `None` at the end mark. Unread content of the current one is skipped.
    pub(crate) fn next_entry(&mut self) -> Result<Option<Entry>, ReadStop> {
        let mut extension = ExtendedHeaders::default();
        loop {
            self.skip_content()?;
            let Some(header) = self.read_header()? else {
                return Ok(None);
            };
            let size = header.entry_size().map_err(|error| self.malformed_archive(error))?;
            let kind = header.entry_type().as_byte();
            if matches!(kind, b'L' | b'K' | b'x' | b'g') {
                extension.headers += 1;
                if extension.headers > MAX_EXTENSIONS {
                    let problem = format!("an entry of more than {MAX_EXTENSIONS} extended headers");
                    return Err(self.malformed_archive(problem));
                }
            }
            match kind {
                b'L' => extension.name = Some(self.read_long_name(size, &mut extension.bytes)?),
                b'K' => extension.link = Some(self.read_long_name(size, &mut extension.bytes)?),
                b'x' => {
                    let records = self.read_extension(size, &mut extension.bytes)?;
                    self.apply_pax_records(&records, &mut extension)?;
                }
                // Global headers contain comments (git archive); nobody puts paths there.
                b'g' => self.begin_content(size),
                b'S' => {
                    return Err(self.malformed_archive("sparse files are not supported; pack without --sparse"));
                }
                _ => return self.build_entry(&header, size, extension).map(Some),
            }
        }
    }

    /// Returns the underlying stream.
    pub(crate) fn source(&mut self) -> &mut R {
        &mut self.input
    }

    /// Returns the underlying stream, positioned after the first block of the end mark.
    pub(crate) fn into_inner(self) -> R {
        self.input
    }

    /// Classifies the error of a failed read of content.
    pub(crate) fn classify_error(&self, error: io::Error) -> ReadStop {
        match error.kind() {
            io::ErrorKind::UnexpectedEof => ReadStop::Refused(Refusal::Truncated { after: display_name(&self.last) }),
            // flate2 reports a corrupt stream this way.
            io::ErrorKind::InvalidInput | io::ErrorKind::InvalidData => self.malformed_archive(error),
            _ => ReadStop::Source(error),
        }
    }

    fn malformed_archive(&self, problem: impl ToString) -> ReadStop {
        ReadStop::Refused(Refusal::Malformed { after: display_name(&self.last), problem: problem.to_string() })
    }

    fn begin_content(&mut self, size: u64) {
        self.remaining = size;
        self.padding = (BLOCK as u64 - size % BLOCK as u64) % BLOCK as u64;
    }

    fn skip_content(&mut self) -> Result<(), ReadStop> {
        let rest = self.remaining.saturating_add(self.padding);
        (self.remaining, self.padding) = (0, 0);
        if rest == 0 {
            return Ok(());
        }
        let skipped = io::copy(&mut (&mut self.input).take(rest), &mut io::sink());
        match skipped {
            Ok(skipped) if skipped == rest => Ok(()),
            Ok(_) => Err(self.classify_error(io::ErrorKind::UnexpectedEof.into())),
            Err(error) => Err(self.classify_error(error)),
        }
    }

    fn read_header(&mut self) -> Result<Option<Header>, ReadStop> {
        let mut header = Header::new_old();
        let block = header.as_mut_bytes();
        if let Err(error) = self.input.read_exact(block) {
            return Err(self.classify_error(error));
        }
        if block.iter().all(|&byte| byte == 0) {
            return Ok(None);
        }
        self.headers += 1;
        // The checksum treats the eight bytes of its own field as spaces.
        let sum: u32 = block[..148].iter().chain(&block[156..]).map(|&byte| u32::from(byte)).sum::<u32>() + 8 * 32;
        match header.cksum() {
            Ok(stated) if stated == sum => Ok(Some(header)),
            _ => Err(self.malformed_archive("a header has a wrong checksum")),
        }
    }

    /// Reads the content of an extended header; `sum` is the total of the entry.
    fn read_extension(&mut self, size: u64, sum: &mut u64) -> Result<Vec<u8>, ReadStop> {
        *sum = sum.saturating_add(size);
        if *sum > MAX_EXTENSION {
            let problem = format!("an entry with extended headers of {sum} bytes");
            return Err(self.malformed_archive(problem));
        }
        self.begin_content(size);
        let mut bytes = vec![0; size as usize];
        if let Err(error) = self.read_exact(&mut bytes) {
            return Err(self.classify_error(error));
        }
        Ok(bytes)
    }

    fn read_long_name(&mut self, size: u64, sum: &mut u64) -> Result<Vec<u8>, ReadStop> {
        let mut name = self.read_extension(size, sum)?;
        if name.last() == Some(&0) {
            name.pop();
        }
        Ok(name)
    }

    /// Parses POSIX pax records: `LENGTH KEY=VALUE `, where LENGTH includes all of it.
    fn apply_pax_records(&self, mut records: &[u8], extension: &mut ExtendedHeaders) -> Result<(), ReadStop> {
        while !records.is_empty() {
            let record = pax_record(records).ok_or_else(|| self.malformed_archive("invalid pax record"))?;
            let (key, value) = (record.key, record.value);
            let number = || {
                let whole = value.split(|&byte| byte == b'.').next().unwrap_or(value);
                std::str::from_utf8(whole).ok()?.parse::<i64>().ok().map(|number| number.max(0) as u64)
            };
            let required =
                || number().ok_or_else(|| self.malformed_archive(format!("pax {} is not a number", display_name(key))));
            match key {
                b"path" => extension.name = Some(value.to_vec()),
                b"linkpath" => extension.link = Some(value.to_vec()),
                b"size" => extension.size = Some(required()?),
                b"uid" => extension.uid = Some(required()?),
                b"gid" => extension.gid = Some(required()?),
                b"mtime" => extension.mtime = number(),
                key if key.starts_with(b"GNU.sparse.") => {
                    return Err(self.malformed_archive("sparse files are not supported; pack without --sparse"));
                }
                key => {
                    if let Some(name) = key.strip_prefix(b"SCHILY.xattr.") {
                        extension.xattrs.push((name.to_vec(), value.to_vec()));
                    }
                }
            }
            records = record.rest;
        }
        Ok(())
    }

    fn build_entry(&mut self, header: &Header, size: u64, extension: ExtendedHeaders) -> Result<Entry, ReadStop> {
        let name = extension.name.unwrap_or_else(|| header.path_bytes().into_owned());
        self.last.clone_from(&name);
        let mut kind = Kind::from_typeflag(header.entry_type().as_byte());
        if kind == Kind::File && name.last() == Some(&b'/') {
            kind = Kind::Directory;
        }
        let link = extension.link.or_else(|| header.link_name_bytes().map(|link| link.into_owned()));
        let device = |number: io::Result<Option<u32>>| number.ok().flatten().unwrap_or(0);
        // Blank means 0, as in GNU tar.
        let blank = |raw: &[u8]| raw.iter().all(|byte| matches!(byte, 0 | b' '));
        let field = |raw: &[u8], value: io::Result<u64>| match value {
            Err(_) if blank(raw) => Ok(0),
            value => value.map_err(|error| self.malformed_archive(error)),
        };
        let old = header.as_old();
        let entry = Entry {
            kind,
            link: link.unwrap_or_default(),
            mode: header.mode().map_err(|error| self.malformed_archive(error))? & 0o7777,
            uid: extension.uid.map_or_else(|| field(&old.uid, header.uid()), Ok)?,
            gid: extension.gid.map_or_else(|| field(&old.gid, header.gid()), Ok)?,
            mtime: extension.mtime.unwrap_or_else(|| header.mtime().unwrap_or(0)),
            // Links and directories have no content, though some writers store the target's size.
            size: if kind == Kind::File { extension.size.unwrap_or(size) } else { 0 },
            device: (device(header.device_major()), device(header.device_minor())),
            xattrs: extension.xattrs,
            name,
        };
        match kind {
            Kind::File | Kind::Other(_) => self.begin_content(extension.size.unwrap_or(size)),
            _ => self.begin_content(0),
        }
        Ok(entry)
    }
}

struct PaxRecord<'a> {
    key: &'a [u8],
    value: &'a [u8],
    rest: &'a [u8],
}

fn pax_record(records: &[u8]) -> Option<PaxRecord<'_>> {
    let space = records.iter().position(|&byte| byte == b' ')?;
    let length: usize = std::str::from_utf8(&records[..space]).ok()?.parse().ok()?;
    let body = records.get(space + 1..length)?.strip_suffix(b"\n")?;
    let equals = body.iter().position(|&byte| byte == b'=')?;
    Some(PaxRecord { key: &body[..equals], value: &body[equals + 1..], rest: &records[length..] })
}

impl<R: Read> Read for TarReader<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let most = buffer.len().min(usize::try_from(self.remaining).unwrap_or(usize::MAX));
        if most == 0 {
            return Ok(0);
        }
        let read = self.input.read(&mut buffer[..most])?;
        if read == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        self.remaining -= read as u64;
        Ok(read)
    }
}

#[cfg(test)]
pub(crate) mod tests;
