//! Reads messages in the order of the file, a chunk at a time: a file may be larger than memory, and may break off.

use std::collections::HashMap;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use mcap::McapError;
use mcap::records::Record;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};

/// Bytes of a record that are read at most; more is no message.
const LARGEST: usize = 1 << 30;

/// A file that is read.
pub struct Reader {
    path: PathBuf,
    file: File,
    records: LinearReader,
    schemas: HashMap<u16, String>,
    channels: HashMap<u16, Channel>,
    ended: bool,
    breaks_off: bool,
}

#[derive(Clone)]
struct Channel {
    topic: String,
    encoding: String,
    schema: u16,
}

/// A message of a file.
#[derive(Debug)]
pub struct Played {
    /// Where it was heard.
    pub topic: String,
    /// Its type, `package/Type`.
    pub of: String,
    /// How it is written: `ros1`, `cdr`.
    pub encoding: String,
    /// When it was heard, in nanoseconds.
    pub time: u64,
    /// Its bytes.
    pub message: Vec<u8>,
}

impl Reader {
    /// Opens a file.
    pub fn open(path: &Path) -> anyhow::Result<Self> {
        let file =
            File::open(path).with_context(|| format!("{} cannot be read", path.display()))?;
        let options = LinearReaderOptions::default().with_record_length_limit(LARGEST);
        Ok(Self {
            path: path.to_owned(),
            file,
            records: LinearReader::new_with_options(options),
            schemas: HashMap::new(),
            channels: HashMap::new(),
            ended: false,
            breaks_off: false,
        })
    }

    /// Whether the file broke off where it was read to.
    pub fn breaks_off(&self) -> bool {
        self.breaks_off
    }

    /// The next message.
    ///
    /// # Errors
    /// It cannot be read, or is no MCAP file.
    pub fn next(&mut self) -> anyhow::Result<Option<Played>> {
        let unreadable = |error: McapError| match error {
            McapError::BadMagic => anyhow!(
                "{} is no MCAP file; cloudroidctl record writes such, and `mcap convert` makes one of a bag",
                self.path.display()
            ),
            error => anyhow!("{} cannot be read on: {error}", self.path.display()),
        };
        while !self.ended {
            match self.records.next_event() {
                None => self.ended = true,
                Some(Ok(LinearReadEvent::ReadRequest(wanted))) => {
                    let read = self.file.read(self.records.insert(wanted));
                    let read =
                        read.with_context(|| format!("{} cannot be read", self.path.display()))?;
                    self.records.notify_read(read);
                }
                Some(Ok(LinearReadEvent::Record { data, opcode })) => {
                    match mcap::parse_record(opcode, data).map_err(unreadable)? {
                        Record::Schema { header, .. } => {
                            self.schemas.insert(header.id, header.name);
                        }
                        Record::Channel(channel) => {
                            let known = Channel {
                                topic: channel.topic,
                                encoding: channel.message_encoding,
                                schema: channel.schema_id,
                            };
                            self.channels.insert(channel.id, known);
                        }
                        Record::Message { header, data } => {
                            let channel = self.channels.get(&header.channel_id).cloned();
                            let channel = channel.with_context(|| {
                                format!(
                                    "{} has a message of channel {}, which it does not describe",
                                    self.path.display(),
                                    header.channel_id
                                )
                            })?;
                            let of = self.schemas.get(&channel.schema);
                            return Ok(Some(Played {
                                topic: channel.topic,
                                of: of.cloned().unwrap_or_default(),
                                encoding: channel.encoding,
                                time: header.log_time,
                                message: data.into_owned(),
                            }));
                        }
                        _ => {}
                    }
                }
                Some(Err(McapError::UnexpectedEof | McapError::UnexpectedEoc)) => {
                    self.breaks_off = true;
                    self.ended = true;
                }
                Some(Err(error)) => return Err(unreadable(error)),
            }
        }
        Ok(None)
    }
}
