//! MCAP writer. The recorder flushes it every second, so that the file is readable up to the last flush, however the
//! process ends.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{self, Cursor, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use mcap::records::MessageHeader;
use mcap::{McapError, WriteOptions};
use serde::Serialize;

use crate::{Error, RecordingFormat};

/// An MCAP file being written.
pub struct RecordingWriter {
    path: PathBuf,
    format: RecordingFormat,
    /// Second handle to the file, used to query its size: the process may lack permission to look into the directory.
    asked: File,
    file: mcap::Writer<ChunkedFile>,
    topics: BTreeMap<u16, ChannelTotals>,
    /// Bytes of messages since the last flush.
    pending: usize,
}

/// Number of pending bytes above which the writer flushes.
const PENDING: usize = 8 << 20;

struct ChannelTotals {
    name: String,
    of: String,
    messages: u32,
    bytes: u64,
}

/// Summary of a finished file.
#[derive(Debug, Serialize)]
pub struct Summary {
    /// Path of the file.
    pub file: PathBuf,
    /// File size in bytes.
    pub size: u64,
    /// Number of messages on all topics.
    pub messages: u64,
    /// Summary of each topic, sorted by name.
    pub topics: Vec<TopicSummary>,
}

/// Summary of one topic.
#[derive(Debug, Serialize)]
pub struct TopicSummary {
    /// Name of the topic.
    pub topic: String,
    /// Message type, `package/Type`.
    #[serde(rename = "type")]
    pub of: String,
    /// Number of messages.
    pub messages: u32,
    /// Size of the messages in bytes, uncompressed.
    pub bytes: u64,
}

impl RecordingWriter {
    /// Creates a file that must not exist yet.
    ///
    /// # Errors
    /// [`Error::NotMade`], [`Error::Unwritable`].
    pub fn create(path: &Path, format: RecordingFormat) -> Result<Self, Error> {
        let mut options = OpenOptions::new();
        let file = options.write(true).create_new(true).open(path);
        let file = file.map_err(|reason| Error::NotMade { path: path.to_owned(), reason })?;
        Self::from_file(path, file, format)
    }

    /// Writes to `file`, which is empty and located at `path`.
    ///
    /// # Errors
    /// [`Error::Unwritable`].
    pub fn from_file(path: &Path, file: File, format: RecordingFormat) -> Result<Self, Error> {
        let asked = file.try_clone().map_err(|reason| Error::NotMade { path: path.to_owned(), reason })?;
        let options =
            WriteOptions::new().profile(format.profile()).library(concat!("cloudroid ", env!("CARGO_PKG_VERSION")));
        let file = options.create(ChunkedFile::new(file)).map_err(write_error(path))?;
        Ok(Self { path: path.to_owned(), format, asked, file, topics: BTreeMap::new(), pending: 0 })
    }

    /// Returns the channel of a topic whose messages have type `of` with the given `definition`.
    ///
    /// # Errors
    /// [`Error::Unwritable`], like the methods below.
    pub fn add_channel(&mut self, topic: &str, of: &str, definition: &[u8]) -> Result<u16, Error> {
        let schema = self.file.add_schema(of, self.format.schema(), definition);
        let schema = schema.map_err(write_error(&self.path))?;
        let encoding = self.format.encoding();
        let channel = self.file.add_channel(schema, topic, encoding, &BTreeMap::new());
        let channel = channel.map_err(write_error(&self.path))?;
        self.topics.entry(channel).or_insert_with(|| ChannelTotals {
            name: topic.to_owned(),
            of: of.to_owned(),
            messages: 0,
            bytes: 0,
        });
        Ok(channel)
    }

    /// Adds a message received at `time`, in nanoseconds since 1970.
    pub fn add_message(&mut self, channel_id: u16, time: u64, message: &[u8]) -> Result<(), Error> {
        let mut sequence = 0;
        if let Some(topic) = self.topics.get_mut(&channel_id) {
            sequence = topic.messages;
            topic.messages += 1;
            topic.bytes += message.len() as u64;
        }
        let header = MessageHeader { channel_id, sequence, log_time: time, publish_time: time };
        let written = self.file.write_to_known_channel(&header, message);
        written.map_err(write_error(&self.path))?;
        self.pending += message.len();
        if self.pending > PENDING { self.flush() } else { Ok(()) }
    }

    /// Flushes pending messages to the file.
    ///
    /// # Errors
    /// [`Error::Unwritable`].
    pub fn flush(&mut self) -> Result<(), Error> {
        self.pending = 0;
        self.file.flush().map_err(write_error(&self.path))
    }

    /// Returns the number of messages written so far.
    pub fn messages(&self) -> u64 {
        let all = self.topics.values();
        all.map(|topic| u64::from(topic.messages)).sum()
    }

    /// Finishes the file with its index.
    pub fn finish(mut self) -> Result<Summary, Error> {
        self.file.finish().map_err(write_error(&self.path))?;
        let messages = self.messages();
        let mut topics: Vec<_> = self
            .topics
            .into_values()
            .map(|topic| TopicSummary { topic: topic.name, of: topic.of, messages: topic.messages, bytes: topic.bytes })
            .collect();
        topics.sort_by(|a, b| a.topic.cmp(&b.topic));
        let size = self.asked.metadata().map_or(0, |found| found.len());
        Ok(Summary { file: self.path, size, messages, topics })
    }
}

/// File to which only whole chunks are written, by `flush`. A chunk cut short, with a length of zero, could not be
/// read, and some programs could not read what precedes it either.
struct ChunkedFile {
    file: File,
    /// Offset of the end of the file.
    end: u64,
    next: Cursor<Vec<u8>>,
}

impl ChunkedFile {
    fn new(file: File) -> Self {
        Self { file, end: 0, next: Cursor::default() }
    }
}

impl Write for ChunkedFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.next.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        let next = std::mem::take(&mut self.next).into_inner();
        self.end += next.len() as u64;
        self.file.write_all(&next)
    }
}

impl Seek for ChunkedFile {
    /// Seeks within the data that was not flushed yet.
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let to = match to {
            SeekFrom::Start(at) => match at.checked_sub(self.end) {
                Some(at) => SeekFrom::Start(at),
                None => return Err(io::ErrorKind::InvalidInput.into()),
            },
            other => other,
        };
        Ok(self.end + self.next.seek(to)?)
    }
}

fn write_error(path: &Path) -> impl FnOnce(McapError) -> Error {
    |reason| Error::Unwritable { path: path.to_owned(), reason }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::RecordingReader;

    #[test]
    fn a_file_of_ros_2_says_so() {
        let place = tempfile::tempdir().expect("a directory");
        let path = place.path().join("two.mcap");
        let mut writer = RecordingWriter::create(&path, RecordingFormat::Ros2).expect("a new file");
        let channel = writer.add_channel("/chatter", "std_msgs/msg/String", b"string data");
        let message = [0, 1, 0, 0, 2, 0, 0, 0, b'a', 0];
        writer.add_message(channel.expect("a channel"), 7, &message).expect("is written");
        writer.finish().expect("an end");
        let bytes = std::fs::read(&path).expect("it is there");
        // Magic, opcode and length of the header, then its first string.
        assert_eq!(&bytes[17..25], b"\x04\0\0\0ros2");
        let summary = mcap::Summary::read(&bytes).expect("it is whole").expect("a summary");
        let channel = summary.channels.values().next().expect("a channel");
        assert_eq!(channel.message_encoding, "cdr");
        let schema = channel.schema.as_ref().expect("a schema");
        assert_eq!((&*schema.name, &*schema.encoding), ("std_msgs/msg/String", "ros2msg"));
        let mut reader = RecordingReader::open(&path).expect("it opens");
        let played = reader.next_message().expect("it is read").expect("a message");
        assert_eq!(RecordingFormat::from_encoding(&played.encoding), Some(RecordingFormat::Ros2));
        assert_eq!((played.time, &*played.message), (7, &message[..]));
    }

    #[test]
    fn what_is_written_is_read_and_a_file_that_breaks_off_up_to_there() {
        let place = tempfile::tempdir().expect("a directory");
        let path = place.path().join("x.mcap");
        let mut writer = RecordingWriter::create(&path, RecordingFormat::Ros1).expect("a new file");
        let text = writer.add_channel("/chatter", "std_msgs/String", b"string data");
        let text = text.expect("a channel");
        let same = writer.add_channel("/chatter", "std_msgs/String", b"string data");
        assert_eq!(same.expect("the same"), text);
        for time in 1..=3 {
            let message = format!("word {time}");
            writer.add_message(text, time, message.as_bytes()).expect("is written");
        }
        writer.flush().expect("is written");
        // Messages after this point, in no complete chunk, would be lost if the writer ended here.
        for time in 4..1000 {
            writer.add_message(text, time, &[b'x'; 1000]).expect("is written");
        }
        let cut = place.path().join("cut.mcap");
        std::fs::copy(&path, &cut).expect("a copy");
        let summary = writer.finish().expect("an end");
        assert_eq!((summary.messages, summary.topics[0].messages), (999, 999));
        assert_eq!(summary.topics[0].bytes, 3 * 6 + 996 * 1000);

        let read = |path: &Path| {
            let mut reader = RecordingReader::open(path).expect("it opens");
            let mut found = Vec::new();
            while let Some(played) = reader.next_message().expect("it is read") {
                assert_eq!(played.topic, "/chatter");
                assert_eq!(played.of, "std_msgs/String");
                found.push((played.time, played.message.to_vec()));
            }
            (found, reader.is_truncated())
        };
        let words: Vec<_> = (1..=3).map(|time| (time, format!("word {time}").into_bytes())).collect();
        assert_eq!(read(&cut), (words.clone(), true));
        let (all, breaks_off) = read(&path);
        assert_eq!((&all[..3], all.len(), breaks_off), (&words[..], 999, false));
        // Wherever the file is truncated, everything before the cut is readable.
        let whole = std::fs::read(&path).expect("it is there");
        for end in (600..whole.len()).step_by(101) {
            std::fs::write(&cut, &whole[..end]).expect("is written");
            let (found, breaks_off) = read(&cut);
            assert!(breaks_off && all.starts_with(&found), "cut at {end}");
        }

        let error = RecordingWriter::create(&path, RecordingFormat::Ros1).err().expect("it is there");
        assert!(error.to_string().contains("exists"), "{error}");
    }
}
