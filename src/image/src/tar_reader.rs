//! Reads tar streams (ustar, GNU and pax) entry by entry, from whoever sent them.
//!
//! Not the `tar` crate's reader: weighed again at its version 0.4.46, it reads an extended header into memory whatever its
//! size, and takes a stream without an end mark for complete. Neither can be mended from outside, since it reads
//! extended headers before it gives an entry; in raw mode, which gives them one by one, it ignores the sizes that pax states. Only its
//! header fields are used here.

use std::io::{self, Read};

use tar::Header;

use crate::Refusal;
use crate::entry::{Entry, Kind, shown};

const BLOCK: usize = 512;

/// The most bytes in all extended headers of one entry: far beyond a path and all attributes a file can have (64 KiB each name).
const MAX_EXTENSION: u64 = 1 << 20;

/// The most extended headers of one entry. Writers need three: a pax header, and GNU's for a name and for a link.
const MAX_EXTENSIONS: u64 = 8;

/// Why reading stopped.
#[derive(Debug)]
pub(crate) enum Stop {
    /// The source failed.
    Source(io::Error),
    /// The archive is at fault.
    Refused(Refusal),
}

impl From<Refusal> for Stop {
    fn from(refusal: Refusal) -> Self {
        Self::Refused(refusal)
    }
}

/// The entries of a stream; reading from it gives the content of the entry that `next_entry` gave last.
pub(crate) struct TarReader<R> {
    input: R,
    /// Content of the present entry that was not read yet.
    remaining: u64,
    /// Zero bytes that fill up its last block.
    padding: u64,
    /// Headers that were read, extended ones among them.
    headers: u64,
    /// For messages: the entry being read.
    last: Vec<u8>,
}

/// What extended headers say about the entry that follows.
#[derive(Default)]
struct Extension {
    /// How many there were.
    headers: u64,
    /// Bytes in them.
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
        Self {
            input,
            remaining: 0,
            padding: 0,
            headers: 0,
            last: Vec::new(),
        }
    }

    /// How many headers were read, extended ones among them: each takes as much work as an entry.
    pub(crate) fn headers(&self) -> u64 {
        self.headers
    }

    /// The next entry; none at the end mark. What was not read of the present one is skipped.
    pub(crate) fn next_entry(&mut self) -> Result<Option<Entry>, Stop> {
        let mut extension = Extension::default();
        loop {
            self.skip_content()?;
            let Some(header) = self.header()? else {
                return Ok(None);
            };
            let size = header.entry_size().map_err(|error| self.malformed(error))?;
            let kind = header.entry_type().as_byte();
            if matches!(kind, b'L' | b'K' | b'x' | b'g') {
                extension.headers += 1;
                if extension.headers > MAX_EXTENSIONS {
                    let problem =
                        format!("an entry of more than {MAX_EXTENSIONS} extended headers");
                    return Err(self.malformed(problem));
                }
            }
            match kind {
                b'L' => extension.name = Some(self.long_name(size, &mut extension.bytes)?),
                b'K' => extension.link = Some(self.long_name(size, &mut extension.bytes)?),
                b'x' => {
                    let records = self.extension(size, &mut extension.bytes)?;
                    self.pax(&records, &mut extension)?;
                }
                // Global headers carry comments (git archive); nobody puts paths there.
                b'g' => self.expect(size),
                b'S' => {
                    return Err(self.malformed("sparse files are not read; pack without --sparse"));
                }
                _ => return self.entry(&header, size, extension).map(Some),
            }
        }
    }

    /// The stream itself.
    pub(crate) fn source(&mut self) -> &mut R {
        &mut self.input
    }

    /// Gives the stream back, positioned after the end mark's first block.
    pub(crate) fn into_inner(self) -> R {
        self.input
    }

    /// What a failed read of content means.
    pub(crate) fn stop(&self, error: io::Error) -> Stop {
        match error.kind() {
            io::ErrorKind::UnexpectedEof => Stop::Refused(Refusal::Truncated {
                after: shown(&self.last),
            }),
            // flate2 reports a corrupt stream so.
            io::ErrorKind::InvalidInput | io::ErrorKind::InvalidData => self.malformed(error),
            _ => Stop::Source(error),
        }
    }

    fn malformed(&self, problem: impl ToString) -> Stop {
        Stop::Refused(Refusal::Malformed {
            after: shown(&self.last),
            problem: problem.to_string(),
        })
    }

    fn expect(&mut self, size: u64) {
        self.remaining = size;
        self.padding = (BLOCK as u64 - size % BLOCK as u64) % BLOCK as u64;
    }

    fn skip_content(&mut self) -> Result<(), Stop> {
        let rest = self.remaining.saturating_add(self.padding);
        (self.remaining, self.padding) = (0, 0);
        if rest == 0 {
            return Ok(());
        }
        let skipped = io::copy(&mut (&mut self.input).take(rest), &mut io::sink());
        match skipped {
            Ok(skipped) if skipped == rest => Ok(()),
            Ok(_) => Err(self.stop(io::ErrorKind::UnexpectedEof.into())),
            Err(error) => Err(self.stop(error)),
        }
    }

    fn header(&mut self) -> Result<Option<Header>, Stop> {
        let mut header = Header::new_old();
        let block = header.as_mut_bytes();
        if let Err(error) = self.input.read_exact(block) {
            return Err(self.stop(error));
        }
        if block.iter().all(|&byte| byte == 0) {
            return Ok(None);
        }
        self.headers += 1;
        // The sum is taken with the eight bytes of its own field as spaces.
        let sum: u32 = block[..148]
            .iter()
            .chain(&block[156..])
            .map(|&byte| u32::from(byte))
            .sum::<u32>()
            + 8 * 32;
        match header.cksum() {
            Ok(stated) if stated == sum => Ok(Some(header)),
            _ => Err(self.malformed("a header's checksum is wrong")),
        }
    }

    /// The content of an extended header; `sum` counts those of one entry.
    fn extension(&mut self, size: u64, sum: &mut u64) -> Result<Vec<u8>, Stop> {
        *sum = sum.saturating_add(size);
        if *sum > MAX_EXTENSION {
            let problem = format!("an entry with extended headers of {sum} bytes");
            return Err(self.malformed(problem));
        }
        self.expect(size);
        let mut bytes = vec![0; size as usize];
        if let Err(error) = self.read_exact(&mut bytes) {
            return Err(self.stop(error));
        }
        Ok(bytes)
    }

    fn long_name(&mut self, size: u64, sum: &mut u64) -> Result<Vec<u8>, Stop> {
        let mut name = self.extension(size, sum)?;
        if name.last() == Some(&0) {
            name.pop();
        }
        Ok(name)
    }

    /// POSIX pax records: `LENGTH KEY=VALUE\n`, LENGTH counting all of it.
    fn pax(&self, mut records: &[u8], extension: &mut Extension) -> Result<(), Stop> {
        while !records.is_empty() {
            let record =
                pax_record(records).ok_or_else(|| self.malformed("a pax record does not parse"))?;
            let (key, value) = (record.key, record.value);
            let number = || {
                let whole = value.split(|&byte| byte == b'.').next().unwrap_or(value);
                std::str::from_utf8(whole)
                    .ok()?
                    .parse::<i64>()
                    .ok()
                    .map(|number| number.max(0) as u64)
            };
            let required = || {
                number().ok_or_else(|| self.malformed(format!("pax {} is no number", shown(key))))
            };
            match key {
                b"path" => extension.name = Some(value.to_vec()),
                b"linkpath" => extension.link = Some(value.to_vec()),
                b"size" => extension.size = Some(required()?),
                b"uid" => extension.uid = Some(required()?),
                b"gid" => extension.gid = Some(required()?),
                b"mtime" => extension.mtime = number(),
                key if key.starts_with(b"GNU.sparse.") => {
                    return Err(self.malformed("sparse files are not read; pack without --sparse"));
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

    fn entry(&mut self, header: &Header, size: u64, extension: Extension) -> Result<Entry, Stop> {
        let name = extension
            .name
            .unwrap_or_else(|| header.path_bytes().into_owned());
        self.last.clone_from(&name);
        let mut kind = Kind::from_typeflag(header.entry_type().as_byte());
        if kind == Kind::File && name.last() == Some(&b'/') {
            kind = Kind::Directory;
        }
        let link = extension
            .link
            .or_else(|| header.link_name_bytes().map(|link| link.into_owned()));
        let device = |number: io::Result<Option<u32>>| number.ok().flatten().unwrap_or(0);
        // Left blank means 0, as GNU tar reads it.
        let blank = |raw: &[u8]| raw.iter().all(|byte| matches!(byte, 0 | b' '));
        let field = |raw: &[u8], value: io::Result<u64>| match value {
            Err(_) if blank(raw) => Ok(0),
            value => value.map_err(|error| self.malformed(error)),
        };
        let old = header.as_old();
        let entry = Entry {
            kind,
            link: link.unwrap_or_default(),
            mode: header.mode().map_err(|error| self.malformed(error))? & 0o7777,
            uid: extension
                .uid
                .map_or_else(|| field(&old.uid, header.uid()), Ok)?,
            gid: extension
                .gid
                .map_or_else(|| field(&old.gid, header.gid()), Ok)?,
            mtime: extension
                .mtime
                .unwrap_or_else(|| header.mtime().unwrap_or(0)),
            // Links and directories carry no content, though some writers state the target's size.
            size: if kind == Kind::File {
                extension.size.unwrap_or(size)
            } else {
                0
            },
            device: (device(header.device_major()), device(header.device_minor())),
            xattrs: extension.xattrs,
            name,
        };
        match kind {
            Kind::File | Kind::Other(_) => self.expect(extension.size.unwrap_or(size)),
            _ => self.expect(0),
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
    Some(PaxRecord {
        key: &body[..equals],
        value: &body[equals + 1..],
        rest: &records[length..],
    })
}

impl<R: Read> Read for TarReader<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let most = buffer
            .len()
            .min(usize::try_from(self.remaining).unwrap_or(usize::MAX));
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
