//! MCAP reader. Returns messages in file order, one chunk at a time, because a file may be larger than memory and may
//! be truncated.

use std::collections::HashMap;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use mcap::McapError;
use mcap::records::Record;
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};

use crate::Error;

/// Maximum size of a record in bytes; a larger one cannot be a message.
const LARGEST: usize = 1 << 30;

/// An MCAP file being read.
pub struct RecordingReader {
    path: PathBuf,
    file: File,
    records: LinearReader,
    schemas: HashMap<u16, String>,
    channels: HashMap<u16, ChannelInfo>,
    ended: bool,
    breaks_off: bool,
}

#[derive(Clone)]
struct ChannelInfo {
    topic: String,
    encoding: String,
    schema: u16,
}

/// A message of a file.
#[derive(Debug)]
pub struct RecordedMessage {
    /// Topic on which the message was recorded.
    pub topic: String,
    /// Message type, `package/Type`.
    pub of: String,
    /// Encoding: `ros1` or `cdr`.
    pub encoding: String,
    /// Time of recording in nanoseconds since 1970.
    pub time: u64,
    /// Serialized message.
    pub message: Vec<u8>,
}

impl RecordingReader {
    /// Opens a file.
    ///
    /// # Errors
    /// [`Error::Unreadable`].
    pub fn open(path: &Path) -> Result<Self, Error> {
        let file = File::open(path).map_err(|reason| Error::Unreadable { path: path.to_owned(), reason })?;
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

    /// Returns true if the file turned out to be truncated.
    pub fn is_truncated(&self) -> bool {
        self.breaks_off
    }

    /// Returns the next message, or `None` at the end of the file.
    ///
    /// # Errors
    /// [`Error::Unreadable`], [`Error::NoRecording`], [`Error::Broken`].
    pub fn next_message(&mut self) -> Result<Option<RecordedMessage>, Error> {
        let path = &self.path;
        let broken = |reason: String| Error::Broken { path: path.clone(), reason };
        let unreadable = |error: McapError| match error {
            McapError::BadMagic => Error::NoRecording { path: path.clone() },
            error => broken(error.to_string()),
        };
        while !self.ended {
            match self.records.next_event() {
                None => self.ended = true,
                Some(Ok(LinearReadEvent::ReadRequest(wanted))) => {
                    let read = self.file.read(self.records.insert(wanted));
                    let read = read.map_err(|reason| Error::Unreadable { path: path.clone(), reason })?;
                    self.records.notify_read(read);
                }
                Some(Ok(LinearReadEvent::Record { data, opcode })) => {
                    match mcap::parse_record(opcode, data).map_err(unreadable)? {
                        Record::Schema { header, .. } => {
                            self.schemas.insert(header.id, header.name);
                        }
                        Record::Channel(channel) => {
                            let known = ChannelInfo {
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
                                broken(format!("it has a message of channel {id}, which it does not describe"))
                            })?;
                            let of = self.schemas.get(&channel.schema);
                            return Ok(Some(RecordedMessage {
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
