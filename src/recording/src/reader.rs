//! Reads messages in the order of the file, a chunk at a time: a file may be larger than memory, and may break off.

use std::collections::HashMap;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use mcap::McapError;
use mcap::records::Record;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};

use crate::Error;

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
    ///
    /// # Errors
    /// [`Error::Unreadable`].
    pub fn open(path: &Path) -> Result<Self, Error> {
        let file = File::open(path).map_err(|reason| Error::Unreadable {
            path: path.to_owned(),
            reason,
        })?;
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
    /// [`Error::Unreadable`], [`Error::NoRecording`], [`Error::Broken`].
    pub fn next_message(&mut self) -> Result<Option<Played>, Error> {
        let path = &self.path;
        let broken = |reason: String| Error::Broken {
            path: path.clone(),
            reason,
        };
        let unreadable = |error: McapError| match error {
            McapError::BadMagic => Error::NoRecording { path: path.clone() },
            error => broken(error.to_string()),
        };
        while !self.ended {
            match self.records.next_event() {
                None => self.ended = true,
                Some(Ok(LinearReadEvent::ReadRequest(wanted))) => {
                    let read = self.file.read(self.records.insert(wanted));
                    let read = read.map_err(|reason| Error::Unreadable {
                        path: path.clone(),
                        reason,
                    })?;
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
                            let channel = channel.ok_or_else(|| {
                                let id = header.channel_id;
                                broken(format!(
                                    "it has a message of channel {id}, and does not describe that"
                                ))
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
